"""States to frames: every picture comes from stored states, so one replay is rendered under many perturbations."""

from __future__ import annotations

import math
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes import PixelPerturbation, RenderPerturbation, of_layer, to_json
from pipeline.axes.light import exposure
from pipeline.config import Config, RenderConfig
from pipeline.episode_schema import SCHEMA, named
from pipeline.errors import PipelineError
from pipeline.libero.tasks import find_task
from pipeline.rendering.geometry import see
from pipeline.rendering.instances import Instances
from pipeline.rendering.jpeg import encode, to_policy
from pipeline.rendering.last_scene import LastScene, scene_of_process
from pipeline.rendering.sight import CAMERA, Sight
from pipeline.run.compute import LOST, Expendable, Run
from pipeline.run.frame_store import FrameStore, Rendered, file_name, joined, shown_of
from pipeline.run.outcome import rejections
from pipeline.run.plan import Row, select
from pipeline.run.streams import Stream, streams_of
from pipeline.run.trajectory_store import TrajectoryStore, verdicts_of
from pipeline.scenes.compiled import proprioception
from pipeline.types import Task, Trajectory

STREAMS_OF_A_JOB = 64
"""Bounds a render job: minutes of a core, which a kill loses at most, and some 200 MB of encoded frames.

A trajectory's second job may have to open its scene once more, which takes some seconds.
"""


def render(
    trajectory: Trajectory, task: Task, streams: Sequence[Stream], config: RenderConfig, opened: LastScene
) -> Rendered:
    """Render the streams of one trajectory of a task: the frame before each executed action.

    Streams that differ in pixel noise alone share the clean frames they are made from. A perturbed scene whose first
    frame is black or blown out is not rendered any further, nor one whose agent view does not show what it should (see
    ``Sight``): a moved camera the task, any camera the objects that were added. Streams that differ in colours alone
    share their geometry. Scenes that differ in textures alone are rendered side by side, so that what is the same in
    them is drawn once.
    """
    scenes: dict[str, dict[str, list[Stream]]] = {}
    for stream in streams:
        scenes.setdefault(_scene(stream, textures=False), {}).setdefault(_scene(stream), []).append(stream)
    encoded: dict[str, list[bytes]] = {stream.stream_id: [] for stream in streams}
    refused: dict[str, str] = {}
    proprioceptions: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    poses: list[NDArray[np.float32]] = []
    steps = len(trajectory.actions)
    renderer = opened.renderer(trajectory.model_xml)
    instances = Instances(renderer.model, trajectory, task) if named(config.extras) else None
    for step in range(steps):
        renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
        proprioceptions.append(proprioception(renderer.data))
        if instances:
            poses.append(instances.poses(renderer.data))
    hand_m = np.array([state[:3] for state, _ in proprioceptions], float)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    original = Sight.of(renderer, task, hand_m)
    for shared in scenes.values():
        variants = list(shared.values())
        changes = [of_layer(members[0].perturbations, RenderPerturbation) for members in variants]
        common = [change for change in changes[0] if not change.paints]
        moved = any(change.sees_otherwise for change in common)
        painted = [[change for change in each if change.paints] for each in changes]
        with renderer.perturbed(common), renderer.painted(painted) as shows:
            for step in range(steps):
                renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
                for show, members, perturbed in zip(shows, variants, changes, strict=True):
                    if members[0].stream_id in refused:
                        continue
                    show()
                    clean = {view: renderer.frame(SCHEMA.views[view].camera) for view in {s.view for s in members}}
                    if step == 0:
                        faults = [fault for frame in clean.values() if perturbed and (fault := exposure(frame))]
                        if any(SCHEMA.views[view].camera == CAMERA for view in clean):
                            sight = Sight.of(renderer, task, hand_m) if moved else original
                            faults += sight.faults(original)
                        if faults:
                            refused |= {stream.stream_id: faults[0] for stream in members}
                            continue
                    for stream in members:
                        frame = clean[stream.view]
                        for noise in of_layer(stream.perturbations, PixelPerturbation):
                            frame = noise.apply(frame, step)
                        encoded[stream.stream_id].append(encode(to_policy(frame), config))
    views = dict.fromkeys(stream.geometry for stream in streams if stream.stream_id not in refused)
    geometry = {view.stream_id: see(renderer, trajectory, view, instances, config.extras) for view in views}
    state, joint_state = (np.stack(column) for column in zip(*proprioceptions, strict=True))
    shown = {stream_id: frames for stream_id, frames in encoded.items() if stream_id not in refused}
    return Rendered(
        replay_mode=trajectory.mode,
        state=state,
        joint_state=joint_state,
        action=trajectory.actions.astype(np.float32),
        streams=shown,
        rejected=refused,
        geometry=geometry,
        object_poses=np.stack(poses) if "object_poses" in config.extras else None,
        instances=instances.names if instances else (),
    )


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
    ordered = sorted(planned.items(), key=lambda item: (_scene(item[1], textures=False), _scene(item[1]), item[0]))
    cut = [int(end) for end in np.linspace(0, len(ordered), math.ceil(len(ordered) / STREAMS_OF_A_JOB) + 1)]
    wanted = [tuple(stream for name, stream in ordered[a:b] if name in needed) for a, b in pairwise(cut)]
    return [portion for portion in wanted if portion]


def _scene(stream: Stream, textures: bool = True) -> str:
    """What streams have in common that are made from the same scene, or from the same one but for its textures."""
    changes = of_layer(stream.perturbations, RenderPerturbation)
    return to_json([change for change in changes if textures or not change.paints])


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
