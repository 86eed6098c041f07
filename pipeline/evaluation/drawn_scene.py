"""The scene of a held-out draw, or of several together."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.axes import AnyPerturbation, PhysicsPerturbation, axes_of
from pipeline.errors import RefusedError
from pipeline.evaluation.disjoint import PlannedDraws
from pipeline.evaluation.tasks import EvaluationTask, draw
from pipeline.libero.tasks import find_task
from pipeline.physics.roll_out import roll_out
from pipeline.types import Demo, Scene

ATTEMPTS = 20
"""How often a draw that its scene refuses, or that a plan has, is drawn anew."""


def drawn_scene(
    task: EvaluationTask, seed: int, demo: Demo, nominal: Callable[[], Scene], planned: PlannedDraws | None
) -> tuple[tuple[AnyPerturbation, ...], Scene | None]:
    """What a task draws, in the order in which it applies, and the scene with it; None where physics stay LIBERO's.

    Each axis has the first draw that the scene takes by itself. That is so too where other axes join it, so that a
    pair has the draws of its singles. They apply one after the other, as those of a plan do.

    Args:
        seed: of all draws.
        demo: of the task, in the initial state that the episode begins in.
        nominal: gives the scene without any change.
        planned: what draws must keep clear of.

    Raises:
        RefusedError: when the scene takes no draw of an axis, or not the draws of several together.
    """
    perturbations: list[AnyPerturbation] = []
    scene = None
    for axis in axes_of(task.axis):
        drawn, alone = _fitting(task, axis, seed, demo, nominal, planned)
        perturbations.append(drawn)
        if isinstance(drawn, PhysicsPerturbation):
            scene = alone if scene is None else drawn.apply(scene, demo, roll_out)
    return tuple(perturbations), scene


def _fitting(
    task: EvaluationTask,
    axis: str,
    seed: int,
    demo: Demo,
    nominal: Callable[[], Scene],
    planned: PlannedDraws | None,
) -> tuple[AnyPerturbation, Scene | None]:
    """The first draw of an axis that is none of the plan's and that the scene takes, and that scene.

    Raises:
        RefusedError: when there is none.
    """
    for attempt in range(ATTEMPTS):
        drawn = draw(task, seed, attempt, axis)
        if planned is not None and planned.overlap(drawn, find_task(task.suite, task.base)):
            continue
        if not isinstance(drawn, PhysicsPerturbation):
            return drawn, None
        try:
            return drawn, drawn.apply(nominal(), demo, roll_out)
        except RefusedError:
            continue
    raise RefusedError(f"no_{axis}_draw_fits")
