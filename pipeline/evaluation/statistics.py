"""Statistics of an evaluation: success rates with their intervals, and differences by bootstrap (Efron, 1979).

Comparisons use outcomes of common trials. A trial is a test task in which two policies act, or an initial state on
which the four combinations of two axes were run. The bootstrap keeps a trial's outcomes together, so the difficulty of
the trial, which affects all its outcomes, cancels. Trials of one base task are correlated, so the choice of the units
that are resampled matters:

* With ``SAMPLE`` base tasks or more, the base tasks are a sample. The bootstrap resamples base tasks, each with all its
  trials, and the interval generalises to other tasks of this kind. Trials are not resampled within the base tasks,
  because their scatter would count twice: simulated intervals of five trials per task cover 97.8 to 99.5 %.
* Fewer base tasks are fixed. The bootstrap resamples trials within each base task, and the interval is about these
  tasks alone. Few base tasks are too small a sample of other tasks: in simulations, a plain bootstrap that resamples
  four base tasks covers 73 to 97 % instead of 95 %.
* If a base task has fewer than ``FEW`` trials, the bootstrap resamples all trials as if they had one base task. The
  interval is wider.

The bootstrap samples n - 1 of n units, which makes the variance of a mean unbiased (Rao and Wu, 1988). The percentiles
are not 2.5 and 97.5. They are further out, as Student's t is wider than the normal distribution (Hesterberg, 2015).
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, norm, t

from pipeline import seeding
from pipeline.evaluation.results import REJECTED, EpisodeResult
from pipeline.grouping import grouped
from pipeline.types import Floats

GROUPINGS = (("suite",), ("axis",), ("axis", "component"), ("level",), ("axis", "level"), ("suite", "axis"))
"""Columns by which success rates are grouped, in addition to the total rate."""


def wilson(successes: float, trials: float) -> tuple[float, float]:
    """Compute the 95 % interval of a success rate (Wilson, 1927).

    The interval is valid for few trials and for rates near 0 and 1.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, float(norm.ppf(0.975))
    z2 = z**2
    middle = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(0.0, middle - half), min(1.0, middle + half)


def summary(rows: Iterable[EpisodeResult]) -> dict[str, Any]:
    """Compute the total success rate and the rates by each of ``GROUPINGS``; a group's key joins its values by ``/``.

    Episodes whose scene was rejected are only counted, because no policy acted in them.
    """
    every = list(rows)
    acted = [row for row in every if row.reason != REJECTED]
    rates: dict[str, Any] = {"all": success_rate(acted), "refused": len(every) - len(acted)}
    for columns in GROUPINGS:
        groups = grouped((_group_name(row, columns), row) for row in acted)
        rates["by_" + "_and_".join(columns)] = {name: success_rate(groups[name]) for name in sorted(groups)}
    return rates


def _group_name(row: EpisodeResult, columns: Sequence[str]) -> str:
    """Join a result's values of some columns by ``/``."""
    return "/".join(str(getattr(row, column)) for column in columns)


