"""State of a scene as a policy may perceive it: pose and speed of the hand, its fingers, and the fastest object."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.types import Floats, State


class Look(NamedTuple):
    """A state: the hand in the world's frame, the gap of its fingers, its speed, and the fastest object's speed."""

    position_m: Floats
    rotation: Rotation
    gripper_mm: float
    hand_cm_s: float
    object_cm_s: float

    @classmethod
    def of(cls, model: mujoco.MjModel, state: Floats) -> Look:
        """Compute the position and speed of the hand, and the speeds of the objects.

        Args:
            model: the scene.
            state: (S,) flattened MuJoCo state of the model.
        """
        data, moving = mujoco.MjData(model), np.empty(6)
        State.of(state, model.nq).put_into(data)
        mujoco.mj_forward(model, data)
        hand = data.site("gripper0_grip_site")
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, hand.id, moving, 0)
        left, right = (data.joint(f"gripper0_finger_joint{n}").qpos[0] for n in (1, 2))
        free = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        speeds = [float(np.linalg.norm(data.qvel[first : first + 3])) for first in free]
        return cls(
            hand.xpos.copy(),
            Rotation.from_matrix(hand.xmat.reshape(3, 3)),
            1000 * float(left - right),
            100 * float(np.linalg.norm(moving[3:])),
            100 * max(speeds, default=0.0),
        )

    def moved_cm(self, other: Look) -> float:
        """Return the distance of the hand from its position in another state."""
        return 100 * math.dist(self.position_m, other.position_m)

    def turned_deg(self, other: Look) -> float:
        """Return the angle of the hand's rotation from its orientation in another state."""
        return float(np.degrees((self.rotation * other.rotation.inv()).magnitude()))
