"""Focus of a plan on failures: a configuration whose episodes follow the failures of policies on axes, levels, tasks.

With few episodes, a smoothed rate of failures stays close to the mean rate. A new share is the share before times the
rate of failures, from a floor to a cap.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from math import isclose, isnan
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import brentq

from pipeline.axes import Axis, axes_of, level_of_test
from pipeline.config import NAME, Config, read_content, validate
from pipeline.errors import PipelineError
from pipeline.evaluation.analyses.other_programs import separate
from pipeline.evaluation.analyses.tested import Outcome
from pipeline.evaluation.goals import find_carried_task
from pipeline.evaluation.results import EpisodeResult, read
from pipeline.evaluation.statistics import wilson
from pipeline.files import write as write_file
from pipeline.grouping import grouped
from pipeline.libero.tasks import select_tasks
from pipeline.planning.apportion import apportion
from pipeline.strict_yaml import dump
from pipeline.testset import benchmark
from pipeline.types import Floats

PRIOR = 5
"""Number of imagined episodes with the mean rate that are added to the episodes of a group."""

LEVEL_ENTRIES = 20
"""Number of entries of ``levels`` that state the shares of the levels."""

LEAST_WEIGHT = 0.01

NO_RESULTS = "no results"

Kind = Literal["axis", "episodes", "level", "task"]


class Attempt(NamedTuple):
    """One episode of an evaluated policy.

    Attributes:
        policy: name of the policy.
        axes: perturbed axes; empty for LIBERO's own tasks.
        level: strength, 1 to 5; 0 if it is unknown, and for several axes.
        task: suite/name of the LIBERO task that the policy was asked for; empty if no plan can train its goal.
        failed: True if the goal was not reached.
    """

    policy: str
    axes: tuple[str, ...]
    level: int
    task: str
    failed: bool

    @property
    def entry(self) -> str:
        """Return the perturbed axes as an entry of ``plan.episodes``; empty for LIBERO's own tasks."""
        return "+".join(axes_of("+".join(self.axes))) if self.axes else ""


class Reason(NamedTuple):
    """Reason of one new share.

    Attributes:
        kind: ``axis`` for a rate without a share of its own, ``episodes`` for an entry of ``plan.episodes``, ``level``
            for a level of an axis, ``task`` for a task.
        name: name of the axis or entry; axis and level; or name of the task.
        failures, episodes: results of its episodes.
        rate: smoothed rate of failures; of a task, smoothed failures divided by the expected ones.
        before, after: shares, 0 to 1; `None` for an axis.
        written: number, entries of ``levels`` or weight in the new configuration; `None` for an axis.
        note: ``floor``, ``cap`` or ``at least 1`` if it limits the share, ``no results`` if there are none.
    """

    kind: Kind
    name: str
    failures: int
    episodes: int
    rate: float
    before: float | None = None
    after: float | None = None
    written: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Limits:
    """Limits of a new share, as multiples of the share before.

    Attributes:
        floor: smallest multiple, 0 to 1.
        cap: largest multiple, at least 1.
    """

    floor: float = 0.5
    cap: float = 2.0

    def __post_init__(self) -> None:
        for name, value in (("floor", self.floor), ("cap", self.cap)):
            if isnan(value):
                raise PipelineError("the limit is not a number", where=f"--{name}", expected="a number such as 0.5")


@dataclass(frozen=True)
class Focused:
    """New values of a plan, with their reasons.

    Attributes:
        episodes: entry of ``plan.episodes`` to its number.
        levels: axis to its ``levels``, of axes whose shares of levels follow from them.
        task_weights: task to its weight; the mean is about 1.
        policies: policy to the number of its episodes that count.
        left_out: number of episodes that do not count, because they are about other tasks, axes or levels.
    """

    episodes: dict[str, int]
    levels: dict[str, list[int]]
    task_weights: dict[str, float]
    reasons: list[Reason]
    policies: dict[str, int]
    left_out: int


def attempts(paths: Sequence[Path]) -> list[Attempt]:
    """Read the episodes of all policies from results of ``evaluate``, vla-eval and lerobot-eval.

    Raises:
        PipelineError: if a path has no results, if a file is damaged, or if policies had black views or no instruction.
    """
    folders, policies = separate(paths)
    listed: list[Attempt] = []
    for evaluated in read(folders, ("prompt", "step_limit")) if folders else ():
        settings = evaluated.settings
        if settings.get("black", "none") != "none" or settings.get("prompt") == "blank":
            raise _without_observation(evaluated.name, folders)
        listed += [_attempt(evaluated.name, row) for row in evaluated.rows]
    for policy in policies:
        if policy.black != "none" or "blank" in (policy.prompt or ""):
            raise _without_observation(policy.name, paths)
        listed += [_attempt_on_test(policy.name, outcome) for outcome in policy.outcomes]
    return listed


