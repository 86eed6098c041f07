"""Which tasks to evaluate on: those that a user names, or a benchmark made as LIBERO-Plus was.

LIBERO-Plus drew 500 candidates of each of its seven dimensions in each of four suites, filtered them, and balanced them
to 10,030. Here the seven are this project's axes with held-out perturbations that the benchmark tests: its layout is
the axes layout and pose, and language has none.
"""

import difflib
import fnmatch
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import combinations, count, islice, product
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from pipeline.axes import AXES, axes_of, level_of_test
from pipeline.axes.base import LEVELS, Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus
from pipeline.evaluation.own_draws import OWN_AXES, PlannedDraws, draw, drawn_task
from pipeline.evaluation.results import REFUSED, EpisodeResult
from pipeline.evaluation.task_list import read_tasks
from pipeline.evaluation.tasks import EvaluationTask, balanced, libero_task, replacements
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.testset.benchmark import TESTED_SUITES, load
from pipeline.types import Task

INITIAL_STATES = 50
"""LIBERO's, of each task."""

COLUMNS = {"suites": "suite", "axes": "axis", "components": "component", "levels": "level"}
"""Fields of a selection to what they restrict."""

PAIR_AXES = ("layout", "robot", "camera", "light", "background", "noise")
"""The six dimensions that the paper pairs: objects, robot start, camera, illumination, environment, noise."""

CANDIDATES = 500
"""Of each axis in each suite, spread evenly over tasks and levels."""

SIZE = 10_000
"""How many tasks the benchmark has; LIBERO-Plus has 10,030."""


class Selection(Frozen, use_attribute_docstrings=True):
    """Which tasks to evaluate on; what is left out does not restrict."""

    source: Literal["libero", "libero_plus", "own", "goals", "pairs"] = "libero"
    """LIBERO's tasks; LIBERO-Plus's test tasks; held-out perturbations on this project's axes (``own``); LIBERO's tasks
    asked for another object of their scene (``goals``); for every two axes LIBERO's task, a held-out perturbation on
    either, and both together, on the same initial states (``pairs``)"""
    file: Path | None = None
    """in place of a source, a list of tasks that ``analyse construct`` wrote"""
    suites: tuple[str, ...] = TESTED_SUITES
    """of these suites only"""
    axes: tuple[str, ...] = ()
    """of these axes only"""
    components: tuple[str, ...] = ()
    """of these components only"""
    levels: tuple[int, ...] = ()
    """of these levels only"""
    tasks: tuple[str, ...] = ()
    """shell-style patterns, one of which must match the task's name or its LIBERO task's"""
    episodes: int = Field(default=1, ge=1)
    """how many of LIBERO's 50 initial states of each task, or, of ``own``, perturbations of each task, axis and level;
    from the 51st on they are on the same initial states again"""
    subset: int | None = Field(default=None, ge=1)
    """at most so many, spread evenly over suites, axes, components and levels"""
    seed: int = 0
    """of the subset and of all perturbations"""


def select(selection: Selection, archive: Path | None = None) -> list[EvaluationTask]:
    """The tasks that a selection names, in a fixed order.

    Raises:
        PipelineError: when it names something unknown, nothing, or what needs the benchmark's asset archive.
    """
    _check_names(selection)
    listed = list(_listed(selection))
    if selection.source == "pairs":  # which are listed by axis and level, and with LIBERO's tasks, which have neither
        selection = selection.model_copy(update={"axes": (), "levels": ()})
    _check_listed(selection, listed)
    wanted = [task for task in listed if _matches(task, selection)]
    if unknown := _of_unknown_level(listed, selection):
        counts = ", ".join(f"{axis} {count}" for axis, count in unknown.items())
        print(f"left out, because the parameters do not tell their level (0): {counts}")
    if selection.source == "libero_plus" and selection.file is None:
        wanted = _runnable(wanted, selection, archive)
    if not wanted:
        raise _nothing_left(selection, listed)
    return wanted if selection.subset is None else balanced(wanted, selection.subset, selection.seed)


