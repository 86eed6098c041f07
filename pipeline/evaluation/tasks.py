"""What a policy can be evaluated on, and how some of it is chosen."""

from __future__ import annotations

import fnmatch
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Literal

from pydantic import Field

from pipeline import seeding
from pipeline.axes import AnyAxis, AnyPerturbation, Axes
from pipeline.axes.base import Frozen, Level
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus
from pipeline.libero.tasks import find_task, tasks
from pipeline.testset import benchmark
from pipeline.testset.benchmark import SUITES

Source = Literal["libero", "libero_plus", "own"]
LEVELS: tuple[Level, ...] = (1, 2, 3, 4, 5)
OWN_AXES = ("layout", "pose", "robot", "camera", "light", "background", "noise")
"""The axes with draws of their own to hold out. Language is none: its rewrites are a list, which training uses up."""


@dataclass(frozen=True, order=True)
class EvaluationTask:
    """One thing to do in one scene; all else is looked up by these.

    Attributes:
        source: ``libero``, ``libero_plus``, or ``own`` for a held-out draw of one of this project's axes.
        suite, base: of the LIBERO task.
        name: of the test task in LIBERO-Plus; else made of what follows, once among the tasks of its source and suite.
        axis, component: what is perturbed; ``clean`` where nothing is.
        level: strength, 1 to 5; 0 where nothing tells.
        number: which of LIBERO's initial states (``libero``), or which draw (``own``); 0 in ``libero_plus``.
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


class Selection(Frozen):
    """Which tasks to evaluate on; what is left out does not restrict.

    Attributes:
        source: where they come from.
        suites, axes, components, levels: those of the tasks wanted.
        tasks: shell-style patterns, one of which must match the task's name or its LIBERO task's.
        episodes: how many of LIBERO's 50 initial states of each task (``libero``), or draws of each task, axis and
            level (``own``).
        subset: at most so many, spread evenly over suites, axes, components and levels.
        seed: of the subset and of all draws.
    """

    source: Source = "libero"
    suites: tuple[str, ...] = SUITES
    axes: tuple[str, ...] = ()
    components: tuple[str, ...] = ()
    levels: tuple[int, ...] = ()
    tasks: tuple[str, ...] = ()
    episodes: int = Field(default=1, ge=1, le=50)
    subset: int | None = Field(default=None, ge=1)
    seed: int = 0


def select(selection: Selection, archive: Path | None = None) -> list[EvaluationTask]:
    """The tasks that a selection names, in a fixed order.

    Args:
        archive: folder of LIBERO-Plus's asset archive, where there is one.

    Raises:
        PipelineError: when it names something unknown, nothing, or what needs the benchmark's asset archive.
    """
    _check_names(selection)
    wanted = [task for task in _listed(selection) if _matches(task, selection)]
    if selection.source == "libero_plus":
        wanted = _runnable(wanted, selection, archive)
    if not wanted:
        raise PipelineError("no task is left", where=f"selection {selection.model_dump(exclude_defaults=True)}")
    return wanted if selection.subset is None else balanced(wanted, selection.subset, selection.seed)


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


def draw(task: EvaluationTask, seed: int, attempt: int = 0) -> AnyPerturbation:
    """The perturbation of a held-out draw.

    Its key begins with ``evaluation``, which no plan's does, so that no seed makes the two draw alike.

    Args:
        attempt: counts the draws that a scene refused.
    """
    axis = _axis(task.axis).model_copy(update={"levels": (task.level,)})
    key = seeding.rng("evaluation", seed, task.axis, task.suite, task.base, task.level, task.number, attempt)
    drawn: AnyPerturbation = axis.sample(key, find_task(task.suite, task.base), task.number)
    return drawn


@cache
def _axis(name: str) -> AnyAxis:
    """An axis with its default ranges."""
    axis: AnyAxis = getattr(Axes.model_validate({name: {}}), name)
    return axis


def _listed(selection: Selection) -> Iterator[EvaluationTask]:
    if selection.source == "libero_plus":
        for test in benchmark.load().tasks:
            level = libero_plus.level_of(test)
            yield EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, level, 0)
        return
    for suite in selection.suites:
        for task in tasks(suite):
            for number in range(selection.episodes):
                if selection.source == "libero":
                    name = f"{task.name}_state{number}"
                    yield EvaluationTask("libero", suite, task.name, name, "clean", "clean", 0, number)
                    continue
                for axis in selection.axes or OWN_AXES:
                    for level in selection.levels or LEVELS:
                        name = f"{task.name}_{axis}_level{level}_draw{number}"
                        undrawn = EvaluationTask("own", suite, task.name, name, axis, "", level, number)
                        if _axis(axis).applies(task):
                            component = draw(undrawn, selection.seed).component
                            yield EvaluationTask("own", suite, task.name, name, axis, component, level, number)


def _matches(task: EvaluationTask, selection: Selection) -> bool:
    restricted = (
        (task.suite, selection.suites),
        (task.axis, selection.axes),
        (task.component, selection.components),
        (task.level, selection.levels),
    )
    named = any(fnmatch.fnmatch(name, pattern) for pattern in selection.tasks for name in (task.name, task.base))
    return all(not allowed or value in allowed for value, allowed in restricted) and (named or not selection.tasks)


def _check_names(selection: Selection) -> None:
    offered = {
        "libero": {"clean"},
        "libero_plus": {axis for axis, _ in benchmark.COUNTS},
        "own": set(OWN_AXES),
    }[selection.source]
    for field, named, known in (("suites", selection.suites, SUITES), ("axes", selection.axes, offered)):
        if unknown := [name for name in named if name not in known]:
            raise PipelineError(
                f"{selection.source} has no {unknown[0]!r}", where=field, expected=" or ".join(sorted(known))
            )


def _runnable(wanted: list[EvaluationTask], selection: Selection, archive: Path | None) -> list[EvaluationTask]:
    """Those that can be rebuilt; says how many cannot.

    Raises:
        PipelineError: when nothing can be rebuilt of an axis that is asked for by name.
    """
    tests = libero_plus.by_name()
    left = [task for task in wanted if libero_plus.runnable(tests[task.suite, task.name], archive)]
    missing = Counter(task.axis for task in wanted) - Counter(task.axis for task in left)
    counts = ", ".join(f"{axis} {count}" for axis, count in missing.items())
    if missing and (not left or {*selection.axes} - {task.axis for task in left}):
        raise PipelineError(
            f"{counts} of {len(wanted)} tasks need files of LIBERO-Plus's asset archive",
            where="axes" if archive is None else archive,
            expected=f"test tasks of {', '.join(libero_plus.RUNNABLE)}, or 62 of background in libero_object",
            remedy=f"name the unpacked archive: --assets DIR; or --axis {' '.join(libero_plus.RUNNABLE)}; or held-out "
            "draws of the same axes: --source own",
        )
    if missing:
        print(f"left out, because they need files of LIBERO-Plus's asset archive: {counts}")
    return left
