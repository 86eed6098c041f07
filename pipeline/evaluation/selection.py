"""What of the tasks is evaluated on, as a user names it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Literal

from pydantic import Field

from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation import disjoint
from pipeline.evaluation.held_out import LEVELS, OWN_AXES
from pipeline.evaluation.settings import Settings
from pipeline.testset import benchmark
from pipeline.testset.benchmark import SUITES

Source = Literal["libero", "libero_plus", "own", "goals"]

INITIAL_STATES = 50
"""LIBERO's, of each task."""


class Selection(Frozen):
    """Which tasks to evaluate on; what is left out does not restrict.

    Attributes:
        source: where they come from. ``pairs`` are, for every two axes, LIBERO's task, the held-out draw of either
            axis, and both draws together, on the same initial states.
        file: a list of tasks that ``analyse construct`` wrote, in place of a source.
        suites, axes, components, levels: those of the tasks wanted.
        tasks: shell-style patterns, one of which must match the task's name or its LIBERO task's.
        episodes: how many of LIBERO's 50 initial states of each task (``libero``, ``goals``, ``pairs``), or draws of
            each task, axis and level (``own``); from the 51st on draws are on the same initial states again.
        subset: at most so many, spread evenly over suites, axes, components and levels.
        seed: of the subset and of all draws.
    """

    source: Source | Literal["pairs"] = "libero"
    file: Path | None = None
    suites: tuple[str, ...] = SUITES
    axes: tuple[str, ...] = ()
    components: tuple[str, ...] = ()
    levels: tuple[int, ...] = ()
    tasks: tuple[str, ...] = ()
    episodes: int = Field(default=1, ge=1)
    subset: int | None = Field(default=None, ge=1)
    seed: int = 0


def check_settings(selection: Selection, settings: Settings) -> None:
    """Have no episode that says a setting which it does not have.

    Raises:
        PipelineError: when one would, or the plan cannot be read.
    """
    if settings.seed != selection.seed:
        raise PipelineError(
            f"tasks are drawn under seed {selection.seed}, what perturbs them under {settings.seed}",
            where="seed",
            expected="one seed for both",
        )
    if settings.plan is not None:
        disjoint.sha256_of(settings.plan)
        if selection.file is None and selection.source not in ("own", "pairs"):
            raise PipelineError(
                f"{selection.source} has no held-out draws to keep clear of a plan",
                where="plan",
                expected="--source own",
            )


def check_names(selection: Selection) -> None:
    """What can be said before anything is listed.

    Raises:
        PipelineError: when it names something unknown.
    """
    check("suites", selection.suites, SUITES, selection)
    if selection.file is not None:
        return
    if selection.source in ("libero", "goals", "pairs") and selection.episodes > INITIAL_STATES:
        raise PipelineError(
            f"a task has {INITIAL_STATES} initial states, not {selection.episodes}",
            where="episodes",
            expected=f"at most {INITIAL_STATES}",
            remedy="held-out draws can be more: --source own",
        )
    if selection.source == "pairs" and (selection.subset or selection.components):
        raise PipelineError(
            "pairs would lose some of their four combinations",
            where="subset" if selection.subset else "components",
            remedy="restrict pairs by suite, axis, level, task and episodes",
        )
    if "language" in selection.axes and selection.source in ("own", "pairs"):
        raise PipelineError(
            "language has no held-out draws: its rewrites are a list, and plans train on all of it",
            where="axes",
            expected=" or ".join(OWN_AXES),
            remedy="--source libero_plus --axis language, whose 1,537 instructions every plan keeps clear of",
        )
    offered: dict[str, Collection[object]] = {
        "libero": {"clean"},
        "libero_plus": benchmark.AXES,
        "own": OWN_AXES,
        "goals": {"goal"},
        "pairs": OWN_AXES,
    }
    check("axes", selection.axes, offered[selection.source], selection)
    if selection.source in ("own", "pairs"):
        check("levels", selection.levels, LEVELS, selection)


def check(field: str, named: Iterable[object], known: Collection[object], selection: Selection) -> None:
    """Have every name of a field be known.

    Raises:
        PipelineError: when one is not, with all that are.
    """
    if unknown := [name for name in named if name not in known]:
        raise PipelineError(
            f"{selection.file or selection.source} has no {unknown[0]!r}",
            where=field,
            expected=" or ".join(str(name) for name in sorted(known, key=str)),
        )
