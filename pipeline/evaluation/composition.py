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

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2_contingency

from pipeline.axes import axes_of
from pipeline.errors import PipelineError
from pipeline.evaluation.results import REFUSED, EpisodeResult, Stored, one_setting, refuse_different
from pipeline.evaluation.statistics import Interval, interval
from pipeline.files import replaced
from pipeline.types import Floats

TITLE = "perturbed-demos: compositional gap"
"""Title in the metadata of a heat map, by which `analyse gap` knows its own."""


@dataclass(frozen=True)
class Pair:
    """Two axes, and the successes of their four combinations.

    Attributes:
        trials: episodes of each combination, on the same tasks, initial states and draws.
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
    def joint(self) -> float:
        """p(D_i = 1, D_j = 1 | Y = 1); NaN without successes."""
        return float(_probabilities(self._sums)[0][0])

    @property
    def product(self) -> float:
        """p(D_i = 1 | Y = 1) p(D_j = 1 | Y = 1); NaN without successes."""
        return float(_probabilities(self._sums)[1][0])

    @property
    def gap(self) -> float:
        return float(gap(self._sums)[0])

    @property
    def _sums(self) -> Floats:
        return np.array([[self.neither, self.only_one, self.only_other, self.both]], float)

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
        counts = {"neither": self.neither, "one": self.only_one, "other": self.only_other, "both": self.both}
        return {
            "trials": self.trials,
            "successes": counts,
            **_finite({"joint": self.joint, "product": self.product, "gap": self.gap}),
            "bootstrap": self.interval._asdict() if self.interval else None,
            "papers_chi_square": _finite({"statistic": statistic, "p_value": p_value}),
        }


def gap(sums: Floats) -> Floats:
    """The gap, of (n, 4) successes without a perturbation, with the one, the other and both; NaN without successes."""
    joint, product = _probabilities(sums)
    return joint - product


def _probabilities(sums: Floats) -> tuple[Floats, Floats]:
    """(n,) the joint probabilities, and the products of the marginal ones."""
    _, one, other, both = sums.T
    whole = np.where(sums.any(axis=1), sums.sum(axis=1), np.nan)
    return np.asarray(both / whole, float), np.asarray((one + both) * (other + both) / whole**2, float)


def pairs(found: Iterable[Stored]) -> list[Pair]:
    """Every pair of axes that the results have, of the trials of which all four combinations were run.

    Raises:
        PipelineError: when they are of several policies or settings, or have no complete trial.
    """
    of_pairs = [(row, files) for row, files in found if row.source in ("libero", "own") and row.reason != REFUSED]
    one_setting(of_pairs)
    refuse_different(of_pairs)
    listed = [row for row, _ in of_pairs]
    # The combinations of a trial share suite, LIBERO task and number of the initial state.
    drawn = {(row.axis, row.level, (row.suite, row.base, row.number)): row for row in listed}
    axes = _in_order(axis for joined, _, _ in drawn if joined != "clean" for axis in joined.split("+"))
    counted = [pair for one, other in combinations(axes, 2) if (pair := _pair(one, other, drawn)) is not None]
    if not counted:
        raise PipelineError(
            "no trial has all four combinations of two axes, the pair with the draws of its singles",
            remedy="python -m pipeline evaluate DIR --server URL --source pairs",
        )
    return counted


def _pair(one: str, other: str, drawn: Mapping[tuple[str, int, tuple[str, str, int]], EpisodeResult]) -> Pair | None:
    """Two axes' trials counted; None where there is none. What has one initial state, at whichever level, is drawn
    together. A pair that does not have the draws of its singles is left out."""
    starts, outcomes = [], []
    for axis, level, start in drawn:
        four = (("clean", 0, start), (one, level, start), (other, level, start), (f"{one}+{other}", level, start))
        if axis == f"{one}+{other}" and drawn.keys() >= {*four}:
            _, first, second, joined = rows = [drawn[combination] for combination in four]
            if joined.perturbations == [*first.perturbations, *second.perturbations]:
                starts.append(start)
                outcomes.append([row.success for row in rows])
    if not starts:
        return None
    measured = interval([start[:2] for start in starts], starts, np.array(outcomes), gap)
    neither, only_one, only_other, both = np.sum(outcomes, axis=0).tolist()
    return Pair(one, other, len(starts), neither, only_one, only_other, both, measured)


def _finite(numbers: Mapping[str, float]) -> dict[str, float | None]:
    return {name: number if np.isfinite(number) else None for name, number in numbers.items()}


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
    """Plot the matrix as the paper does."""
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
        figure.savefig(temporary, format="png", dpi=120, metadata={"Title": TITLE})