def _without_observation(name: str, paths: Sequence[Path]) -> PipelineError:
    """Return the error about a policy that had black views or no instruction."""
    return PipelineError(
        f"{name} had black views or no instruction, so its failures do not show lacking episodes",
        where=", ".join(map(str, paths)),
        expected="results of policies with their views and instructions",
        remedy="leave out the folder",
    )


def _attempt(policy: str, row: EpisodeResult) -> Attempt:
    """Return the attempt of a result."""
    if row.source == "libero_plus":
        return _attempt_on_test(policy, row)
    task = f"{row.suite}/{row.base}"
    if row.source == "goals":
        task = str(find_carried_task(row) or "")
    axes = () if row.axis == "clean" else tuple(row.axis.split("+"))
    return Attempt(policy, axes, row.level if len(axes) == 1 else 0, task, not row.success)


def _attempt_on_test(policy: str, outcome: EpisodeResult | Outcome) -> Attempt:
    """Return the attempt at a test task, with axis and level from the benchmark.

    A result of an earlier version may have another level.
    """
    test = benchmark.load().find(outcome.suite, outcome.name)
    return Attempt(policy, (test.axis,), level_of_test(test), f"{test.suite}/{test.base}", not outcome.success)


def focus(config: Config, results: Sequence[Attempt], episodes: int | None, limits: Limits = Limits()) -> Focused:
    """Distribute a plan's episodes by failure rates.

    Args:
        config: the configuration whose plan is changed.
        results: episodes of evaluated policies. Episodes on other tasks, axes or levels than the plan's do not count.
        episodes: total number of kept perturbed episodes; ``None`` for that of the configuration.
        limits: floor and cap.

    Raises:
        PipelineError: if no result belongs to an axis of the plan, or if ``episodes`` is too small.
    """
    plan = config.plan
    total = sum(plan.episodes.values()) if episodes is None else episodes
    if total < len(plan.episodes):
        raise PipelineError(
            f"{total} episodes for {len(plan.episodes)} entries of plan.episodes",
            where="--episodes",
            expected="at least one for each entry",
            remedy=f"set --episodes to {len(plan.episodes)} or more, or remove entries",
        )
    axes, tasks = plan.axes.configured(), select_tasks(config.demos.tasks)
    weights = {str(task): plan.task_weights.get(str(task), 1.0) for task in tasks}
    of_plan = [attempt for attempt in results if attempt.task in weights and _is_of_axes(attempt, axes)]
    by_axes = grouped((attempt.entry, attempt) for attempt in of_plan)
    if not by_axes.keys() - {""}:
        about = ", ".join(sorted({axis for attempt in results for axis in attempt.axes})) or "no axis"
        raise PipelineError(
            f"no result is about an axis and a task of the plan; the axes of the results: {about}",
            expected=f"results on {', '.join(axes)}, on tasks that demos.tasks selects",
            remedy="evaluate the policy on --source libero_plus, own or goals",
        )
    rates = _rates(by_axes, [*axes, *plan.episodes])
    reasons: list[Reason] = []
    for axis in axes:
        of_axis = by_axes.get(axis, ())
        note = "" if of_axis else NO_RESULTS
        reasons.append(Reason("axis", axis, _failures(of_axis), len(of_axis), rates[axis], note=note))
    numbers, of_entries = _by_entry(plan.episodes, by_axes, rates, total, limits)
    levels: dict[str, list[int]] = {}
    of_levels: list[Reason] = []
    for axis, settings in axes.items():
        with_level = [attempt for attempt in by_axes.get(axis, ()) if attempt.level]
        if with_level and all(settings.levels_set_shares(task) for task in tasks):
            levels[axis], level_reasons = _by_level(axis, settings.levels, with_level, rates[axis], limits)
            of_levels += level_reasons
    new_weights, of_tasks = _by_task(weights, by_axes, limits)
    return Focused(
        numbers,
        levels,
        new_weights,
        [*reasons, *of_entries, *of_levels, *of_tasks],
        dict(Counter(attempt.policy for attempt in of_plan)),
        len(results) - len(of_plan),
    )


def _is_of_axes(attempt: Attempt, axes: Mapping[str, Axis]) -> bool:
    """Return whether the axes of an attempt, and its level if it is known, are among those of a plan."""
    if not axes.keys() >= {*attempt.axes}:
        return False
    return attempt.level == 0 or any(attempt.level in axes[axis].levels for axis in attempt.axes)


def smoothed(results: Sequence[Attempt], mean: float) -> float:
    """Return the rate of failures with ``PRIOR`` further episodes at the mean rate."""
    return (_failures(results) + PRIOR * mean) / (len(results) + PRIOR)


