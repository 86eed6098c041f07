"""Placement of objects in a demonstration's scene, outside of the demonstration's path."""

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from pipeline import seeding
from pipeline.catalogue.object_model import ObjectModel
from pipeline.errors import RejectedError
from pipeline.libero.arenas import ARENAS
from pipeline.libero.bddl import Bddl
from pipeline.libero.carried import definition_of
from pipeline.scenes.agent_view import AgentView
from pipeline.scenes.compiled import CompiledScene, compile_for_physics, simulate_held
from pipeline.scenes.swept_path import SweptPath
from pipeline.types import Demo, Floats, RollOut, Scene, State

_BODY = "layout"
MOST_SCENES, MOST_PLACES = 12, 60
"""Number of attempts before giving up: whole scenes, and places of one object in either region."""
SAMPLED_CLEARANCE_M, CLEARANCE_M = 0.02, 0.015
"""Least distance of an object from the demonstration's path: at the sampled place, and after it has come to rest."""
HIDDEN = 1 / 3
"""Largest share of a thing of the task, as the first frame shows it, that added objects may cover.

The visible part is then at least twice the covered part, so the thing is still recognised by its colour and outline.
"""
SEEN_PX, PLACED_PX = 20, 30
"""Least number of pixels, of 256 x 256, on which an added object is visible in the agent view's first frame.

``SEEN_PX`` is the limit for the frame, ``PLACED_PX`` the limit for the placement. The placement needs more pixels,
because it uses rays, whose pixels at outlines differ somewhat from the rendered pixels.
"""
_SETTLE_S, _REST_S = 1.0, 0.25
_STILL_M, _TILT_DEG, _SLID_M = 2e-4, 15.0, 0.03
_DISTURBED_M = 1e-3


def place(scene: Scene, demo: Demo, objects: Sequence[ObjectModel], seed: int, roll_out: RollOut) -> Scene:
    """Add objects to a scene: at rest on its working surface, visible, and outside of the demonstration's path.

    All things of the scene keep their recorded state exactly, and gripper and controller keep their targets. The
    objects' joints come last: the state is time, the old qpos, the new qpos (7 each), the old qvel, the new qvel (6
    each).

    Args:
        scene: the scene at the start of the demonstration.
        demo: the demonstration.
        objects: the objects to add.
        seed: seed of the sampled places.
        roll_out: function that returns the states of the demonstration's actions in the scene without added objects.

    Raises:
        RejectedError: when no place was found; its reason is the most frequent reason for the rejection of places.
    """
    placement = _Placement(scene, roll_out(scene, demo), objects, definition_of(demo.task))
    rejected: Counter[str] = Counter()
    for attempt in range(MOST_SCENES):
        poses = placement.sample(seeding.rng(seed, "layout", attempt), rejected)
        if poses is None:
            continue
        settled, fault = placement.settle(poses)
        if fault:
            rejected[fault] += 1
            continue
        placed = []
        for model, pose, px in zip(objects, settled, placement.seen_px(settled), strict=True):
            position_m, quaternion = pose[:3].tolist(), pose[3:].tolist()
            placed.append({"name": model.name, "position_m": position_m, "quaternion_wxyz": quaternion, "seen_px": px})
        resolved = {"objects": placed, "scenes": attempt + 1, "rejected": dict(sorted(rejected.items()))}
        return replace(
            scene,
            model_xml=placement.model_xml,
            state=placement.state_with(scene.state, settled),
            resolved={**scene.resolved, "layout": resolved},
        )
    raise RejectedError(f"layout_{max(sorted(rejected), key=rejected.__getitem__)}")


def added_names(resolved: Mapping[str, Any]) -> list[str]:
    """List the catalogue's names of the objects that were added to a scene, by its ``resolved``, in their order."""
    return [placed["name"] for placed in resolved.get("layout", {}).get("objects", [])]


def added_objects(model: mujoco.MjModel) -> list[str]:
    """List the bodies of the objects that were added to a scene, in their order."""
    names = (model.body(body).name for body in range(model.nbody))
    return [name for name in names if re.fullmatch(rf"{_BODY}\d+", name)]


