"""Held-out perturbations: perturbations that no plan has, and their distance to a plan."""

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
from pipeline.axes import AXES, Axis, Perturbation, PhysicsPerturbation, axes_of, from_json, task_of, to_json
from pipeline.errors import MAKE_AGAIN, PipelineError, RejectedError
from pipeline.evaluation import held_out_sight
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import Edition, checksum_of, edition
from pipeline.grouping import grouped
from pipeline.libero.carried import definition_of
from pipeline.libero.tasks import common_key, find_task
from pipeline.physics.replay import roll_out
from pipeline.planning import plan
from pipeline.rendering.renderer import LastScene
from pipeline.seeding import digest
from pipeline.types import Demo, Scene, Task

OWN_AXES = tuple(name for name, axis in AXES.items() if not axis.not_held_out)
"""Axes that have held-out perturbations."""

ATTEMPTS = 20
"""Number of samples per axis of a task; a sample is rejected by its scene, by its visibility, or by a plan."""


def held_out_task(task: Task, axis: str, level: int, number: int, seed: int) -> EvaluationTask | None:
    """Return a LIBERO task with a held-out perturbation.

    Return `None` if one of the axes cannot change anything in the task.

    Args:
        axis: name of an axis, or names of several axes joined by +.
        number: number of the perturbation among those of the same task, axis and level.
    """
    names = axes_of(axis)
    if not all(held_out_axis(name).applies(task) for name in names):
        return None
    # Stored results have this name, so "draw", a former term for a held-out perturbation, stays.
    task_name = f"{task.name}_{axis}_level{level}_draw{number}"
    evaluation_task = EvaluationTask("own", task.suite, task.name, task_name, axis, "", level, number)
    components = [sample_perturbation(evaluation_task, seed, axis=name).component for name in names]
    return replace(evaluation_task, component="+".join(components))


def sample_perturbation(task: EvaluationTask, seed: int, attempt: int = 0, axis: str = "") -> Perturbation:
    """Sample the perturbation of a task on one axis.

    The random key begins with ``evaluation``. No plan's key does, so no seed gives a plan the same perturbations. The
    joined axes are not part of the key, so a pair has the perturbations of its single axes.

    Args:
        attempt: number of perturbations that were rejected before.
        axis: the axis, if the task joins several.
    """
    name = axis or task.axis
    key = seeding.rng("evaluation", seed, name, task.suite, task.base, task.level, task.number, attempt)
    ranges = held_out_axis(name).model_copy(update={"levels": (task.level,)})
    return ranges.sample(key, find_task(task.suite, task.base), task.number)


def digest_first_perturbations(task: EvaluationTask, seed: int) -> str:
    """Compute a digest of a task's first perturbation on each axis.

    Another version of this project compares the digest to detect that it samples different perturbations.
    """
    return digest(to_json(sample_perturbation(task, seed, axis=axis) for axis in axes_of(task.axis)))[:16]


@cache
def held_out_axis(name: str) -> Axis:
    """Return the ranges of an axis's held-out perturbations."""
    return AXES[name].held_out()


def held_out_scene(
    task: EvaluationTask,
    seed: int,
    demo: Demo,
    nominal: Callable[[], Scene],
    planned: PlannedPerturbations | None,
    opened: LastScene,
) -> tuple[tuple[Perturbation, ...], Scene | None]:
    """Sample the perturbations of a task, and return them with the perturbed scene.

    Each axis gets the first perturbation that the scene accepts alone and that is as visible as a run requires of its
    episodes. The choice does not depend on the joined axes, so a pair has the perturbations of its single axes. The
    perturbations apply one after the other, as in a plan.

    Args:
        demo: demonstration of the task, in the initial state with which the episode begins.
        nominal: returns the scene without perturbations.
        planned: perturbations to which the samples must keep the clearance; `None` compares with no plan.
        opened: renderer for the visibility check.

    Returns:
        The perturbations in the order in which they apply, and the scene; `None` if physics stay LIBERO's.

    Raises:
        RejectedError: if the scene accepts no perturbation of an axis, or rejects the perturbations of several axes
            together.
    """
    perturbations: list[Perturbation] = []
    scene = None
    for axis in axes_of(task.axis):
        samples = (sample_perturbation(task, seed, attempt, axis) for attempt in range(ATTEMPTS))
        far_from_plan = (sample for sample in samples if planned is None or not planned.overlap(sample, demo.task))
        perturbation, moved = _first_accepted(far_from_plan, axis, demo, nominal, opened)
        if isinstance(perturbation, PhysicsPerturbation):
            scene = moved if scene is None else perturbation.apply(scene, demo, roll_out)
        perturbations.append(perturbation)
    if len(perturbations) > 1 and any(change.can_hide for change in perturbations):
        fault = held_out_sight.fault(scene or nominal(), demo, perturbations, opened)
        if fault:
            raise RejectedError(fault)
    return tuple(perturbations), scene


def _first_accepted(
    samples: Iterable[Perturbation], axis: str, demo: Demo, nominal: Callable[[], Scene], opened: LastScene
) -> tuple[Perturbation, Scene]:
    """Return the first perturbation that its scene accepts, and the scene with this perturbation alone.

    Raises:
        RejectedError: if the scene accepts no perturbation.
    """
    for perturbation in samples:
        scene = _scene_with(perturbation, demo, nominal, opened)
        if scene is not None:
            return perturbation, scene
    raise RejectedError(f"no_{axis}_perturbation_fits")


