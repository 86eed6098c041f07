"""Subtasks of a trajectory in plain words, from contacts, joints and the gripper's commands.

A lifted object of the goal has four subtasks: approach it, grasp it, move it to its place, place it there. An object
that is moved without being lifted is pushed. If it rises without a grip, it is carried together with another object:
approach it, move it, place it. A drawer, door or knob of the goal has two: approach it, then open, close or turn it. A
subtask lasts until the next begins, so exactly one subtask is active at each step.

Until an object is lifted, the words for it include its place at the start if other things have the same noun: the black
bowl next to the ramekin.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.libero.bddl import Bddl, Fact
from pipeline.libero.carried import definition_of
from pipeline.libero.task_goal import describe_place, describe_thing, describe_thing_at_start
from pipeline.physics.reference import Mask, runs
from pipeline.scenes.compiled import CompiledScene, contacts
from pipeline.types import Floats, State, Subtask, Task, Trajectory

SHORTEST = 5
"""Least number of steps (0.25 s) between the beginnings of two subtasks.

lerobot 0.6.1 assigns a subtask that began within 0.1 s of a frame to this frame (``EMITTED_AT_TOLERANCE_S`` in
``datasets/language_render.py``). It fails if a frame gets two subtasks.
"""

GAP = 10
"""Longest gap in steps (0.5 s) during which the robot may release a thing and still be manipulating it."""

MOVED_M, LIFTED_M = 0.02, 0.01
"""Least displacements of a moved object, and of a gripped object that counts as lifted though it slides on its support.
"""

CARRIED_M = 0.05
"""Least rise of an object without a grip that is carried with another object; LIBERO's pushed plate rises less."""

TURNED, MOVING = 0.1, 0.005
"""Least shares of its range by which a drawer, door or knob moves in all, and in a step in which it counts as moving.

Contacts alone do not suffice: the hand may knock a door shut without contact in any stored state.
"""

VERBS = {
    "open": ("open", "close"),
    "close": ("open", "close"),
    "turnon": ("turn on", "turn off"),
    "turnoff": ("turn on", "turn off"),
}
"""State in the goal to the verbs for a turn of a thing's joint, away from zero and towards zero.

The joints of LIBERO's drawers, doors and knobs are zero where the thing is closed or off.
"""


class _Manipulation(NamedTuple):
    """Manipulation of one thing, from the step at which it is reached until it is left."""

    reached: int
    left: int
    thing: str
    subtasks: tuple[Subtask, ...]


def subtasks(trajectory: Trajectory, task: Task) -> tuple[Subtask, ...]:
    """Return the subtasks of a trajectory as ``subtasks_by_contacts`` does, from its states alone.

    This takes 0.3 ms a step if the scene is compiled already.

    Raises:
        ValueError: if MuJoCo rejects the scene.
    """
    scene = CompiledScene(trajectory.scene)
    pairs = []
    for state in trajectory.states:
        scene.restore(state)
        pairs.append(contacts(scene.data))
    return subtasks_by_contacts(trajectory, task, scene.model, pairs)


def subtasks_by_contacts(
    trajectory: Trajectory, task: Task, model: mujoco.MjModel, pairs: Sequence[NDArray[np.intp]]
) -> tuple[Subtask, ...]:
    """Return the subtasks of a trajectory; the first begins at step 0.

    The result is empty if the trajectory manipulates nothing that the goal names.

    Args:
        trajectory: the trajectory.
        task: its task.
        model: a compiled model of its scene.
        pairs: pairs (C, 2) of bodies in contact in each of its K+1 states.
    """
    problem, seen = definition_of(task), _Seen(trajectory, model, pairs)
    manipulations: set[_Manipulation] = set()
    for fact in problem.goal:
        manipulations.update(seen.manipulations(problem, fact))
    sequence: list[Subtask] = []
    begin = 0
    for manipulation in sorted(manipulations):
        for step, text in (Subtask(begin, f"approach {manipulation.thing}"), *manipulation.subtasks):
            first_step = max(step, sequence[-1].step + SHORTEST) if sequence else 0
            if first_step < len(trajectory.actions):
                sequence.append(Subtask(first_step, text))
        begin = manipulation.left
    if sequence and sequence[-1].text.startswith("approach "):
        sequence.pop()  # The trajectory ends before the manipulation has its turn.
    return tuple(sequence)


