"""Job of a worker that generates one file of frames: read the trajectory, render it, store the encoded frames."""

import platform
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline import gl
from pipeline.axes import task_of
from pipeline.compute.pool import LOST, Job
from pipeline.config import RenderConfig
from pipeline.errors import PipelineError
from pipeline.physics.quality import measure
from pipeline.planning.plan import Row
from pipeline.planning.streams import Stream
from pipeline.rendering.render import render
from pipeline.rendering.renderer import scene_of_process
from pipeline.stores.frame_store import FrameStore, merged
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Rendered, Trajectory


@dataclass(frozen=True)
class RenderJob(Job[None]):
    """Streams of one trajectory to render into one file, as they are sent to a worker.

    Attributes:
        row: a row of the plan that has this trajectory.
        device: OpenGL name of the device that renders the run.
    """

    row: Row
    streams: tuple[Stream, ...]
    trajectories: Path
    frames: Path
    render_config: RenderConfig
    device: str

    def __call__(self) -> None:
        """Store the streams in one file: copy the streams of the trajectory's other files, and render the rest.

        Raises:
            PipelineError: when another device renders here: its pixels differ, and the run would never use them.
        """
        device = gl.choose().device
        if device != self.device:
            raise PipelineError(
                f"this worker renders with {device}, but the run renders with {self.device}",
                where=f"worker on {platform.node()}",
                expected="the same device for all frames of a run, as devices differ by some grey levels",
                remedy="start the stage and every worker on machines with the same OpenGL device (MUJOCO_GL selects "
                "the back end)",
            )
        trajectory = self._trajectory()
        parts, missing = self._stored()
        if missing:
            task = task_of(self.row.suite, self.row.task, self.row.perturbations)
            if trajectory.quality is None:  # The replay of a failure stores no quality.
                trajectory = replace(trajectory, quality=measure(trajectory, task))
            parts = [*parts, render(trajectory, task, missing, self.render_config, scene_of_process())]
        self._save(parts)

    def size(self) -> int:
        """Return the largest possible number of frames."""
        return self.row.demo_steps * len(self.streams)

    def limit_s(self) -> float:
        """Return the time after which the job counts as hanging, in s: about twenty times the time without a GPU."""
        return 1800.0 + 2.0 * self.size()

    def lost(self) -> None:
        """Store that no worker survived the streams, unless a worker stored them before it was lost.

        The streams are not tried again while the file exists.
        """
        trajectory = self._trajectory()
        action, steps = trajectory.actions.astype(np.float32), len(trajectory.actions)
        state, seven = np.zeros((steps, 8), np.float32), np.zeros((steps, 7), np.float32)
        parts, missing = self._stored()
        rejected = {stream.stream_id: LOST for stream in missing}
        self._save([*parts, Rendered(trajectory.mode, state, seven, action, seven, rejected=rejected)])

    def _trajectory(self) -> Trajectory:
        return TrajectoryStore(self.trajectories).load(self.row.trajectory_id)

    def _stored(self) -> tuple[list[Rendered], list[Stream]]:
        """Read the stored streams, and list the streams that are not stored."""
        wanted = {stream.stream_id: stream.geometry.stream_id for stream in self.streams}
        parts = FrameStore(self.frames, self.render_config).stored(self.row.trajectory_id, wanted, self.device)
        held: set[str] = set()
        for part in parts:
            held |= {*part.streams, *part.rejected}
        return parts, [stream for stream in self.streams if stream.stream_id not in held]

    def _save(self, parts: list[Rendered]) -> None:
        FrameStore(self.frames, self.render_config).save(self.row.trajectory_id, merged(parts), self.device)
