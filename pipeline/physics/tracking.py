"""Tracked replay: repetition of a successful rollout by feedback, from another start or with moved objects.

A ``Route`` is a reference rollout bent to a new scene: it begins at the hand's position and meets every moved object at
its new place. ``follow`` yields the actions that keep the hand on the route. Each action is the sum of the
demonstrator's action, the bend's own motion and feedback. Actions use the OSC_POSE interface at 20 Hz, like policies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.episode_schema import SCHEMA
from pipeline.errors import RejectedError
from pipeline.physics.reference import Reference, runs
from pipeline.types import Floats

OUTPUT_MAX = SCHEMA.action.units
"""(6,) m and rad that an action of 1 commands (robosuite's ``osc_pose.json``)."""

STRIDE = 0.306 * OUTPUT_MAX
"""(6,) m and rad that the hand travels in a control step under a steady action of 1.

OSC accelerates the hand by 150 / s^2 times the commanded distance and damps it by 2 sqrt(150) / s. The hand's speed
settles at 6.12 / s times this distance, which is 0.306 times the distance in the 50 ms of a step.
"""

GAIN = 0.8
"""Share of the error that the feedback commands in each step; at 1, OSC and feedback together are critically damped."""

TOLERANCE_M, TOLERANCE_RAD = 0.03, 0.15
"""Errors at which the route waits for the hand; it slows down from half of these errors."""

PATIENCE = 80.0
"""Control steps (4 s) that the route waits in all; if the hand is blocked for longer, it resumes without waiting."""

REGRASP = 0.1
"""Share of the difference in grasp that is added to the route's correction in each control step."""

LOST_M = 0.05
"""Largest difference in grasp; beyond it, the object was not grasped or was dropped."""

BEND_SPEED = 0.6
"""Largest share of the hand's speed that returning to the demonstrated route may take by itself."""

TILTED_RAD = 0.3
"""Largest tilt of a thing that the hand meets: if it is tilted by more, it has fallen over, and the scene is rejected.

In LIBERO's initial states, the bowl on the ramekin is tilted by 0.07 rad relative to the human's. At a reset it is
tilted by more, because it still falls.
"""

MARGIN = 4
"""Control steps before a contact by which a bend is complete."""

FLICKER = 8
"""Longest gap, in control steps, within one contact."""

MOVED_M = 0.02
"""Least distance that an object travels in a rollout that manipulates it."""

Hand = tuple[Floats, Rotation]
"""Position (3,) in m and orientation of the grip site in the world's frame."""


@dataclass(frozen=True)
class Route:
    """Wanted poses of the hand before each action and after the last.

    Attributes:
        reference: the rollout.
        positions_m: (K+1, 3).
        rotations: K+1.
    """

    reference: Reference
    positions_m: Floats
    rotations: Rotation

    @classmethod
    def through(cls, reference: Reference, hand: Hand, poses: Mapping[str, Floats]) -> Route:
        """Bend a reference to a scene.

        An object's displacement (along and across the vertical, and about it) is followed from before the hand meets
        the object until the object is carried off. Then the route returns to the reference on the way to the goal.

        Supports and containers of objects, and parts that are opened, closed or turned, are followed from before the
        hand meets them until their last contact. If several things are met at once, things that the hand moves come
        first, then things that it meets for longest.

        Args:
            reference: the rollout.
            hand: the hand's pose at the start.
            poses: object, fixture or region to its pose (7,) in the scene; things that are left out have not moved.

        Raises:
            RejectedError: ``object_not_upright`` if a thing that the hand meets has fallen over. No bend about the
                vertical follows such a displacement.
        """

        def rank(name: str) -> tuple[bool, int]:
            return not _moves(reference, name), -int(reference.met[name].sum())

        positions, rotations = reference.positions_m, reference.rotations
        free_share: Floats = np.ones(len(reference) + 1)
        for name in sorted(poses, key=rank):
            pose = poses[name]
            reference_pose = reference.poses[name][0] if name in reference.poses else reference.places[name]
            shift_m = pose[:3] - reference_pose[:3]
            turn = (_rotation(pose) * _rotation(reference_pose).inv()).as_rotvec()
            if np.abs(shift_m).max() < 1e-4 and np.abs(turn).max() < 1e-3:
                continue
            share = _share_to_follow(reference, name) * free_share
            if np.abs(turn[:2]).max() > TILTED_RAD and share.any():
                raise RejectedError("object_not_upright")
            free_share = free_share - share
            yaw = np.array([0.0, 0.0, turn[2]])
            positions, rotations = _bend_to_thing(positions, rotations, reference_pose[:3], shift_m, yaw, share)
        start_shift_m, start_turn = hand[0] - positions[0], (hand[1] * rotations[0].inv()).as_rotvec()
        start_share = _returning(reference, np.concatenate([start_shift_m, start_turn]))[:, None]
        return cls(
            reference,
            positions + start_share * start_shift_m,
            Rotation.from_rotvec(start_share * start_turn) * rotations,
        )

    def __len__(self) -> int:
        return len(self.reference)

    def at(self, index: float) -> Hand:
        """Interpolate the wanted pose of the hand at a fractional index."""
        step = min(int(index), len(self) - 1)
        fraction = index - step
        turn = (self.rotations[step + 1] * self.rotations[step].inv()).as_rotvec()
        position: Floats = (1 - fraction) * self.positions_m[step] + fraction * self.positions_m[step + 1]
        return position, Rotation.from_rotvec(fraction * turn) * self.rotations[step]


def _bend_to_thing(
    positions_m: Floats, rotations: Rotation, place_m: Floats, shift_m: Floats, yaw: Floats, share: Floats
) -> tuple[Floats, Rotation]:
    """Return a route that follows a moved thing.

    Args:
        positions_m, rotations: (K+1, 3) and K+1, the route.
        place_m: (3,) place of the thing in the reference.
        shift_m: (3,) displacement of the thing.
        yaw: (3,) turn of the thing about the vertical, a rotation vector in rad.
        share: (K+1,) share of the displacement that each pose of the route follows.
    """
    weights = share[:, None]
    turned = Rotation.from_rotvec(yaw).apply(positions_m - place_m)
    displaced = place_m + shift_m + turned
    positions_m = positions_m + weights * (displaced - positions_m)
    return positions_m, Rotation.from_rotvec(weights * yaw) * rotations


def follow(route: Route, hand: Callable[[], Hand], pose: Callable[[str], Floats]) -> Iterator[Floats]:
    """Yield the actions (7,) in [-1, 1] that keep the hand on a route; each action is computed when it is requested.

    The index along the route advances by one a step, so grasp and release keep their timing. It advances more slowly
    while the hand is far from its wanted pose. A carried object may have been grasped differently than in the
    reference. While an object is carried, the object instead of the hand is brought to its place in the reference.

    Args:
        route: the route.
        hand: returns the hand's current pose.
        pose: returns an object's current pose (7,) by its name.
    """
    reference = route.reference
    turns = (route.rotations * reference.rotations.inv()).as_rotvec()
    bend = np.hstack([route.positions_m - reference.positions_m, turns])
    steps = np.arange(len(route) + 1)
    index, patience = 0.0, PATIENCE
    grasp: Floats = np.zeros(3)
    while index < len(route):
        position, rotation = hand()
        wanted_position, wanted_rotation = route.at(index)
        offset = _grasp_offset(reference, int(index), (position, rotation), pose, grasp)
        grasp = grasp + REGRASP * (offset - grasp)
        wanted_position = wanted_position + wanted_rotation.apply(grasp)
        error = np.concatenate([wanted_position - position, (wanted_rotation * rotation.inv()).as_rotvec()])
        relative_error = max(np.linalg.norm(error[:3]) / TOLERANCE_M, np.linalg.norm(error[3:]) / TOLERANCE_RAD)
        rate = float(np.clip(2 - 2 * relative_error, 0.0, 1.0)) if patience > 0 else 1.0
        patience -= 1 - rate
        # Round the index: otherwise a tiny rest of the route could remain, which would cost one more step.
        upcoming = min(round(index + rate, 6), float(len(route)))
        demonstrated = reference.actions[int(index)]
        bend_motion = [np.interp(upcoming, steps, column) - np.interp(index, steps, column) for column in bend.T]
        action = demonstrated.copy()
        action[:6] = np.clip(rate * demonstrated[:6] + bend_motion / STRIDE + GAIN * error / OUTPUT_MAX, -1.0, 1.0)
        yield action
        index = upcoming


def _grasp_offset(
    reference: Reference, step: int, hand: Hand, pose: Callable[[str], Floats], last_offset: Floats
) -> Floats:
    """Return the offset (3,) in m from a carried object's place in the hand to its place in the reference's hand.

    The offset is in the hand's frame. It is zero if nothing is carried. While the object is put down, contacts shift it
    in the hand, so the offset stays ``last_offset``.
    """
    held = [name for name, mask in reference.held.items() if mask[step]]
    carried = [name for name in held if reference.carried[name][step]]
    if not carried:
        return last_offset if held else np.zeros(3)
    name, (position, rotation) = carried[0], hand
    reference_reach = reference.poses[name][step, :3] - reference.positions_m[step]
    place_in_reference = reference.rotations[step].inv().apply(reference_reach)
    offset: Floats = place_in_reference - rotation.inv().apply(pose(name)[:3] - position)
    return offset if np.linalg.norm(offset) < LOST_M else np.zeros(3)


def _share_to_follow(reference: Reference, name: str) -> Floats:
    """Return the share (K+1,) of a moved thing's displacement that the hand has to follow at each state."""
    if _moves(reference, name):
        held_steps = np.flatnonzero(reference.held[name])
        carried_runs = runs(reference.carried[name], FLICKER)
        long_runs = [(first, last) for first, last in carried_runs if last - first >= MARGIN]
        first = int(held_steps[0])
        # The object is carried off, or pushed all the way. The share falls to 0 until the object is put down.
        taken, put_down = long_runs[0] if long_runs else (first, int(held_steps[-1]))
        full_until = max(taken, first)
        return _window(reference, full_from=first, full_until=full_until, zero_from=put_down - MARGIN, rise_from=None)
    weights: Floats = np.zeros(len(reference) + 1)
    for first, last in runs(reference.met[name], FLICKER):
        rise_from = _pushed_since(reference, first) if name in reference.places else first
        later = np.flatnonzero(reference.engaged[last + FLICKER + 1 :])
        zero_from = last + FLICKER + 1 + int(later[0]) - MARGIN if len(later) else None
        window = _window(reference, full_from=first, full_until=last, zero_from=zero_from, rise_from=rise_from)
        weights = np.maximum(weights, window)
    return weights


def _pushed_since(reference: Reference, step: int) -> int:
    """Return the step since which the hand holds a moved object that it holds at ``step``; else ``step``.

    The hand may push an object along the table for long before the object meets a place.
    """
    since = step
    for name, mask in reference.held.items():
        if _moves(reference, name):
            for first, last in runs(mask, FLICKER):
                if first <= step <= last:
                    since = min(since, first)
    return since


def _moves(reference: Reference, name: str) -> bool:
    """Return whether the hand carries or pushes a thing to another place."""
    if name not in reference.poses or not reference.held[name].any():
        return False
    travelled = np.linalg.norm(reference.poses[name][:, :3] - reference.poses[name][0, :3], axis=1)
    return bool(travelled.max() > MOVED_M)


def _window(
    reference: Reference, *, full_from: int, full_until: int, zero_from: int | None, rise_from: int | None
) -> Floats:
    """Return weights (K+1,): 1 from shortly before ``full_from`` to ``full_until``, and 0 from ``zero_from`` on.

    The weights rise after the last contact before ``full_from``, and after the hand has released all objects other
    than the object that it holds at ``full_from``. If ``rise_from`` is earlier, they rise from ``rise_from`` on.
    """
    steps = np.arange(len(reference) + 1)
    engaged = reference.engaged.copy()
    for held in reference.held.values():
        if not held[max(full_from - FLICKER, 0) : full_from + 1].any():
            engaged |= held
    contacts_before = np.flatnonzero(engaged[: max(full_from - FLICKER, 0)])
    start = int(contacts_before[-1]) + 1 if len(contacts_before) else 0
    if rise_from is not None:
        start = min(start, rise_from)
    weights = _smooth((steps - start) / max(full_from - MARGIN - start, 1))
    if zero_from is not None:
        weights = np.minimum(weights, 1 - _smooth((steps - full_until) / max(zero_from - full_until, 1)))
    return weights


def _returning(reference: Reference, offset: Floats) -> Floats:
    """Return the share (K+1,) of the start's offset (6,) (m, rad) that remains at each state.

    The share reaches 0 before the first contact, or earlier if ``BEND_SPEED`` allows it.
    """
    # 15/8 is the largest slope of the smooth step.
    steps_needed = float(np.abs(offset / STRIDE).max()) * 15 / 8 / BEND_SPEED
    contacts = np.flatnonzero(reference.busy)
    steps_available = float(contacts[0] - MARGIN) if len(contacts) else float(len(reference))
    return 1 - _smooth(np.arange(len(reference) + 1) / max(min(steps_needed, steps_available), 1.0))


def _smooth(x: Floats) -> Floats:
    """Rise from 0 to 1 over the unit interval with the least jerk, at rest at both ends (Flash and Hogan 1985)."""
    share: Floats = np.clip(x, 0.0, 1.0)
    return np.asarray(share**3 * (10 - 15 * share + 6 * share**2))


def _rotation(pose: Floats) -> Rotation:
    """Return the rotation of a pose (7,), whose quaternion is wxyz."""
    return Rotation.from_quat(pose[[4, 5, 6, 3]])
