"""Selection of the tasks to evaluate on: tasks that a user names."""

import difflib
import fnmatch
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import chain, combinations, product
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.axes import AXES, axes_of, level_of_test
from pipeline.axes.base import LEVELS
from pipeline.axes.component_names import ComponentName
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus
from pipeline.evaluation.goals import list_carried_tasks, list_replacements
from pipeline.evaluation.held_out import OWN_AXES, held_out_task
from pipeline.evaluation.task_list import read_tasks
from pipeline.evaluation.tasks import EvaluationTask, balanced, libero_task
from pipeline.libero.tasks import SUITES, suites, tasks
from pipeline.testset.benchmark import TESTED_SUITES, load
from pipeline.types import Frozen, Task

INITIAL_STATES = 50
"""Number of LIBERO's initial states per task."""

COLUMNS = {"suites": "suite", "axes": "axis", "components": "component", "levels": "level"}
"""Field of a selection to the field of a task that it restricts."""

PAIR_AXES = tuple(name for name in OWN_AXES if AXES[name].dimension == name)
"""Axes of the six dimensions that the paper pairs: objects, robot start, camera, illumination, environment, noise.

Each has the name of its dimension; pose is a second axis of the dimension layout."""


class Selection(Frozen, use_attribute_docstrings=True):
    """Selection of tasks; a field that is left out does not restrict it."""

    source: Literal["libero", "libero_plus", "own", "goals", "pairs"] = "libero"
    """LIBERO's tasks and the user's own; LIBERO-Plus's test tasks; held-out perturbations on this project's axes
    (``own``); LIBERO's scenes with another goal: another object of the scene, or a held-out pair of the axis
    goal (``goals``); for every two axes the task, a
    held-out perturbation on either, and both together, on the same initial states (``pairs``)"""
    file: Path | None = None
    """list of tasks that ``analyze construct`` or ``analyze grade`` wrote, in place of a source"""
    suites: tuple[str, ...] = TESTED_SUITES
    """only these suites, such as libero_goal; suites of the user's own tasks must be named, except with a list of
    tasks, which is whole by default"""
    axes: tuple[str, ...] = ()
    """only these axes, which ``python -m pipeline axes`` lists"""
    components: tuple[ComponentName, ...] = ()
    """only these components, which the same command lists"""
    levels: tuple[int, ...] = ()
    """only these levels, 1 to 5; 0 selects tasks without a level"""
    tasks: tuple[str, ...] = ()
    """shell-style patterns, one of which must match the name of the task or of its LIBERO task, or suite/name"""
    episodes: int = Field(default=1, ge=1)
    """number of LIBERO's 50 initial states per task, of resets of an own task, or of demonstrations; for ``own``,
    number of perturbations per task, axis and level, whose initial states repeat from the 51st on"""
    subset: int | None = Field(default=None, ge=1)
    """largest number of tasks, spread evenly over suites, axes, components and levels"""
    seed: int = 0
    """seed of the subset and of all perturbations"""

    @model_validator(mode="before")
    @classmethod
    def _a_list_is_whole(cls, values: Any) -> Any:
        """Name no suites by default with a list, which may have tasks of LIBERO-90 and of the user's suites."""
        if isinstance(values, dict) and values.get("file") is not None:
            return {"suites": (), **values}
        return values

    @field_validator("suites", "axes", "components", "levels", "tasks")
    @classmethod
    def _each_once(cls, values: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(dict.fromkeys(values))


def select(selection: Selection, archive: Path | None = None) -> list[EvaluationTask]:
    """Return the selected tasks in a fixed order.

    Raises:
        PipelineError: if the selection names something unknown, matches no task, or needs the benchmark's asset
            archive.
    """
    _check_names(selection)
    source_tasks = list(_list_source_tasks(selection))
    if selection.source == "pairs":
        # Pairs are already restricted by axis and level. They include LIBERO's tasks, which have neither.
        selection = selection.model_copy(update={"axes": (), "levels": ()})
    _check_restrictions(selection, source_tasks)
    wanted = [task for task in source_tasks if _matches(task, selection)]
    unknown = _count_unknown_levels(source_tasks, selection)
    if unknown:
        counts = ", ".join(f"{axis} {count}" for axis, count in unknown.items())
        print(f"left out, because their parameters do not state their level (0): {counts}")
    if selection.source == "libero_plus" and selection.file is None:
        wanted = _select_runnable(wanted, selection, archive)
    if not wanted:
        raise _nothing_left(selection, source_tasks)
    return wanted if selection.subset is None else balanced(wanted, selection.subset, selection.seed)


def _check_names(selection: Selection) -> None:
    """Reject errors in a selection that do not depend on the listed tasks.

    Raises:
        PipelineError: if the selection is rejected.
    """
    # The benchmark leaves LIBERO-90 out.
    of_benchmark = selection.source == "libero_plus" and selection.file is None
    valid = TESTED_SUITES if of_benchmark else SUITES if selection.source == "goals" else suites()
    _check_known("suites", selection.suites, valid, selection)
    if selection.episodes > 1 and (of_benchmark or selection.file is not None):
        raise PipelineError(
            f"{selection.file or selection.source} has one episode of each task",
            where="episodes",
            expected="1",
            remedy="leave --episodes out",
        )
    if selection.file is not None:
        if "source" in selection.model_fields_set:
            raise PipelineError(
                f"{selection.file} takes the place of a source",
                where="source",
                remedy="leave --source or --tasks-from out",
            )
        return
    of_libero = bool({*selection.suites} & {*SUITES})
    if of_libero and selection.source in ("libero", "goals", "pairs") and selection.episodes > INITIAL_STATES:
        raise PipelineError(
            f"a task has {INITIAL_STATES} initial states, not {selection.episodes}",
            where="episodes",
            expected=f"at most {INITIAL_STATES}",
            remedy="use --source own, whose held-out perturbations are not limited",
        )
    if selection.source == "pairs" and (selection.subset or selection.components):
        raise PipelineError(
            "pairs would lose some of their four combinations",
            where="subset" if selection.subset else "components",
            remedy="restrict pairs by suite, axis, level, task and episodes",
        )
    if selection.source in ("own", "pairs"):
        for axis in selection.axes:
            reason = AXES[axis].not_held_out if axis in AXES else ""
            if reason:
                tests = f"use --source libero_plus --axis {axis}: test tasks, from which plans keep their clearance"
                raise PipelineError(
                    f"{axis} has no held-out perturbations: {reason}",
                    where="axes",
                    expected=" or ".join(OWN_AXES),
                    remedy=tests if AXES[axis].dimension else f"leave {axis} out",
                )
        _check_known("axes", selection.axes, OWN_AXES, selection)
        _check_known("levels", selection.levels, LEVELS, selection)


def _check_known(field: str, named: Iterable[object], valid: Collection[object], selection: Selection) -> None:
    """Reject values of a field that are not valid.

    Raises:
        PipelineError: if there is such a value; it names the first one and the valid values.
    """
    unknown = [name for name in named if name not in valid]
    if unknown:
        raise PipelineError(
            f"{selection.file or selection.source} has no {unknown[0]!r}",
            where=field,
            expected=" or ".join(str(name) for name in sorted(valid, key=str)),
        )


def _list_source_tasks(selection: Selection) -> Iterator[EvaluationTask]:
    """Yield the tasks of the selection's source, before the other fields restrict them."""
    if selection.file is not None:
        yield from read_tasks(selection.file, selection.seed)
        return
    if selection.source == "libero_plus":
        for test in load().tasks:
            names = test.suite, test.base, test.name
            yield EvaluationTask("libero_plus", *names, test.axis, test.component, level_of_test(test), 0)
        return
    numbered_tasks: list[tuple[int, Task]] = []
    for suite in selection.suites:
        numbered_tasks += enumerate(tasks(suite))
    for place, task in numbered_tasks:
        for number in range(selection.episodes):
            match selection.source:
                case "libero":
                    yield libero_task(task, number)
                case "goals":
                    for replacement in list_replacements(task):
                        name, kind = replacement.name(task, number), replacement.category
                        yield EvaluationTask("goals", task.suite, task.name, name, "goal", kind, 0, number)
                    yield from list_carried_tasks(task, number)
                case "own":
                    kinds = product(selection.axes or OWN_AXES, selection.levels or LEVELS)
                    sampled = (held_out_task(task, axis, level, number, selection.seed) for axis, level in kinds)
                    yield from filter(None, sampled)
                case "pairs":
                    yield from _list_pairs(task, place + number, number, selection)


def _list_pairs(task: Task, turn: int, number: int, selection: Selection) -> Iterator[EvaluationTask]:
    """Yield all combinations of no axis, one axis and two axes on one initial state, at one level.

    Args:
        turn: sum of the task's place in its suite and the state's number; it selects the level.
    """
    levels, axes = selection.levels or LEVELS, axes_of("+".join(selection.axes or PAIR_AXES))
    pairs = ["+".join(pair) for pair in combinations(axes, 2)]
    level = levels[turn % len(levels)]
    yield libero_task(task, number)
    for axis in (*axes, *pairs):
        perturbed = held_out_task(task, axis, level, number, selection.seed)
        if perturbed is not None:
            yield perturbed


def _matches(task: EvaluationTask, selection: Selection) -> bool:
    """Return whether a task matches the names and the other restrictions of a selection."""
    name_matches = not selection.tasks or any(
        fnmatch.filter(_collect_names(task, pattern), pattern) for pattern in selection.tasks
    )
    restrictions = {column: getattr(selection, field) for field, column in COLUMNS.items()}
    return name_matches and all(
        not values or getattr(task, column) in values for column, values in restrictions.items()
    )


def _collect_names(task: EvaluationTask, pattern: str) -> set[str]:
    """Return the names of a task and its LIBERO task, after the suite if the pattern has a slash."""
    suite = f"{task.suite}/" if "/" in pattern else ""
    return {suite + task.name, suite + task.base}


def _count_unknown_levels(source_tasks: Sequence[EvaluationTask], selection: Selection) -> Counter[str]:
    """Count, for each axis, the perturbed tasks with an unknown level that match apart from their level."""
    if not selection.levels or 0 in selection.levels:
        return Counter()
    at_any = selection.model_copy(update={"levels": ()})
    unknown = (task for task in source_tasks if task.level == 0 and task.axis != "clean")
    return Counter(task.axis for task in unknown if _matches(task, at_any))


def _check_restrictions(selection: Selection, source_tasks: Sequence[EvaluationTask]) -> None:
    """Reject restrictions that no listed task has.

    Raises:
        PipelineError: if an axis, a component, a level or a pattern of names matches no task.
    """
    for field in ("axes", "components", "levels"):
        values = {getattr(task, COLUMNS[field]) for task in source_tasks}
        _check_known(field, getattr(selection, field), values, selection)
    if not selection.tasks:
        return
    # A faulty file of another suite of the user must not stop the evaluation.
    all_tasks = [*chain.from_iterable(map(tasks, {*SUITES, *selection.suites}))]
    for pattern in selection.tasks:
        names = {str(task) if "/" in pattern else task.name for task in all_tasks}
        for task in source_tasks:
            names |= _collect_names(task, pattern)
        if not fnmatch.filter(names, pattern):
            closest = difflib.get_close_matches(pattern, names, cutoff=0)
            raise PipelineError(f"no task is named {pattern!r}", where="tasks", expected=" or ".join(closest))


def _nothing_left(selection: Selection, source_tasks: Sequence[EvaluationTask]) -> PipelineError:
    """Return an error that lists, for each restriction, the values that would still match the other restrictions."""
    alternatives: list[str] = []
    for field, column in COLUMNS.items():
        if getattr(selection, field):
            without_field = selection.model_copy(update={field: ()})
            values = {getattr(task, column) for task in source_tasks if _matches(task, without_field)}
            if values:
                names = " or ".join(str(value) for value in sorted(values))
                alternatives.append(f"{field} {names}")
    return PipelineError(
        "no task matches the selection",
        where=f"selection {selection.model_dump(mode='json', exclude_defaults=True)}",
        expected="with the other restrictions as they are, " + "; or ".join(alternatives) if alternatives else None,
    )


def _select_runnable(wanted: list[EvaluationTask], selection: Selection, archive: Path | None) -> list[EvaluationTask]:
    """Return the tasks that can be rebuilt here, and print how many cannot.

    Raises:
        PipelineError: if no task can be rebuilt, or no task of an axis that the selection names.
    """
    runnable = [task for task in wanted if libero_plus.assets_of(load().find(task.suite, task.name), archive)]
    missing = Counter(task.axis for task in wanted) - Counter(task.axis for task in runnable)
    counts = ", ".join(f"{axis} {count}" for axis, count in missing.items())
    if missing and (not runnable or {*selection.axes} - {task.axis for task in runnable}):
        raise PipelineError(
            f"{counts} of {len(wanted)} tasks need files of LIBERO-Plus's asset archive",
            where="axes" if archive is None else archive,
            expected=f"test tasks of {', '.join(libero_plus.RUNNABLE)}, or 62 of background in libero_object",
            remedy=f"name the unpacked archive: --assets DIR; or --axis {' --axis '.join(libero_plus.RUNNABLE)}; or "
            "held-out perturbations on the same axes: --source own",
        )
    if missing:
        print(f"left out, because they need files of LIBERO-Plus's asset archive: {counts}")
    return runnable
