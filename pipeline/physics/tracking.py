"""Tracked replay: repeating by feedback what succeeded once, from another start or with objects moved.

A ``Route`` is a reference rollout bent so that it begins where the hand is and meets every moved object where it now
stands. ``follow`` yields the actions that keep the hand on it: what the demonstrator did, plus the bend's own motion,
plus feedback, through the same OSC_POSE interface at 20 Hz that policies act through.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.errors import RefusedError
from pipeline.physics.reference import Reference, runs
from pipeline.types import Floats

OUTPUT_MAX = np.array([0.05, 0.05, 0.05, 0.5, 0.5, 0.5])
"""(6,) m and rad that an action of 1 asks for (robosuite's ``osc_pose.json``)."""

STRIDE = 0.306 * OUTPUT_MAX
"""(6,) m and rad that the hand travels in a control step under a steady action of 1.

OSC accelerates the hand by 150 / s^2 times the distance asked for and damps it by 2 sqrt(150) / s, so it settles at
6.12 / s times that distance: 0.306 times in the 50 ms of a step.
"""

GAIN = 0.8
"""Share of the error that the feedback asks for in each step; at 1, OSC and feedback together are critically damped."""

TOLERANCE_M, TOLERANCE_RAD = 0.03, 0.15
"""Errors at which the route waits for the hand; it slows down from half of them."""

PATIENCE = 80.0
"""Control steps (4 s) that the route waits in all; where the hand is held up for longer, it goes on without waiting."""

REGRASP = 0.1
"""Share of the difference in grasp that is added to the route's correction in each control step."""

LOST_M = 0.05
"""An object whose place in the hand differs by more than this was not grasped, or was dropped."""

BEND_SPEED = 0.6
"""Largest share of the hand's speed that returning to the demonstrated route may take by itself."""

TILTED_RAD = 0.3
"""A thing that the hand meets is not tried where it is tilted by more: it has fallen over. The bowl on the ramekin is
0.07 from the human's in LIBERO's initial states, and more at a reset, where it still falls."""

MARGIN = 4
"""Control steps before a contact by which a bend is complete."""

FLICKER = 8
"""Longest gap, in control steps, within what counts as one contact."""

MOVED_M = 0.02
"""How far an object travels in a rollout that manipulates it."""

Hand = tuple[Floats, Rotation]
"""Position (3,) in m and orientation of the grip site in the world's frame."""


@dataclass(frozen=True)
class Route:
    """Where the hand should be before each action and after the last.

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

        An object's displacement (about the vertical and along it and across it) is followed from before the hand
        meets it until it is carried off; then the route returns to the reference on the way to the goal. What objects
        are put on or in, and what is opened, closed or turned, is followed from before the hand meets it until its
        last contact. Where several are met at once, what the hand moves comes first, then what it meets for longest.

        Args:
            hand: where the hand starts.
            poses: object, fixture or region to its pose (7,) in the scene; those that are left out have not moved.

        Raises:
            RefusedError: ``object_not_upright`` when a thing that the hand meets has fallen over, which no bend about
                the vertical follows.
        """
        positions, rotations = reference.positions_m, reference.rotations
        free: Floats = np.ones(len(reference) + 1)
        for name in sorted(poses, key=lambda name: (not _moves(reference, name), -int(reference.met[name].sum()))):
            pose, then = poses[name], reference.poses[name][0] if name in reference.poses else reference.places[name]
            shift = pose[:3] - then[:3]
            turn = (_rotation(pose) * _rotation(then).inv()).as_rotvec()
            if np.abs(shift).max() < 1e-4 and np.abs(turn).max() < 1e-3:
                continue
            share = _followed(reference, name) * free
            if np.abs(turn[:2]).max() > TILTED_RAD and share.any():
                raise RefusedError("object_not_upright")
            upright = np.array([0.0, 0.0, turn[2]])
            free, weights = free - share, share[:, None]
            displaced = then[:3] + shift + Rotation.from_rotvec(upright).apply(positions - then[:3])
            positions = positions + weights * (displaced - positions)
            rotations = Rotation.from_rotvec(weights * upright) * rotations
        shift, turn = hand[0] - positions[0], (hand[1] * rotations[0].inv()).as_rotvec()
        weights = _returning(reference, np.concatenate([shift, turn]))[:, None]
        return cls(reference, positions + weights * shift, Rotation.from_rotvec(weights * turn) * rotations)

    def __len__(self) -> int:
        return len(self.reference)

    def at(self, index: float) -> Hand:
        """Where the hand should be at a fractional index."""
        step = min(int(index), len(self) - 1)
        way = index - step
        turn = (self.rotations[step + 1] * self.rotations[step].inv()).as_rotvec()
        position: Floats = (1 - way) * self.positions_m[step] + way * self.positions_m[step + 1]
        return position, Rotation.from_rotvec(way * turn) * self.rotations[step]


def follow(route: Route, hand: Callable[[], Hand], pose: Callable[[str], Floats]) -> Iterator[Floats]:
    """Actions (7,) in [-1, 1] that keep the hand on a route; each is made when it is asked for.

    The index along the route advances by one a step, so that grasp and release keep their timing, and more slowly while
    the hand is far from where it should be. While something is carried, it is brought where it was in the reference
    rather than the hand, because it may have been grasped differently. ``hand`` and ``pose`` give where the hand and an
    object (7,) are.
    """
    reference = route.reference
    turns = (route.rotations * reference.rotations.inv()).as_rotvec()
    bend = np.hstack([route.positions_m - reference.positions_m, turns])
    steps = np.arange(len(route) + 1)
    index, patience = 0.0, PATIENCE
    grasp: Floats = np.zeros(3)
    while index < len(route):
        (position, rotation), (wanted_position, wanted_rotation) = hand(), route.at(index)
        grasp = grasp + REGRASP * (_grasp_offset(reference, int(index), (position, rotation), pose, grasp) - grasp)
        wanted_position = wanted_position + wanted_rotation.apply(grasp)
        error = np.concatenate([wanted_position - position, (wanted_rotation * rotation.inv()).as_rotvec()])
        off = max(np.linalg.norm(error[:3]) / TOLERANCE_M, np.linalg.norm(error[3:]) / TOLERANCE_RAD)
        rate = float(np.clip(2 - 2 * off, 0.0, 1.0)) if patience > 0 else 1.0
        patience -= 1 - rate
        # Rounding must not leave a very short rest of the route, which would cost one more step.
        upcoming = min(round(index + rate, 6), float(len(route)))
        demonstrated = reference.actions[int(index)]
        moved = [np.interp(upcoming, steps, column) - np.interp(index, steps, column) for column in bend.T]
        action = demonstrated.copy()
        action[:6] = np.clip(rate * demonstrated[:6] + moved / STRIDE + GAIN * error / OUTPUT_MAX, -1.0, 1.0)
        yield action
        index = upcoming


def _grasp_offset(reference: Reference, step: int, hand: Hand, pose: Callable[[str], Floats], before: Floats) -> Floats:
    """(3,) m from where a carried object is in the hand to where it was in the reference's, in the hand's frame.

    Zero when nothing is carried; ``before`` while it is put down, because contacts then shift it in the hand.
    """
    held = [name for name, mask in reference.held.items() if mask[step]]
    carried = [name for name in held if reference.carried[name][step]]
    if not carried:
        return before if held else np.zeros(3)
    name, (position, rotation) = carried[0], hand
    then = reference.rotations[step].inv().apply(reference.poses[name][step, :3] - reference.positions_m[step])
    off: Floats = then - rotation.inv().apply(pose(name)[:3] - position)
    return off if np.linalg.norm(off) < LOST_M else np.zeros(3)


def _followed(reference: Reference, name: str) -> Floats:
    """(K+1,) share of a moved object's displacement that the hand has to take over at each state."""
    weights: Floats = np.zeros(len(reference) + 1)
    if _moves(reference, name):
        held, carried = reference.held[name], runs(reference.carried[name], FLICKER)
        carried = [(first, last) for first, last in carried if last - first >= MARGIN]
        first = int(np.flatnonzero(held)[0])
        # Carried off, or pushed all the way: the displacement is given back until it is put down.
        taken, put_down = carried[0] if carried else (first, int(np.flatnonzero(held)[-1]))
        return np.maximum(weights, _window(reference, first, max(taken, first), put_down - MARGIN))
    for first, last in runs(reference.met[name], FLICKER):
        # Something may have been in the hand for long, pushed along the table, before it meets a place.
        since = min(
            (
                run[0]
                for other in reference.held
                if name in reference.places and _moves(reference, other)
                for run in runs(reference.held[other], FLICKER)
                if run[0] <= first <= run[1]
            ),
            default=first,
        )
        later = np.flatnonzero(reference.engaged[last + FLICKER + 1 :])
        until = last + FLICKER + 1 + int(later[0]) - MARGIN if len(later) else None
        weights = np.maximum(weights, _window(reference, first, last, until, since))
    return weights


def _moves(reference: Reference, name: str) -> bool:
    """Whether the hand carries or pushes something elsewhere."""
    if name not in reference.poses or not reference.held[name].any():
        return False
    travelled = np.linalg.norm(reference.poses[name][:, :3] - reference.poses[name][0, :3], axis=1)
    return bool(travelled.max() > MOVED_M)


def _window(reference: Reference, first: int, last: int, until: int | None, since: int | None = None) -> Floats:
    """(K+1,) 1 from shortly before ``first`` to ``last``, 0 from ``until`` on.

    It rises since ``since``, at the latest since the contact before ``first`` and since what the hand held then was
    let go, unless it is what is in the hand at ``first``.
    """
    steps = np.arange(len(reference) + 1)
    engaged = reference.engaged.copy()
    for held in reference.held.values():
        if not held[max(first - FLICKER, 0) : first + 1].any():
            engaged |= held
    before = np.flatnonzero(engaged[: max(first - FLICKER, 0)])
    start = int(before[-1]) + 1 if len(before) else 0
    start = start if since is None else min(start, since)
    weights = _smooth((steps - start) / max(first - MARGIN - start, 1))
    if until is not None:
        weights = np.minimum(weights, 1 - _smooth((steps - last) / max(until - last, 1)))
    return weights


def _returning(reference: Reference, offset: Floats) -> Floats:
    """(K+1,) share of the start's offset (6,) (m, rad) that is left: 0 before the first contact, sooner if it can."""
    # 15/8 is the largest slope of the smooth step.
    slowly = float(np.abs(offset / STRIDE).max()) * 15 / 8 / BEND_SPEED
    contacts = np.flatnonzero(reference.busy)
    available = float(contacts[0] - MARGIN) if len(contacts) else float(len(reference))
    return 1 - _smooth(np.arange(len(reference) + 1) / max(min(slowly, available), 1.0))


def _smooth(x: Floats) -> Floats:
    """From 0 to 1 over the unit interval with the least jerk, at rest at both ends (Flash and Hogan 1985)."""
    share: Floats = np.clip(x, 0.0, 1.0)
    return np.asarray(share**3 * (10 - 15 * share + 6 * share**2))


def _rotation(pose: Floats) -> Rotation:
    return Rotation.from_quat(pose[[4, 5, 6, 3]])