class _Words(NamedTuple):
    """Descriptions of an object and of its place in the goal.

    Attributes:
        thing: the object.
        thing_at_start: the object, with its place at the start if needed to distinguish it.
        to: the place as a direction, such as "to the plate".
        at: the place as a position, such as "on the plate".
    """

    thing: str
    thing_at_start: str
    to: str
    at: str


class _Seen:
    """Positions and contacts of a trajectory's K+1 states."""

    def __init__(self, trajectory: Trajectory, model: mujoco.MjModel, pairs: Sequence[NDArray[np.intp]]):
        self.model = model
        self.pairs = pairs
        self.qpos = np.stack([State.of(state, self.model.nq).qpos for state in trajectory.states])
        self.closing: Mask = np.append(trajectory.actions[:, 6] > 0, False)
        self.robot = self._below(self.model.body("robot0_base").id)

    def manipulations(self, problem: Bddl, fact: Fact) -> Iterator[_Manipulation]:
        """Yield the manipulations that belong to a fact of the goal."""
        if fact[1] in problem.targets:
            yield from self._with_object(problem, fact)
        if {*problem.things_named(fact[-1:])} & problem.fixtures.keys():
            yield from self._with_part(problem, fact)

    def _with_object(self, problem: Bddl, fact: Fact) -> Iterator[_Manipulation]:
        """Yield the manipulations of the fact's movable object: it is pushed, or grasped, moved and placed."""
        body = self._below(self.model.body(f"{fact[1]}_main").id)
        gripped, resting = self._gripped(body), self._touch(body, ~body & ~self.robot)
        first = int(self.model.joint(f"{fact[1]}_joint0").qposadr[0])
        positions_m = self.qpos[:, first : first + 3]
        words = _Words(
            describe_thing(problem, fact[1]), describe_thing_at_start(problem, fact[1]), *describe_place(problem, fact)
        )
        for reached, left in _runs(self._touch(body, self.robot)):
            moved_m = _distances(positions_m[reached : left + 1], positions_m[reached])
            if moved_m.max() < MOVED_M:
                continue
            grips = reached + np.flatnonzero(gripped[reached:left])
            slid_m = _distances(positions_m[grips], positions_m[grips[:1]])
            lifted = grips[~resting[grips] | (slid_m >= LIFTED_M)]
            heights_m = positions_m[reached : left + 1, 2]
            if len(lifted):
                subtasks = self._grasp_and_place(words, resting, int(lifted[0]), int(grips[-1]) + 1)
            elif heights_m.max() - heights_m[0] < CARRIED_M:
                subtasks = [Subtask(reached, f"push {words.thing_at_start} {words.to}")]
            else:
                subtasks = _move_with_another(words, reached, heights_m)
            yield _Manipulation(reached, left, words.thing_at_start, tuple(subtasks))

    def _gripped(self, body: Mask) -> Mask:
        """Return a mask (K+1,) of the states in which both fingers touch a body while the gripper closes."""
        left_finger = self._below(self.model.body("gripper0_leftfinger").id)
        right_finger = self._below(self.model.body("gripper0_rightfinger").id)
        gripped: Mask = self._touch(body, left_finger) & self._touch(body, right_finger) & self.closing
        return gripped

    def _grasp_and_place(self, words: _Words, resting: Mask, lifted: int, release: int) -> list[Subtask]:
        """Return the subtasks of a lifted object.

        Args:
            words: descriptions of the object and its place.
            resting: (K+1,) True while the object touches anything other than the robot.
            lifted: first step at which it is lifted.
            release: step at which its last grip ends.
        """
        grasp = np.flatnonzero(~self.closing[:lifted]).max(initial=-1) + 1
        return [
            Subtask(int(grasp), f"grasp {words.thing_at_start}"),
            Subtask(lifted, f"move {words.thing} {words.to}"),
            Subtask(_put_down(resting, lifted, release), f"place {words.thing} {words.at}"),
        ]

    def _with_part(self, problem: Bddl, fact: Fact) -> Iterator[_Manipulation]:
        """Yield the manipulations of the fact's drawer, door or knob: each turn of one of its joints."""
        name, state = fact[-1], fact[0] if len(fact) == 2 else "open"
        site = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site >= 0:
            bodies = [self.model.site_bodyid[site]]
        else:
            bodies = np.flatnonzero(self._below(self.model.body(f"{name}_main").id)).tolist()
        thing = describe_thing(problem, name)
        away, back = VERBS[state]
        for joint in np.flatnonzero(np.isin(self.model.jnt_bodyid, bodies)):
            turned = np.abs(self.qpos[:, self.model.jnt_qposadr[joint]]) / np.ptp(self.model.jnt_range[joint])
            touched = self._touch(self._below(self.model.jnt_bodyid[joint]), self.robot)
            moving = np.append(np.abs(np.diff(turned)) >= MOVING, False)
            for reached, left in _runs(touched | moving):
                # The last motion ends in the state ``left``.
                change = turned[min(left, len(turned) - 1)] - turned[reached]
                if abs(change) >= TURNED:
                    verb = away if change > 0 else back
                    yield _Manipulation(reached, left, thing, (Subtask(reached, f"{verb} {thing}"),))

    def _below(self, body: int) -> Mask:
        """Return a mask (nbody,) of a body and the bodies that move with it.

        MuJoCo numbers a body after its parent.
        """
        below: Mask = np.arange(self.model.nbody) == body
        for later_body in range(int(body) + 1, self.model.nbody):
            below[later_body] = below[self.model.body_parentid[later_body]]
        return below

    def _touch(self, first: Mask, second: Mask) -> Mask:
        """Return a mask (K+1,) of the states in which any body of ``first`` touches any body of ``second``."""
        return np.array([bool((first[pairs] & second[pairs[:, ::-1]]).any()) for pairs in self.pairs])


