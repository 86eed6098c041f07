"""Tasks of an evaluation: their identification, LIBERO's initial states, and the choice of a balanced subset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from itertools import zip_longest
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator

from pipeline import seeding
from pipeline.axes.component_names import current_names, stored_names
from pipeline.errors import PipelineError
from pipeline.grouping import grouped
from pipeline.libero.assets import libero_folder
from pipeline.libero.tasks import tasks
from pipeline.types import Floats, Task

Source = Literal["libero", "libero_plus", "own", "goals"]

Prompt = Literal["clean", "benchmark", "blank"]
"""Kind of instruction for a policy.

``clean`` is LIBERO's instruction. ``benchmark`` is, in test tasks, the instruction in the benchmark's code: the name of
the task's file, such as "turn on the stove view 0 0 100 2 352 initstate 0". ``blank`` is an empty instruction.
"""


@dataclass(frozen=True, order=True)
class EvaluationTask:
    """Identification of one task in one scene; everything else about the task is looked up by these fields.

    Attributes:
        source: ``libero`` for a task without perturbation, also a user's own. ``libero_plus`` for a test task. ``own``
            for held-out perturbations on one or more of this project's axes. ``goals`` for another goal in the scene
            of a LIBERO task: another object for its place, or the goal of another LIBERO task.
        suite, base: suite and name of the LIBERO task, whose scene the episode has, or of the user's own task.
        name: name of the test task in LIBERO-Plus, else a name that is composed of the other fields. It is unique among
            the tasks of its source and suite.
        axis, component: perturbed axis and component, several joined by +; ``clean`` without a perturbation. In
            ``goals`` the component is the category of the object that is asked for, or ``other_scene`` for the goal of
            another task.
        level: strength of all perturbations, 1 to 5; 0 if it is unknown.
        number: number of the perturbation (``own``), and of the initial state, the reset or the demonstration; 0 in
            ``libero_plus``.
    """

    source: Source
    suite: str
    base: str
    name: str
    axis: str
    component: Annotated[str, BeforeValidator(current_names)]
    level: int
    number: int

    def __str__(self) -> str:
        return f"{self.source}/{self.suite}/{self.name}"

    def for_harness(self) -> dict[str, Any]:
        """Return the task in vla-eval's format, with a unique ``name``; the task's own name is ``task_name``."""
        return {**asdict(self), "name": str(self), "task_name": self.name}

    @classmethod
    def of_harness(cls, task: Mapping[str, Any]) -> EvaluationTask:
        """Return the task that ``for_harness`` returned, or a task of the harness's own LIBERO class.

        The harness's own class numbers tasks and names them by instruction. An instruction is not unique: 16 tasks of
        LIBERO-90 share theirs with a task of another scene.

        Raises:
            PipelineError: if LIBERO's suite has no task with this number and instruction.
        """
        if "source" in task:
            return cls(**{name: task[name] for name in cls.__dataclass_fields__} | {"name": task["task_name"]})
        listed, number = tasks(task["suite"]), int(task["task_id"])
        if not 0 <= number < len(listed) or listed[number].instruction != task["name"]:
            raise PipelineError(
                f"{task['suite']} has no task {number} {task['name']!r}",
                where="task of the harness",
                expected="LIBERO's own number and instruction of the task",
            )
        return libero_task(listed[number], int(task.get("episode_idx", 0)))


def libero_task(task: Task, number: int) -> EvaluationTask:
    """Return a task without perturbation, from its initial state with a number."""
    return EvaluationTask("libero", task.suite, task.name, f"{task.name}_state{number}", "clean", "clean", 0, number)


@cache
def libero_states(task: Task) -> Floats:
    """Read the (50, S) initial states of LIBERO's evaluation of a task: time, qpos, qvel."""
    with np.load(libero_folder() / "init_files" / task.suite / f"{task.name}.pruned_init.npz") as arrays:
        return np.asarray(arrays["states"], np.float64)


def balanced(wanted: Iterable[EvaluationTask], count: int, seed: int) -> list[EvaluationTask]:
    """Choose at most ``count`` tasks: axes in turn, for each axis its components in turn, then levels, then suites.

    With equal seeds, a larger subset contains a smaller one.
    """
    return sorted(_in_turn(list(wanted), ("axis", "component", "level", "suite"), seed)[:count])


def _in_turn(wanted: list[EvaluationTask], columns: tuple[str, ...], seed: int) -> list[EvaluationTask]:
    """Order tasks so that the values of the first column take turns, and for each value those of the next columns."""
    if not columns:
        return sorted(wanted, key=lambda task: seeding.digest("subset", seed, str(task)))
    column, *rest = columns
    groups = grouped((getattr(task, column), task) for task in wanted)

    def turn_of(name: str | int) -> str:
        """Return the sort key of a group; it does not change if the group's component is renamed."""
        stored = stored_names(name) if isinstance(name, str) else name
        return seeding.digest("turn", seed, column, stored, str(min(groups[name])))

    names = sorted(groups, key=turn_of)
    rows = [_in_turn(groups[name], tuple(rest), seed) for name in names]
    ordered: list[EvaluationTask] = []
    for turn in zip_longest(*rows):
        ordered += [task for task in turn if task is not None]
    return ordered
