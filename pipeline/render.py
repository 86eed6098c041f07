"""States to frames: every picture comes from stored states, so one replay is rendered under many perturbations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes import PixelPerturbation, RenderPerturbation, from_json, of_layer, to_json
from pipeline.axes.light import exposure
from pipeline.compute import Run
from pipeline.config import Config, RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.episodes import rejected, verdicts
from pipeline.frames import Stream, encode, streams_of, to_policy
from pipeline.physics.scene import proprioception
from pipeline.plan import Row, select
from pipeline.store import FrameStore, Rendered, TrajectoryStore
from pipeline.types import Frame, Trajectory

GL = gl.choose()
"""What renders in this process; chosen here because MuJoCo reads the choice when it is imported."""

import mujoco  # noqa: E402


class Renderer:
    """Renders one scene through one GL context; close it before the next is made.

    Args:
        model_xml: MJCF of the scene.
    """

    def __init__(self, model_xml: str):
        height, width, _ = SCHEMA.frame.shape
        self.model = mujoco.MjModel.from_xml_string(model_xml)
        self.data = mujoco.MjData(self.model)
        self._renderer = mujoco.Renderer(self.model, height, width, max_geom=1000)
        self._option = mujoco.MjvOption()
        # As robosuite's off-screen context: visual meshes without the collision geometry.
        self._option.geomgroup[0], self._option.geomgroup[1] = 0, 1

    def restore(self, state: NDArray[np.float64], site_alpha: NDArray[np.float32]) -> None:
        """Put the scene into a stored state (S,) with its sites' opacity (nsite,)."""
        nq, nv = self.model.nq, self.model.nv
        self.data.time = state[0]
        self.data.qpos[:] = state[1 : 1 + nq]
        self.data.qvel[:] = state[1 + nq : 1 + nq + nv]
        self.model.site_rgba[:, 3] = site_alpha
        mujoco.mj_forward(self.model, self.data)

    def frame(self, camera: str) -> Frame:
        """(H, W, 3) uint8 RGB of the restored state in the orientation of LIBERO's raw observations."""
        self._renderer.update_scene(self.data, camera, self._option)
        return np.ascontiguousarray(self._renderer.render()[::-1])

    @contextmanager
    def perturbed(self, perturbations: Sequence[RenderPerturbation]) -> Iterator[None]:
        """Apply render-layer perturbations to the model for a moment."""
        written = {name for perturbation in perturbations for name in perturbation.fields}
        saved = {name: getattr(self.model, name).copy() for name in written}
        # Textures are a hundred megabytes and more, and copied to the GL context: keep only those that change.
        pixels = saved.pop("tex_data", None)
        replaced: dict[int, NDArray[np.uint8]] = {}
        try:
            try:
                for perturbation in perturbations:
                    perturbation.apply(self.model)
            finally:
                if pixels is not None:
                    replaced = self._changed(pixels)
                    del pixels
            self._upload(replaced)
            yield
        finally:
            for name, value in saved.items():
                getattr(self.model, name)[:] = value
            for texture, value in replaced.items():
                self.model.tex_data[self._texels()[texture]] = value
            self._upload(replaced)

    def _texels(self) -> list[slice]:
        """Where each texture's bytes lie in the model's ``tex_data``."""
        starts = self.model.tex_adr
        sizes = self.model.tex_height * self.model.tex_width * self.model.tex_nchannel
        return [slice(start, start + size) for start, size in zip(starts.tolist(), sizes.tolist(), strict=True)]

    def _changed(self, pixels: NDArray[np.uint8]) -> dict[int, NDArray[np.uint8]]:
        """The former bytes of the textures that differ from ``pixels``, an earlier copy of ``tex_data``."""
        return {
            texture: pixels[texels].copy()
            for texture, texels in enumerate(self._texels())
            if not np.array_equal(pixels[texels], self.model.tex_data[texels])
        }

    def _upload(self, textures: Iterable[int]) -> None:
        """Copy textures of the model to the GL context."""
        self._renderer._gl_context.make_current()
        for texture in textures:
            mujoco.mjr_uploadTexture(self.model, self._renderer._mjr_context, texture)

    def close(self) -> None:
        self._renderer.close()


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
    """One trajectory's share of the rendering, as it is sent to a worker."""

    trajectory_id: str
    streams: tuple[Stream, ...]
    trajectories: Path
    frames: Path
    config: RenderConfig

    def __call__(self) -> None:
        """Render what is missing and store it with what an earlier run already rendered."""
        store = FrameStore(self.frames, self.config, GL.device)
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
    store = FrameStore(folder, config.render, GL.device)
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
            RenderJob(trajectory_id, tuple(shown.values()), trajectories, folder, config.render)
            for trajectory_id, shown in streams.items()
            if store.streams(trajectory_id) != set(shown)
        ]
        if not jobs:
            return set(streams)
        # The longest first, so that no worker is left alone with one at the end.
        jobs.sort(key=lambda job: -steps[job.trajectory_id] * len(job.streams))
        run(RenderJob.__call__, jobs, "render")
