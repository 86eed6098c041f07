"""Motion quality of a trajectory: the measures that graders of demonstrations use, from states and actions alone."""

from collections.abc import Set

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.libero.bddl import Bddl
from pipeline.libero.carried import definition_of
from pipeline.scenes.compiled import ARM, FINGERS, CompiledScene, contacts, grip_pose
from pipeline.types import Floats, Quality, State, Task, Trajectory

MOVED_M = 0.001
"""Shorter displacements count as 0: objects creep by less while they rest."""

IDLE_M, IDLE_DEG = 0.0005, 0.25
"""A step is idle if hand and fingers move less: 1 cm/s and 5 degrees/s."""


def measure(trajectory: Trajectory, task: Task) -> Quality:
    """Measure a trajectory with at least one action; 0.3 ms a step if the scene is compiled already.

    Raises:
        ValueError: if MuJoCo rejects the scene.
    """
    scene = CompiledScene(trajectory.scene)
    model = scene.model
    target_names = list_allowed_things(definition_of(task))
    allowed_roots = {int(model.body(f"{name}_main").rootid[0]) for name in target_names}
    robot = int(model.body("robot0_base").rootid[0])
    positions, rotations, touched_steps = [], [], 0
    for step, state in enumerate(trajectory.states):
        scene.restore(state)
        grip = grip_pose(scene.data)
        positions.append(grip.position_m)
        rotations.append(grip.rotation)
        root_pairs = model.body_rootid[contacts(scene.data)].tolist()
        touched_roots: set[int] = set()
        for pair in root_pairs:
            if robot in pair:
                touched_roots.update(pair)
        # The fingers of an empty gripper touch each other.
        touched_steps += step > 0 and bool(touched_roots - {robot} - allowed_roots)
    hand = np.stack(positions)
    qpos = np.stack([State.of(state, model.nq).qpos for state in trajectory.states])
    steps_m: Floats = np.linalg.norm(np.diff(hand, axis=0), axis=1)
    commanded = hand[:-1] + SCHEMA.action.unit_m * np.clip(trajectory.actions[:, :3], *SCHEMA.action.range)
    away_m = _displacements(model, qpos, target_names)
    low, high = np.stack([model.joint(name).range for name in ARM]).T
    arm = qpos[:, [int(model.joint(name).qposadr[0]) for name in ARM]]
    return Quality(
        non_target_moved_m=_single(away_m.max(initial=0.0), MOVED_M),
        non_target_left_m=_single(away_m[-1].max(initial=0.0), MOVED_M),
        touched_steps=touched_steps,
        path_m=_single(steps_m.sum()),
        jerk_rms_m_s3=_single(_jerk(hand)),
        idle_share=_single(_idle(steps_m, Rotation.from_matrix(rotations), qpos, model).mean()),
        joint_margin_rad=_single(np.minimum(arm - low, high - arm).min()),
        lag_m=_single(np.linalg.norm(hand[1:] - commanded, axis=1).max()),
    )


def smoothness(trajectory: Trajectory, task: Task) -> dict[str, float]:
    """Return a trajectory's number of steps, and path and jerk of its ``Quality``.

    If the trajectory carries no quality, measure it.

    Raises:
        ValueError: if MuJoCo rejects the scene.
    """
    quality = trajectory.quality or measure(trajectory, task)
    return {"steps": len(trajectory.actions), "path_m": quality.path_m, "jerk_rms_m_s3": quality.jerk_rms_m_s3}


def list_allowed_things(problem: Bddl) -> Set[str]:
    """List the objects and fixtures that a solution may touch and move.

    These are the things that the goal names. Objects that stand on or in a moved target object, or in an opened drawer,
    are also included.
    """
    opened_parts = [fact[1] for fact in problem.goal if len(fact) == 2]
    carriers = {*problem.targets, *opened_parts}
    while carried := {name for name, place in problem.places.items() if place in carriers} - carriers:
        carriers |= carried
    return {*problem.things_of_goal} | (carriers & problem.objects.keys())


def _displacements(model: mujoco.MjModel, qpos: Floats, named: Set[str]) -> Floats:
    """Return the distance (K+1, N) in m of each object that is not ``named`` from its place in the first state."""
    free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    unnamed = [joint for joint in free_joints if model.joint(joint).name.removesuffix("_joint0") not in named]
    places = qpos[:, model.jnt_qposadr[unnamed, None] + np.arange(3)]
    return np.asarray(np.linalg.norm(places - places[0], axis=2))


def _single(value: float, least: float = -np.inf) -> float:
    """Round a value to single precision, as in the datasets; return 0 for values below ``least``."""
    return float(np.float32(value)) if value >= least else 0.0


def _jerk(hand: Floats) -> float:
    """Return the root mean square of the hand's jerk in m/s^3.

    The result is 0 for fewer than four positions, which a third difference needs.
    """
    jerk = np.diff(hand, n=3, axis=0) * SCHEMA.fps_hz**3
    return float(np.sqrt((jerk**2).sum(axis=1).mean())) if len(jerk) else 0.0


def _idle(steps_m: Floats, turns: Rotation, qpos: Floats, model: mujoco.MjModel) -> Floats:
    """Return a mask (K,) that is True for steps in which neither hand nor fingers move."""
    turned_deg = np.rad2deg((turns[1:] * turns[:-1].inv()).magnitude())
    finger_columns = [int(model.joint(name).qposadr[0]) for name in FINGERS]
    finger_steps_m = np.diff(qpos[:, finger_columns], axis=0)
    fingers_rest = (np.abs(finger_steps_m) < IDLE_M).all(axis=1)
    return np.asarray((steps_m < IDLE_M) & (turned_deg < IDLE_DEG) & fingers_rest)