def _failures(results: Iterable[Attempt]) -> int:
    return sum(attempt.failed for attempt in results)


def _rates(by_axes: Mapping[str, Sequence[Attempt]], names: Iterable[str]) -> dict[str, float]:
    """Return the rate of each axis and combination.

    The mean rate counts a success and a failure more, so that it is neither 0 nor 1. A combination is smoothed towards
    the mean rate of its axes.
    """
    perturbed = list(chain.from_iterable(results for name, results in by_axes.items() if name))
    mean = (_failures(perturbed) + 1) / (len(perturbed) + 2)
    rates: dict[str, float] = {}
    for name in sorted({*names, *by_axes} - {""}, key=lambda name: name.count("+")):
        parts = axes_of(name)
        expected = mean if len(parts) == 1 else fmean(rates[axis] for axis in parts)
        rates[name] = smoothed(by_axes.get(name, ()), expected)
    return rates


def _by_entry(
    before: Mapping[str, int],
    by_axes: Mapping[str, Sequence[Attempt]],
    rates: Mapping[str, float],
    total: int,
    limits: Limits,
) -> tuple[dict[str, int], list[Reason]]:
    """Distribute ``total`` episodes over the entries of ``plan.episodes``."""
    shares = _shares(before, rates, limits)
    numbers = dict(zip(before, apportion(total, [*shares.values()], least=1), strict=True))
    return numbers, _reasons("episodes", by_axes, rates, before, shares, numbers, limits)


def _by_level(
    axis: str, before: Sequence[int], results: Sequence[Attempt], of_axis: float, limits: Limits
) -> tuple[list[int], list[Reason]]:
    """Distribute the entries of an axis's ``levels`` by the rate of each level; each level keeps an entry."""
    names = {f"{axis} {level}": level for level in sorted({*before})}
    entries_before = {name: before.count(level) for name, level in names.items()}
    by_level = grouped((f"{axis} {attempt.level}", attempt) for attempt in results)
    rates = {name: smoothed(by_level.get(name, ()), of_axis) for name in names}
    shares = _shares(entries_before, rates, limits)
    entries = apportion(max(LEVEL_ENTRIES, len(before)), [*shares.values()], least=1)
    numbers = dict(zip(names, entries, strict=True))
    levels: list[int] = []
    for name, level in names.items():
        levels += [level] * numbers[name]
    return levels, _reasons("level", by_level, rates, entries_before, shares, numbers, limits)


def _by_task(
    before: Mapping[str, float], by_axes: Mapping[str, Sequence[Attempt]], limits: Limits
) -> tuple[dict[str, float], list[Reason]]:
    """Distribute weights with the mean 1 over tasks, by their failures divided by the expected ones.

    The expected failures are those with the rates of the axes over all tasks. A task that was evaluated more on
    difficult axes therefore gets no larger weight for it. Both numbers are smoothed by ``PRIOR`` failures.
    """
    by_task = grouped((attempt.task, attempt) for attempt in chain.from_iterable(by_axes.values()))
    rates = {name: _failures(results) / len(results) for name, results in by_axes.items()}
    ratios: dict[str, float] = {}
    for task in before:
        of_task = by_task.get(task, [])
        expected = sum(rates[attempt.entry] for attempt in of_task)
        ratios[task] = (_failures(of_task) + PRIOR) / (expected + PRIOR)
    shares = _shares(before, ratios, limits)
    weights = {task: max(LEAST_WEIGHT, round(len(before) * share, 2)) for task, share in shares.items()}
    return weights, _reasons("task", by_task, ratios, before, shares, weights, limits)


def _shares(before: Mapping[str, float], rates: Mapping[str, float], limits: Limits) -> dict[str, float]:
    """Return shares with the sum 1: c times share before times rate, from floor to cap times the share before."""
    old: Floats = np.array([*before.values()], float)
    old /= old.sum()
    if limits.floor == 1 or limits.cap == 1:
        return dict(zip(before, old.tolist(), strict=True))
    weighted = old * [rates[name] for name in before]

    def shares_at(factor: float) -> Floats:
        return np.asarray(np.clip(factor * weighted, limits.floor * old, limits.cap * old))

    # At the largest factor each share is at its cap.
    largest = limits.cap * float((old / weighted).max())
    factor = brentq(lambda factor: float(shares_at(factor).sum()) - 1.0, 0.0, largest)
    shares = shares_at(factor)
    return dict(zip(before, (shares / shares.sum()).tolist(), strict=True))


