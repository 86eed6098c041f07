"""How well a trajectory was moved: what graders of demonstrations ask, from states and actions alone."""

from collections.abc import Set

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl
from pipeline.scenes.compiled import ARM, FINGERS, CompiledScene
from pipeline.types import Floats, Quality, State, Task, Trajectory

MOVED_M = 0.001
"""A shorter displacement is none: objects creep by less while they rest."""

IDLE_M, IDLE_DEG = 0.0005, 0.25
"""A step is idle where hand and fingers move less: 1 cm/s and 5 degrees/s."""


def measure(trajectory: Trajectory, task: Task) -> Quality:
    """Measure a trajectory with at least one action; 0.3 ms a step, where the scene is compiled already.

    Raises:
        ValueError: when MuJoCo refuses the scene.
    """
    scene = CompiledScene(trajectory.scene)
    model, data = scene.model, scene.data
    named = of_goal(bddl.read(task.bddl_file))
    allowed = {int(model.body(f"{name}_main").rootid[0]) for name in named}
    robot = int(model.body("robot0_base").rootid[0])
    positions, turns, touched = [], [], 0
    for step, state in enumerate(trajectory.states):
        scene.restore(state)
        grip = data.site("gripper0_grip_site")
        positions.append(grip.xpos.copy())
        turns.append(grip.xmat.reshape(3, 3).copy())
        roots = model.body_rootid[scene.contacts].tolist()
        others = [{*pair} - {robot} for pair in roots if robot in pair]
        # The fingers of an empty gripper touch each other.
        touched += step > 0 and any(other and not allowed & other for other in others)
    hand, qpos = np.stack(positions), np.stack([State.of(state, model.nq).qpos for state in trajectory.states])
    steps_m: Floats = np.linalg.norm(np.diff(hand, axis=0), axis=1)
    asked = hand[:-1] + SCHEMA.action.unit_m * np.clip(trajectory.actions[:, :3], -1, 1)
    away_m = _displacements(model, qpos, named)
    low, high = np.stack([model.joint(name).range for name in ARM]).T
    arm = qpos[:, [int(model.joint(name).qposadr[0]) for name in ARM]]
    return Quality(
        non_target_moved_m=_single(away_m.max(initial=0.0), MOVED_M),
        non_target_left_m=_single(away_m[-1].max(initial=0.0), MOVED_M),
        touched_steps=touched,
        path_m=_single(steps_m.sum()),
        jerk_rms_m_s3=_single(_jerk(hand)),
        idle_share=_single(_idle(steps_m, Rotation.from_matrix(turns), qpos, model).mean()),
        joint_margin_rad=_single(np.minimum(arm - low, high - arm).min()),
        lag_m=_single(np.linalg.norm(hand[1:] - asked, axis=1).max()),
    )


def smoothness(trajectory: Trajectory, task: Task) -> dict[str, float]:
    """Its steps, and path and jerk of its ``Quality``, which is measured where nobody has."""
    quality = trajectory.quality or measure(trajectory, task)
    return {"steps": len(trajectory.actions), "path_m": quality.path_m, "jerk_rms_m_s3": quality.jerk_rms_m_s3}


def of_goal(known: Bddl) -> Set[str]:
    """The objects and fixtures that a solution may touch and move: those that the goal names, and what stands on or in
    an object that it puts somewhere or in a drawer that it opens."""
    found = {*known.things_named(name for fact in known.goal for name in fact[1:])}
    carriers = {*known.targets, *(fact[1] for fact in known.goal if len(fact) == 2)}
    while carried := {name for name, place in known.places.items() if place in carriers} - carriers:
        carriers |= carried
    return found | (carriers & known.objects.keys())


def _displacements(model: mujoco.MjModel, qpos: Floats, named: Set[str]) -> Floats:
    """(K+1, N) distance in m of each other object from where it was at the first look."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    others = [joint for joint in free if model.joint(joint).name.removesuffix("_joint0") not in named]
    places = qpos[:, model.jnt_qposadr[others, None] + np.arange(3)]
    return np.asarray(np.linalg.norm(places - places[0], axis=2))


def _single(value: float, least: float = -np.inf) -> float:
    """As the datasets have it, in single precision; 0 for less than ``least``."""
    return float(np.float32(value)) if value >= least else 0.0


def _jerk(hand: Floats) -> float:
    """In m/s^3; 0 where there are fewer than the four positions that a third difference takes."""
    jerk = np.diff(hand, n=3, axis=0) * SCHEMA.fps_hz**3
    return float(np.sqrt((jerk**2).sum(axis=1).mean())) if len(jerk) else 0.0


def _idle(steps_m: Floats, turns: Rotation, qpos: Floats, model: mujoco.MjModel) -> Floats:
    """(K,) whether a step moves neither hand nor fingers."""
    turned = np.rad2deg((turns[1:] * turns[:-1].inv()).magnitude())
    fingers = np.diff(qpos[:, [int(model.joint(name).qposadr[0]) for name in FINGERS]], axis=0)
    return np.asarray((steps_m < IDLE_M) & (turned < IDLE_DEG) & (np.abs(fingers) < IDLE_M).all(axis=1))
