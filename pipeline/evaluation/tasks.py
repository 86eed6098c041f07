"""The tasks that policies are evaluated on: what names one, LIBERO's initial states, and lists of them."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from pipeline import seeding
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.libero.assets import libero_folder
from pipeline.libero.tasks import tasks
from pipeline.types import Floats, Task

Source = Literal["libero", "libero_plus", "own", "goals"]


@dataclass(frozen=True, order=True)
class EvaluationTask:
    """One thing to do in one scene; all else is looked up by these.

    Attributes:
        source: ``libero``, ``libero_plus``, ``own`` for held-out draws of one or more of this project's axes, or
            ``goals`` for a LIBERO task that asks for another object of its scene.
        suite, base: of the LIBERO task.
        name: of the test task in LIBERO-Plus; else made of what follows, once among the tasks of its source and suite.
        axis, component: what is perturbed, several joined by +; ``clean`` where nothing is. In ``goals`` the component
            is the category of the object that is asked for.
        level: strength, 1 to 5, of all that is drawn; 0 where nothing tells.
        number: which draw (``own``), and which of LIBERO's initial states; 0 in ``libero_plus``.
    """

    source: Source
    suite: str
    base: str
    name: str
    axis: str
    component: str
    level: int
    number: int

    def __str__(self) -> str:
        return f"{self.source}/{self.suite}/{self.name}"

    def for_harness(self) -> dict[str, Any]:
        """As vla-eval takes a task, by a ``name`` that no other has; the task's own is ``task_name``."""
        return {**asdict(self), "name": str(self), "task_name": self.name}

    @classmethod
    def of_harness(cls, task: Mapping[str, Any]) -> EvaluationTask:
        """The task that ``for_harness`` gave, or one of the harness's own LIBERO class, which words it."""
        if "source" not in task:
            known = next(known for known in tasks(task["suite"]) if known.instruction == task["name"])
            return libero_task(known, int(task.get("episode_idx", 0)))
        return cls(**{name: task[name] for name in cls.__dataclass_fields__} | {"name": task["task_name"]})


def libero_task(task: Task, number: int) -> EvaluationTask:
    """LIBERO's own task, from its initial state of that number."""
    return EvaluationTask("libero", task.suite, task.name, f"{task.name}_state{number}", "clean", "clean", 0, number)


@cache
def libero_states(task: Task) -> Floats:
    """(50, S) the initial states that LIBERO evaluates a task from: time, qpos, qvel."""
    with np.load(libero_folder() / "init_files" / task.suite / f"{task.name}.pruned_init.npz") as arrays:
        return np.asarray(arrays["states"], np.float64)


def balanced(wanted: Iterable[EvaluationTask], count: int, seed: int) -> list[EvaluationTask]:
    """At most ``count`` tasks: axes in turn, of each axis its components in turn, then levels, then suites.

    A larger subset under the same seed holds the smaller one.
    """
    return sorted(_in_turn(list(wanted), ("axis", "component", "level", "suite"), seed)[:count])


def _in_turn(wanted: list[EvaluationTask], columns: tuple[str, ...], seed: int) -> list[EvaluationTask]:
    """All tasks, one of each value of the first column after the other, of each value by the columns that follow."""
    if not columns:
        return sorted(wanted, key=lambda task: seeding.digest("subset", seed, str(task)))
    column, *rest = columns
    groups: dict[object, list[EvaluationTask]] = defaultdict(list)
    for task in wanted:
        groups[getattr(task, column)].append(task)
    names = sorted(groups, key=lambda name: seeding.digest("turn", seed, column, name, str(min(groups[name]))))
    rows = [_in_turn(groups[name], tuple(rest), seed) for name in names]
    return [task for turn in zip_longest(*rows) for task in turn if task is not None]


class _TaskList(BaseModel):
    """What a file of tasks holds; the tasks may have more fields, such as ``difficulty``."""

    seed: int
    tasks: list[EvaluationTask]


def read_tasks(file: Path, seed: int) -> list[EvaluationTask]:
    """The tasks that ``analyse construct`` or ``analyse grade`` listed.

    Raises:
        PipelineError: when the file is not such a list, or its draws were made under another seed.
    """
    try:
        listed = _TaskList.model_validate_json(file.read_bytes())
    except (OSError, ValueError) as error:
        raise PipelineError(
            f"not a list of tasks ({error})", where=file, expected="a file that `analyse construct` wrote"
        ) from error
    if listed.seed != seed:
        raise PipelineError(
            f"these tasks were drawn under seed {listed.seed}, not {seed}", where=file, remedy=f"--seed {listed.seed}"
        )
    return listed.tasks


def write_tasks(listed: Iterable[EvaluationTask | dict[str, Any]], seed: int, file: Path) -> None:
    """Write a list of tasks that ``evaluate --tasks-from`` reads."""
    content = [task if isinstance(task, dict) else asdict(task) for task in listed]
    lines = ",\n".join(json.dumps(task) for task in content)
    with replaced(file) as temporary:
        temporary.write_text(f'{{"seed": {seed}, "tasks": [\n{lines}\n]}}\n')
