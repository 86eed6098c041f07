"""Render the frames that a plan needs and a folder does not hold yet, spread over workers."""

from __future__ import annotations

import math
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline import gl
from pipeline.compute.pool import LOST, Expendable, Run
from pipeline.config import Config, RenderConfig
from pipeline.errors import PipelineError
from pipeline.libero.tasks import find_task
from pipeline.planning.plan import Row, select
from pipeline.planning.streams import Stream, streams_of
from pipeline.rendering.last_scene import scene_of_process
from pipeline.rendering.render import render, scene_of
from pipeline.run.outcome import rejections
from pipeline.stores.frame_store import FrameStore, file_name, joined, shown_of
from pipeline.stores.trajectory_store import TrajectoryStore, verdicts_of
from pipeline.types import Rendered, Task

STREAMS_OF_A_JOB = 64
"""Bounds a render job: minutes of a core, which a kill loses at most, and some 200 MB of encoded frames.

A trajectory's second job may have to open its scene once more, which takes some seconds.
"""


@dataclass(frozen=True)
class RenderJob:
    """Streams of one trajectory to render into one file, as they are sent to a worker.

    Attributes:
        trajectory_id, task, streams: what to render.
        steps: of the trajectory, at most.
        trajectories, frames: folders of the stores.
        config: how frames are encoded.
        device: what renders the run, as OpenGL names it.
    """

    trajectory_id: str
    task: Task
    streams: tuple[Stream, ...]
    steps: int
    trajectories: Path
    frames: Path
    config: RenderConfig
    device: str

    def __call__(self) -> None:
        """Store the streams in one file: those that other files of the trajectory hold are copied, others rendered.

        Raises:
            PipelineError: when another device renders here: its pixels differ, and the run would never use them.
        """
        device = gl.choose().device
        if device != self.device:
            raise PipelineError(
                f"this worker renders with {device}, the run with {self.device}",
                where=f"worker on {platform.node()}",
                expected="one device for all frames of a run, as devices differ by some grey levels",
                remedy="start the stage and every worker on machines that render alike (MUJOCO_GL picks the back end)",
            )
        trajectory = TrajectoryStore(self.trajectories).load(self.trajectory_id)
        parts, missing = self._stored(device)
        if missing:
            parts = [*parts, render(trajectory, self.task, missing, self.config, scene_of_process())]
        FrameStore(self.frames, self.config).save(self.trajectory_id, joined(parts), device)

    def frames_at_most(self) -> int:
        return self.steps * len(self.streams)

    def limit_s(self) -> float:
        """So long it may take before it counts as hanging: about twenty times what a frame takes without a GPU."""
        return 1800.0 + 2.0 * self.frames_at_most()

    def lost(self) -> None:
        """Store that no worker survived the streams, unless one stored them before it was lost.

        They are not tried again while the file is there.
        """
        trajectory = TrajectoryStore(self.trajectories).load(self.trajectory_id)
        action, steps = trajectory.actions.astype(np.float32), len(trajectory.actions)
        state, joint_state = np.zeros((steps, 8), np.float32), np.zeros((steps, 7), np.float32)
        parts, missing = self._stored(self.device)
        rejected = {stream.stream_id: LOST for stream in missing}
        parts = [*parts, Rendered(trajectory.mode, state, joint_state, action, rejected=rejected)]
        FrameStore(self.frames, self.config).save(self.trajectory_id, joined(parts), self.device)

    def _stored(self, device: str) -> tuple[list[Rendered], list[Stream]]:
        """What files hold of the streams, and those that none holds."""
        wanted = {stream.stream_id: stream.geometry.stream_id for stream in self.streams}
        parts = FrameStore(self.frames, self.config).stored(self.trajectory_id, wanted, device)
        held = {stream_id for part in parts for stream_id in (*part.streams, *part.rejected)}
        return parts, [stream for stream in self.streams if stream.stream_id not in held]


