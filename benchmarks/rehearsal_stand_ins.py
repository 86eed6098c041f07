"""Stage of a run with stand-ins for physics and pixels; all other code is the stage's own.

    python benchmarks/rehearsal_stand_ins.py stages/replay.py configs/NAME.yaml

Eight steps replace a replay, and smooth patterns replace frames. Dask's workers load this file as they start
(``distributed.worker.preload``).
"""

import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

import pipeline
import pipeline.run.render_job
import pipeline.run.replay_job
import pipeline.validation.doctor
import pipeline.validation.validate
from pipeline import seeding
from pipeline.axes import PhysicsPerturbation
from pipeline.config import RenderConfig, ReplayConfig
from pipeline.episode_schema import SCHEMA
from pipeline.images.jpeg import encode
from pipeline.physics.controller_goals import absolute_actions
from pipeline.planning.streams import Stream
from pipeline.scenes.compiled import GripPose
from pipeline.types import Demo, Frame, Geometry, Jpeg, Rendered, Scene, Task, Trajectory, Verdict
from pipeline.validation.checks.motion import ARM, GRIP_IN_HAND

STEPS = 8
"""Shortest episode that OpenVLA-OFT can read: one of its chunks."""
DROPPED = 0.1
"""Share of the perturbed replays that fail."""


def replay(
    environment: object,
    demo: Demo,
    trajectory_id: str,
    config: ReplayConfig,
    perturbations: Sequence[PhysicsPerturbation],
    reference: object,
) -> Trajectory:
    """Return the trajectory of a robot that stands still in the demonstration's scene."""
    rng = seeding.rng("rehearsal", trajectory_id)
    states = np.repeat(demo.init_state[None], STEPS + 1, axis=0)
    states[:, 0] = np.arange(STEPS + 1) / SCHEMA.fps_hz
    actions = rng.uniform(-1, 1, (STEPS, 7))
    actions[:, 6] = -1.0
    model_xml = demo.model_xml or ""
    kept = not perturbations or rng.uniform() >= DROPPED
    return Trajectory(
        trajectory_id=trajectory_id,
        mode="open_loop",
        scene=Scene(model_xml, demo.init_state),
        states=states,
        actions=actions,
        site_alpha=np.zeros((STEPS + 1, model_xml.count("<site ")), np.float32),
        verdict=Verdict(kept, "kept" if kept else "goal_not_reached"),
    )


def render(
    trajectory: Trajectory, task: Task, streams: Sequence[Stream], config: RenderConfig, opened: object
) -> Rendered:
    """Return frames with a different pattern for each stream and step."""
    steps = len(trajectory.actions)
    streams_of_frames: dict[str, list[Jpeg]] = {}
    for stream in streams:
        patterns = [_pattern(f"{stream.stream_id} {step}") for step in range(steps)]
        streams_of_frames[stream.stream_id] = [encode(pattern, config.jpeg_quality) for pattern in patterns]
    geometries = {stream.geometry for stream in streams}
    fixed = Geometry(np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32))
    state = np.zeros((steps, 8), np.float32)
    state[:, 6:] = 0.04, -0.04
    grip = GripPose(np.zeros(3), GRIP_IN_HAND.as_matrix())
    goals = absolute_actions(trajectory.actions, grip, [grip] * steps)
    return Rendered(
        replay_mode=trajectory.mode,
        state=state,
        joint_state=trajectory.states[:-1, ARM].astype(np.float32),
        action=trajectory.actions.astype(np.float32),
        action_absolute=goals.astype(np.float32),
        streams=streams_of_frames,
        geometry={geometry.stream_id: fixed for geometry in geometries},
        quality=trajectory.quality,
    )


def _pattern(name: str) -> Frame:
    height, width, channels = SCHEMA.frame.shape
    coarse = seeding.rng("rehearsal", name).integers(40, 216, (4, 4, channels), np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def put_in() -> None:
    """Install the stand-ins in this process."""
    for module, name, stand_in in (
        (pipeline.run.replay_job, "shared", lambda task: None),
        (pipeline.run.replay_job, "replay", replay),
        (pipeline.run.render_job, "render", render),
        (pipeline.validation.validate, "rendered", lambda *_: ()),
    ):
        setattr(module, name, stand_in)


def dask_setup(worker: object) -> None:
    """Install the stand-ins in a Dask worker; Dask calls this function when the worker starts."""
    put_in()


if __name__ == "__main__":
    sys.argv = sys.argv[1:]
    if Path(sys.argv[0]).stem == "doctor":
        # doctor steps and renders for some seconds at any size, and the run does not fill the disk.
        vars(pipeline.validation.doctor)["needed_mb"] = lambda config: {}
    else:
        put_in()
    runpy.run_path(sys.argv[0], run_name="__main__")
