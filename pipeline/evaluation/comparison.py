"""Two policies on the same episodes: what one solves and the other does not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from pipeline.evaluation.bootstrap import interval
from pipeline.evaluation.results import Row
from pipeline.types import Floats

Pair = tuple[Row, Row]
"""Two policies' results of one episode."""


def paired(first: Iterable[Row], second: Iterable[Row]) -> list[Pair]:
    """Results of the same task, initial state and draw."""
    by_task = {_task(row): row for row in second}
    return [(row, by_task[_task(row)]) for row in first if _task(row) in by_task]


def compare(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Counts of the four outcomes, both rates, and whether they differ, as a whole and by axis.

    Returns:
        ``all`` and ``by_axis`` with ``p_value`` of McNemar's exact test, and ``difference``: the second rate minus the
        first as ``value``, and its ``Interval``.
    """
    axes = sorted({row["axis"] for row, _ in pairs})
    by_axis = {axis: _compared([pair for pair in pairs if pair[0]["axis"] == axis]) for axis in axes}
    return {"all": _compared(pairs), "by_axis": by_axis}


def mcnemar(only_first: int, only_second: int) -> float:
    """The two-sided p-value of McNemar's exact test (McNemar, 1947).

    Of the episodes that one policy alone solves, each is either's with probability 1/2 where both are as good.
    """
    trials = only_first + only_second
    return float(binomtest(only_first, trials).pvalue) if trials else 1.0


def difference(sums: Floats) -> Floats:
    """The second rate minus the first, of (n, 3) sums of successes of the first and of the second, and of episodes."""
    return np.asarray((sums[:, 1] - sums[:, 0]) / sums[:, 2], float)


def _task(row: Row) -> tuple[Any, ...]:
    # The seed is of what is drawn for the task: the perturbation (own), or random noise.
    return row["source"], row["suite"], row["name"], row["seed"]


def _compared(pairs: Sequence[Pair]) -> dict[str, Any]:
    counts = Counter((bool(one["success"]), bool(other["success"])) for one, other in pairs)
    both, neither = counts[True, True], counts[False, False]
    only_first, only_second = counts[True, False], counts[False, True]
    outcomes = np.array([(one["success"], other["success"], 1) for one, other in pairs], float)
    measured = interval(
        [(row["suite"], row["base"]) for row, _ in pairs], [_task(row) for row, _ in pairs], outcomes, difference
    )
    return {
        "episodes": len(pairs),
        "both": both,
        "only_first": only_first,
        "only_second": only_second,
        "neither": neither,
        "first_rate": (both + only_first) / len(pairs),
        "second_rate": (both + only_second) / len(pairs),
        "p_value": mcnemar(only_first, only_second),
        "difference": {"value": (only_second - only_first) / len(pairs), **measured._asdict()},
    }
