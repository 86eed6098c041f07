"""Focus of a plan on failures: episodes by failure rates of evaluated policies on axes, levels and tasks.

A rate is that of ``smoothed``, so that few episodes say little. Axes, levels and tasks without results have the mean
rate of the group that they belong to. A new share is the configured share times the rate, within a floor and a cap.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from math import isclose
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, NamedTuple

import numpy as np
import yaml
from scipy.optimize import brentq

from pipeline.axes import axes_of, level_of_test
from pipeline.config import Config, read_content, validate
from pipeline.errors import PipelineError
from pipeline.evaluation.other_programs import PROTOCOL, separate
from pipeline.evaluation.results import read
from pipeline.evaluation.statistics import wilson
from pipeline.files import refuse_other_file
from pipeline.files import write as write_file
from pipeline.grouping import grouped
from pipeline.libero.tasks import select_tasks
from pipeline.planning.plan import apportion
from pipeline.testset import benchmark

PRIOR = 5
"""Number of imagined episodes with the mean rate that are added to each group's episodes."""

LEVEL_ENTRIES = 20
"""Number of entries of ``levels`` that state the shares of the levels."""


Kind = Literal["episodes", "level", "task"]


class Attempt(NamedTuple):
    """One episode of an evaluated policy.

    Attributes:
        axes: perturbed axes; empty for LIBERO's own tasks.
        level: strength, 1 to 5; 0 if it is unknown, or that of several axes.
        task: suite/name of the LIBERO task.
        failed: True if the goal was not reached.
    """

    axes: tuple[str, ...]
    level: int
    task: str
    failed: bool


class Reason(NamedTuple):
    """Reason of one new share.

    Attributes:
        kind: ``episodes`` for an entry of ``plan.episodes``, ``level`` for a level of an axis, ``task`` for a task.
        name: name of the entry; axis and level; or name of the task.
        failures, episodes: results on it.
        rate: smoothed rate of failures.
        before, after: share before and after, as the configuration states it.
        note: ``floor`` or ``cap`` if it limits the share, ``no results`` if there are none.
    """

    kind: Kind
    name: str
    failures: int
    episodes: int
    rate: float
    before: float
    after: float
    note: str

    @property
    def interval(self) -> tuple[float, float] | None:
        """Return Wilson's 95 % interval of the measured rate of failures; `None` without results."""
        return wilson(self.failures, self.episodes) if self.episodes else None


@dataclass(frozen=True)
class Limits:
    """Limits of a new share, as multiples of the share without any focus."""

    floor: float = 0.5
    cap: float = 2.0


@dataclass(frozen=True)
class Focused:
    """New values of a plan, with their reasons.

    Attributes:
        episodes: entry of ``plan.episodes`` to its number.
        levels: axis to its ``levels``; axes without results, and axes that take entries of lists, are left out.
        task_weights: task to its weight.
    """

    episodes: dict[str, int]
    levels: dict[str, list[int]]
    task_weights: dict[str, float]
    reasons: list[Reason]


def attempts(paths: Sequence[Path]) -> list[Attempt]:
    """Read the episodes of all policies from results of ``evaluate``, vla-eval and lerobot-eval.

    Raises:
        PipelineError: if a path has no results, or a file is damaged.
    """
    folders, policies = separate(paths)
    found: list[Attempt] = []
    for evaluated in read(folders, PROTOCOL) if folders else ():
        for row in evaluated.rows:
            axes = () if row.axis == "clean" else tuple(row.axis.split("+"))
            level = row.level if len(axes) == 1 else 0
            found.append(Attempt(axes, level, f"{row.suite}/{row.base}", not row.success))
    for policy in policies:
        for outcome in policy.outcomes:
            test = benchmark.load().find(outcome.suite, outcome.name)
            task = f"{test.suite}/{test.base}"
            found.append(Attempt((test.axis,), level_of_test(test), task, not outcome.success))
    return found


