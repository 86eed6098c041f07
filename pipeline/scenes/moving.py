"""A demonstration's scene with one or all of its things moved, and whether that scene can be."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline import rotations
from pipeline.errors import RefusedError
from pipeline.libero import bddl
from pipeline.libero.task_goal import relation_holds
from pipeline.scenes.compiled import CompiledScene, simulate_held
from pipeline.types import Floats, Scene, Task

SETTLE_S = 0.3
"""How long a scene is watched. The farthest that an object of the starter demonstrations still falls takes 0.06 s."""

DEEPER_M = 0.001
"""How much deeper than recorded two things may sit in each other, such as a bowl in the wall of its drawer."""

CREEP_M, CREEP_DEG = 0.002, 2.0
"""How much farther than recorded an object may slide and tilt until it stops."""

Moves = Mapping[str, tuple[float, float]]
"""Object or fixture, by its name in the BDDL file, to its displacement (dx, dy) in m."""


def move_one(scene: Scene, task: Task, name: str, shift_m: tuple[float, float], turn_deg: float) -> Scene:
    """The scene with an object moved in the horizontal plane and turned about the vertical through its origin.

    The recorded and the moved object are both watched for ``SETTLE_S`` while everything else is held: they must come to
    rest on the same things, after as little motion.

    Raises:
        RefusedError: as ``move``.
    """
    before = CompiledScene(scene)
    moved = replace(scene, state=scene.state.copy())
    pose = before.pose_in(moved.state, name)
    pose[:2] += shift_m
    pose[3:] = rotations.product(rotations.about("z", turn_deg), pose[3:])
    after = CompiledScene(moved)
    _refuse_relations(task, after)
    _refuse(before, after, before.model.jnt_bodyid == before.model.body(f"{name}_main").id, {name: shift_m})
    found = {"moved": name, "position_m": pose[:3].tolist(), "rotation_wxyz": pose[3:].tolist()}
    return replace(moved, resolved={**scene.resolved, "pose": found})


def move(scene: Scene, task: Task, moves: Moves) -> Scene:
    """The scene with things moved in the horizontal plane: fixtures and goal regions in its MJCF, objects in its state.

    A region of the working surface that the goal names moves with the thing that it is named after, so that the front
    of the stove stays in front of the stove. The recorded and the moved scene are both watched for ``SETTLE_S`` while
    the robot and the fixtures' joints are held.

    Raises:
        RefusedError: ``relation_broken`` when something leaves what it stands on or in, or a target the place that the
            instruction names; ``object_in_collision`` when things touch that did not; ``object_unstable`` when an
            object slides or tilts more than the recorded one.
    """
    known = bddl.read(task.bddl_file)
    before = CompiledScene(scene)
    regions = {region: moves[thing] for region, thing in known.goal_regions.items() if thing in moves}
    fixtures = {name: shift for name, shift in moves.items() if name in known.fixtures}
    model_xml = _shifted(scene.model_xml, fixtures, regions)
    state = scene.state.copy()
    for name in moves.keys() - fixtures.keys():
        before.pose_in(state, name)[:2] += moves[name]
    moved = replace(scene, model_xml=model_xml, state=state)
    after = CompiledScene(moved)
    _refuse_relations(task, after)
    placed = {name: after.data.body(f"{name}_main").xpos.tolist() for name in moves}
    if _blocked(after, fixtures) - _blocked(before, fixtures):
        raise RefusedError("object_in_collision")
    _refuse(before, after, before.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE, moves)
    return replace(moved, resolved={**scene.resolved, "pose": {"positions_m": placed}})


def _shifted(model_xml: str, fixtures: Moves, regions: Moves) -> str:
    """The scene's MJCF with the bodies of fixtures and the sites of regions moved."""
    tree = ET.fromstring(model_xml)
    for element, shift in [
        *((tree.find(f"worldbody//body[@name='{name}_main']"), shift) for name, shift in fixtures.items()),
        *((tree.find(f"worldbody//site[@name='{name}']"), shift) for name, shift in regions.items()),
    ]:
        if element is None:
            raise RefusedError("scene_refused")
        x, y, z = map(float, element.get("pos", "0 0 0").split())
        element.set("pos", f"{x + shift[0]:.9g} {y + shift[1]:.9g} {z:.9g}")
    return ET.tostring(tree, encoding="unicode")