def enough_seen(seen_px: Sequence[int], least_px: int = SEEN_PX) -> bool:
    """Return whether enough added objects are visible on at least ``least_px`` pixels.

    At most one object may be less visible, and at least one object must be visible.
    """
    visible = sum(px >= least_px for px in seen_px)
    return visible >= max(1, len(seen_px) - 1)


def _with(model_xml: str, objects: Sequence[ObjectModel], names: Sequence[str]) -> str:
    """Insert the objects' MJCF into a scene's MJCF, at the ends of its assets and of its bodies."""
    models = [model.mjcf_of(name) for model, name in zip(objects, names, strict=True)]
    assets, bodies = zip(*models, strict=True)
    for end, added in (("</asset>", assets), ("</worldbody>", bodies)):
        before, _, after = model_xml.rpartition(end)
        model_xml = f"{before}{''.join(added)}{end}{after}"
    return model_xml


class _Placement:
    """A scene with added objects whose places are not yet decided.

    Args:
        scene: the scene without the objects.
        states: (K+1, S) states of the demonstration in the scene without the objects.
        objects: the added objects.
        definition: the demonstration's task.
    """

    def __init__(self, scene: Scene, states: Floats, objects: Sequence[ObjectModel], definition: Bddl):
        names = [f"{_BODY}{number}" for number in range(len(objects))]
        self.model_xml = _with(scene.model_xml, objects, names)
        self._state, self._states, self._objects = scene.state, states, objects
        self._parked = np.array([[50.0 + 5 * number, 0.0, 50.0, 1.0, 0.0, 0.0, 0.0] for number in range(len(names))])
        model = compile_for_physics(self.model_xml)
        self._old_nq = model.nq - 7 * len(names)
        self._scene = CompiledScene(Scene(self.model_xml, self.state_with(states[0], self._parked)))
        self._added = [model.body(name).id for name in names]
        path = np.stack([State.of(state, self._old_nq).qpos for state in states])
        self._swept = SweptPath(model, np.isin(model.geom_bodyid, self._added), path)
        self._regions = ARENAS[definition.arena].regions
        self._view = AgentView(model, self._scene.data)
        things = [int(model.body(f"{thing}_main").rootid[0]) for thing in definition.things_of_interest]
        self._things_px = [pixels for pixels in self._view.pixels_of(things) if len(pixels)]

    def state_with(self, state: Floats, poses: Floats) -> Floats:
        """Extend a state (S,) of the scene without the objects by the objects at rest at poses (N, 7)."""
        time, qpos, qvel = State.of(state, self._old_nq)
        return State(time, np.append(qpos, poses), np.append(qvel, np.zeros(6 * len(poses)))).flat

    def sample(self, rng: np.random.Generator, rejected: Counter[str]) -> Floats | None:
        """Sample a pose for each object, the broadest object first.

        Args:
            rng: source of random numbers.
            rejected: counts, for each reason, the places that are rejected.

        Returns:
            (N, 7) poses, or `None` if no place is left for an object.
        """
        poses = self._parked.copy()
        broadest_first = sorted(range(len(poses)), key=lambda number: -self._objects[number].shape.footprint_m2)
        for number in broadest_first:
            first, second = self._regions.order(rng)
            for region in [first] * MOST_PLACES + [second] * MOST_PLACES:
                fault = self._fault_at(poses, number, region.sample(rng), rng.uniform(-np.pi, np.pi))
                if fault is None:
                    break
                rejected[fault] += 1
            else:
                return None
        return poses

    def _fault_at(self, poses: Floats, number: int, at_m: Floats, yaw: float) -> str | None:
        """Put one object into ``poses`` and return why the place is rejected.

        Return `None` for an accepted place. A rejected object is parked again.
        """
        low, high, _ = self._objects[number].shape
        half = (np.array(high) - np.array(low)) / 2
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        corners = np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]]) * half[:2] @ turn.T + at_m
        heights = [self._swept.height(corner) for corner in corners]
        if min(heights) == -np.inf or max(heights) - min(heights) > 1e-3:
            return "off_the_surface"
        poses[number] = [*at_m, heights[0] + 0.001, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        if not self._view.holds(poses[number, :3] + [0, 0, half[2]]):
            # The object's middle must be in view: the border of the frame then cuts off at most about half of it.
            fault = "out_of_view"
        elif not self._swept.clear(poses, SAMPLED_CLEARANCE_M):
            fault = "in_the_way"
        elif self.seen_px(poses)[number] < PLACED_PX:
            fault = "not_seen"
        elif self._hidden(poses) > HIDDEN:
            fault = "hides_target"
        else:
            return None
        poses[number] = self._parked[number]
        return fault

    def settle(self, poses: Floats) -> tuple[Floats, str | None]:
        """Let the objects come to rest while the robot is held.

        Returns:
            (N, 7) poses at rest, and the reason why they are rejected or `None`.
        """
        at_rest, places_m = self._simulated(poses, held=False)
        _, places_without_m = self._simulated(self._parked, held=True)
        # Some demonstrations begin while an object is still falling over: only the difference is caused by the objects.
        if np.linalg.norm(places_m - places_without_m, axis=1).max() > _DISTURBED_M:
            return poses, "moved_another_object"
        rest, before = at_rest
        if np.linalg.norm((rest - before)[:, :3], axis=1).max() > _STILL_M:
            return poses, "not_at_rest"
        upright = 1 - 2 * (rest[:, 4] ** 2 + rest[:, 5] ** 2)
        slid = np.linalg.norm((rest - poses)[:, :3], axis=1)
        if upright.min() < np.cos(np.deg2rad(_TILT_DEG)) or slid.max() > _SLID_M:
            return poses, "fell_over"
        rest = np.round(rest, 6) + 0.0  # no -0.0
        if not self._swept.clear(rest, CLEARANCE_M):
            return poses, "in_the_way"
        if self._hidden(rest) > HIDDEN:
            return poses, "hides_target"
        if not enough_seen(self.seen_px(rest), PLACED_PX):
            return poses, "not_seen"
        return rest, None

    def seen_px(self, poses: Floats) -> list[int]:
        """Count the pixels of the agent view's first frame that show each object; 0 for a parked object."""
        self._scene.restore(self.state_with(self._states[0], poses))
        counts = []
        for body, model, pose in zip(self._added, self._objects, poses, strict=True):
            low, high, _ = model.shape
            # A body's origin is in the middle of its underside.
            half = (np.array(high) - np.array(low)) / 2
            corners = np.array(list(itertools.product((-1, 1), (-1, 1), (0, 2)))) * half
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, pose[3:])
            # The shape bounds the collision geometry; the rendered geometry may be somewhat larger.
            pixels = self._view.pixels_near(corners @ turn.reshape(3, 3).T + pose[:3])
            counts.append(int((self._view.shown(pixels) == body).sum()))
        return counts

    def _simulated(self, poses: Floats, held: bool) -> tuple[tuple[Floats, Floats], Floats]:
        """Simulate the scene with the objects at some poses while the robot is held.

        Args:
            poses: (N, 7) poses of the objects at the start.
            held: hold the objects too.

        Returns:
            The objects' poses (N, 7) at the end, their poses ``_REST_S`` before, and the positions (B, 3) of all other
            bodies at the end.
        """
        self._scene.restore(self.state_with(self._state, poses))
        model, data = self._scene.model, self._scene.data
        robot = [joint for joint in range(model.njnt) if model.joint(joint).name.startswith(("robot0_", "gripper0_"))]
        still = np.append(robot, np.flatnonzero(held & (model.jnt_qposadr >= self._old_nq)))
        poses_at = []
        for seconds in (_SETTLE_S, _REST_S):
            simulate_held(model, data, still, seconds)
            poses_at.append(data.qpos[self._old_nq :].reshape(-1, 7).copy())
        mujoco.mj_kinematics(model, data)
        other_bodies_m = data.xpos[: model.nbody - len(poses)].copy()
        return (poses_at[1], poses_at[0]), other_bodies_m

    def _hidden(self, poses: Floats) -> float:
        """Return the share of the most covered thing of the task that the objects cover in the first frame."""
        self._scene.restore(self.state_with(self._states[0], poses))
        shares = [np.isin(self._view.shown(pixels), self._added).mean() for pixels in self._things_px]
        return float(max(shares, default=0.0))
