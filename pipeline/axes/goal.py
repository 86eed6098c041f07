"""Goal: a demonstration's task, carried out in the scene of another task of its suite.

Physics layer. In LIBERO nearly every scene has one instruction, so a policy may ignore the text. Here one scene, and
one picture at the start, has the instructions of several tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from pipeline import seeding
from pipeline.axes.base import LEVELS, Axis, Level, PhysicsPerturbation
from pipeline.axes.language_goal import lost_demands
from pipeline.axes.report_data import CoveragePlots, KeptPerturbation, Strips
from pipeline.files import checksum
from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl
from pipeline.libero.carried import CannotCarryError, carry, definition_of
from pipeline.libero.task_goal import has_lookalike_in_place
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.testset.benchmark import TestSet
from pipeline.types import Demo, RollOut, Scene, Task

HELD_OUT = 5
"""One of this many pairs of a suite is held out for evaluations."""

LEVEL_M = (0.1, 0.2, 0.3, 0.4)
"""Distances that separate the levels: from the thing that the scene's own task takes first to the carried task's."""


class Pair(NamedTuple):
    """A task and the scene of another task of its suite.

    Attributes:
        task: the task whose goal is carried.
        scene: the first task of LIBERO's list that begins in the scene.
        left_out: reason why no episode can be generated; empty if the pair can be used.
    """

    task: Task
    scene: Task
    left_out: str

    @property
    def carried_task(self) -> Task:
        """The task in the other scene."""
        return carry(self.task, self.scene)


@cache
def pairs(suite: str) -> tuple[Pair, ...]:
    """List the pairs of a suite, with and without a reason to leave them out; a task's own scene is in no pair."""
    listed = []
    scenes: dict[object, Task] = {}
    for task in tasks(suite):
        scenes.setdefault(bddl.read(task.bddl_file).scene, task)
    for task in tasks(suite):
        own_scene = bddl.read(task.bddl_file).scene
        for place, scene in scenes.items():
            if place != own_scene:
                listed.append(Pair(task, scene, _fault(task, scene)))
    return tuple(listed)


def usable(suite: str) -> list[Pair]:
    """List the pairs of a suite that are not left out, in the order of ``pairs``."""
    return [pair for pair in pairs(suite) if not pair.left_out]


def _fault(task: Task, scene: Task) -> str:
    """Return the reason why a task cannot be carried to a scene, or an empty text."""
    place = bddl.read(scene.bddl_file).scene
    for other in tasks(task.suite):
        if other.instruction == task.instruction and bddl.read(other.bddl_file).scene == place:
            return "LIBERO has this instruction in the scene"
    carried_task = carry(task, scene)
    try:
        definition_of(carried_task)
    except CannotCarryError as error:
        return str(error)
    lost = lost_demands(task, carried_task)
    return f"in the scene, the instruction {lost[0]}" if lost else ""


@cache
def held_out_pairs(suite: str) -> frozenset[tuple[Task, Task]]:
    """Return the pairs (task, scene) that no plan uses: a fixed fifth of the suite's pairs, chosen by a hash."""
    shuffled = sorted(usable(suite), key=lambda pair: seeding.digest("held-out goal", str(pair.task), str(pair.scene)))
    return frozenset((pair.task, pair.scene) for pair in shuffled[: round(len(shuffled) / HELD_OUT)])


@cache
def _trained(task: Task) -> tuple[Task, ...]:
    """List the scenes to which plans carry a task.

    Pairs are left out that are held out, or whose scene has another object in the place that the instruction names.
    """
    pairs_of_task = [pair for pair in usable(task.suite) if pair.task == task]
    not_held_out = [pair for pair in pairs_of_task if (task, pair.scene) not in held_out_pairs(task.suite)]
    return tuple(pair.scene for pair in not_held_out if not has_lookalike_in_place(pair.carried_task))


