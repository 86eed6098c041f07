"""What the hand did in a rollout, what it touched, and where the objects were, read from the stored states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.scenes.compiled import CompiledScene, fixed_pose
from pipeline.scenes.swept_path import SURFACES
from pipeline.types import Floats, Scene

Mask = NDArray[np.bool_]

FALL = 10
"""Control steps (0.5 s) within which an object that was let go comes down on what it is meant for."""


@dataclass(frozen=True)
class Reference:
    """What has to be known of a rollout to repeat it.

    K actions lie between K+1 states. An object is *carried* while it touches the robot and nothing else, and *met*
    while the hand touches it without carrying it, or while something in the hand newly touches it, and also when it
    catches what the hand has let go. Fixtures, such as a stove, are met in the same way. A region of the working
    surface is met while something in the hand stands in it.

    Attributes:
        positions_m: (K+1, 3) of the grip site in the world's frame.
        rotations: K+1 orientations of the grip site in the world's frame.
        actions: (K, 7).
        busy: (K+1,) whether the hand, or something in it, touches anything besides what is carried.
        engaged: (K+1,) the same without the hand's own contacts with the working surface, which never moves.
        held: object to (K+1,) whether the robot touches it.
        carried: object to (K+1,).
        met: object, fixture or region to (K+1,).
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
        """Read a rollout, its states (K+1, S) and actions (K, 7), in the scene of an MJCF; takes half a second for the
        model and under a millisecond for each state."""
        compiled = CompiledScene(Scene(model_xml, states[0]))
        model, data = compiled.model, compiled.data
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        objects = [model.joint(joint).name.removesuffix("_joint0") for joint in free]
        places = _places(model, data)
        positions, matrices = np.empty((len(states), 3)), np.empty((len(states), 3, 3))
        poses = {name: np.empty((len(states), 7)) for name in objects}
        partners = []
        for step, state in enumerate(states):
            compiled.restore(state)
            grip = data.site("gripper0_grip_site")
            positions[step], matrices[step] = grip.xpos, grip.xmat.reshape(3, 3)
            for name in objects:
                poses[name][step] = data.joint(f"{name}_joint0").qpos
            partners.append(_partners(compiled))
        contacts = _contacts(model, partners, poses, places)
        return cls(positions, Rotation.from_matrix(matrices), actions, *contacts, poses, places)

    def __len__(self) -> int:
        return len(self.actions)


def _contacts(
    model: mujoco.MjModel,
    partners: Sequence[Mapping[int, set[int]]],
    poses: Mapping[str, Floats],
    places: Mapping[str, Floats],
) -> tuple[Mask, Mask, Mapping[str, Mask], Mapping[str, Mask], Mapping[str, Mask]]:
    """``Reference``'s ``busy``, ``engaged``, ``held``, ``carried`` and ``met``, from its ``poses`` and ``places``."""
    steps, robot = len(partners), int(model.body("robot0_base").rootid[0])
    # By the joint: bodies of added objects have names of another kind.
    free = {int(model.body_rootid[model.joint(f"{name}_joint0").bodyid[0]]): name for name in poses}
    things = free | {int(model.body(f"{name}_main").id): name for name in places if f"{name}_main" in _roots(model)}
    regions = [name for name in places if name not in things.values()]
    busy, engaged = np.zeros(steps, bool), np.zeros(steps, bool)
    held, carried = ({name: np.zeros(steps, bool) for name in poses} for _ in range(2))
    met = {name: np.zeros(steps, bool) for name in (*things.values(), *regions)}
    # What an object stood on until the hand took it: it is not met when that happens.
    stood_on: dict[int, set[int]] = {body: set() for body in free}
    let_go: dict[int, int] = {}
    for step, touching in enumerate(partners):
        for body in touching.get(robot, set()):
            alone = body in free and touching[body] == {robot}
            busy[step] |= not alone
            engaged[step] |= not alone and body in things
            if body in things:
                (carried if alone else met)[things[body]][step] = True
        for body, name in free.items():
            touched = touching.get(body, set())
            if robot in touched:
                held[name][step], let_go[body] = True, step
            elif not held[name].any():
                stood_on[body] |= touched
                continue
            elif step > let_go[body] + FALL:
                continue
            # The last step in the hand stands for where it came down.
            for other in (touched & things.keys()) - stood_on[body]:
                met[things[other]][let_go[body]] = True
            if touched - {robot}:
                for region in regions:
                    # Its origin is over the region, or under it.
                    away_m = np.abs(poses[name][step, :2] - places[region][:2])
                    if (away_m < model.site(region).size[:2]).all():
                        met[region][let_go[body]] = True
    return busy, engaged, held, carried, met


def _roots(model: mujoco.MjModel) -> set[str]:
    """Names of the bodies that stand in the world itself."""
    return {model.body(body).name for body in np.flatnonzero(model.body_parentid == 0)}


def _places(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, Floats]:
    """Fixture, or region of the working surface, to its pose (7,)."""
    jointed = {int(model.jnt_bodyid[joint]) for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)}
    names = [name for name in _roots(model) if name.endswith("_main") and model.body(name).id not in jointed]
    places = {name.removesuffix("_main"): fixed_pose(data, name.removesuffix("_main")) for name in sorted(names)}
    for site in range(model.nsite):
        if model.body(model.site_bodyid[site]).name in SURFACES:
            places[model.site(site).name] = fixed_pose(data, model.site(site).name)
    return places


def _partners(compiled: CompiledScene) -> dict[int, set[int]]:
    """Root body to the root bodies that it touches."""
    partners: dict[int, set[int]] = {}
    for pair in compiled.touching():
        one, other = compiled.model.body_rootid[[*pair]].tolist()
        partners.setdefault(one, set()).add(other)
        partners.setdefault(other, set()).add(one)
    return partners


def runs(mask: Mask, gap: int) -> list[tuple[int, int]]:
    """First and last index of each stretch of True; within one, neighbours are up to ``gap`` apart."""
    indices = np.flatnonzero(mask)
    parts = np.split(indices, np.flatnonzero(np.diff(indices) > gap) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts if len(part)]