def _scene_with(
    perturbation: Perturbation, demo: Demo, nominal: Callable[[], Scene], opened: LastScene
) -> Scene | None:
    """Return the scene with one perturbation; `None` if the scene rejects it or if too little is visible."""
    scene = nominal()
    if isinstance(perturbation, PhysicsPerturbation):
        try:
            scene = perturbation.apply(scene, demo, roll_out)
        except RejectedError:
            return None
    if perturbation.can_hide and held_out_sight.fault(scene, demo, (perturbation,), opened):
        return None
    return scene


class PlannedPerturbations:
    """Perturbations of a plan, with which held-out perturbations are compared.

    Distances are those of the leakage report, with the plan in place of the benchmark's test tasks.

    Args:
        rows: rows of the plan, including reserves.
    """

    def __init__(self, rows: Iterable[plan.Row]):
        self._perturbations: dict[Hashable, list[tuple[Perturbation, str]]] = defaultdict(list)
        self.counts = Counter[str]()
        """Axis to the number of its perturbations."""
        self.goals: set[Hashable] = set()
        """Goals of tasks that are carried to other scenes, as ``Bddl.asked``."""
        for row in rows:
            task = task_of(row.suite, row.task, row.perturbations)
            if task.goal_file is not None:
                self.goals.add(definition_of(task).asked)
            for perturbation in from_json(row.perturbations):
                key = _comparable(perturbation, task)
                self._perturbations[key].append((perturbation.in_scene(task), row.episode_id))
                self.counts[perturbation.axis] += 1

    def nearest(self, sampled: Perturbation, task: Task) -> tuple[float, str]:
        """Return the distance to the nearest planned perturbation on the same axis, and its episode.

        If the plan has nothing to compare with, the distance is infinite and the episode is empty.
        """
        comparable = self._perturbations.get(_comparable(sampled, task), [])
        if not comparable:
            return math.inf, ""
        distances = sampled.in_scene(task).distances_to([perturbation for perturbation, _ in comparable])
        if not np.isfinite(distances).any():
            return math.inf, ""
        closest = int(np.nanargmin(distances))
        _, episode = comparable[closest]
        return float(distances[closest]), episode

    def overlap(self, sampled: Perturbation, task: Task) -> bool:
        """Return whether a perturbation equals a planned one or is closer to one than the axis's clearance."""
        distance, _ = self.nearest(sampled, task)
        return distance == 0 or distance < sampled.clearance


def _comparable(perturbation: Perturbation, task: Task) -> Hashable:
    """Return a key that is equal for perturbations between which a distance is defined."""
    return type(perturbation), perturbation.same and common_key(task, perturbation.same)


def planned(file: Path) -> PlannedPerturbations:
    """Read the perturbations of a plan's file, once per process.

    Raises:
        PipelineError: if the file is not a plan of this version.
    """
    return _planned(_edition(file))


@cache
def _planned(file: Edition) -> PlannedPerturbations:
    """Read the perturbations of one edition of a plan's file."""
    return PlannedPerturbations(plan.read(file.path))


def sha256_of(file: Path) -> str:
    """Compute the SHA-256 of a plan's file, which names the plan in results.

    Raises:
        PipelineError: if the file cannot be read.
    """
    return checksum_of(_edition(file))


def _edition(file: Path) -> Edition:
    """Return the current edition of a plan's file.

    Raises:
        PipelineError: if the file cannot be read.
    """
    try:
        return edition(file)
    except OSError as error:
        raise PipelineError(
            f"the plan cannot be read ({error})",
            where=file,
            expected="data/<run>/plan.parquet",
            remedy=f"run `{MAKE_AGAIN}`, which writes the plan",
        ) from error


def compare(
    sampled: Iterable[tuple[str, Perturbation, Task]], planned_perturbations: PlannedPerturbations
) -> dict[str, Any]:
    """Compare held-out perturbations with a plan.

    Args:
        sampled: name, perturbation and perturbed task of each held-out perturbation.

    Returns:
        Axis to a dictionary with these keys:

        * ``draws``: number of held-out perturbations.
        * ``planned``: number of planned perturbations.
        * ``overlaps``: number of held-out perturbations that overlap with a planned one.
        * ``smallest``: the smallest distance; `None` if nothing could be compared.
        * ``closest``: names of the perturbation and of the planned episode at the smallest distance, or `None`.
        * ``clearance``: the least distance that the leakage report allows.
    """
    by_axis = {}
    for axis, of_axis in grouped((named[1].axis, named) for named in sampled).items():
        distances = [(*planned_perturbations.nearest(perturbation, task), name) for name, perturbation, task in of_axis]
        smallest, episode, name = min(distances)
        compared = math.isfinite(smallest)
        # Programs of users may read this output, so the key "draws" keeps the former term for perturbations.
        by_axis[axis] = {
            "draws": len(of_axis),
            "planned": planned_perturbations.counts[axis],
            "overlaps": sum(planned_perturbations.overlap(perturbation, task) for _, perturbation, task in of_axis),
            "smallest": smallest if compared else None,
            "closest": (name, episode) if compared else None,
            "clearance": of_axis[0][1].clearance,
        }
    return by_axis
