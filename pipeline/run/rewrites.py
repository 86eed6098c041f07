"""Rewrites that training may use in place of an episode's instruction."""

from functools import cache

from pipeline.axes import from_json, task_of
from pipeline.axes.language import LanguageAxis
from pipeline.testset import benchmark
from pipeline.types import Task


def list_episode_rewrites(axis: LanguageAxis | None, suite: str, task: str, perturbations: str) -> tuple[str, ...]:
    """List the rewrites that a language axis may sample for an episode with these perturbations.

    A plan never joins a rewrite with an added object that the rewrite names.

    Args:
        axis: `None` for the axis with default ranges.
        perturbations: JSON list, as in the columns of the plan and the manifest.
    """
    changes = from_json(perturbations)
    other_objects = any(change.changes_objects for change in changes)
    carried_task = task_of(suite, task, perturbations)
    texts = _list_clear_rewrites(axis or LanguageAxis(), carried_task, other_objects=other_objects)
    return tuple(text for text in texts if not any(change.named_in(text) for change in changes))


@cache
def _list_clear_rewrites(axis: LanguageAxis, task: Task, *, other_objects: bool) -> tuple[str, ...]:
    return axis.list_clear_rewrites(task, benchmark.load(), other_objects=other_objects)
