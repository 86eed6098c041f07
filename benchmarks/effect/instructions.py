"""Instructions that a policy gets in each scene of an experiment, and the goals that it can reach there."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from pipeline.axes.goal import held_out_pairs, usable
from pipeline.libero import bddl
from pipeline.libero.bddl import Fact
from pipeline.libero.carried import carry, definition_of
from pipeline.libero.tasks import find_task
from pipeline.types import Task

SAME_PLACE_M = 0.05
"""Distance below which two places of a thing count as equal."""

Kind = Literal["own", "rewrite", "carried", "held out", "nothing"]
"""Kind of an instruction in a scene: LIBERO's own, a rewrite of it, another task's that plans may carry there, another
task's that no plan carries there, or the empty instruction."""


@dataclass(frozen=True)
class Instruction:
    """An instruction in a scene.

    Attributes:
        scene: the experiment's first task that begins in the scene.
        asked: the task whose instruction it is; ``None`` for the empty instruction.
        kind: kind of the instruction.
        rewrite: text of the kind ``rewrite``; empty for the others.
    """

    scene: Task
    asked: Task | None
    kind: Kind
    rewrite: str = ""

    @property
    def text(self) -> str:
        return self.rewrite or (self.asked.instruction if self.asked else "")


def find_tasks(names: Sequence[str]) -> list[Task]:
    """Return the tasks with the names ``<suite>/<task>``."""
    return [find_task(*name.split("/")) for name in names]


def scenes_of(tasks: Sequence[Task]) -> list[Task]:
    """List the first task of each scene."""
    first: dict[object, Task] = {}
    for task in tasks:
        first.setdefault(bddl.read(task.bddl_file).scene, task)
    return list(first.values())


def instructions_in(scene: Task, tasks: Sequence[Task]) -> list[Instruction]:
    """List the instructions in a scene: of the tasks that begin there, of tasks that can be carried there, and none."""
    place = bddl.read(scene.bddl_file).scene
    listed = [Instruction(scene, task, "own") for task in tasks if bddl.read(task.bddl_file).scene == place]
    for pair in usable(scene.suite):
        if pair.task in tasks and bddl.read(pair.scene.bddl_file).scene == place:
            held = (pair.task, pair.scene) in held_out_pairs(scene.suite)
            listed.append(Instruction(scene, pair.task, "held out" if held else "carried"))
    return [*listed, Instruction(scene, None, "nothing")]


def every_instruction(tasks: Sequence[Task]) -> list[Instruction]:
    """List the instructions of all scenes."""
    listed: list[Instruction] = []
    for scene in scenes_of(tasks):
        listed += instructions_in(scene, tasks)
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
    own, carried = definition_of(task), definition_of(carry(task, find_task(suite, scene)))
    apart_m = np.subtract(own.centres_m[own.targets[0]], carried.centres_m[carried.targets[0]])
    return bool(np.linalg.norm(apart_m) < SAME_PLACE_M)


def goals_in(scene: Task, tasks: Sequence[Task]) -> dict[str, tuple[Fact, ...]]:
    """Return the name of each task in a scene and its goal there."""
    goals: dict[str, tuple[Fact, ...]] = {}
    for instruction in instructions_in(scene, tasks):
        if instruction.asked:
            task = instruction.asked if instruction.kind == "own" else carry(instruction.asked, scene)
            goals[instruction.asked.name] = definition_of(task).goal
    return goals