@cache
def level_of_pair(task: Task, scene: Task) -> Level:
    """Return the strength of a pair: the distance in the scene between the first things that both tasks take."""
    usual, carried = definition_of(scene), definition_of(carry(task, scene))
    usual_m, carried_m = (carried.centres_m.get(_first_thing(each), (0.0, 0.0)) for each in (usual, carried))
    apart_m = float(np.linalg.norm(np.subtract(usual_m, carried_m)))
    return LEVELS[int(np.searchsorted(LEVEL_M, apart_m))]


def _first_thing(task: Bddl) -> str:
    """Return the first object that the goal moves, or the thing whose state it changes."""
    return task.targets[0] if task.targets else str(task.owner(task.goal[0][1]))


class GoalPerturbation(PhysicsPerturbation):
    """The task in the scene of another task, from one of this scene's resets.

    Attributes:
        scene: name of the first task of LIBERO's list that begins in the scene.
        start: number of the reset; episodes of one scene with equal numbers begin with the same picture.
        scene_sha256: SHA-256 of the scene's file in a suite of the user, so that an edited scene gives other episodes;
            empty for LIBERO's suites.
    """

    axis: Literal["goal"] = "goal"
    component: Literal["other_scene"] = "other_scene"
    scene: str
    start: Annotated[int, Field(ge=0)]
    scene_sha256: str = Field(default="", exclude_if=lambda sha256: not sha256)

    changes_objects: ClassVar[bool] = True

    def carry(self, task: Task) -> Task:
        """Return ``task`` carried to the other scene."""
        return carry(task, find_task(task.suite, self.scene))

    @property
    def reset_seed(self) -> int:
        """Seed of the scene's reset with this number; it does not depend on the carried task."""
        return int(seeding.rng("goal start", self.scene, self.start).integers(2**32))

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """Return the scene, which the replay has opened by ``carry`` and ``reset_seed``, with the goal's facts."""
        facts = [list(fact) for fact in definition_of(demo.task).goal]
        return replace(scene, resolved={**scene.resolved, "goal": {"facts": facts}})


class GoalAxis(Axis):
    """Tasks in all scenes of their suite in which their instruction means one thing; a fifth of these is held out.

    Attributes:
        levels: Levels of the scenes to use, 1 (weak) to 5 (strong); all five by default. Each scene has equal
            probability, and repeated entries have no effect.
        starts: Number of different resets of each scene; all tasks that are carried to a scene share them; 10 by
            default.
    """

    kinds: ClassVar = (GoalPerturbation,)
    colour: ClassVar = "#8a5a9e"
    not_held_out: ClassVar = "held-out pairs of task and scene are run by --source goals"

    starts: Annotated[int, Field(ge=1, le=100_000)] = 10

    def applies(self, task: Task) -> bool:
        return bool(self.entries(task))

    def levels_set_shares(self, task: Task) -> bool:
        """Return ``False``: the levels only select scenes."""
        return False

    def entries(self, task: Task) -> Sequence[str]:
        """List the names of the scenes to which the task is carried, of the configured levels."""
        return [scene.name for scene in _trained(task) if level_of_pair(task, scene) in self.levels]

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> GoalPerturbation:
        """Return the scene at ``entry_index`` of ``entries``, with one of its starts.

        The list of entries starts again at its end.
        """
        scenes = self.entries(task)
        scene = find_task(task.suite, scenes[entry_index % len(scenes)])
        start = int(rng.integers(self.starts))
        sha256 = "" if scene.suite in SUITES else checksum(scene.bddl_file)
        return GoalPerturbation(scene=scene.name, start=start, level=level_of_pair(task, scene), scene_sha256=sha256)

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[GoalPerturbation]], test: TestSet) -> CoveragePlots:
        """Describe the plot of the levels."""
        levels = {"episodes": {"goal": np.array([item.perturbation.level for item in kept], float)}}
        return CoveragePlots(f"{len(test.on_axis(cls.name())):,} test tasks.", [Strips("level", levels, "level")])
