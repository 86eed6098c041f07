"""The compositional gap: whether two perturbations together cost more successes than each of them does by itself.

D_i is 1 where the first perturbation is there, D_j where the second is, Y is success. With s(d_i, d_j) the success rate
of a combination, as many trials of each:

    p(D_i = 1, D_j = 1 | Y = 1) = s(1, 1) / sum of s
    p(D_i = 1 | Y = 1) = (s(1, 0) + s(1, 1)) / sum of s
    gap = p(D_i = 1, D_j = 1 | Y = 1) - p(D_i = 1 | Y = 1) p(D_j = 1 | Y = 1)

which is the covariance of D_i and D_j among successes: negative where both together hurt more than independence says
(LIBERO-Plus, its section on compositional generalisation; negative in all its pairs, for OpenVLA-OFT).

The paper tests it by Pearson's chi-square of the successes, as if successes were as uncertain as counts of rare events
are. They are not: of a combination that succeeds in 95 % of its trials, their number has a twentieth of that variance,
and the four combinations of a trial go together. So at high success it nearly never rejects, also where there is a gap.
It is kept as the paper's figure; the interval is by bootstrap over trials.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import chi2_contingency

from pipeline.axes import axes_of
from pipeline.errors import PipelineError
from pipeline.evaluation.results import REFUSED, Row
from pipeline.evaluation.statistics import Interval, interval
from pipeline.files import replaced
from pipeline.types import Floats


@dataclass(frozen=True)
class Pair:
    """Two axes, and the successes of their four combinations.

    Attributes:
        one, other: the axes.
        trials: episodes of each combination, on the same tasks, initial states and draws.
        neither, only_one, only_other, both: successes.
        interval: of the gap, by bootstrap over trials; None where only the counts are known.
    """

    one: str
    other: str
    trials: int
    neither: int
    only_one: int
    only_other: int
    both: int
    interval: Interval | None = None

    @property
    def successes(self) -> int:
        return self.neither + self.only_one + self.only_other + self.both

    @property
    def joint(self) -> float:
        """p(D_i = 1, D_j = 1 | Y = 1); NaN without successes."""
        return self.both / self.successes if self.successes else float("nan")

    @property
    def product(self) -> float:
        """p(D_i = 1 | Y = 1) p(D_j = 1 | Y = 1); NaN without successes."""
        if not self.successes:
            return float("nan")
        return (self.only_one + self.both) * (self.only_other + self.both) / self.successes**2

    @property
    def gap(self) -> float:
        return self.joint - self.product

    def chi_square(self) -> tuple[float, float]:
        """The paper's test: Pearson's statistic of the successes by D_i and D_j, with one degree of freedom and without
        a correction for continuity, and the probability of one as large if these were independent; NaN where it is not
        defined."""
        table = np.array([[self.neither, self.only_other], [self.only_one, self.both]])
        if not (table.any(axis=0).all() and table.any(axis=1).all()):
            return float("nan"), float("nan")
        tested = chi2_contingency(table, correction=False)
        return float(tested.statistic), float(tested.pvalue)

    def figures(self) -> dict[str, Any]:
        """All of it, JSON-serialisable: None where a number is not defined."""
        statistic, p_value = self.chi_square()
        numbers = {"joint": self.joint, "product": self.product, "gap": self.gap}
        paper = {"statistic": statistic, "p_value": p_value}
        counts = {"neither": self.neither, "one": self.only_one, "other": self.only_other, "both": self.both}
        return {
            "trials": self.trials,
            "successes": counts,
            **_finite(numbers),
            "bootstrap": self.interval._asdict() if self.interval else None,
            "papers_chi_square": _finite(paper),
        }


def gap(sums: Floats) -> Floats:
    """The gap, of (n, 4) successes without a perturbation, with the one, the other and both; NaN without successes."""
    _, one, other, both = sums.T
    whole = np.where(sums.any(axis=1), sums.sum(axis=1), np.nan)
    return np.asarray(both / whole - (one + both) * (other + both) / whole**2, float)


def pairs(rows: Iterable[Row]) -> list[Pair]:
    """Every pair of axes that the results have, of the trials of which all four combinations were run.

    Raises:
        PipelineError: when they are of several policies or settings, or have no complete trial.
    """
    listed = [row for row in rows if row["source"] in ("libero", "own") and row["reason"] != REFUSED]
    if len({json.dumps([row["identity"], row["settings"]], sort_keys=True) for row in listed}) > 1:
        raise PipelineError(
            "these are results of several policies or settings",
            expected="one policy under one setting",
            remedy="give each a folder of its own",
        )
    clean = {_start(row): bool(row["success"]) for row in listed if row["axis"] == "clean"}
    drawn = {(row["axis"], row["level"], _start(row)): bool(row["success"]) for row in listed if row["axis"] != "clean"}
    axes = _in_order(axis for joined, _, _ in drawn for axis in joined.split("+"))
    counted = []
    for one, other in combinations(axes, 2):
        both = f"{one}+{other}"
        trials = [
            (start, (clean[start], drawn[one, level, start], drawn[other, level, start], drawn[both, level, start]))
            for axis, level, start in drawn
            if axis == both and start in clean and {(one, level, start), (other, level, start)} <= drawn.keys()
        ]
        if trials:
            counted.append(_pair(one, other, [start for start, _ in trials], np.array([four for _, four in trials])))
    if not counted:
        raise PipelineError(
            "no trial has all four combinations of two axes",
            remedy="python -m pipeline evaluate DIR --source pairs",
        )
    return counted


def _pair(one: str, other: str, starts: Sequence[tuple[str, str, int]], outcomes: NDArray[np.bool_]) -> Pair:
    """Two axes' trials (n, 4) counted. What has one initial state, at whichever level, is drawn together."""
    measured = interval([start[:2] for start in starts], starts, outcomes, gap)
    neither, only_one, only_other, both = outcomes.sum(axis=0).tolist()
    return Pair(one, other, len(starts), neither, only_one, only_other, both, measured)