def _check_names(selection: Selection) -> None:
    """Refuse what can be refused before anything is listed."""
    # The benchmark leaves LIBERO-90 out.
    of_benchmark = selection.source == "libero_plus" and selection.file is None
    _check_known("suites", selection.suites, TESTED_SUITES if of_benchmark else SUITES, selection)
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
                f"{selection.file} is in place of a source", where="source", remedy="leave --source or --tasks-from out"
            )
        return
    if selection.source in ("libero", "goals", "pairs") and selection.episodes > INITIAL_STATES:
        raise PipelineError(
            f"a task has {INITIAL_STATES} initial states, not {selection.episodes}",
            where="episodes",
            expected=f"at most {INITIAL_STATES}",
            remedy="held-out perturbations can be more: --source own",
        )
    if selection.source == "pairs" and (selection.subset or selection.components):
        raise PipelineError(
            "pairs would lose some of their four combinations",
            where="subset" if selection.subset else "components",
            remedy="restrict pairs by suite, axis, level, task and episodes",
        )
    if selection.source in ("own", "pairs"):
        for axis in selection.axes:
            if axis in AXES and (reason := AXES[axis].not_held_out):
                raise PipelineError(
                    f"{axis} has no held-out perturbations: {reason}",
                    where="axes",
                    expected=" or ".join(OWN_AXES),
                    remedy=f"--source libero_plus --axis {axis}, the benchmark's test tasks, which plans keep clear of",
                )
        _check_known("axes", selection.axes, OWN_AXES, selection)
        _check_known("levels", selection.levels, LEVELS, selection)


def _check_known(field: str, named: Iterable[object], known: Collection[object], selection: Selection) -> None:
    if unknown := [name for name in named if name not in known]:
        raise PipelineError(
            f"{selection.file or selection.source} has no {unknown[0]!r}",
            where=field,
            expected=" or ".join(str(name) for name in sorted(known, key=str)),
        )


def _listed(selection: Selection) -> Iterator[EvaluationTask]:
    if selection.file is not None:
        yield from read_tasks(selection.file, selection.seed)
        return
    if selection.source == "libero_plus":
        for test in load().tasks:
            named = test.suite, test.base, test.name
            yield EvaluationTask("libero_plus", *named, test.axis, test.component, level_of_test(test), 0)
        return
    every = [(place, task) for suite in selection.suites for place, task in enumerate(tasks(suite))]
    for place, task in every:
        for number in range(selection.episodes):
            match selection.source:
                case "libero":
                    yield libero_task(task, number)
                case "goals":
                    for replacement in replacements(task):
                        name, kind = replacement.name(task, number), replacement.category
                        yield EvaluationTask("goals", task.suite, task.name, name, "goal", kind, 0, number)
                case "own":
                    kinds = product(selection.axes or OWN_AXES, selection.levels or LEVELS)
                    drawn = (drawn_task(task, axis, level, number, selection.seed) for axis, level in kinds)
                    yield from filter(None, drawn)
                case "pairs":
                    yield from _pairs(task, place + number, number, selection)


def _pairs(task: Task, turn: int, number: int, selection: Selection) -> Iterator[EvaluationTask]:
    """All combinations of none, one and two axes on one initial state, at one level.

    Args:
        turn: place of the task in its suite and number of the state, added: which of the levels it is.
    """
    levels, axes = selection.levels or LEVELS, axes_of("+".join(selection.axes or PAIR_AXES))
    pairs = ("+".join(pair) for pair in combinations(axes, 2))
    level = levels[turn % len(levels)]
    yield libero_task(task, number)
    yield from filter(None, (drawn_task(task, axis, level, number, selection.seed) for axis in (*axes, *pairs)))


def _matches(task: EvaluationTask, selection: Selection) -> bool:
    named = not selection.tasks or any(fnmatch.filter((task.name, task.base), one) for one in selection.tasks)
    asked = {column: getattr(selection, field) for field, column in COLUMNS.items()}
    return named and all(not values or getattr(task, column) in values for column, values in asked.items())


def _of_unknown_level(listed: Sequence[EvaluationTask], selection: Selection) -> Counter[str]:
    """Axis to the number of perturbed tasks that match but for their level, which is unknown."""
    if not selection.levels or 0 in selection.levels:
        return Counter()
    at_any = selection.model_copy(update={"levels": ()})
    unknown = (task for task in listed if task.level == 0 and task.axis != "clean")
    return Counter(task.axis for task in unknown if _matches(task, at_any))


def _check_listed(selection: Selection, listed: Sequence[EvaluationTask]) -> None:
    for field in ("axes", "components", "levels"):
        known = {getattr(task, COLUMNS[field]) for task in listed}
        _check_known(field, getattr(selection, field), known, selection)
    names = {name for task in listed for name in (task.name, task.base)}
    names |= {task.name for suite in SUITES for task in tasks(suite)}
    for pattern in selection.tasks:
        if not fnmatch.filter(names, pattern):
            closest = difflib.get_close_matches(pattern, names, cutoff=0)
            raise PipelineError(f"no task is named {pattern!r}", where="tasks", expected=" or ".join(closest))


