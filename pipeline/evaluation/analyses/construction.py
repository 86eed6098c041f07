"""Construction of a benchmark like LIBERO-Plus, from held-out perturbations on this project's axes.

LIBERO-Plus sampled 500 candidates of each of its seven dimensions in each of four suites, filtered them, and balanced
them to 10,030 tasks. Here, this project's axes with held-out perturbations take the place of the seven dimensions, if
the benchmark tests them. LIBERO-Plus's layout corresponds to the axes layout and pose. Language has no held-out
perturbations.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import count, islice, product
from typing import Any

from pipeline.axes.base import LEVELS
from pipeline.errors import PipelineError
from pipeline.evaluation.held_out import OWN_AXES, PlannedPerturbations, held_out_task, sample_perturbation
from pipeline.evaluation.results import REJECTED, EpisodeResult
from pipeline.evaluation.tasks import EvaluationTask, balanced
from pipeline.libero.tasks import find_task, tasks
from pipeline.testset.benchmark import TESTED_SUITES, load

CANDIDATES = 500
"""Number of candidates of each axis in each suite, spread evenly over tasks and levels."""

SIZE = 10_000
"""Number of tasks in the benchmark; LIBERO-Plus has 10,030."""


def candidates(seed: int, each: int = CANDIDATES) -> list[EvaluationTask]:
    """Sample ``each`` held-out perturbations on every axis that the benchmark tests, in every suite.

    No scene is built.
    """
    sampled: list[EvaluationTask] = []
    tested = [axis for axis in OWN_AXES if load().on_axis(axis)]
    for suite, axis in product(TESTED_SUITES, tested):
        sampled += islice(_held_out_tasks(suite, axis, seed), each)
    return sampled


def _held_out_tasks(suite: str, axis: str, seed: int) -> Iterator[EvaluationTask]:
    """Yield a suite's tasks with held-out perturbations on one axis, without end.

    The number of a perturbation increases after all tasks and levels had one, so initial states differ too.
    """
    for number in count():
        for level, task in product(LEVELS, tasks(suite)):
            perturbed = held_out_task(task, axis, level, number, seed)
            if perturbed is not None:
                yield perturbed


def construct(
    sampled: Sequence[EvaluationTask],
    seed: int,
    size: int = SIZE,
    results: Iterable[EpisodeResult] = (),
    plan: PlannedPerturbations | None = None,
) -> tuple[list[EvaluationTask], dict[str, Any]]:
    """Filter candidates, and choose tasks evenly: axes in turn, for each axis its components, then levels, then suites.

    Args:
        results: episodes of candidates that were run; candidates whose scene was rejected are left out.
        plan: a training plan; candidates whose first perturbation overlaps with it are left out. If the scene rejects
            the first perturbation, the next ones are compared when an evaluation gets the plan.

    Returns:
        The benchmark's tasks, and the numbers of tasks and of left-out candidates by kind, JSON-serialisable.

    Raises:
        PipelineError: if a result has another seed, because its perturbations differ under equal names.
    """
    rejected = set()
    for row in results:
        if row.seed != seed:
            raise PipelineError(
                f"the result has seed {row.seed}",
                where=str(row),
                expected=f"seed {seed}, as the candidates",
                remedy=f"set --seed {row.seed}, or leave these results out",
            )
        if row.reason == REJECTED:
            rejected.add(str(row))
    accepted = [task for task in sampled if str(task) not in rejected]
    not_overlapping = accepted
    if plan is not None:
        not_overlapping = [
            task
            for task in accepted
            if not plan.overlap(sample_perturbation(task, seed), find_task(task.suite, task.base))
        ]
    chosen = balanced(not_overlapping, size, seed)
    return chosen, {
        "candidates": len(sampled),
        "refused": len(sampled) - len(accepted),
        "overlapping": len(accepted) - len(not_overlapping),
        "tasks": len(chosen),
        "by_axis": dict(sorted(Counter(task.axis for task in chosen).items())),
        "by_component": dict(sorted(Counter(f"{task.axis}/{task.component}" for task in chosen).items())),
    }