def _finite(numbers: Mapping[str, float]) -> dict[str, float | None]:
    return {name: number if np.isfinite(number) else None for name, number in numbers.items()}


def _start(row: Row) -> tuple[str, str, int]:
    """What the combinations of a trial share."""
    return row["suite"], row["base"], row["number"]


def _in_order(axes: Iterable[str]) -> list[str]:
    """None twice, in the order in which they apply."""
    once = dict.fromkeys(axes)
    return list(axes_of("+".join(once))) if once else []


def matrix(measured: Sequence[Pair]) -> tuple[list[str], Floats]:
    """The axes (N), and (N, N) the products of the two marginal probabilities above the diagonal, the joint
    probabilities below it, NaN where a pair was not measured."""
    names = _in_order(axis for pair in measured for axis in (pair.one, pair.other))
    shown = np.full((len(names), len(names)), np.nan)
    for pair in measured:
        row, column = names.index(pair.one), names.index(pair.other)
        shown[row, column], shown[column, row] = pair.product, pair.joint
    return names, shown


def heatmap(measured: Sequence[Pair], file: Path) -> None:
    """Draw the matrix as the paper does."""
    names, shown = matrix(measured)
    figure = Figure(figsize=(1.6 + 0.9 * len(names), 1.2 + 0.8 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    image = axes.imshow(shown, cmap="viridis")
    middle = (np.nanmin(shown) + np.nanmax(shown)) / 2 if np.isfinite(shown).any() else 0.0
    for row, column in np.argwhere(np.isfinite(shown)):
        colour = "black" if shown[row, column] > middle else "white"
        axes.text(column, row, f"{shown[row, column]:.3f}", ha="center", va="center", color=colour)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.set_title("above: p(i | success) p(j | success)\nbelow: p(i, j | success)", fontsize=10)
    figure.colorbar(image, ax=axes)
    with replaced(file) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