def success_rate(rows: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return ``episodes``, ``successes``, their ``rate`` (`None` without episodes), and the interval's bounds.

    The bounds are ``low`` and ``high``, rounded to four decimals.
    """
    successes = sum(row.success for row in rows)
    low, high = wilson(successes, len(rows))
    rate = successes / len(rows) if rows else None
    return {"episodes": len(rows), "successes": successes, "rate": rate, "low": round(low, 4), "high": round(high, 4)}


SAMPLE = 10
"""Least number of base tasks that are a sample. Simulated intervals of ten cover 94 to 96 % (``test_bootstrap.py``)."""

FEW = 5
"""Least number of trials of a base task from which their scatter can be estimated."""

RESAMPLES = 10_000

Statistic = Callable[[Floats], Floats]
"""Function from sums of outcomes over trials (n, outcomes) to (n,) figures; undefined figures are NaN."""


class Interval(NamedTuple):
    """95 % interval of a figure.

    Attributes:
        low, high: bounds; `None` if the interval is not defined, because outcomes never differ or hardly any outcome is
            a success.
        p_value: two-sided p-value of the figure being 0. It is below 0.05 if 0 is outside the interval, and at least
            0.0002. `None` if the interval is not defined.
        resampled: description of the resampled units.
    """

    low: float | None
    high: float | None
    p_value: float | None
    resampled: str


def interval(
    base_tasks: Sequence[Any], trials: Sequence[Any], outcomes: NDArray[np.generic], statistic: Statistic
) -> Interval:
    """Compute the interval of ``statistic``; it does not depend on the order of the results.

    Args:
        base_tasks: base task of each result; hashable, sortable names of one type.
        trials: trial of each result; results of one trial are resampled together.
        outcomes: (results, outcomes) numbers, which are summed.
        statistic: the figure whose interval is computed.
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
    """Compute the bounds and the p-value of an interval; three `None` if it is not defined.

    Args:
        sums: (units, outcomes) sums of the outcomes of each resampled unit.
        strata: (units,) stratum of each unit; units are resampled within their stratum.
    """
    groups = [sums[strata == stratum] for stratum in np.unique(strata)]
    freedom = len(sums) - len(groups)
    if freedom < 1:
        return None, None, None
    generator = seeding.rng("evaluation", "bootstrap")
    # Rounded, so that figures that are 0 apart from floating-point errors count as 0.
    figures = np.round(statistic(np.sum([_resampled(group, generator) for group in groups], axis=0)), 12)
    if bool(np.isnan(figures).any()) or figures.min() == figures.max():
        return None, None, None
    outside = norm.cdf(t.ppf(0.025, freedom))
    low, high = np.quantile(figures, [outside, 1 - outside])
    beyond = min((figures <= 0).sum(), (figures >= 0).sum())
    p_value = 2 * t.cdf(norm.ppf((1 + beyond) / (1 + RESAMPLES)), freedom)
    return float(low), float(high), min(1.0, float(p_value))


def _resampled(group: Floats, generator: np.random.Generator) -> Floats:
    """Resample the units of a stratum.

    Each resample has one unit less than the stratum, and its sums are scaled to the stratum's number of units.

    Returns:
        (RESAMPLES, outcomes) scaled sums.
    """
    picked = generator.integers(len(group), size=(RESAMPLES, len(group) - 1), dtype=np.int32)
    sums = np.stack([outcome[picked].sum(axis=1) for outcome in np.ascontiguousarray(group.T)], axis=1)
    return np.asarray(sums * (len(group) / (len(group) - 1)), float)


Pair = tuple[EpisodeResult, EpisodeResult]
"""Results of two policies in one trial."""


def paired(first: Iterable[EpisodeResult], second: Iterable[EpisodeResult]) -> list[Pair]:
    """Pair results with equal task, initial state and perturbation."""
    of_trial = {row.trial: row for row in second}
    return [(row, of_trial[row.trial]) for row in first if row.trial in of_trial]


def compare(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Compare two policies: counts of the four outcomes, both rates, and tests of their difference.

    Returns:
        ``all`` and ``by_axis``. Each comparison has the ``p_value`` of McNemar's exact test, and the ``difference``:
        the second rate minus the first as ``value``, and its ``Interval``.
    """
    by_axis = grouped((pair[0].axis, pair) for pair in pairs)
    return {"all": _compared(pairs), "by_axis": {axis: _compared(by_axis[axis]) for axis in sorted(by_axis)}}


def mcnemar(only_first: int, only_second: int) -> float:
    """Compute the two-sided p-value of McNemar's exact test (McNemar, 1947).

    If both policies are equally good, each episode that only one policy solves belongs to either policy with
    probability 1/2.
    """
    trials = only_first + only_second
    return float(binomtest(only_first, trials).pvalue) if trials else 1.0


def difference(sums: Floats) -> Floats:
    """Compute the second rate minus the first, (n,).

    Args:
        sums: (n, 3) sums of the first policy's successes, the second policy's successes, and the episodes.
    """
    return np.asarray((sums[:, 1] - sums[:, 0]) / sums[:, 2], float)


def _compared(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Compare two policies over some pairs of results, JSON-serialisable."""
    counts = Counter((first.success, second.success) for first, second in pairs)
    both, only_first, only_second = counts[True, True], counts[True, False], counts[False, True]
    outcomes = np.array([(first.success, second.success, 1) for first, second in pairs], float)
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
