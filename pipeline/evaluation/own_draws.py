"""Draws of the axes that no plan has: how they are drawn, and kept clear of a plan."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import seeding
from pipeline.axes import AXES, Axis, Perturbation, PhysicsPerturbation, axes_of, from_json, to_json
from pipeline.errors import PipelineError, RefusedError
from pipeline.evaluation import held_out_sight
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import Edition, checksum_of, edition
from pipeline.grouping import grouped
from pipeline.libero.tasks import find_task, shared
from pipeline.physics.replay import roll_out
from pipeline.planning import plan
from pipeline.rendering.renderer import LastScene
from pipeline.seeding import digest
from pipeline.types import Demo, Scene, Task

OWN_AXES = tuple(name for name, axis in AXES.items() if not axis.not_held_out)
"""The axes with draws of their own to hold out."""

ATTEMPTS = 20
"""How often a draw is sampled again that its scene refuses, that shows too little, or that a plan has."""


def drawn_task(task: Task, axis: str, level: int, number: int, seed: int) -> EvaluationTask | None:
    """A held-out perturbation on a LIBERO task; None where an axis cannot change anything that the task has.

    Args:
        axis: one, or several joined by +.
        number: counts the draws of a task, axis and level.
    """
    axes = axes_of(axis)
    if not all(held_out(one).applies(task) for one in axes):
        return None
    name = f"{task.name}_{axis}_level{level}_draw{number}"
    drawn = EvaluationTask("own", task.suite, task.name, name, axis, "", level, number)
    return replace(drawn, component="+".join(draw(drawn, seed, axis=one).component for one in axes))


def draw(task: EvaluationTask, seed: int, attempt: int = 0, axis: str = "") -> Perturbation:
    """The perturbation of a task on one axis.

    Its key begins with ``evaluation``, which no plan's does, so that no seed makes the two draw alike. What a draw is
    joined with is not part of the key: a pair has the draws of its singles.

    Args:
        attempt: counts the draws that were refused.
        axis: which, where the task joins several.
    """
    name = axis or task.axis
    key = seeding.rng("evaluation", seed, name, task.suite, task.base, task.level, task.number, attempt)
    ranges = held_out(name).model_copy(update={"levels": (task.level,)})
    return ranges.sample(key, find_task(task.suite, task.base), task.number)


def first_draws(task: EvaluationTask, seed: int) -> str:
    """Digest of a task's first draw on each axis, by which another version tells whether it draws the same."""
    return digest(to_json(draw(task, seed, axis=axis) for axis in axes_of(task.axis)))[:16]


@cache
def held_out(name: str) -> Axis:
    """The ranges of an axis's held-out perturbations."""
    return AXES[name].held_out()


def drawn_scene(
    task: EvaluationTask,
    seed: int,
    demo: Demo,
    nominal: Callable[[], Scene],
    planned: PlannedDraws | None,
    opened: LastScene,
) -> tuple[tuple[Perturbation, ...], Scene | None]:
    """What a task draws, in the order in which it applies, and the scene with it; None where physics stay LIBERO's.

    Each axis has the first draw that the scene takes by itself, and that shows as much as a run asks of an episode.
    That is so too where other axes join it, so that a pair has the draws of its singles. They apply one after the
    other, as those of a plan do.

    Args:
        demo: of the task, in the initial state that the episode begins in.
        nominal: gives the scene without any change.
        planned: what draws must keep clear of.
        opened: renders what is judged.

    Raises:
        RefusedError: when the scene takes no draw of an axis, or not the draws of several together.
    """
    perturbations: list[Perturbation] = []
    scene = None
    for axis in axes_of(task.axis):
        draws = (draw(task, seed, attempt, axis) for attempt in range(ATTEMPTS))
        clear = (one for one in draws if planned is None or not planned.overlap(one, demo.task))
        alone = next((taken for one in clear if (taken := _taken(one, demo, nominal, opened))), None)
        if alone is None:
            raise RefusedError(f"no_{axis}_draw_fits")
        one, moved = alone
        if isinstance(one, PhysicsPerturbation):
            scene = moved if scene is None else one.apply(scene, demo, roll_out)
        perturbations.append(one)
    together = len(perturbations) > 1 and any(map(held_out_sight.can_hide, perturbations))
    if together and (fault := held_out_sight.fault(scene or nominal(), demo, perturbations, opened)):
        raise RefusedError(fault)
    return tuple(perturbations), scene


