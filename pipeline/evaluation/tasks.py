"""What a policy can be evaluated on, and how some of it is chosen."""

from __future__ import annotations

import difflib
import fnmatch
import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, product, zip_longest
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from pipeline import seeding
from pipeline.axes import AnyPerturbation, axes_of
from pipeline.errors import PipelineError
from pipeline.evaluation import goals, held_out, libero_plus
from pipeline.evaluation.held_out import LEVELS, OWN_AXES
from pipeline.evaluation.selection import Selection as Selection
from pipeline.evaluation.selection import Source, check, check_names
from pipeline.libero.tasks import find_task, tasks
from pipeline.testset import benchmark
from pipeline.testset.benchmark import SUITES
from pipeline.types import Task

COLUMNS = {"suites": "suite", "axes": "axis", "components": "component", "levels": "level"}
"""Fields of a selection to what they restrict."""

PAIR_AXES = ("layout", "robot", "camera", "light", "background", "noise")
"""The six dimensions that the paper pairs: objects, robot start, camera, illumination, environment, noise."""


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
            return _clean(known, int(task.get("episode_idx", 0)))
        return cls(**{name: task[name] for name in cls.__dataclass_fields__} | {"name": task["task_name"]})


def select(selection: Selection, archive: Path | None = None) -> list[EvaluationTask]:
    """The tasks that a selection names, in a fixed order.

    Args:
        archive: folder of LIBERO-Plus's asset archive, where there is one.

    Raises:
        PipelineError: when it names something unknown, nothing, or what needs the benchmark's asset archive.
    """
    check_names(selection)
    listed = list(_listed(selection))
    _check_listed(selection, listed)
    wanted = [task for task in listed if _matches(task, selection)]
    if selection.source == "libero_plus" and selection.file is None:
        wanted = _runnable(wanted, selection, archive)
    if not wanted:
        raise _nothing_left(selection, listed)
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


def draw(task: EvaluationTask, seed: int, attempt: int = 0, axis: str = "") -> AnyPerturbation:
    """The perturbation of a held-out draw on one axis: of ``axis`` where the task joins several."""
    base = find_task(task.suite, task.base)
    return held_out.draw(base, axis or task.axis, task.level, task.number, seed, attempt)


def drawn_task(task: Task, axis: str, level: int, number: int, seed: int) -> EvaluationTask | None:
    """A held-out draw on a LIBERO task; None where an axis cannot change anything that the task has.

    Args:
        axis: one, or several joined by +.
    """
    axes = axes_of(axis)
    if not all(held_out.axis(one).applies(task) for one in axes):
        return None
    component = "+".join(held_out.draw(task, one, level, number, seed).component for one in axes)
    name = f"{task.name}_{axis}_level{level}_draw{number}"
    return EvaluationTask("own", task.suite, task.name, name, axis, component, level, number)


def read_tasks(file: Path, seed: int) -> list[EvaluationTask]:
    """The tasks that ``analyse construct`` or ``analyse grade`` listed.

    Raises:
        PipelineError: when the file is not such a list, or its draws were made under another seed.
    """
    try:
        content = json.loads(file.read_text())
        names = EvaluationTask.__dataclass_fields__
        described = [{name: task[name] for name in names} for task in content["tasks"]]
        listed = TypeAdapter(list[EvaluationTask]).validate_python(described)
        drawn_under = content["seed"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PipelineError(
            f"not a list of tasks ({error!r})", where=file, expected="a file that `analyse construct` wrote"
        ) from error
    if drawn_under != seed:
        raise PipelineError(
            f"these tasks were drawn under seed {drawn_under}, not {seed}", where=file, remedy=f"--seed {drawn_under}"
        )
    return listed


def _listed(selection: Selection) -> Iterator[EvaluationTask]:
    if selection.file is not None:
        yield from read_tasks(selection.file, selection.seed)
        return
    if selection.source == "libero_plus":
        for test in benchmark.load().tasks:
            level = libero_plus.level_of(test)
            yield EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, level, 0)
        return
    every = [(place, task) for suite in selection.suites for place, task in enumerate(tasks(suite))]
    for place, task in every:
        for number in range(selection.episodes):
            match selection.source:
                case "libero":
                    yield _clean(task, number)
                case "goals":
                    for replacement in goals.replacements(task):
                        name, kind = replacement.name(task, number), replacement.category
                        yield EvaluationTask("goals", task.suite, task.name, name, "goal", kind, 0, number)
                case "own":
                    kinds = product(selection.axes or OWN_AXES, selection.levels or LEVELS)
                    drawn = (drawn_task(task, axis, level, number, selection.seed) for axis, level in kinds)
                    yield from filter(None, drawn)
                case "pairs":
                    yield from _pairs(task, place + number, number, selection)


def _clean(task: Task, number: int) -> EvaluationTask:
    return EvaluationTask("libero", task.suite, task.name, f"{task.name}_state{number}", "clean", "clean", 0, number)


def _pairs(task: Task, turn: int, number: int, selection: Selection) -> Iterator[EvaluationTask]:
    """All combinations of none, one and two axes on one initial state, at one level.

    Args:
        turn: place of the task in its suite and number of the state, added: which of the levels it is.
    """
    levels, axes = selection.levels or LEVELS, axes_of("+".join(selection.axes or PAIR_AXES))
    pairs = ("+".join(pair) for pair in combinations(axes, 2))
    yield _clean(task, number)
    level = levels[turn % len(levels)]
    drawn = (drawn_task(task, axis, level, number, selection.seed) for axis in (*axes, *pairs))
    yield from filter(None, drawn)


def _matches(task: EvaluationTask, selection: Selection) -> bool:
    kinds = (
        (task.axis, selection.axes),
        (task.component, selection.components),
        (task.level, selection.levels),
    )
    # Pairs are listed by axis and level, and with LIBERO's tasks, which have neither.
    restricted = ((task.suite, selection.suites), *(() if selection.source == "pairs" else kinds))
    named = any(fnmatch.fnmatch(name, pattern) for pattern in selection.tasks for name in (task.name, task.base))
    return all(not allowed or value in allowed for value, allowed in restricted) and (named or not selection.tasks)


def _check_listed(selection: Selection, listed: Sequence[EvaluationTask]) -> None:
    """Have every name that chooses among the listed tasks be one of theirs.

    Raises:
        PipelineError: when one is not.
    """
    # Pairs are listed by axis and level, and with LIBERO's tasks, which have neither.
    for field in () if selection.source == "pairs" else ("axes", "components", "levels"):
        check(field, getattr(selection, field), {getattr(task, COLUMNS[field]) for task in listed}, selection)
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
