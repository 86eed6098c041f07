"""The statistics of an evaluation: success rates with their intervals, and differences by bootstrap (Efron, 1979).

What is compared is of the same trials: a test task that two policies act in, or an initial state on which the four
combinations of two axes were run. A trial's outcomes stay together, so what makes it easy or hard for all of them
cancels. Trials of one base task are alike, so it matters what is drawn anew:

* With ``SAMPLE`` base tasks or more these are a sample, and are drawn, each with all its trials. The interval says what
  other tasks of this kind would show. Trials are not drawn again within the drawn tasks: their scatter would count
  twice, and simulated intervals of five trials a task cover 97.8 to 99.5 %.
* Fewer are fixed: trials are drawn within each of them, and the interval is about these tasks alone. They tell too
  little of others: simulated, a plain bootstrap that draws four base tasks anew covers 73 to 97 % instead of 95 %.
* Where some base task has fewer than ``FEW`` trials, all trials are drawn as if of one. This is wider.

Of n units n - 1 are drawn, which makes the variance of a mean unbiased (Rao and Wu, 1988). The percentiles are not 2.5
and 97.5 but further out, by as much as Student's t is wider than the normal distribution (Hesterberg, 2015).
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, norm, t

from pipeline import seeding
from pipeline.errors import PipelineError
from pipeline.evaluation.own_draws import drawn_task
from pipeline.evaluation.results import REFUSED, EpisodeResult, Stored, one_setting, refuse_different
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.grouping import grouped
from pipeline.libero.tasks import find_task
from pipeline.types import Floats

GROUPINGS = (("suite",), ("axis",), ("axis", "component"), ("level",), ("axis", "level"), ("suite", "axis"))
"""What success rates are given by, beside the whole."""


def wilson(successes: float, trials: float) -> tuple[float, float]:
    """The 95 % interval of a success rate (Wilson, 1927); it holds for few trials and for rates near 0 and 1."""
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, float(norm.ppf(0.975))
    z2 = z**2
    middle = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(0.0, middle - half), min(1.0, middle + half)


def summary(rows: Iterable[EpisodeResult]) -> dict[str, Any]:
    """Success as a whole and by each of ``GROUPINGS``; a group's key joins its values by ``/``.

    Episodes whose scene was refused are only counted, as no policy acted in them.
    """
    every = list(rows)
    listed = [row for row in every if row.reason != REFUSED]
    found: dict[str, Any] = {"all": success_rate(listed), "refused": len(every) - len(listed)}
    for columns in GROUPINGS:
        groups = grouped(("/".join(str(getattr(row, column)) for column in columns), row) for row in listed)
        found["by_" + "_and_".join(columns)] = {name: success_rate(groups[name]) for name in sorted(groups)}
    return found


def success_rate(rows: Sequence[EpisodeResult]) -> dict[str, Any]:
    """``episodes``, ``successes``, their ``rate`` (None without episodes), and the interval's ``low`` and ``high``."""
    successes = sum(row.success for row in rows)
    low, high = wilson(successes, len(rows))
    rate = successes / len(rows) if rows else None
    return {"episodes": len(rows), "successes": successes, "rate": rate, "low": round(low, 4), "high": round(high, 4)}


SAMPLE = 10
"""So many base tasks are a sample. Simulated, intervals of ten cover 94 to 96 % (``test_bootstrap.py``)."""

FEW = 5
"""Fewer trials of a base task say too little about how they scatter."""

RESAMPLES = 10_000

Statistic = Callable[[Floats], Floats]
"""Sums of outcomes over trials (n, outcomes) to n figures; NaN where one is not defined."""


class Interval(NamedTuple):
    """The 95 % interval of a figure.

    Attributes:
        low, high: None where it is not defined: outcomes never differ, or hardly any is a success.
        p_value: two-sided, of the figure being 0: below 0.05 where 0 is outside the interval; at least 0.0002.
        resampled: what was drawn anew.
    """

    low: float | None
    high: float | None
    p_value: float | None
    resampled: str


def interval(
    base_tasks: Sequence[Any], trials: Sequence[Any], outcomes: NDArray[np.generic], statistic: Statistic
) -> Interval:
    """The interval of ``statistic``; the same whatever the order of the results.

    Args:
        base_tasks: of each result; hashable names of one kind that can be sorted.
        trials: of each result; results of one trial are drawn together.
        outcomes: (results, outcomes) numbers, which are summed.
    """
    bases = {name: place for place, name in enumerate(sorted(set(base_tasks)))}
    of_trial = dict(zip(trials, base_tasks, strict=True))
    units = {name: place for place, name in enumerate(sorted(of_trial))}
    member, strata = [units[name] for name in trials], [bases[of_trial[name]] for name in units]
    resampled = f"{len(units)} trials within {len(bases)} base tasks"
    if len(bases) >= SAMPLE:
        resampled = f"{len(bases)} base tasks"
        member, strata = [bases[name] for name in base_tasks], [0] * len(bases)
    elif len(bases) == 1 or min(np.bincount(strata)) < FEW:
        resampled, strata = f"{len(units)} trials", [0] * len(units)
    sums = np.zeros((len(strata), outcomes.shape[1]))
    np.add.at(sums, member, outcomes)
    low, high, p_value = _percentiles(sums, np.array(strata), statistic)
    return Interval(low, high, p_value, resampled)


