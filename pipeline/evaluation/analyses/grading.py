"""Grading of tasks by the number of models that solve them, as LIBERO-Plus grades its test tasks."""

from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain
from typing import Any

from pipeline.errors import PipelineError
from pipeline.evaluation.held_out import held_out_task
from pipeline.evaluation.results import (
    REJECTED,
    Stored,
    Trial,
    one_setting,
    reject_different,
    reject_repeated_models,
    reject_repeated_tasks,
)
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import find_task


def difficulty(solved: int, models: int) -> int:
    """Compute the difficulty, 1 to 5, of a task that ``solved`` of ``models`` models solve.

    LIBERO-Plus has four models; its difficulty is 5 minus the number of models that solve the task. For any number of
    models, the difficulty is 5 minus four times the share of models that solve the task. It is rounded to the nearest
    integer, and halves are rounded to the harder level. With up to seven models, 1 means that all models solve the
    task, and 5 that no model does.
    """
    # ceil(4 solved / models - 1 / 2) in whole numbers.
    return 5 + (models - 8 * solved) // (2 * models)


def grade(results: Sequence[Sequence[Stored]]) -> list[dict[str, Any]]:
    """List every task that all models ran, as JSON, with its ``difficulty`` and the number of models that solve it.

    A held-out perturbation has the requested component, which is part of its episode's name, even if a perturbation of
    another component was used.

    Args:
        results: results of each model.

    Raises:
        PipelineError: if results of a model have several settings or two episodes of a task, or if two results are of
            one model. Also if models cannot be compared, or if no task was run by all models.
    """
    for model_results in results:
        one_setting(model_results)
        reject_repeated_tasks(model_results)
    reject_repeated_models(results)
    reject_different(chain(*results))
    models: list[dict[Trial, bool]] = []
    for model_results in results:
        models.append({row.trial: row.success for row, _ in model_results if row.reason != REJECTED})
    graded: list[dict[str, Any]] = []
    for trial in models[0]:
        if not all(trial in model for model in models):
            continue
        task, seed, _ = trial
        solved = sum(model[trial] for model in models)
        level = difficulty(solved, len(models))
        graded.append({**asdict(_asked(task, seed)), "solved": solved, "difficulty": level})
    if not graded:
        raise PipelineError(
            "no task was run by all models",
            expected="results of all models on equal tasks, perturbations and seeds",
            remedy="evaluate all of them with the same --tasks-from",
        )
    return graded


def _asked(task: EvaluationTask, seed: int) -> EvaluationTask:
    """Return the requested task of a result.

    The requested component differs from the result's component if the scene rejected the first perturbation.
    """
    if task.source != "own":
        return task
    return held_out_task(find_task(task.suite, task.base), task.axis, task.level, task.number, seed) or task