def _move_with_another(words: _Words, reached: int, heights_m: Floats) -> list[Subtask]:
    """Return the subtasks of an object that rises without a grip, from its heights while the robot touches it."""
    rising = reached + int(np.argmax(heights_m >= heights_m[0] + LIFTED_M))
    subtasks = [Subtask(rising, f"move {words.thing} {words.to}")]
    higher = np.flatnonzero(heights_m >= heights_m[-1] + LIFTED_M)
    # The trajectory may end before the object comes down.
    if len(higher):
        subtasks.append(Subtask(reached + int(higher[-1]) + 1, f"place {words.thing} {words.at}"))
    return subtasks


def _put_down(resting: Mask, lifted: int, release: int) -> int:
    """Return the step at which a lifted object is put down: it then rests until about its release, the last grip's end.

    An object that does not rest before its release is put down by the release.
    """
    step = release
    for start, end in _runs(resting[:release]):
        if start > lifted + GAP and end > release - GAP:
            step = start
    return step


def _distances(places: Floats, origin: Floats) -> Floats:
    """Return the distance of each place (N, 3) from an origin, (3,) or (1, 3)."""
    return np.asarray(np.linalg.norm(places - origin, axis=1))


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """Return the first step, and the step after the last, of each stretch of a mask.

    A stretch may have gaps of at most ``GAP`` steps.
    """
    return [(first, last + 1) for first, last in runs(mask, GAP + 1)]