def portions(planned: Mapping[str, Stream], needed: Collection[str]) -> list[tuple[Stream, ...]]:
    """The needed streams of a trajectory, in portions of ``STREAMS_OF_A_JOB`` at most, each to be one file.

    All planned ones are cut, and then those left out that are not needed. So a portion does not change when a stream
    of another one is rejected and a reserve takes its place. Streams that share a scene are beside each other.

    Args:
        planned: stream id to each stream that an episode of the plan shows, reserves included.
        needed: ids of those that are to be rendered.
    """
    ordered = sorted(planned.items(), key=lambda item: (scene_of(item[1], textures=False), scene_of(item[1]), item[0]))
    cut = [int(end) for end in np.linspace(0, len(ordered), math.ceil(len(ordered) / STREAMS_OF_A_JOB) + 1)]
    wanted = [tuple(stream for name, stream in ordered[a:b] if name in needed) for a, b in pairwise(cut)]
    return [portion for portion in wanted if portion]


def render_plan(rows: Sequence[Row], config: Config, trajectories: Path, folder: Path, run: Run) -> set[str]:
    """Render the streams of every kept episode that ``folder`` does not hold yet.

    Where frames are rejected, reserves take the place of their episodes, so this goes on until nothing is missing that
    can be made from the trajectories that are there.

    Returns:
        The files of ``folder`` that the plan needs: the same ones whatever was rendered before.

    Raises:
        PipelineError: when rendering leaves the same work undone.
    """
    device = gl.choose().device
    store = FrameStore(folder, config.render)
    judged = verdicts_of(TrajectoryStore(trajectories).rows())
    steps = {row.trajectory_id: row.demo_steps for row in rows}
    demos = {row.trajectory_id: (row.suite, row.task, row.demo_id) for row in rows}
    planned: dict[str, dict[str, Stream]] = {row.trajectory_id: {} for row in rows}
    shown: dict[str, set[str]] = {}
    for row in rows:
        streams = {stream.stream_id: stream for stream in streams_of(row.perturbations).values()}
        planned[row.trajectory_id] |= streams
        shown[row.episode_id] = set(streams)
    undone: list[RenderJob] = []
    while True:
        stored = {name: row for name, row in store.refresh().items() if row["device"] == device}
        rejected = rejections(rows, shown_of(stored))
        outcome = select(rows, judged, rejected)
        needed: dict[str, set[str]] = {}
        for row in rows:
            verdict = outcome[row.episode_id]
            # A rejected stream stays needed: without it, its episode would be tried again.
            if verdict.kept or verdict.reason == rejected.get(row.episode_id):
                needed.setdefault(row.trajectory_id, set()).update(shown[row.episode_id])
        files = {
            file_name(trajectory_id, [stream.stream_id for stream in portion]): (trajectory_id, portion)
            for trajectory_id, ids in needed.items()
            for portion in portions(planned[trajectory_id], ids)
        }
        jobs = [
            RenderJob(
                trajectory_id,
                find_task(*demos[trajectory_id][:2]),
                portion,
                steps[trajectory_id],
                trajectories,
                folder,
                config.render,
                device,
            )
            for name, (trajectory_id, portion) in files.items()
            if name not in stored
        ]
        if not jobs:
            return set(files)
        if jobs == undone:
            raise PipelineError(
                f"{len(jobs)} files of frames were rendered and are still not there, such as one in this folder",
                where=store.folder(jobs[0].trajectory_id),
                expected=f"files written there by workers, rendered on {device}",
                remedy="check that all workers see this folder and have the same versions and OpenGL device",
            )
        undone = jobs
        # Those of many streams first, so that no worker is left alone with one at the end. Those of few, to which the
        # scene matters, by task and demonstration: what their scenes have in common, a worker keeps.
        in_turn = sorted(jobs, key=lambda job: (-len(job.streams), demos[job.trajectory_id]))
        work = Expendable(RenderJob.__call__, RenderJob.limit_s, RenderJob.lost, RenderJob.frames_at_most)
        try:
            run(work, in_turn, "render, frames")
        finally:
            scene_of_process().close()