def _reasons(
    kind: Kind,
    results: Mapping[str, Sequence[Attempt]],
    rates: Mapping[str, float],
    before: Mapping[str, float],
    shares: Mapping[str, float],
    written: Mapping[str, float],
    limits: Limits,
) -> list[Reason]:
    """Return the reason of each share."""
    reasons: list[Reason] = []
    for name, share in shares.items():
        share_before, of_name = before[name] / sum(before.values()), results.get(name, ())
        notes = [] if of_name else [NO_RESULTS]
        if kind != "task" and share * sum(written.values()) < 1:
            notes.append("at least 1")
        elif isclose(share, limits.cap * share_before):
            notes.append("cap")
        elif isclose(share, limits.floor * share_before):
            notes.append("floor")
        counts = _failures(of_name), len(of_name)
        note = ", ".join(notes)
        reasons.append(Reason(kind, name, *counts, rates[name], share_before, share, written[name], note))
    return reasons


def write(
    results: Sequence[Path], source: Path, out: Path, episodes: int | None = None, limits: Limits = Limits()
) -> Focused:
    """Write a new configuration, with the reasons of its shares as a comment.

    Args:
        results: results of policies, as ``attempts``.
        source: configuration to start from.
        out: new file; its stem is the name of the run.

    Raises:
        PipelineError: if the file exists, or has no name for a run; also as ``attempts`` and ``focus``.
    """
    content = read_content(source)
    config = validate(content, source)
    if out.exists() or out.is_symlink():
        raise PipelineError("the file exists, and may have been edited", where=out, remedy="choose another name")
    if not re.fullmatch(NAME, out.stem) or out.stem == config.name:
        raise PipelineError(
            f"the run would have the name {out.stem!r}",
            where=f"--out {out}",
            expected=f"another name than {config.name}, of small letters, digits and underscores, as <name>.yaml",
            remedy="choose another file name",
        )
    focused = focus(config, attempts(results), episodes, limits)
    changed = _changed(content, focused, out.stem)
    validate(changed, out)
    write_file(out, _comment(focused, results, source, limits) + "\n" + dump(changed))
    return focused


def _changed(content: Mapping[str, Any], focused: Focused, name: str) -> dict[str, Any]:
    """Return the content of a configuration with the new plan, and without names of the datasets of its old run."""
    plan = dict(content["plan"])
    axes = dict(plan.get("axes") or {})
    for axis, levels in focused.levels.items():
        axes[axis] = {**(axes.get(axis) or {}), "levels": levels}
    weights = {task: weight for task, weight in focused.task_weights.items() if weight != 1}
    plan |= {"axes": axes, "episodes": focused.episodes, "task_weights": weights}
    changed = {**content, "name": name, "plan": plan}
    if content.get("export"):
        changed["export"] = {key: _unnamed(options) for key, options in content["export"].items()}
    return changed


def _unnamed(options: Any) -> Any:
    """Return the options of a format without the name of its dataset; other values as they are."""
    if not isinstance(options, dict):
        return options
    return {field: value for field, value in options.items() if field != "name"}


def _comment(focused: Focused, results: Sequence[Path], source: Path, limits: Limits) -> str:
    """Return the head of a new configuration: results, formula and reasons."""
    counted = ", ".join(f"{policy} ({number})" for policy, number in focused.policies.items())
    lines = [
        f"Written by `python -m pipeline focus` from {str(source)!a}, by failures of policies in",
        *(f"  {str(path)!a}" for path in results),
        f"Counted episodes: {ascii(counted)[1:-1]}; left out, of other tasks, axes or levels: {focused.left_out}.",
        "",
        f"after = c * before * smoothed rate, from {limits.floor:g} to {limits.cap:g} times before; c makes the sum 1.",
        f"The smoothed rate counts {PRIOR} more episodes with the mean rate; those of tasks are relative to axes.",
        "",
        *("  ".join(row) for row in table(focused.reasons)),
    ]
    return "".join(f"# {line}".rstrip() + "\n" for line in lines)


HEADINGS = ("for", "failed", "rate (95 %)", "smoothed", "before", "after", "written", "note", "name")


def table(reasons: Sequence[Reason]) -> list[list[str]]:
    """Return the table of reasons, with headings and columns of equal width."""
    rows = [list(HEADINGS)]
    for reason in reasons:
        low, high = wilson(reason.failures, reason.episodes)
        interval = f"({_percent(low)} to {_percent(high)})"
        rate = f"{_percent(reason.failures / reason.episodes)} {interval}" if reason.episodes else "-"
        smooth = f"x {reason.rate:.2f}" if reason.kind == "task" else _percent(reason.rate)
        shares = ["-" if share is None else _percent(share) for share in (reason.before, reason.after)]
        written = "-" if reason.written is None else f"{reason.written:g}"
        counts = f"{reason.failures} of {reason.episodes}"
        rows.append([reason.kind, counts, rate, smooth, *shares, written, reason.note, reason.name])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