def _refuse_relations(task: Task, scene: CompiledScene) -> None:
    if not all(relation_holds(task, target, scene.xy_m) for target in bddl.read(task.bddl_file).targets):
        raise RefusedError("relation_broken")


class _Settled(NamedTuple):
    """How a scene came to rest: gaps in m of what touched at the start and at rest, and how far objects went.

    Attributes:
        started, rested: pairs of bodies to the gap between them, deepest, negative.
        slid_m, tilted_deg: (N,) of each object that was free to move.
    """

    started: Mapping[tuple[int, int], float]
    rested: Mapping[tuple[int, int], float]
    slid_m: Floats
    tilted_deg: Floats


def _settle(compiled: CompiledScene, free: NDArray[np.bool_]) -> _Settled:
    """Let objects come to rest from the compiled state while all but their joints (njnt,) are held."""
    model, data = compiled.model, compiled.data
    poses = model.jnt_qposadr[free, None] + np.arange(7)
    started, first = compiled.touching(), data.qpos[poses]
    simulate_held(model, data, np.flatnonzero(~free), SETTLE_S)
    mujoco.mj_forward(model, data)
    last = data.qpos[poses]
    cosines = np.minimum(1.0, np.abs((first[:, 3:] * last[:, 3:]).sum(axis=1)))
    slid_m: Floats = np.linalg.norm((last - first)[:, :3], axis=1)
    return _Settled(started, compiled.touching(), slid_m, np.rad2deg(2 * np.arccos(cosines)))


def _blocked(compiled: CompiledScene, fixtures: Iterable[str]) -> set[tuple[str, str]]:
    """Pairs of fixtures, or a fixture and the robot's mount, that overlap: MuJoCo has no contacts between what cannot
    move."""
    model, data = compiled.model, compiled.data
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    roots = model.body_rootid[model.geom_bodyid]
    names = ["robot0_base", *(f"{name}_main" for name in fixtures)]
    geoms = {name: np.flatnonzero(solid & (roots == model.body(name).id)) for name in names}
    overlapping = set()
    for one, other in combinations(names, 2):
        for first, second in product(geoms[one], geoms[other]):
            apart_m = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second])
            if apart_m < model.geom_rbound[first] + model.geom_rbound[second] and (
                mujoco.mj_geomDistance(model, data, first, second, 0.001, None) <= 0
            ):
                overlapping.add((one, other))
                break
    return overlapping


def _refuse(before: CompiledScene, after: CompiledScene, free: NDArray[np.bool_], moves: Moves) -> None:
    """Raise what is wrong with the moved scene, where the ``free`` of its joints (njnt,) are let move."""
    then, now = _settle(before, free), _settle(after, free)
    new = (now.started.keys() | now.rested.keys()) - (then.started.keys() | then.rested.keys())
    deeper = any(gap_m < then.started.get(pair, 0.0) - DEEPER_M for pair, gap_m in now.started.items())
    if new or deeper:
        raise RefusedError("object_in_collision")
    # Neighbours that move apart may lose touch; nothing may lose touch with what it moves with or stands on.
    shifts = {int(after.model.body(f"{name}_main").id): shift for name, shift in moves.items()}
    for pair in then.rested.keys() - now.rested.keys():
        one, other = (shifts.get(int(after.model.body_rootid[body])) for body in pair)
        if one == other or one is None or other is None:
            raise RefusedError("relation_broken")
    if (now.slid_m > then.slid_m + CREEP_M).any() or (now.tilted_deg > then.tilted_deg + CREEP_DEG).any():
        raise RefusedError("object_unstable")
