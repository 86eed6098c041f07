"""What a trajectory does one after the other, in plain words, from contacts, joints and the gripper's commands.

An object of the goal that is lifted: approach it, grasp it, move it to its place, place it there. One that is moved
without that is pushed. A drawer, door or knob of the goal: approach it, then open, close or turn it. A subtask lasts
until the next begins, so that one of them is active at each step.
"""

from collections.abc import Iterator
from itertools import cycle
from typing import NamedTuple

import mujoco
import numpy as np

from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl, Fact
from pipeline.libero.task_goal import called, where
from pipeline.physics.reference import Mask, runs
from pipeline.scenes.compiled import CompiledScene
from pipeline.types import Floats, State, Subtask, Task, Trajectory

SHORTEST = 5
"""Steps between the beginnings of two subtasks, at least: 0.25 s. lerobot 0.6.1 takes what began within 0.1 s of a
frame as begun there (``EMITTED_AT_TOLERANCE_S`` in ``datasets/language_render.py``), and fails where two have."""

GAP = 10
"""So many steps, half a second, the robot may let go of something it is not done with."""

MOVED_M, LIFTED_M = 0.02, 0.01
"""How far an object goes that is moved, and that is lifted where it slides along what it stands on."""

TURNED, MOVING = 0.1, 0.005
"""Shares of its range by which a drawer, door or knob moves in all, and in a step: the hand may knock a door shut with
no contact at the moments that are stored."""

VERBS = {
    "open": ("open", "close"),
    "close": ("close", "open"),
    "turnon": ("turn on", "turn off"),
    "turnoff": ("turn off", "turn on"),
}
"""State to what brings something into it, and out of it."""


class _Deed(NamedTuple):
    """What is done with one thing, from the step at which it is reached until it is left."""

    reached: int
    left: int
    thing: str
    subtasks: tuple[Subtask, ...]


def subtasks(trajectory: Trajectory, task: Task) -> tuple[Subtask, ...]:
    """The subtasks of a trajectory, the first from step 0; none where it leaves alone what the goal names.

    Takes 0.3 ms a step, where the scene is compiled already.

    Raises:
        ValueError: when MuJoCo refuses the scene.
    """
    known, seen = bddl.read(task.bddl_file), _Seen(trajectory)
    found: list[Subtask] = []
    begin = 0
    for deed in sorted({deed for fact in known.goal for deed in seen.deeds(known, fact)}):
        for step, text in (Subtask(begin, f"approach {deed.thing}"), *deed.subtasks):
            at = max(step, found[-1].step + SHORTEST) if found else 0
            if at < len(trajectory.actions):
                found.append(Subtask(at, text))
        begin = deed.left
    return tuple(found)


class _Seen:
    """Positions and contacts of a trajectory's K+1 states."""

    def __init__(self, trajectory: Trajectory):
        scene = CompiledScene(trajectory.scene)
        self.model = scene.model
        self.qpos = np.stack([State.of(state, self.model.nq).qpos for state in trajectory.states])
        self.closing = np.append(trajectory.actions[:, 6] > 0, False)
        self.pairs = []
        for state in trajectory.states:
            scene.restore(state)
            self.pairs.append(scene.contacts)
        self.robot = self._below(self.model.body("robot0_base").id)

    def deeds(self, known: Bddl, fact: Fact) -> Iterator[_Deed]:
        """What is done for a fact of the goal."""
        if fact[1] in known.targets:
            yield from self._with_object(known, fact)
        if {*known.things_named(fact[-1:])} & known.fixtures.keys():
            yield from self._with_part(known, fact)

    def _with_object(self, known: Bddl, fact: Fact) -> Iterator[_Deed]:
        own = self._below(self.model.body(f"{fact[1]}_main").id)
        fingers = [self._below(self.model.body(f"gripper0_{side}finger").id) for side in ("left", "right")]
        gripped = self._touch(own, fingers[0]) & self._touch(own, fingers[1]) & self.closing
        resting = self._touch(own, ~own & ~self.robot)
        first = int(self.model.joint(f"{fact[1]}_joint0").qposadr[0])
        place = self.qpos[:, first : first + 3]
        thing = called(known, fact[1])
        to, at = where(known, fact)
        for reached, left in _runs(self._touch(own, self.robot)):
            grips = np.flatnonzero(gripped[:left])
            grips = grips[grips >= reached]
            lifted = grips[~resting[grips] | (_far(place[grips], place[grips[:1]]) >= LIFTED_M)]
            if _far(place[reached : left + 1], place[reached]).max() < MOVED_M:
                continue
            if not len(lifted):
                yield _Deed(reached, left, thing, (Subtask(reached, f"push {thing} {to}"),))
                continue
            grasp = np.flatnonzero(~self.closing[: lifted[0]]).max(initial=-1) + 1
            let_go = int(grips[-1]) + 1
            down = [start for start, end in _runs(resting[:let_go]) if start > lifted[0] + GAP and end > let_go - GAP]
            steps = (int(grasp), int(lifted[0]), *down[-1:], let_go)
            texts = (f"grasp {thing}", f"move {thing} {to}", f"place {thing} {at}")
            yield _Deed(reached, left, thing, tuple(map(Subtask, steps, texts)))

    def _with_part(self, known: Bddl, fact: Fact) -> Iterator[_Deed]:
        name, state = fact[-1], fact[0] if len(fact) == 2 else "open"
        site = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name)
        bodies = (
            [self.model.site_bodyid[site]]
            if site >= 0
            else np.flatnonzero(self._below(self.model.body(f"{name}_main").id))
        )
        thing = called(known, name)
        verbs = VERBS[state][:: -1 if (state, name) in known.start else 1]
        for joint in np.flatnonzero(np.isin(self.model.jnt_bodyid, bodies)):
            turned = self.qpos[:, self.model.jnt_qposadr[joint]] / np.ptp(self.model.jnt_range[joint])
            touched = self._touch(self._below(self.model.jnt_bodyid[joint]), self.robot)
            moving = np.append(np.abs(np.diff(turned)) >= MOVING, False)
            turns = [run for run in _runs(touched | moving) if np.ptp(turned[slice(*run)][[0, -1]]) >= TURNED]
            for (reached, left), verb in zip(turns, cycle(verbs), strict=False):
                yield _Deed(reached, left, thing, (Subtask(reached, f"{verb} {thing}"),))

    def _below(self, body: int) -> Mask:
        """(nbody,) whether it is this body, or moves with it; MuJoCo numbers a body after its parent."""
        below: Mask = np.arange(self.model.nbody) == body
        for each in range(int(body) + 1, self.model.nbody):
            below[each] = below[self.model.body_parentid[each]]
        return below

    def _touch(self, one: Mask, other: Mask) -> Mask:
        """(K+1,) whether any of these bodies touches any of the others."""
        return np.array([bool((one[pairs] & other[pairs[:, ::-1]]).any()) for pairs in self.pairs])


def _far(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.linalg.norm(one - other, axis=1))


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """First step, and the one after the last, of each stretch of a mask, with gaps of ``GAP`` at most in it."""
    return [(first, last + 1) for first, last in runs(mask, GAP + 1)]
