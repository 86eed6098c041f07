"""States to frames: every picture comes from stored states, so one replay is rendered under many perturbations."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes import PixelPerturbation, RenderPerturbation, from_json, of_layer, to_json
from pipeline.axes.light import exposure
from pipeline.config import Config, RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.rendering.jpeg import encode, to_policy
from pipeline.rendering.renderer import Renderer
from pipeline.run.compute import Run
from pipeline.run.episode_loader import rejected, verdicts
from pipeline.run.plan import Row, select
from pipeline.run.stores import FrameStore, Rendered, TrajectoryStore
from pipeline.run.streams import Stream, streams_of
from pipeline.scenes.compiled import proprioception
from pipeline.types import Trajectory


def render(trajectory: Trajectory, streams: Sequence[Stream], config: RenderConfig) -> Rendered:
    """Render the streams of one trajectory: the frame before each executed action.

    Streams that differ in pixel noise alone share the clean frames they are made from. A perturbed scene whose first
    frame is black or blown out is not rendered any further.
    """
    variants: dict[str, list[Stream]] = {}
    for stream in streams:
        variants.setdefault(to_json(of_layer(stream.perturbations, RenderPerturbation)), []).append(stream)
    encoded: dict[str, list[bytes]] = {stream.stream_id: [] for stream in streams}
    refused: dict[str, str] = {}
    proprioceptions: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    steps = len(trajectory.actions)
    renderer = Renderer(trajectory.model_xml)
    try:
        for step in range(steps):
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            proprioceptions.append(proprioception(renderer.data))
        for perturbations, members in variants.items():
            with renderer.perturbed(of_layer(from_json(perturbations), RenderPerturbation)):
                for step in range(steps):
                    renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
                    clean = {view: renderer.frame(SCHEMA.views[view].camera) for view in {s.view for s in members}}
                    faults = [fault for frame in clean.values() if (fault := exposure(frame))]
                    if step == 0 and faults and perturbations != "[]":
                        refused |= {stream.stream_id: faults[0] for stream in members}
                        break
                    for stream in members:
                        frame = clean[stream.view]
                        for noise in of_layer(stream.perturbations, PixelPerturbation):
                            frame = noise.apply(frame, step)
                        encoded[stream.stream_id].append(encode(to_policy(frame), config))
    finally:
        renderer.close()
    state, joint_state = (np.stack(column) for column in zip(*proprioceptions, strict=True))
    shown = {stream_id: frames for stream_id, frames in encoded.items() if stream_id not in refused}
    return Rendered(trajectory.mode, state, joint_state, trajectory.actions.astype(np.float32), shown, refused)


@dataclass(frozen=True)
class RenderJob:
    """One trajectory's share of the rendering, as it is sent to a worker.

    Attributes:
        trajectory_id, streams: what to render.
        trajectories, frames: folders of the stores.
        config: how frames are encoded.
        device: what renders the run, as OpenGL names it.
    """

    trajectory_id: str
    streams: tuple[Stream, ...]
    trajectories: Path
    frames: Path
    config: RenderConfig
    device: str

    def __call__(self) -> None:
        """Render what is missing and store it with what an earlier run already rendered.

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
        store = FrameStore(self.frames, self.config, device)
        there = store.streams(self.trajectory_id)
        trajectory = TrajectoryStore(self.trajectories).load(self.trajectory_id)
        rendered = render(trajectory, [s for s in self.streams if s.stream_id not in there], self.config)
        refused = store.rejected(self.trajectory_id) if there else {}
        earlier = [s.stream_id for s in self.streams if s.stream_id in there and s.stream_id not in refused]
        if there:
            known = store.load(self.trajectory_id, earlier)
            rendered = replace(
                rendered,
                streams={**rendered.streams, **known.streams},
                rejected={**rendered.rejected, **refused},
            )
        store.save(self.trajectory_id, rendered)


def render_plan(rows: Sequence[Row], config: Config, trajectories: Path, folder: Path, run: Run) -> set[str]:
    """Render the streams of every kept episode that ``folder`` does not hold yet.

    Where frames are rejected, reserves take the place of their episodes, so this goes on until nothing is missing.

    Returns:
        The trajectories that have a file in ``folder`` now.
    """
    device = gl.choose().device
    store = FrameStore(folder, config.render, device)
    judged = verdicts(rows, trajectories)
    steps = {row.trajectory_id: row.demo_steps for row in rows}
    while True:
        refused = rejected(rows, store)
        outcome = select(rows, judged, refused)
        streams: dict[str, dict[str, Stream]] = {}
        for row in rows:
            if outcome[row.episode_id].kept or row.episode_id in refused:
                shown = streams.setdefault(row.trajectory_id, {})
                shown |= {stream.stream_id: stream for stream in streams_of(row.perturbations).values()}
        jobs = [
            RenderJob(trajectory_id, tuple(shown.values()), trajectories, folder, config.render, device)
            for trajectory_id, shown in streams.items()
            if store.streams(trajectory_id) != set(shown)
        ]
        if not jobs:
            return set(streams)
        # The longest first, so that no worker is left alone with one at the end.
        jobs.sort(key=lambda job: -steps[job.trajectory_id] * len(job.streams))
        run(RenderJob.__call__, jobs, "render")
