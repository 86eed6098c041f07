"""Goals that an episode's actions set for the controller, as robosuite's OSC_POSE computes them from deltas."""

from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.scenes.compiled import ARM, GripPose
from pipeline.types import Floats, Scene, State

FIRST_SIDE = np.array([1.0, 0.1, 0.01])
"""Direction on whose side an episode's first axis-angle is; its entries differ, so that no usual axis is ambiguous."""

SMALLEST_ANGLE = 1e-6
"""Angle in rad below which a rotation has no certain axis."""


def first_posture(scene: Scene, model: mujoco.MjModel) -> Floats:
    """Return the scene's state (S,) with the arm in the posture that the controller sees when it is restored.

    The orientation of the grip in this posture is the controller's goal until an action turns the hand.
    """
    state = scene.state.copy()
    if scene.start.posture_rad is not None:
        addresses = [int(model.joint(name).qposadr[0]) for name in ARM]
        State.of(state, model.nq).qpos[addresses] = scene.start.posture_rad
    return state


def absolute_actions(actions: Floats, first_grip: GripPose, grips: Sequence[GripPose]) -> Floats:
    """Return the actions (K, 7) as goals: position and axis-angle of the grip site in the world, and the gripper.

    The controller adds each delta to the pose of its step. It keeps its goal of the orientation through steps without
    any turn. The axis-angles have no jumps (``without_jumps``).

    Args:
        actions: (K, 7) executed actions.
        first_grip: pose in ``first_posture``.
        grips: K poses, before each action.
    """
    deltas = SCHEMA.action.units * np.clip(actions[:, :6], *SCHEMA.action.range)
    positions_m, rotations = [], []
    rotation = Rotation.from_matrix(first_grip.rotation)
    for grip, delta in zip(grips, deltas, strict=True):
        shift_m, turn = delta[:3], delta[3:]
        if turn.any():
            rotation = Rotation.from_rotvec(turn) * Rotation.from_matrix(grip.rotation)
        positions_m.append(grip.position_m + shift_m)
        rotations.append(rotation.as_rotvec())
    return np.hstack([np.stack(positions_m), without_jumps(np.stack(rotations)), actions[:, 6:]])


def without_jumps(axis_angles: Floats) -> Floats:
    """Return axis-angles (K, 3) of the same rotations, of which each is the nearest to its predecessor.

    An axis-angle with another multiple of 2 pi as its angle is the same rotation. LIBERO's hand points down, which is a
    rotation by about pi, and SciPy's axis-angles change their sign there. The first axis-angle points to the side of
    ``FIRST_SIDE``, so that all episodes begin with the same sign.
    """
    continuous: list[Floats] = []
    former = np.pi * FIRST_SIDE
    for axis_angle in axis_angles:
        angle = np.linalg.norm(axis_angle)
        if angle > SMALLEST_ANGLE:
            axis = axis_angle / angle
            turns = np.rint((former @ axis - angle) / (2 * np.pi))
            axis_angle = axis_angle + 2 * np.pi * turns * axis
        former = axis_angle
        continuous.append(former)
    return np.stack(continuous)
