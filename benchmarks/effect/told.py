"""Instructions that a policy gets in each scene of an experiment, and the goals that it can reach there."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from pipeline.axes.goal import held_out, usable
from pipeline.libero import bddl
from pipeline.libero.bddl import Fact
from pipeline.libero.carried import carried, definition_of
from pipeline.libero.tasks import find_task
from pipeline.types import Task

SAME_PLACE_M = 0.05
"""Distance below which two places of a thing count as equal."""

Kind = Literal["own", "carried", "held out", "nothing"]
"""Kind of an instruction in a scene: LIBERO's own, another task's that plans may carry there, another task's that no
plan carries there, or the empty instruction."""


@dataclass(frozen=True)
class Told:
    """An instruction in a scene.

    Attributes:
        scene: the experiment's first task that begins in the scene.
        asked: the task whose instruction it is; ``None`` for the empty instruction.
        kind: kind of the instruction.
    """

    scene: Task
    asked: Task | None
    kind: Kind

    @property
    def instruction(self) -> str:
        return self.asked.instruction if self.asked else ""


def find_tasks(names: Sequence[str]) -> list[Task]:
    """Return the tasks with the names ``<suite>/<task>``."""
    return [find_task(*name.split("/")) for name in names]


def scenes_of(tasks: Sequence[Task]) -> list[Task]:
    """List the first task of each scene."""
    first: dict[object, Task] = {}
    for task in tasks:
        first.setdefault(bddl.read(task.bddl_file).scene, task)
    return list(first.values())


def told_in(scene: Task, tasks: Sequence[Task]) -> list[Told]:
    """List the instructions in a scene: of the tasks that begin there, of tasks that can be carried there, and none."""
    place = bddl.read(scene.bddl_file).scene
    listed = [Told(scene, task, "own") for task in tasks if bddl.read(task.bddl_file).scene == place]
    for pair in usable(scene.suite):
        if pair.task in tasks and bddl.read(pair.scene.bddl_file).scene == place:
            held = (pair.task, pair.scene) in held_out(scene.suite)
            listed.append(Told(scene, pair.task, "held out" if held else "carried"))
    return [*listed, Told(scene, None, "nothing")]


def every_told(tasks: Sequence[Task]) -> list[Told]:
    """List the instructions of all scenes."""
    listed: list[Told] = []
    for scene in scenes_of(tasks):
        listed += told_in(scene, tasks)
    return listed


@cache
def at_own_place(suite: str, scene: str, asked: str) -> bool:
    """Return whether the thing that a task takes first stands in another scene where it stands in the task's own.

    A policy that has learned a place for each instruction reaches such a goal without looking for the thing.

    Args:
        suite: suite of both tasks.
        scene: name of the task whose scene it is.
        asked: name of the task that is carried to the scene.
    """
    task = find_task(suite, asked)
    own, played = definition_of(task), definition_of(carried(task, find_task(suite, scene)))
    apart_m = np.subtract(own.centres_m[own.targets[0]], played.centres_m[played.targets[0]])
    return bool(np.linalg.norm(apart_m) < SAME_PLACE_M)


def goals_in(scene: Task, tasks: Sequence[Task]) -> dict[str, tuple[Fact, ...]]:
    """Return the name of each task in a scene and its goal there."""
    goals: dict[str, tuple[Fact, ...]] = {}
    for told in told_in(scene, tasks):
        if told.asked:
            played = told.asked if told.kind == "own" else carried(told.asked, scene)
            goals[told.asked.name] = definition_of(played).goal
    return goals
