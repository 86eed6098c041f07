"""What the hand did in a rollout, what it touched, and where the objects were, read from the stored states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.scenes.compiled import CompiledScene
from pipeline.types import Floats, Scene

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Reference:
    """What has to be known of a rollout to repeat it.

    K actions lie between K+1 states. An object is *carried* while it touches the robot and nothing else, and *met*
    while the hand touches it without carrying it, or while something in the hand newly touches it.

    Attributes:
        positions_m: (K+1, 3) of the grip site in the world's frame.
        rotations: K+1 orientations of the grip site in the world's frame.
        actions: (K, 7).
        busy: (K+1,) whether the hand, or something in it, touches anything besides what is carried.
        held: object to (K+1,) whether the robot touches it.
        carried: object to (K+1,).
        met: object to (K+1,).
        poses: object to (K+1, 7), position in m and rotation wxyz.
    """

    positions_m: Floats
    rotations: Rotation
    actions: Floats
    busy: Mask
    held: Mapping[str, Mask]
    carried: Mapping[str, Mask]
    met: Mapping[str, Mask]
    poses: Mapping[str, Floats]

    @classmethod
    def of(cls, model_xml: str, states: Floats, actions: Floats) -> Reference:
        """Read a rollout; takes half a second for the model and under a millisecond for each state.

        Args:
            model_xml: MJCF of the scene that it happened in.
            states: (K+1, S) flattened MuJoCo states.
            actions: (K, 7).
        """
        compiled = CompiledScene(Scene(model_xml, states[0]))
        model, data = compiled.model, compiled.data
        steps = len(states)
        root = model.body_rootid
        robot = int(root[model.body("robot0_base").id])
        grip = model.site("gripper0_grip_site").id
        # Movable objects by their body, each with the place of its pose in qpos.
        free = {
            int(root[model.jnt_bodyid[joint]]): (
                model.joint(joint).name.removesuffix("_joint0"),
                slice(model.jnt_qposadr[joint], model.jnt_qposadr[joint] + 7),
            )
            for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        }
        positions, matrices, busy = np.empty((steps, 3)), np.empty((steps, 3, 3)), np.zeros(steps, bool)
        held, carried, met = ({name: np.zeros(steps, bool) for name, _ in free.values()} for _ in range(3))
        poses = {name: np.empty((steps, 7)) for name, _ in free.values()}
        compiled.restore(states[0])
        touched_at_start = _partners(compiled)
        for step, state in enumerate(states):
            compiled.restore(state)
            positions[step], matrices[step] = data.site_xpos[grip], data.site_xmat[grip].reshape(3, 3)
            for name, place in free.values():
                poses[name][step] = data.qpos[place]
            partners = _partners(compiled)
            for body in partners.get(robot, set()):
                alone = body in free and partners[body] == {robot}
                busy[step] |= not alone
                if body not in free:
                    continue
                name = free[body][0]
                held[name][step] = True
                (carried if alone else met)[name][step] = True
                # What an object stood on from the start is not met when the hand takes the object.
                for other in (partners[body] & free.keys()) - touched_at_start.get(body, set()):
                    met[free[other][0]][step] = True
        return cls(positions, Rotation.from_matrix(matrices), actions, busy, held, carried, met, poses)

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def shape(self) -> dict[str, float]:
        """How the hand moved: control steps, length of its path in m, root mean square of its jerk in m a step^3."""
        travelled, jerks = np.diff(self.positions_m, axis=0), np.diff(self.positions_m, n=3, axis=0)
        return {
            "steps": float(len(self)),
            "path_m": float(np.linalg.norm(travelled, axis=1).sum()),
            "jerk": float(np.sqrt((jerks**2).sum(axis=1).mean())),
        }


def _partners(compiled: CompiledScene) -> dict[int, set[int]]:
    """Root body to the root bodies that it touches."""
    model = compiled.model
    partners: dict[int, set[int]] = {}
    for contact in compiled.data.contact:
        one, other = (int(model.body_rootid[model.geom_bodyid[geom]]) for geom in contact.geom)
        if contact.dist <= 0 and one != other:
            partners.setdefault(one, set()).add(other)
            partners.setdefault(other, set()).add(one)
    return partners
