"""Draws of the axes that no plan has: keyed apart, and of noise with strengths of their own."""

from __future__ import annotations

from functools import cache

from pipeline import seeding
from pipeline.axes import AnyAxis, AnyPerturbation, Axes
from pipeline.axes.base import Level
from pipeline.axes.noise import NoiseAxis
from pipeline.evaluation import libero_plus
from pipeline.testset import benchmark
from pipeline.types import Task

LEVELS: tuple[Level, ...] = (1, 2, 3, 4, 5)
OWN_AXES = ("layout", "pose", "robot", "camera", "light", "background", "noise")
"""The axes with draws of their own to hold out. Language is none: its rewrites are a list, which training uses up."""


def draw(task: Task, name: str, level: int, number: int, seed: int, attempt: int = 0) -> AnyPerturbation:
    """One held-out draw.

    Its key begins with ``evaluation``, which no plan's does, so that no seed makes the two draw alike. What a draw is
    joined with is not part of the key: a pair has the draws of its singles.

    Args:
        name: of the axis.
        number: counts the draws of a task, axis and level.
        attempt: counts the draws that were refused.
    """
    key = seeding.rng("evaluation", seed, name, task.suite, task.name, level, number, attempt)
    drawn: AnyPerturbation = axis(name).model_copy(update={"levels": (level,)}).sample(key, task, number)
    return drawn


@cache
def axis(name: str) -> AnyAxis:
    """An axis with its default ranges; noise has the strengths of the benchmark's even severities.

    Noise has one strength for each component and level. With the default ones, held-out draws would be as strong as
    those that plans train on; from the benchmark's, plans keep clear.
    """
    if name == "noise":
        tests = benchmark.load().of("noise")
        effects = {(test.component, test.parameters["severity"]): libero_plus.noise(test, 0).effect for test in tests}
        components = dict.fromkeys(test.component for test in tests)
        return NoiseAxis.model_validate(
            {component: tuple(effects[component, 2 * level] for level in LEVELS) for component in components}
        )
    default: AnyAxis = getattr(Axes.model_validate({name: {}}), name)
    return default