def _percentiles(
    sums: Floats, strata: NDArray[np.int64], statistic: Statistic
) -> tuple[float, float, float] | tuple[None, None, None]:
    """Low, high and p.

    Args:
        sums: (units, outcomes) of what is drawn.
        strata: (units,) those within which they are drawn.
    """
    groups = [sums[strata == stratum] for stratum in np.unique(strata)]
    freedom = len(sums) - len(groups)
    if freedom < 1:
        return None, None, None
    draws = seeding.rng("evaluation", "bootstrap")
    # Rounded, so that what is 0 but for the order of a sum counts as 0.
    figures = np.round(statistic(np.sum([_drawn(group, draws) for group in groups], axis=0)), 12)
    if bool(np.isnan(figures).any()) or figures.min() == figures.max():
        return None, None, None
    outside = norm.cdf(t.ppf(0.025, freedom))
    low, high = np.quantile(figures, [outside, 1 - outside])
    beyond = min((figures <= 0).sum(), (figures >= 0).sum())
    p_value = 2 * t.cdf(norm.ppf((1 + beyond) / (1 + RESAMPLES)), freedom)
    return float(low), float(high), min(1.0, float(p_value))


def _drawn(group: Floats, draws: np.random.Generator) -> Floats:
    """(RESAMPLES, outcomes) sums over as many units as there are, from one unit less."""
    picked = draws.integers(len(group), size=(RESAMPLES, len(group) - 1), dtype=np.int32)
    sums = np.stack([outcome[picked].sum(axis=1) for outcome in np.ascontiguousarray(group.T)], axis=1)
    return np.asarray(sums * (len(group) / (len(group) - 1)), float)


Pair = tuple[EpisodeResult, EpisodeResult]
"""Two policies' results of one episode."""


def paired(first: Iterable[EpisodeResult], second: Iterable[EpisodeResult]) -> list[Pair]:
    """Results of the same task, initial state and draw."""
    of_trial = {row.trial: row for row in second}
    return [(row, of_trial[row.trial]) for row in first if row.trial in of_trial]


def compare(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Counts of the four outcomes, both rates, and whether they differ, as a whole and by axis.

    Returns:
        ``all`` and ``by_axis`` with ``p_value`` of McNemar's exact test, and ``difference``: the second rate minus the
        first as ``value``, and its ``Interval``.
    """
    by_axis = grouped((pair[0].axis, pair) for pair in pairs)
    return {"all": _compared(pairs), "by_axis": {axis: _compared(by_axis[axis]) for axis in sorted(by_axis)}}


def mcnemar(only_first: int, only_second: int) -> float:
    """The two-sided p-value of McNemar's exact test (McNemar, 1947).

    Of the episodes that one policy alone solves, each is either's with probability 1/2 where both are as good.
    """
    trials = only_first + only_second
    return float(binomtest(only_first, trials).pvalue) if trials else 1.0


def difference(sums: Floats) -> Floats:
    """The second rate minus the first, of (n, 3) sums of successes of the first and of the second, and of episodes."""
    return np.asarray((sums[:, 1] - sums[:, 0]) / sums[:, 2], float)


def _compared(pairs: Sequence[Pair]) -> dict[str, Any]:
    counts = Counter((one.success, other.success) for one, other in pairs)
    both, only_first, only_second = counts[True, True], counts[True, False], counts[False, True]
    outcomes = np.array([(one.success, other.success, 1) for one, other in pairs], float)
    bases, trials = [(row.suite, row.base) for row, _ in pairs], [row.trial for row, _ in pairs]
    measured = interval(bases, trials, outcomes, difference)
    return {
        "episodes": len(pairs),
        "both": both,
        "only_first": only_first,
        "only_second": only_second,
        "neither": counts[False, False],
        "first_rate": (both + only_first) / len(pairs),
        "second_rate": (both + only_second) / len(pairs),
        "p_value": mcnemar(only_first, only_second),
        "difference": {"value": (only_second - only_first) / len(pairs), **measured._asdict()},
    }


def difficulty(solved: int, models: int) -> int:
    """Level 1 to 5 of a task that ``solved`` of some models solve.

    LIBERO-Plus has four models, and 5 minus how many solve the task. For any number of models this is 5 minus four
    times the share that solves it, rounded to the nearest, halves to the harder: with up to seven models, 1 means that
    all solve the task and 5 that none does.
    """
    # ceil(4 solved / models - 1 / 2) in whole numbers.
    return 5 + (models - 8 * solved) // (2 * models)


def grade(results: Sequence[Sequence[Stored]]) -> list[dict[str, Any]]:
    """Every task that all models ran, as JSON, with its ``difficulty`` and how many models solve it.

    Held-out perturbations have the component that was asked for, which names their episodes, also where another was
    sampled.

    Raises:
        PipelineError: when results of a model have several settings, models cannot be compared, or no task was run by
            all.
    """
    for of_model in results:
        one_setting(of_model)
    refuse_different(chain(*results))
    models = [{row.trial: row.success for row, _ in of_model if row.reason != REFUSED} for of_model in results]
    shared = [trial for trial in models[0] if all(trial in model for model in models)]
    if not shared:
        raise PipelineError("no task was run by all models", remedy="evaluate all of them with the same --tasks-from")
    graded = []
    for trial in shared:
        solved = sum(model[trial] for model in models)
        graded.append({**asdict(_asked(*trial[:2])), "solved": solved, "difficulty": difficulty(solved, len(models))})
    return graded


def _asked(task: EvaluationTask, seed: int) -> EvaluationTask:
    """A result's task as it was asked for: the scene may have refused that draw and taken one of another component."""
    if task.source != "own":
        return task
    return drawn_task(find_task(task.suite, task.base), task.axis, task.level, task.number, seed) or task
