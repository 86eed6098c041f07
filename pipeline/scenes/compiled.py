"""A scene compiled for its physics and put into its state, for perturbations that depend on where things stand."""

import xml.etree.ElementTree as ET
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rotations import axis_angle
from pipeline.types import Floats, Scene, State

Joints = NDArray[np.intp]

ARM = tuple(f"robot0_joint{number}" for number in range(1, 8))
FINGERS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
"""The robot's joints, base to wrist, and those of its gripper."""


def compiled(model_xml: str) -> mujoco.MjModel:
    """A scene's model, images included.

    Compiled in 0.6 s, and in 2 to 3 by a process that has not read its files before.

    Raises:
        ValueError: when MuJoCo refuses the scene.
    """
    model = mujoco.MjModel.from_xml_string(model_xml)
    # MuJoCo keeps what it read last, images included, until it reads something else: 300 MB.
    mujoco.MjModel.from_xml_string("<mujoco/>")
    return model


@lru_cache(maxsize=2)
def physics_to_read(model_xml: str) -> mujoco.MjModel:
    """A scene's model, with plain colours for images: nothing is rendered with it, and images are half of the work.

    The same for all who ask, and not to be written into: compiling takes 0.2 to 0.4 s, a copy 0.05 s and 100 MB.

    Raises:
        ValueError: when MuJoCo refuses the scene.
    """
    scene = ET.fromstring(model_xml)
    for texture in scene.iterfind("asset/texture[@name][@file]"):
        del texture.attrib["file"]
        texture.attrib.update(builtin="flat", width="1", height="1")
    return compiled(ET.tostring(scene, encoding="unicode"))


class CompiledScene:
    """A scene's model, as of ``physics_to_read``, not to be written into, and data at its state."""

    def __init__(self, scene: Scene):
        self.model = physics_to_read(scene.model_xml)
        self.data = mujoco.MjData(self.model)
        self.restore(scene.state)

    @property
    def state(self) -> Floats:
        """(S,) flattened MuJoCo state: time, qpos, qvel."""
        return State(self.data.time, self.data.qpos, self.data.qvel).flat

    def restore(self, state: Floats) -> None:
        """Reset the data, put a flattened state (S,) into it and compute its contacts."""
        mujoco.mj_resetData(self.model, self.data)
        State.of(state, self.model.nq).put_into(self.data)
        mujoco.mj_forward(self.model, self.data)

    def xy_m(self, name: str) -> Floats:
        """(2,) where a movable object stands, by its name in the BDDL file."""
        return np.asarray(self.data.body(f"{name}_main").xpos[:2])

    def pose_in(self, state: Floats, name: str) -> Floats:
        """(7,) the part of a flattened state (S,) that is a movable object's pose: position in m, rotation wxyz."""
        first = int(self.model.joint(f"{name}_joint0").qposadr[0])
        return State.of(state, self.model.nq).qpos[first : first + 7]

    @property
    def contacts(self) -> NDArray[np.intp]:
        """(C, 2) the bodies in contact."""
        contact = self.data.contact
        return np.asarray(self.model.geom_bodyid[contact.geom[contact.dist <= 0]], np.intp)

    def touching(self) -> dict[tuple[int, int], float]:
        """Each pair of bodies of different things in contact, and the gap in m: deepest, negative."""
        contact = self.data.contact
        bodies = np.sort(self.model.geom_bodyid[contact.geom], axis=1)
        one, other = self.model.body_rootid[bodies].T
        met = (one != other) & (contact.dist <= 0)
        gaps: dict[tuple[int, int], float] = {}
        for (first, second), gap_m in zip(bodies[met].tolist(), contact.dist[met].tolist(), strict=True):
            gaps[first, second] = min(gaps.get((first, second), 0.0), gap_m)
        return gaps


def simulate_held(model: mujoco.MjModel, data: mujoco.MjData, held: Joints, seconds: float) -> None:
    """Let a scene move for some time while the ``held`` of its joints stay where they are."""
    positions_of = np.repeat(np.arange(model.njnt), np.diff([*model.jnt_qposadr, model.nq]))
    qpos, qvel = np.isin(positions_of, held), np.isin(model.dof_jntid, held)
    start = data.qpos[qpos].copy()
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        data.qpos[qpos], data.qvel[qvel] = start, 0.0


def fixed_pose(data: mujoco.MjData, name: str) -> Floats:
    """(7,) position in m and rotation wxyz of a fixture or a region, by its name in the BDDL file."""
    if mujoco.mj_name2id(data.model, mujoco.mjtObj.mjOBJ_BODY, f"{name}_main") >= 0:
        body = data.body(f"{name}_main")
        return np.concatenate([body.xpos, body.xquat])
    site, quaternion = data.site(name), np.empty(4)
    mujoco.mju_mat2Quat(quaternion, site.xmat)
    return np.concatenate([site.xpos, quaternion])


def proprioception(data: mujoco.MjData) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """State (8,) and joint state (7,) of a restored scene; names and units in ``schemas/episode.json``."""
    position = data.site("gripper0_grip_site").xpos
    w, *xyz = data.body("robot0_right_hand").xquat
    fingers, joints = ([data.joint(name).qpos[0] for name in names] for names in (FINGERS, ARM))
    state = np.concatenate([position, axis_angle(w, np.array(xyz)), fingers])
    return state.astype(np.float32), np.array(joints, np.float32)
