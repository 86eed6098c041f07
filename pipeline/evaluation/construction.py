"""A benchmark made as LIBERO-Plus was: 14,000 candidates, filtered, balanced to about 10,000, graded by models.

LIBERO-Plus drew 500 candidates of each of its seven dimensions in each of four suites. Here the seven are this
project's axes with held-out draws: its layout is the axes layout and pose, and language has no draws of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import count, islice, product
from typing import Any

from pipeline.axes.base import LEVELS
from pipeline.errors import PipelineError
from pipeline.evaluation.own_draws import OWN_AXES, PlannedDraws, draw, drawn_task
from pipeline.evaluation.results import REFUSED, Row
from pipeline.evaluation.tasks import EvaluationTask, balanced
from pipeline.libero.tasks import find_task, tasks
from pipeline.testset.benchmark import SUITES

CANDIDATES = 500
"""Of each axis in each suite, spread evenly over tasks and levels."""

SIZE = 10_000
"""How many tasks the benchmark has; LIBERO-Plus has 10,030."""

Identity = tuple[str, str, str]
"""Source, suite and name of a task, which are once in a benchmark."""


def candidates(seed: int, each: int = CANDIDATES) -> list[EvaluationTask]:
    """``each`` held-out draws of every axis in every suite; parameters only, no scene is built.

    The number of a draw counts up once all tasks and levels had one, so initial states differ too.
    """
    drawn: list[EvaluationTask] = []
    for suite, axis in product(SUITES, OWN_AXES):
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
    results: Iterable[Row] = (),
    plan: PlannedDraws | None = None,
) -> tuple[list[EvaluationTask], dict[str, Any]]:
    """Filter candidates, and choose some evenly: axes in turn, of each axis its components, then levels, then suites.

    Args:
        results: episodes of candidates that were run; those whose scene was refused are left out.
        plan: a training plan; candidates that overlap with it are left out.

    Returns:
        The benchmark's tasks, and how many there are of each kind, JSON-serialisable, with those that were left out.
    """
    refused = {_identity(row) for row in results if row["reason"] == REFUSED}
    there = [task for task in drawn if (task.source, task.suite, task.name) not in refused]
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


def difficulty(solved: int, models: int) -> int:
    """Level 1 to 5 of a task that ``solved`` of some models solve.

    LIBERO-Plus has four models, and 5 minus how many solve the task. For any number of models this is 5 minus four
    times the share that solves it, rounded to the nearest, halves to the harder: with up to seven models, 1 means that
    all solve the task and 5 that none does.
    """
    # ceil(4 solved / models - 1 / 2) in whole numbers.
    return 5 + (models - 8 * solved) // (2 * models)


def grade(results: Sequence[Iterable[Row]]) -> list[dict[str, Any]]:
    """Every task that all models ran, as JSON, with its ``difficulty`` and how many models solve it.

    Args:
        results: the episodes of each model.

    Raises:
        PipelineError: when a model has two results of one task, or no task was run by all.
    """
    outcomes = [_outcomes(rows) for rows in results]
    shared = [identity for identity in outcomes[0] if all(identity in of_model for of_model in outcomes)]
    if not shared:
        raise PipelineError("no task was run by all models", remedy="evaluate all of them with the same --tasks-from")
    graded = []
    for identity in shared:
        rows = [of_model[identity] for of_model in outcomes]
        solved = sum(bool(row["success"]) for row in rows)
        fields = {name: rows[0][name] for name in EvaluationTask.__dataclass_fields__}
        graded.append({**fields, "solved": solved, "difficulty": difficulty(solved, len(rows))})
    return graded


def _outcomes(rows: Iterable[Row]) -> dict[Identity, Row]:
    outcomes: dict[Identity, Row] = {}
    for row in rows:
        if row["reason"] == REFUSED:
            continue
        if outcomes.setdefault(_identity(row), row) is not row:
            raise PipelineError(
                f"several results of {'/'.join(_identity(row))}", expected="one model under one setting in each folder"
            )
    return outcomes


def _identity(row: Row) -> Identity:
    return row["source"], row["suite"], row["name"]
