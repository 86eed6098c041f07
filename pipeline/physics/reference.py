"""References: the hand's motion, its contacts and the objects' poses in a rollout, read from the stored states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.libero.arenas import SURFACES
from pipeline.scenes.compiled import CompiledScene, fixed_pose, grip_pose
from pipeline.types import Floats, Scene

Mask = NDArray[np.bool_]
T = TypeVar("T")

FALL = 10
"""Control steps (0.5 s) within which a released object comes down on its target."""


@dataclass(frozen=True)
class Reference:
    """Data of a rollout that are needed to repeat it.

    K actions lie between K+1 states. An object is *carried* while it touches the robot and nothing else. It is *met*

    * while the hand touches it without carrying it,
    * while an object in the hand newly touches it,
    * when it catches an object that the hand has released.

    Fixtures, such as a stove, are met in the same way. A region of the working surface is met while an object in the
    hand stands in it.

    Attributes:
        positions_m: (K+1, 3) positions of the grip site in the world's frame.
        rotations: K+1 orientations of the grip site in the world's frame.
        actions: (K, 7).
        busy: (K+1,) True while the hand, or an object in it, touches anything other than the carried object.
        engaged: (K+1,) ``busy`` without the hand's own contacts with the working surface, which never moves.
        held: object to mask (K+1,), True while the robot touches it.
        carried: object to mask (K+1,).
        met: object, fixture or region to mask (K+1,).
        poses: object to (K+1, 7), position in m and rotation wxyz.
        places: fixture or region, by its name in the BDDL file, to its pose (7,).
    """

    positions_m: Floats
    rotations: Rotation
    actions: Floats
    busy: Mask
    engaged: Mask
    held: Mapping[str, Mask]
    carried: Mapping[str, Mask]
    met: Mapping[str, Mask]
    poses: Mapping[str, Floats]
    places: Mapping[str, Floats]

    @classmethod
    def of(cls, model_xml: str, states: Floats, actions: Floats) -> Reference:
        """Read a rollout, its states (K+1, S) and actions (K, 7), in the scene of an MJCF.

        This takes half a second for the model and under a millisecond for each state.
        """
        compiled = CompiledScene(Scene(model_xml, states[0]))
        model, data = compiled.model, compiled.data
        free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        objects = [model.joint(joint).name.removesuffix("_joint0") for joint in free_joints]
        places = _places(model, data)
        positions, matrices = np.empty((len(states), 3)), np.empty((len(states), 3, 3))
        poses = {name: np.empty((len(states), 7)) for name in objects}
        log = _ContactLog(model, poses, places, len(states))
        for step, state in enumerate(states):
            compiled.restore(state)
            positions[step], matrices[step] = grip_pose(data)
            for name in objects:
                poses[name][step] = data.joint(f"{name}_joint0").qpos
            log.note(step, _partners(compiled))
        return cls(
            positions_m=positions,
            rotations=Rotation.from_matrix(matrices),
            actions=actions,
            poses=poses,
            places=places,
            **log.masks()._asdict(),
        )

    def __len__(self) -> int:
        return len(self.actions)

    def in_scene(self, names: Mapping[str, str]) -> Reference:
        """Return the rollout for another scene, without the things that this scene lacks.

        Args:
            names: object, fixture or region to its name in the other scene.
        """
        return replace(
            self,
            held=_renamed(self.held, names),
            carried=_renamed(self.carried, names),
            met=_renamed(self.met, names),
            poses=_renamed(self.poses, names),
            places=_renamed(self.places, names),
        )


def _renamed(by_name: Mapping[str, T], names: Mapping[str, str]) -> dict[str, T]:
    """Return the entries that have a new name, under this name."""
    return {names[name]: value for name, value in by_name.items() if name in names}


class _Contacts(NamedTuple):
    """Fields of a ``Reference`` that come from contacts."""

    busy: Mask
    engaged: Mask
    held: Mapping[str, Mask]
    carried: Mapping[str, Mask]
    met: Mapping[str, Mask]


class _ContactLog:
    """Contacts of the hand and of the objects in it, noted state by state.

    Args:
        model: the scene's model.
        poses: object to (K+1, 7), as in ``Reference``.
        places: fixture or region to its pose (7,), as in ``Reference``.
        states: number K+1 of the states.
    """

    def __init__(
        self, model: mujoco.MjModel, poses: Mapping[str, Floats], places: Mapping[str, Floats], states: int
    ) -> None:
        self._model, self._poses, self._places = model, poses, places
        self._robot = int(model.body("robot0_base").rootid[0])
        # Look bodies up by the joint, because bodies of added objects follow another naming scheme.
        self._object_of_body = {int(model.body_rootid[model.joint(f"{name}_joint0").bodyid[0]]): name for name in poses}
        roots = _roots(model)
        fixtures = [name for name in places if f"{name}_main" in roots]
        self._thing_of_body = self._object_of_body | {int(model.body(f"{name}_main").id): name for name in fixtures}
        things = self._thing_of_body.values()
        self._regions = [name for name in places if name not in things]
        self._busy, self._engaged = np.zeros(states, bool), np.zeros(states, bool)
        self._held = {name: np.zeros(states, bool) for name in poses}
        self._carried = {name: np.zeros(states, bool) for name in poses}
        self._met = {name: np.zeros(states, bool) for name in (*things, *self._regions)}
        # Object to the bodies that it stood on until the hand took it: taking it does not meet them.
        self._stood_on: dict[int, set[int]] = {body: set() for body in self._object_of_body}
        self._last_held: dict[int, int] = {}

    def note(self, step: int, partners: Mapping[int, set[int]]) -> None:
        """Note the contacts of the next state.

        Args:
            step: number of the state.
            partners: root body to the root bodies that it touches.
        """
        for body in partners.get(self._robot, set()):
            self._note_hand(step, body, partners[body])
        for body in self._object_of_body:
            touched = partners.get(body, set())
            if self._robot in touched:
                self._held[self._object_of_body[body]][step] = True
                self._last_held[body] = step
            if body not in self._last_held:
                self._stood_on[body] |= touched
            elif step <= self._last_held[body] + FALL:
                self._note_held(step, body, touched)

    def _note_hand(self, step: int, body: int, touched: set[int]) -> None:
        """Note that the robot touches ``body``, which touches the bodies ``touched``."""
        if body in self._object_of_body and touched == {self._robot}:
            self._carried[self._object_of_body[body]][step] = True
            return
        self._busy[step] = True
        if body in self._thing_of_body:
            self._engaged[step] = True
            self._met[self._thing_of_body[body]][step] = True

    def _note_held(self, step: int, body: int, touched: set[int]) -> None:
        """Note the things that an object touches in the hand, or while it comes down after its release.

        Contacts of a released object count at the last step in the hand.
        """
        last_held = self._last_held[body]
        for thing in (touched & self._thing_of_body.keys()) - self._stood_on[body]:
            self._met[self._thing_of_body[thing]][last_held] = True
        if touched - {self._robot}:
            for region in self._regions_at(self._poses[self._object_of_body[body]][step, :2]):
                self._met[region][last_held] = True

    def _regions_at(self, xy_m: Floats) -> list[str]:
        """List the regions that are above or below an object's origin (2,)."""
        regions = []
        for region in self._regions:
            away_m = np.abs(xy_m - self._places[region][:2])
            if (away_m < self._model.site(region).size[:2]).all():
                regions.append(region)
        return regions

    def masks(self) -> _Contacts:
        """Return the masks of all noted states."""
        return _Contacts(busy=self._busy, engaged=self._engaged, held=self._held, carried=self._carried, met=self._met)