def _nothing_left(selection: Selection, listed: Sequence[EvaluationTask]) -> PipelineError:
    """What there is of each restriction among the tasks that keep to all others."""
    there = []
    for field, column in COLUMNS.items():
        if getattr(selection, field):
            others = selection.model_copy(update={field: ()})
            values = {getattr(task, column) for task in listed if _matches(task, others)}
            there += [f"{field} {' or '.join(str(value) for value in sorted(values))}"] if values else []
    return PipelineError(
        "no task is left",
        where=f"selection {selection.model_dump(mode='json', exclude_defaults=True)}",
        expected="with the other restrictions as they are, " + "; or ".join(there) if there else None,
    )


def _runnable(wanted: list[EvaluationTask], selection: Selection, archive: Path | None) -> list[EvaluationTask]:
    """Those that can be rebuilt; says how many cannot. Refuses an axis of which nothing can be, if it is named."""
    left = [task for task in wanted if libero_plus.assets_of(load().find(task.suite, task.name), archive)]
    missing = Counter(task.axis for task in wanted) - Counter(task.axis for task in left)
    counts = ", ".join(f"{axis} {count}" for axis, count in missing.items())
    if missing and (not left or {*selection.axes} - {task.axis for task in left}):
        raise PipelineError(
            f"{counts} of {len(wanted)} tasks need files of LIBERO-Plus's asset archive",
            where="axes" if archive is None else archive,
            expected=f"test tasks of {', '.join(libero_plus.RUNNABLE)}, or 62 of background in libero_object",
            remedy=f"name the unpacked archive: --assets DIR; or --axis {' '.join(libero_plus.RUNNABLE)}; or held-out "
            "perturbations on the same axes: --source own",
        )
    if missing:
        print(f"left out, because they need files of LIBERO-Plus's asset archive: {counts}")
    return left


def candidates(seed: int, each: int = CANDIDATES) -> list[EvaluationTask]:
    """``each`` held-out perturbations on every axis that the benchmark tests, in every suite; no scene is built.

    The number of a draw counts up once all tasks and levels had one, so initial states differ too.
    """
    drawn: list[EvaluationTask] = []
    tested = [axis for axis in OWN_AXES if load().of(axis)]
    for suite, axis in product(TESTED_SUITES, tested):
        every = (
            drawn_task(task, axis, level, number, seed)
            for number in count()
            for level, task in product(LEVELS, tasks(suite))
        )
        drawn += islice((task for task in every if task is not None), each)
    return drawn


def construct(
    drawn: Sequence[EvaluationTask],
    seed: int,
    size: int = SIZE,
    results: Iterable[EpisodeResult] = (),
    plan: PlannedDraws | None = None,
) -> tuple[list[EvaluationTask], dict[str, Any]]:
    """Filter candidates, and choose some evenly: axes in turn, of each axis its components, then levels, then suites.

    Args:
        results: episodes of candidates that were run; those whose scene was refused are left out.
        plan: a training plan; candidates whose first draw overlaps with it are left out. Those that follow where a
            scene refuses it are compared when an evaluation is given the plan.

    Returns:
        The benchmark's tasks, and how many there are of each kind, JSON-serialisable, with those that were left out.

    Raises:
        PipelineError: when a result is of another seed, whose draws are others under the same names.
    """
    refused = set()
    for row in results:
        if row.seed != seed:
            raise PipelineError(
                f"a result of seed {row.seed}", where=str(row), expected=f"seed {seed}, as the candidates"
            )
        if row.reason == REFUSED:
            refused.add(str(row))
    there = [task for task in drawn if str(task) not in refused]
    apart = there
    if plan is not None:
        apart = [task for task in there if not plan.overlap(draw(task, seed), find_task(task.suite, task.base))]
    chosen = balanced(apart, size, seed)
    return chosen, {
        "candidates": len(drawn),
        "refused": len(drawn) - len(there),
        "overlapping": len(there) - len(apart),
        "tasks": len(chosen),
        "by_axis": dict(sorted(Counter(task.axis for task in chosen).items())),
        "by_component": dict(sorted(Counter(f"{task.axis}/{task.component}" for task in chosen).items())),
    }
