"""Goals that an episode's actions set for the controller, as robosuite's OSC_POSE computes them from deltas."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.scenes.compiled import ARM, CompiledScene
from pipeline.types import Floats, Scene, State


@dataclass(frozen=True)
class GripPath:
    """Poses of the grip site, which the controller moves, in the world.

    Attributes:
        positions_m: (K, 3) before each action; a further one may follow.
        rotations: K rotations before each action; a further one may follow.
        first_goal: goal of the orientation before the first action.
    """

    positions_m: Floats
    rotations: Rotation
    first_goal: Rotation

    @classmethod
    def of(cls, scene: Scene, states: Floats) -> GripPath:
        """Return the path through flattened states (K, S) that begins at a scene; the scene is compiled.

        Raises:
            ValueError: if MuJoCo rejects the scene.
        """
        compiled = CompiledScene(scene)

        def restored(state: Floats) -> mujoco.MjData:
            compiled.restore(state)
            return compiled.data

        return grip_path(scene, states, restored)


def grip_path(scene: Scene, states: Iterable[Floats], restored: Callable[[Floats], mujoco.MjData]) -> GripPath:
    """Return the path through flattened states (S,), given a function that sets a state and returns the data.

    When a scene is restored, the controller's goal is the orientation of the arm in its posture. The goal stays until
    an action turns the hand.
    """
    _, first_goal = _pose(restored(_first_posture(scene, restored(scene.state).model)))
    positions_m, rotations = zip(*(_pose(restored(state)) for state in states), strict=True)
    return GripPath(np.stack(positions_m), Rotation.from_matrix(np.stack(rotations)), Rotation.from_matrix(first_goal))


def _pose(data: mujoco.MjData) -> tuple[Floats, Floats]:
    """Return position (3,) in m and rotation (3, 3) of the grip site in the world."""
    site = data.site("gripper0_grip_site")
    return site.xpos.copy(), site.xmat.reshape(3, 3).copy()


def _first_posture(scene: Scene, model: mujoco.MjModel) -> Floats:
    """Return the scene's state (S,) with the arm in the posture that the controller sees when it is restored."""
    state = scene.state.copy()
    if scene.posture_rad is not None:
        addresses = [int(model.joint(name).qposadr[0]) for name in ARM]
        State.of(state, model.nq).qpos[addresses] = scene.posture_rad
    return state


def absolute_actions(actions: Floats, path: GripPath) -> Floats:
    """Return the actions (K, 7) as goals: position and axis-angle of the grip site in the world, and the gripper.

    The controller adds each delta to the pose of its step. It keeps its goal of the orientation through steps without
    any turn.

    Args:
        actions: (K, 7) executed actions.
        path: poses before each action.
    """
    units = np.repeat([SCHEMA.action.unit_m, SCHEMA.action.unit_rad], 3)
    deltas = units * np.clip(actions[:, :6], *SCHEMA.action.range)
    positions_m = path.positions_m[: len(actions)] + deltas[:, :3]
    axis_angles = np.empty_like(positions_m)
    goal = path.first_goal
    for step, turn in enumerate(deltas[:, 3:]):
        if turn.any():
            goal = Rotation.from_rotvec(turn) * path.rotations[step]
        axis_angles[step] = goal.as_rotvec()
    return np.hstack([positions_m, axis_angles, actions[:, 6:]])
