"""Displacement of one or several things in a demonstration's scene, and checks that the moved scene is possible."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline import rotations
from pipeline.errors import RejectedError
from pipeline.libero.carried import definition_of
from pipeline.libero.task_goal import instruction_holds
from pipeline.scenes.compiled import CompiledScene, simulate_held
from pipeline.types import Floats, Scene, Task

SETTLE_S = 0.3
"""Time for which a scene is simulated to check it. The longest fall in the starter demonstrations takes 0.06 s."""

DEEPER_M = 0.001
"""Largest increase over the recording of the depth by which two things overlap, such as a bowl and its drawer."""

CREEP_M, CREEP_DEG = 0.002, 2.0
"""Largest increase over the recording of the distance and the angle that an object slides and tilts until it stops."""

Moves = Mapping[str, tuple[float, float]]
"""Object or fixture, by its name in the BDDL file, to its displacement (dx, dy) in m."""


def move_one(scene: Scene, task: Task, name: str, shift_m: tuple[float, float], turn_deg: float) -> Scene:
    """Move an object of a scene in the horizontal plane, and turn it about the vertical through its origin.

    The recorded and the moved object are both simulated for ``SETTLE_S`` while everything else is held. Both must come
    to rest on the same things, and the moved object must not move more than the recorded object.

    Raises:
        RejectedError: for the reasons of ``move``.
    """
    before = CompiledScene(scene)
    moved = replace(scene, state=scene.state.copy())
    pose = before.pose_in(moved.state, name)
    pose[:2] += shift_m
    pose[3:] = rotations.product(rotations.about("z", turn_deg), pose[3:])
    after = CompiledScene(moved)
    _reject_relations(task, after)
    joints_of_object = before.model.jnt_bodyid == before.model.body(f"{name}_main").id
    _reject(before, after, joints_of_object, {name: shift_m})
    resolved = {"moved": name, "position_m": pose[:3].tolist(), "rotation_wxyz": pose[3:].tolist()}
    return replace(moved, resolved={**scene.resolved, "pose": resolved})


def move(scene: Scene, task: Task, moves: Moves) -> Scene:
    """Move things of a scene in the horizontal plane: fixtures and goal regions in its MJCF, objects in its state.

    A region of the working surface that the goal names moves with the thing that it is named after: the front of the
    stove stays in front of the stove. The recorded and the moved scene are both simulated for ``SETTLE_S`` while the
    robot and the fixtures' joints are held.

    Raises:
        RejectedError: ``relation_broken`` when a thing loses contact with the thing that it stands on or in, or a
            target leaves the place that the instruction names; ``object_in_collision`` when things touch that did not
            touch before; ``object_unstable`` when an object slides or tilts more than the recorded object.
    """
    definition = definition_of(task)
    before = CompiledScene(scene)
    regions = {region: moves[thing] for region, thing in definition.goal_regions.items() if thing in moves}
    fixtures = {name: shift for name, shift in moves.items() if name in definition.fixtures}
    model_xml = _shifted(scene.model_xml, fixtures, regions)
    state = scene.state.copy()
    for name in moves.keys() - fixtures.keys():
        before.pose_in(state, name)[:2] += moves[name]
    moved = replace(scene, model_xml=model_xml, state=state)
    after = CompiledScene(moved)
    _reject_relations(task, after)
    positions_m = {name: after.data.body(f"{name}_main").xpos.tolist() for name in moves}
    if _blocked(after, fixtures) - _blocked(before, fixtures):
        raise RejectedError("object_in_collision")
    _reject(before, after, before.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE, moves)
    return replace(moved, resolved={**scene.resolved, "pose": {"positions_m": positions_m}})


def _shifted(model_xml: str, fixtures: Moves, regions: Moves) -> str:
    """Move the bodies of fixtures and the sites of regions in a scene's MJCF."""
    tree = ET.fromstring(model_xml)
    shifts = {f"body[@name='{name}_main']": shift for name, shift in fixtures.items()}
    shifts |= {f"site[@name='{name}']": shift for name, shift in regions.items()}
    for path, shift in shifts.items():
        element = tree.find(f"worldbody//{path}")
        if element is None:
            raise RejectedError("scene_refused")
        x, y, z = map(float, element.get("pos", "0 0 0").split())
        element.set("pos", f"{x + shift[0]:.9g} {y + shift[1]:.9g} {z:.9g}")
    return ET.tostring(tree, encoding="unicode")


