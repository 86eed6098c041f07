"""A scene compiled and put into its state, for perturbations that must see what stands where."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.types import Floats, Scene


class Compiled:
    """A scene's model and data at its state.

    Args:
        scene: what to compile; takes 0.3 to 0.5 s, mostly for the meshes.
    """

    def __init__(self, scene: Scene):
        self.model = mujoco.MjModel.from_xml_string(scene.model_xml)
        self.data = mujoco.MjData(self.model)
        self.restore(scene.state)

    @property
    def state(self) -> Floats:
        """(S,) flattened MuJoCo state: time, qpos, qvel."""
        return np.concatenate([[self.data.time], self.data.qpos, self.data.qvel])

    def restore(self, state: Floats) -> None:
        """Put a flattened state (S,) into the data, forgetting what was there, and find its contacts."""
        mujoco.mj_resetData(self.model, self.data)
        nq = self.model.nq
        self.data.time, self.data.qpos[:], self.data.qvel[:] = state[0], state[1 : 1 + nq], state[1 + nq :]
        mujoco.mj_forward(self.model, self.data)

    def part(self, body: str) -> NDArray[np.bool_]:
        """(nbody,) which bodies move with ``body``'s tree: a robot with its gripper, an object with all its parts."""
        mask: NDArray[np.bool_] = self.model.body_rootid == self.model.body(body).rootid
        return mask

    def touching(self, part: NDArray[np.bool_]) -> dict[tuple[str, str], float]:
        """Each pair of (a body of the part, a body outside of it) in contact, and the gap in m: deepest, negative."""
        gaps: dict[tuple[str, str], float] = {}
        for contact in self.data.contact:
            own, other = self.model.geom_bodyid[contact.geom]
            if part[own] == part[other] or contact.dist > 0:
                continue
            if part[other]:
                own, other = other, own
            pair = (self.model.body(own).name, self.model.body(other).name)
            gaps[pair] = min(gaps.get(pair, 0.0), float(contact.dist))
        return gaps
