"""A scene compiled for its physics and put into its state, for perturbations that depend on where things stand."""

from __future__ import annotations

import copy
import posixpath
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.types import Floats, Scene

WRITTEN = ("type", "name", "file")
"""Attributes that MuJoCo writes of an image, in its order; LIBERO's have no others."""


def physics_of(model_xml: str) -> mujoco.MjModel:
    """A scene's model, with plain colours for images: nothing is rendered with it, and images are half of the work.

    Compiled in 0.2 to 0.4 s, mostly for the meshes, and one of the last two scenes copied in 0.05: a perturbation looks
    at the scene that is replayed before and after it.

    Raises:
        ValueError: when MuJoCo refuses the scene.
    """
    return copy.copy(physics_to_read(model_xml))


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
    """The same model for all who ask, not to be written into: a copy takes 100 MB."""
    scene = ET.fromstring(model_xml)
    take_images(scene)
    return compiled(ET.tostring(scene, encoding="unicode"))


def take_images(scene: ET.Element) -> dict[str, dict[str, str]]:
    """Put a plain colour in place of each image of a scene.

    Returns:
        Attributes of the ``<texture>`` elements that had one, by their names.
    """
    taken = {}
    for texture in scene.iterfind("asset/texture[@name][@file]"):
        taken[texture.attrib["name"]] = dict(texture.attrib)
        del texture.attrib["file"]
        texture.attrib.update(builtin="flat", width="1", height="1")
    return taken


def put_images(scene: ET.Element, taken: Mapping[str, Mapping[str, str]]) -> None:
    """Undo ``take_images``, in a scene that MuJoCo compiled without its images and wrote as MJCF since."""
    for texture in scene.iterfind("asset/texture[@name]"):
        if (attributes := taken.get(texture.attrib["name"])) is not None:
            texture.attrib.clear()
            texture.attrib.update((name, attributes[name]) for name in WRITTEN if name in attributes)
            # MuJoCo writes paths without "..".
            texture.set("file", posixpath.normpath(attributes["file"]))


class CompiledScene:
    """A scene's model, not to be written into, and data at its state.

    Args:
        scene: what to compile, as ``physics_to_read`` does.
    """

    def __init__(self, scene: Scene):
        self.model = physics_to_read(scene.model_xml)
        self.data = mujoco.MjData(self.model)
        self.restore(scene.state)

    @property
    def state(self) -> Floats:
        """(S,) flattened MuJoCo state: time, qpos, qvel."""
        return np.concatenate([[self.data.time], self.data.qpos, self.data.qvel])

    def restore(self, state: Floats) -> None:
        """Reset the data, put a flattened state (S,) into it and compute its contacts."""
        mujoco.mj_resetData(self.model, self.data)
        nq = self.model.nq
        self.data.time, self.data.qpos[:], self.data.qvel[:] = state[0], state[1 : 1 + nq], state[1 + nq :]
        mujoco.mj_forward(self.model, self.data)

    def part(self, body: str) -> NDArray[np.bool_]:
        """(nbody,) which bodies move with ``body``'s tree: a robot with its gripper, an object with all its parts."""
        mask: NDArray[np.bool_] = self.model.body_rootid == self.model.body(body).rootid
        return mask

    def xy_m(self, name: str) -> Floats:
        """(2,) where a movable object stands, by its name in the BDDL file."""
        position: Floats = self.data.body(f"{name}_main").xpos[:2]
        return position

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
    fingers = [data.joint(f"gripper0_finger_joint{n}").qpos[0] for n in (1, 2)]
    joints = [data.joint(f"robot0_joint{n}").qpos[0] for n in range(1, 8)]
    state = np.concatenate([position, _axis_angle(w, np.array(xyz)), fingers])
    return state.astype(np.float32), np.array(joints, np.float32)


def _axis_angle(w: float, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axis times angle (rad) of a unit quaternion, the angle in [0, 2 pi] as robosuite's ``quat2axisangle`` has it."""
    w = float(np.clip(w, -1.0, 1.0))
    sine = np.sqrt(1.0 - w * w)
    if np.isclose(sine, 0.0):
        return np.zeros(3)
    return np.asarray(xyz * 2.0 * np.arccos(w) / sine)