def _reject_relations(task: Task, scene: CompiledScene) -> None:
    """Reject a scene in which the instruction no longer describes the task's objects."""
    if not instruction_holds(task, scene.xy_m):
        raise RejectedError("relation_broken")


class _Settled(NamedTuple):
    """Contacts of a scene at the start and at rest, and the motion of its objects.

    Attributes:
        started, rested: pairs of touching bodies, at the start and at rest, to their deepest gap in m, negative or 0.
        slid_m, tilted_deg: (N,) distance and angle of each object that was free to move.
    """

    started: Mapping[tuple[int, int], float]
    rested: Mapping[tuple[int, int], float]
    slid_m: Floats
    tilted_deg: Floats


def _settle(compiled: CompiledScene, free: NDArray[np.bool_]) -> _Settled:
    """Let objects come to rest from the compiled state; all joints are held except the joints ``free`` (njnt,)."""
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
    """Return pairs of fixtures, and of a fixture and the robot's mount, that overlap.

    MuJoCo computes no contacts between immovable bodies.
    """
    model, data = compiled.model, compiled.data
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    roots = model.body_rootid[model.geom_bodyid]
    names = ["robot0_base", *(f"{name}_main" for name in fixtures)]
    geoms = {name: np.flatnonzero(solid & (roots == model.body(name).id)) for name in names}
    overlapping = set()
    for first_name, second_name in combinations(names, 2):
        for first, second in product(geoms[first_name], geoms[second_name]):
            centres_apart_m = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second])
            spheres_overlap = centres_apart_m < model.geom_rbound[first] + model.geom_rbound[second]
            if spheres_overlap and mujoco.mj_geomDistance(model, data, first, second, 0.001, None) <= 0:
                overlapping.add((first_name, second_name))
                break
    return overlapping


def _reject(before: CompiledScene, after: CompiledScene, free: NDArray[np.bool_], moves: Moves) -> None:
    """Settle the recorded and the moved scene, and reject the moved scene if it differs too much.

    Args:
        before: the recorded scene.
        after: the moved scene.
        free: (njnt,) mask of the joints that can move; all other joints are held.
        moves: displacements of the moved things.

    Raises:
        RejectedError: for the reasons of ``move``.
    """
    recorded, moved = _settle(before, free), _settle(after, free)
    new = (moved.started.keys() | moved.rested.keys()) - (recorded.started.keys() | recorded.rested.keys())
    deeper = any(gap_m < recorded.started.get(pair, 0.0) - DEEPER_M for pair, gap_m in moved.started.items())
    if new or deeper:
        raise RejectedError("object_in_collision")
    # Neighbours that move apart may lose contact. A thing must not lose contact with the thing that it moves with or
    # stands on.
    shifts = {int(after.model.body(f"{name}_main").id): shift for name, shift in moves.items()}
    for pair in recorded.rested.keys() - moved.rested.keys():
        first_shift, second_shift = (shifts.get(int(after.model.body_rootid[body])) for body in pair)
        if first_shift == second_shift or first_shift is None or second_shift is None:
            raise RejectedError("relation_broken")
    slid_farther = (moved.slid_m > recorded.slid_m + CREEP_M).any()
    tilted_farther = (moved.tilted_deg > recorded.tilted_deg + CREEP_DEG).any()
    if slid_farther or tilted_farther:
        raise RejectedError("object_unstable")