def _roots(model: mujoco.MjModel) -> set[str]:
    """Return the names of the bodies whose parent is the world."""
    return {model.body(body).name for body in np.flatnonzero(model.body_parentid == 0)}


def _places(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, Floats]:
    """Map each fixture, and each region of the working surface, to its pose (7,)."""
    free_joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    movable = {int(model.jnt_bodyid[joint]) for joint in free_joints}
    bodies = [name for name in _roots(model) if name.endswith("_main") and model.body(name).id not in movable]
    places = {}
    for body in sorted(bodies):
        fixture = body.removesuffix("_main")
        places[fixture] = fixed_pose(data, fixture)
    for site in range(model.nsite):
        if model.body(model.site_bodyid[site]).name in SURFACES:
            places[model.site(site).name] = fixed_pose(data, model.site(site).name)
    return places


def _partners(compiled: CompiledScene) -> dict[int, set[int]]:
    """Map each root body to the root bodies that it touches."""
    partners: dict[int, set[int]] = {}
    for pair in compiled.touching():
        first, second = compiled.model.body_rootid[[*pair]].tolist()
        partners.setdefault(first, set()).add(second)
        partners.setdefault(second, set()).add(first)
    return partners


def runs(mask: Mask, gap: int) -> list[tuple[int, int]]:
    """Return the first and last index of each stretch of True; neighbours in a stretch are up to ``gap`` apart."""
    indices = np.flatnonzero(mask)
    stretches = np.split(indices, np.flatnonzero(np.diff(indices) > gap) + 1)
    return [(int(stretch[0]), int(stretch[-1])) for stretch in stretches if len(stretch)]