def focus(config: Config, tried: Sequence[Attempt], episodes: int | None = None, limits: Limits = Limits()) -> Focused:
    """Distribute a plan's episodes by failure rates.

    Args:
        config: the configuration whose plan is changed.
        tried: episodes of evaluated policies.
        episodes: total number of kept perturbed episodes; that of the configuration by default.
        limits: floor and cap.

    Raises:
        PipelineError: if no result belongs to an axis of the plan, or if the floor and the cap exclude each other.
    """
    if not 0 <= limits.floor <= 1 <= limits.cap:
        raise PipelineError(
            f"floor {limits.floor:g}, cap {limits.cap:g}", expected="a floor from 0 to 1, and a cap of at least 1"
        )
    total = episodes if episodes is not None else sum(config.plan.episodes.values())
    if total < len(config.plan.episodes):
        raise PipelineError(
            f"{total} episodes for {len(config.plan.episodes)} entries of plan.episodes",
            where="--episodes",
            expected="at least one for each",
        )
    axes = config.plan.axes.configured()
    by_axis = grouped((axis, one) for one in tried for axis in one.axes if axis in axes)
    if not by_axis:
        tested = ", ".join(sorted({axis for one in tried for axis in one.axes})) or "no axis"
        raise PipelineError(
            f"the results are about {tested}",
            where="RESULTS",
            expected=f"results on axes of the plan: {', '.join(axes)}",
            remedy="evaluate the policy on --source libero_plus, own or goals",
        )
    mean = _mean([one for one in tried if {*one.axes} & by_axis.keys()])
    of_axis = {axis: smoothed(by_axis.get(axis, ()), mean) for axis in axes}
    numbers, reasons = _by_entry(config.plan.episodes, by_axis, of_axis, total, limits)
    levels: dict[str, list[int]] = {}
    tasks = select_tasks(config.demos.tasks)
    for axis in axes:
        known = [one for one in by_axis.get(axis, ()) if one.level in axes[axis].levels]
        # The levels of an axis with lists only select entries, so their shares cannot be stated.
        if known and not any(axes[axis].entries(task) for task in tasks):
            levels[axis], further = _by_level(axis, axes[axis].levels, known, of_axis[axis], limits)
            reasons += further
    before = {str(task): config.plan.task_weights.get(str(task), 1.0) for task in tasks}
    weights, further = _by_task(before, tried, limits)
    return Focused(numbers, levels, weights, [*reasons, *further])


def _by_entry(
    before: Mapping[str, int],
    by_axis: Mapping[str, Sequence[Attempt]],
    rates: Mapping[str, float],
    total: int,
    limits: Limits,
) -> tuple[dict[str, int], list[Reason]]:
    """Distribute ``total`` episodes over the entries of ``plan.episodes`` by the mean rate of each entry's axes."""
    tried: dict[str, list[Attempt]] = {}
    for name in before:
        tried[name] = list(chain.from_iterable(by_axis.get(axis, ()) for axis in axes_of(name)))
    of_entry = {name: fmean(rates[axis] for axis in axes_of(name)) for name in before}
    shares = _shares(before, of_entry, limits)
    numbers = dict(zip(before, apportion(total, [*shares.values()], least=1), strict=True))
    return numbers, _reasons("episodes", tried, of_entry, before, shares, numbers, limits)


def _by_level(
    axis: str, before: Sequence[int], tried: Sequence[Attempt], of_axis: float, limits: Limits
) -> tuple[list[int], list[Reason]]:
    """Distribute the entries of an axis's ``levels`` by the rate of each level; each level keeps an entry."""
    names = {f"{axis} {level}": level for level in sorted({*before})}
    old = {name: float(before.count(level)) for name, level in names.items()}
    of_level = grouped((f"{axis} {one.level}", one) for one in tried)
    rates = {name: smoothed(of_level.get(name, ()), of_axis) for name in names}
    shares = _shares(old, rates, limits)
    numbers = dict(zip(names, apportion(LEVEL_ENTRIES, [*shares.values()], least=1), strict=True))
    levels: list[int] = []
    for name, level in names.items():
        levels += [level] * numbers[name]
    return levels, _reasons("level", of_level, rates, old, shares, numbers, limits)


def _by_task(
    before: Mapping[str, float], tried: Sequence[Attempt], limits: Limits
) -> tuple[dict[str, float], list[Reason]]:
    """Distribute weights with the mean 1 over tasks by the rate of each task, its unperturbed episodes included."""
    of_task = grouped((one.task, one) for one in tried if one.task in before)
    mean = _mean(list(chain.from_iterable(of_task.values())))
    rates = {task: smoothed(of_task.get(task, ()), mean) for task in before}
    shares = _shares(before, rates, limits)
    weights = {task: round(len(before) * share, 2) for task, share in shares.items()}
    return weights, _reasons("task", of_task, rates, before, shares, weights, limits)


