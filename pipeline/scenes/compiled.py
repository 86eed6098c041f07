"""Compiled scenes in their states, for perturbations that depend on the places of things."""

import xml.etree.ElementTree as ET
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rotations import axis_angle
from pipeline.scenes.flat_images import flat_images
from pipeline.types import Floats, Scene, State

Joints = NDArray[np.intp]

ARM = tuple(f"robot0_joint{number}" for number in range(1, 8))
FINGERS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
"""Joints of the robot's arm, base to wrist, and joints of its gripper."""


def compile_model(model_xml: str) -> mujoco.MjModel:
    """Compile a scene's model, images included.

    This takes 0.6 s, and 2 to 3 s in a process that has not read the scene's files before.

    Raises:
        ValueError: when MuJoCo rejects the scene.
    """
    model = mujoco.MjModel.from_xml_string(model_xml)
    # MuJoCo keeps the last document that it read, images included, until it reads another document: 300 MB.
    mujoco.MjModel.from_xml_string("<mujoco/>")
    return model


@lru_cache(maxsize=2)
def compile_for_physics(model_xml: str) -> mujoco.MjModel:
    """Compile a scene's model for physics, with plain colours instead of images.

    Images are half of the work. All callers share one model and must only read it: compiling takes 0.2 to 0.4 s, a copy
    0.05 s and 100 MB.

    Raises:
        ValueError: when MuJoCo rejects the scene.
    """
    scene = ET.fromstring(model_xml)
    flat_images(scene)
    return compile_model(ET.tostring(scene, encoding="unicode"))


class CompiledScene:
    """A scene's model of ``compile_for_physics``, which must not be changed, and data in the scene's state."""

    def __init__(self, scene: Scene):
        self.model = compile_for_physics(scene.model_xml)
        self.data = mujoco.MjData(self.model)
        self.restore(scene.state)

    @property
    def state(self) -> Floats:
        """Flattened MuJoCo state (S,): time, qpos, qvel."""
        return State(self.data.time, self.data.qpos, self.data.qvel).flat

    def restore(self, state: Floats) -> None:
        """Reset the data, set a flattened state (S,) and compute the contacts."""
        mujoco.mj_resetData(self.model, self.data)
        State.of(state, self.model.nq).put_into(self.data)
        mujoco.mj_forward(self.model, self.data)

    def xy_m(self, name: str) -> Floats:
        """Return the position (2,) of a movable object, by its name in the BDDL file."""
        return np.asarray(self.data.body(f"{name}_main").xpos[:2])

    def pose_in(self, state: Floats, name: str) -> Floats:
        """Return the part (7,) of a flattened state (S,) that holds a movable object's pose.

        The pose is the position in m, then the rotation wxyz. The result is a view of the state.
        """
        first = int(self.model.joint(f"{name}_joint0").qposadr[0])
        return State.of(state, self.model.nq).qpos[first : first + 7]

    def touching(self) -> dict[tuple[int, int], float]:
        """Map each pair of bodies of different things in contact to their deepest gap in m, which is negative or 0."""
        contact = self.data.contact
        bodies = np.sort(self.model.geom_bodyid[contact.geom], axis=1)
        first_roots, second_roots = self.model.body_rootid[bodies].T
        touching = (first_roots != second_roots) & (contact.dist <= 0)
        gaps: dict[tuple[int, int], float] = {}
        for (first, second), gap_m in zip(bodies[touching].tolist(), contact.dist[touching].tolist(), strict=True):
            gaps[first, second] = min(gaps.get((first, second), 0.0), gap_m)
        return gaps


def contacts(data: mujoco.MjData) -> NDArray[np.intp]:
    """Return the pairs (C, 2) of bodies in contact in a restored scene."""
    contact = data.contact
    return np.asarray(data.model.geom_bodyid[contact.geom[contact.dist <= 0]], np.intp)


def simulate_held(model: mujoco.MjModel, data: mujoco.MjData, held: Joints, seconds: float) -> None:
    """Simulate a scene for some seconds while the joints ``held`` keep their positions."""
    joint_of_qpos = np.repeat(np.arange(model.njnt), np.diff([*model.jnt_qposadr, model.nq]))
    held_qpos, held_qvel = np.isin(joint_of_qpos, held), np.isin(model.dof_jntid, held)
    start = data.qpos[held_qpos].copy()
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        data.qpos[held_qpos], data.qvel[held_qvel] = start, 0.0


def fixed_pose(data: mujoco.MjData, name: str) -> Floats:
    """Return position in m and rotation wxyz (7,) of a fixture or a region, by its name in the BDDL file."""
    if mujoco.mj_name2id(data.model, mujoco.mjtObj.mjOBJ_BODY, f"{name}_main") >= 0:
        body = data.body(f"{name}_main")
        return np.concatenate([body.xpos, body.xquat])
    site, quaternion = data.site(name), np.empty(4)
    mujoco.mju_mat2Quat(quaternion, site.xmat)
    return np.concatenate([site.xpos, quaternion])


class GripPose(NamedTuple):
    """Pose of the grip site, which the controller moves, in the world.

    Attributes:
        position_m: (3,).
        rotation: (3, 3).
    """

    position_m: Floats
    rotation: Floats


def grip_pose(data: mujoco.MjData) -> GripPose:
    """Return the grip site's pose in a restored scene."""
    site = data.site("gripper0_grip_site")
    return GripPose(site.xpos.copy(), site.xmat.reshape(3, 3).copy())


def proprioception(data: mujoco.MjData) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return state (8,) and joint state (7,) of a restored scene; names and units are in ``schemas/episode.json``."""
    position = data.site("gripper0_grip_site").xpos
    w, *xyz = data.body("robot0_right_hand").xquat
    fingers = [data.joint(name).qpos[0] for name in FINGERS]
    joints = [data.joint(name).qpos[0] for name in ARM]
    state = np.concatenate([position, axis_angle(w, np.array(xyz)), fingers])
    return state.astype(np.float32), np.array(joints, np.float32)