def _taken(
    one: Perturbation, demo: Demo, nominal: Callable[[], Scene], opened: LastScene
) -> tuple[Perturbation, Scene] | None:
    """A draw and the scene with it alone; None where the scene refuses it, or too little can be seen."""
    scene = nominal()
    if isinstance(one, PhysicsPerturbation):
        try:
            scene = one.apply(scene, demo, roll_out)
        except RefusedError:
            return None
    if held_out_sight.can_hide(one) and held_out_sight.fault(scene, demo, (one,), opened):
        return None
    return one, scene


class PlannedDraws:
    """What a plan draws, to keep held-out perturbations clear of it.

    Distances are those of the leakage report, with the plan in the place of the benchmark's test tasks.

    Args:
        rows: of the plan, reserves among them.
    """

    def __init__(self, rows: Iterable[plan.Row]):
        self._draws: dict[Hashable, list[tuple[Perturbation, str]]] = defaultdict(list)
        self.counts = Counter[str]()
        """Axis to the number of its draws."""
        for row in rows:
            task = find_task(row.suite, row.task)
            for one in from_json(row.perturbations):
                self._draws[_comparable(one, task)].append((one.in_scene(task), row.episode_id))
                self.counts[one.axis] += 1

    def nearest(self, drawn: Perturbation, task: Task) -> tuple[float, str]:
        """The distance to the nearest planned draw on the same axis and the episode it belongs to; infinite, and no
        episode, where there is none to compare with."""
        others = self._draws.get(_comparable(drawn, task), [])
        distances = drawn.in_scene(task).apart([other for other, _ in others]) if others else np.array([])
        if not np.isfinite(distances).any():
            return math.inf, ""
        closest = int(np.nanargmin(distances))
        return float(distances[closest]), others[closest][1]

    def overlap(self, drawn: Perturbation, task: Task) -> bool:
        """Whether a draw is a planned one, or closer to one than the axis keeps from the benchmark's test tasks."""
        distance, _ = self.nearest(drawn, task)
        return distance == 0 or distance < drawn.clearance


def _comparable(drawn: Perturbation, task: Task) -> Hashable:
    """Equal for draws that have a distance."""
    return type(drawn), drawn.same and shared(task, drawn.same)


def planned(file: Path) -> PlannedDraws:
    """The draws of a plan's file, read once a process.

    Raises:
        PipelineError: when it is not a plan of this version.
    """
    return _planned(_edition(file))


@cache
def _planned(file: Edition) -> PlannedDraws:
    return PlannedDraws(plan.read(file.path))


def sha256_of(file: Path) -> str:
    """By which results name a plan.

    Raises:
        PipelineError: when the file cannot be read.
    """
    return checksum_of(_edition(file))


def _edition(file: Path) -> Edition:
    try:
        return edition(file)
    except OSError as error:
        raise PipelineError(f"cannot be read ({error})", where=file, expected="data/<run>/plan.parquet") from error


def compare(drawn: Iterable[tuple[str, Perturbation, Task]], planned_draws: PlannedDraws) -> dict[str, Any]:
    """How close held-out perturbations come to a plan.

    Args:
        drawn: the name of each, the draw, and the task that it changes.

    Returns:
        Axis to how many ``draws`` there are, how many are ``planned``, in how many a plan's draw ``overlaps``, and the
        ``smallest`` distance with the names of its draw and of its planned episode (``closest``), None where nothing
        could be compared. ``clearance`` is the least distance that the leakage report allows.
    """
    found = {}
    for axis, draws in grouped((named[1].axis, named) for named in drawn).items():
        smallest, episode, name = min((*planned_draws.nearest(one, task), name) for name, one, task in draws)
        compared = math.isfinite(smallest)
        found[axis] = {
            "draws": len(draws),
            "planned": planned_draws.counts[axis],
            "overlaps": sum(planned_draws.overlap(one, task) for _, one, task in draws),
            "smallest": smallest if compared else None,
            "closest": (name, episode) if compared else None,
            "clearance": draws[0][1].clearance,
        }
    return found