def smoothed(tried: Iterable[Attempt], mean: float) -> float:
    """Return the rate of failures with ``PRIOR`` further episodes at the mean rate."""
    failed = [one.failed for one in tried]
    return (sum(failed) + PRIOR * mean) / (len(failed) + PRIOR)


def _mean(tried: Sequence[Attempt]) -> float:
    """Return the rate of failures, of one success and one failure more, so that it is neither 0 nor 1."""
    return (sum(one.failed for one in tried) + 1) / (len(tried) + 2)


def _shares(before: Mapping[str, float], rates: Mapping[str, float], limits: Limits) -> dict[str, float]:
    """Return shares with the sum 1: in proportion to number times rate, from floor to cap times the share before."""
    old = np.array([*before.values()], float)
    old /= old.sum()
    wanted = old * [rates[name] for name in before]

    def limited(factor: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.clip(factor * wanted, limits.floor * old, limits.cap * old)

    largest = limits.cap * float((old / wanted).max())
    factor = brentq(lambda value: float(limited(value).sum()) - 1.0, 0.0, largest)
    shares = limited(factor)
    return dict(zip(before, (shares / shares.sum()).tolist(), strict=True))


def _reasons(
    kind: Kind,
    tried: Mapping[str, Sequence[Attempt]],
    rates: Mapping[str, float],
    before: Mapping[str, float],
    shares: Mapping[str, float],
    after: Mapping[str, float],
    limits: Limits,
) -> list[Reason]:
    """Return the reason of each share."""
    reasons: list[Reason] = []
    for name, share in shares.items():
        of_name = tried.get(name, ())
        factor = share * sum(before.values()) / before[name]
        notes = [] if of_name else ["no results"]
        if isclose(factor, limits.floor):
            notes.append("floor")
        elif isclose(factor, limits.cap):
            notes.append("cap")
        failures = sum(one.failed for one in of_name)
        reasons.append(
            Reason(kind, name, failures, len(of_name), rates[name], before[name], after[name], ", ".join(notes))
        )
    return reasons


def write(
    results: Sequence[Path], source: Path, out: Path, episodes: int | None = None, limits: Limits = Limits()
) -> Focused:
    """Write a configuration, and the reasons of its shares as a comment.

    Args:
        results: results of policies, as ``attempts``.
        source: configuration to start from.
        out: file to write; its stem is the name of the run.

    Raises:
        PipelineError: if the file exists and is not such a configuration, or as ``attempts`` and ``focus``.
    """
    refuse_other_file(out, MARK)
    if out.resolve() == source.resolve():
        raise PipelineError("--out is the configuration to start from", where=out, remedy="choose another name")
    content = read_content(source)
    focused = focus(validate(content, source), attempts(results), episodes, limits)
    plan = content["plan"]
    axes = dict(plan.get("axes") or {})
    for axis, levels in focused.levels.items():
        axes[axis] = {**(axes.get(axis) or {}), "levels": levels}
    changed = {"axes": axes, "episodes": focused.episodes, "task_weights": focused.task_weights}
    content |= {"name": out.stem, "plan": {**plan, **changed}}
    head = [
        MARK,
        f"# {', '.join(map(str, results))}",
        f"# From {source}: a share is the share there times the rate of failures, smoothed by {PRIOR} more episodes",
        f"# with the mean rate, and at least {limits.floor:g} and at most {limits.cap:g} times the share there.",
        "#",
        *("# " + "  ".join(row).rstrip() for row in table(focused.reasons)),
    ]
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    validate(content, out)
    write_file(out, "\n".join(head) + "\n\n" + text)
    return focused


MARK = "# Written by `python -m pipeline focus`: episodes by the failures in these results."
"""First line of a written configuration."""

HEADINGS = ("for", "name", "failed", "rate (95 %)", "smoothed", "before", "after", "note")


def table(reasons: Sequence[Reason]) -> list[list[str]]:
    """Return the table of reasons, with headings and columns of equal width."""
    rows = [list(HEADINGS)]
    for reason in reasons:
        interval = reason.interval
        rate = f"{100 * reason.failures / reason.episodes:.0f} %" if reason.episodes else "-"
        bounds = "" if interval is None else f" ({100 * interval[0]:.0f} to {100 * interval[1]:.0f})"
        rows.append(
            [
                *(reason.kind, reason.name, f"{reason.failures} of {reason.episodes}", rate + bounds),
                *(f"{100 * reason.rate:.0f} %", f"{reason.before:g}", f"{reason.after:g}", reason.note),
            ]
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
