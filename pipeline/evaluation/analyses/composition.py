"""The compositional gap: a test of two perturbations that cost more successes together than each of them does alone.

D_i is 1 if the first perturbation is applied, D_j if the second is applied, and Y is success. All four combinations
have equally many trials. With s(d_i, d_j) the success rate of a combination:

    p(D_i = 1, D_j = 1 | Y = 1) = s(1, 1) / sum of s
    p(D_i = 1 | Y = 1) = (s(1, 0) + s(1, 1)) / sum of s
    gap = p(D_i = 1, D_j = 1 | Y = 1) - p(D_i = 1 | Y = 1) p(D_j = 1 | Y = 1)

The gap is the covariance of D_i and D_j among successes. It is negative if both perturbations together hurt more than
independence predicts (LIBERO-Plus, section on compositional generalisation). It is negative in all of the paper's
pairs, for OpenVLA-OFT.

The paper tests the gap by Pearson's chi-square of the successes. The test assumes that successes are as uncertain as
counts of rare events. The assumption fails. If a combination succeeds in 95 % of its trials, its number of
successes has a twentieth of that variance. Also, the four combinations of a trial are correlated. At high success the
test nearly never rejects, even if there is a gap. The test is kept as the paper's figure. The interval is computed by
bootstrap over trials.
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
from pipeline.evaluation.results import (
    REJECTED,
    EpisodeResult,
    Stored,
    one_setting,
    reject_different,
    reject_repeated_tasks,
)
from pipeline.evaluation.statistics import Interval, interval
from pipeline.outputs import written
from pipeline.types import Floats


@dataclass(frozen=True)
class AxisPair:
    """Pair of axes, and the successes of their four combinations.

    Attributes:
        first: the first axis.
        second: the second axis.
        trials: number of episodes of each combination; all combinations share tasks, initial states and perturbations.
        neither: successes without a perturbation.
        only_first: successes with the first axis alone.
        only_second: successes with the second axis alone.
        both: successes with both axes.
        interval: interval of the gap, by bootstrap over trials; `None` if only the counts are known.
    """

    first: str
    second: str
    trials: int
    neither: int
    only_first: int
    only_second: int
    both: int
    interval: Interval | None = None

    @property
    def joint(self) -> float:
        """Return p(D_i = 1, D_j = 1 | Y = 1); NaN without successes."""
        return float(_probabilities(self._sums)[0][0])

    @property
    def product(self) -> float:
        """Return p(D_i = 1 | Y = 1) p(D_j = 1 | Y = 1); NaN without successes."""
        return float(_probabilities(self._sums)[1][0])

    @property
    def gap(self) -> float:
        """Return the joint probability minus the product; NaN without successes."""
        return float(gap(self._sums)[0])

    @property
    def _sums(self) -> Floats:
        """Return the (1, 4) successes as ``gap`` takes them."""
        return np.array([[self.neither, self.only_first, self.only_second, self.both]], float)

    def chi_square(self) -> tuple[float, float]:
        """Return the statistic and the p-value of the paper's test.

        The test is Pearson's chi-square of the successes by D_i and D_j, with one degree of freedom and without a
        correction for continuity. The p-value is the probability of a statistic as large or larger if D_i and D_j were
        independent. Both numbers are NaN if the test is not defined.
        """
        table = np.array([[self.neither, self.only_second], [self.only_first, self.both]])
        if not (table.any(axis=0).all() and table.any(axis=1).all()):
            return float("nan"), float("nan")
        tested = chi2_contingency(table, correction=False)
        return float(tested.statistic), float(tested.pvalue)

    def figures(self) -> dict[str, Any]:
        """Return all figures of the pair, JSON-serialisable; undefined numbers are `None`."""
        statistic, p_value = self.chi_square()
        counts = {"neither": self.neither, "one": self.only_first, "other": self.only_second, "both": self.both}
        return {
            "trials": self.trials,
            "successes": counts,
            **_finite({"joint": self.joint, "product": self.product, "gap": self.gap}),
            "bootstrap": self.interval._asdict() if self.interval else None,
            "papers_chi_square": _finite({"statistic": statistic, "p_value": p_value}),
        }


def gap(sums: Floats) -> Floats:
    """Compute the (n,) gaps from (n, 4) successes; NaN without successes.

    Args:
        sums: columns are successes without a perturbation, with the first axis, with the second axis, and with both.
    """
    joint, product = _probabilities(sums)
    return joint - product


def _probabilities(sums: Floats) -> tuple[Floats, Floats]:
    """Compute the (n,) joint probabilities, and the (n,) products of the marginal probabilities."""
    _, only_first, only_second, both = sums.T
    whole = np.where(sums.any(axis=1), sums.sum(axis=1), np.nan)
    product = (only_first + both) * (only_second + both) / whole**2
    return np.asarray(both / whole, float), np.asarray(product, float)


def pairs(results: Iterable[Stored]) -> list[AxisPair]:
    """Count the successes of every pair of axes among results, over the trials with all four combinations.

    Raises:
        PipelineError: if the results have several policies or settings, or two episodes of a task, or if no trial is
            complete.
    """
    of_pairs = [(row, files) for row, files in results if row.source in ("libero", "own") and row.reason != REJECTED]
    one_setting(of_pairs)
    reject_different(of_pairs)
    reject_repeated_tasks(of_pairs)
    rows = [row for row, _ in of_pairs]
    # The combinations of a trial share suite, LIBERO task and number of the initial state.
    combined = {(row.axis, row.level, (row.suite, row.base, row.number)): row for row in rows}
    perturbed_axes: list[str] = []
    for axis, _, _ in combined:
        if axis != "clean":
            perturbed_axes += axis.split("+")
    counted: list[AxisPair] = []
    for first_axis, second_axis in combinations(_in_order(perturbed_axes), 2):
        pair = _pair(first_axis, second_axis, combined)
        if pair is not None:
            counted.append(pair)
    if not counted:
        raise PipelineError(
            "no trial has all four combinations of two axes with equal perturbations in the pair and its single axes",
            expected="results of the source pairs",
            remedy="run `python -m pipeline evaluate DIR --server URL --source pairs`",
        )
    return counted


def _pair(
    first_axis: str, second_axis: str, combined: Mapping[tuple[str, int, tuple[str, str, int]], EpisodeResult]
) -> AxisPair | None:
    """Count the trials of two axes; return `None` if there are no trials.

    The bootstrap resamples all trials of one initial state together, across levels. A trial is left out if its pair
    does not have the perturbations of its single axes.

    Args:
        combined: axis (or joined axes), level and initial state to the result.
    """
    joined_axes = f"{first_axis}+{second_axis}"
    starts, outcomes = [], []
    for axis, level, start in combined:
        if axis != joined_axes:
            continue
        four = (
            ("clean", 0, start),
            (first_axis, level, start),
            (second_axis, level, start),
            (joined_axes, level, start),
        )
        if not combined.keys() >= {*four}:
            continue
        rows = [combined[combination] for combination in four]
        _, first, second, joined = rows
        if joined.perturbations == [*first.perturbations, *second.perturbations]:
            starts.append(start)
            outcomes.append([row.success for row in rows])
    if not starts:
        return None
    measured = interval([start[:2] for start in starts], starts, np.array(outcomes), gap)
    neither, only_first, only_second, both = np.sum(outcomes, axis=0).tolist()
    return AxisPair(first_axis, second_axis, len(starts), neither, only_first, only_second, both, measured)


def _finite(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """Replace NaN and infinity by `None`."""
    return {name: number if np.isfinite(number) else None for name, number in numbers.items()}


def _in_order(axes: Iterable[str]) -> list[str]:
    """List axes without duplicates, in the order in which their perturbations apply."""
    once = dict.fromkeys(axes)
    return list(axes_of("+".join(once))) if once else []


def matrix(measured: Sequence[AxisPair]) -> tuple[list[str], Floats]:
    """Return the N axes, and an (N, N) matrix of probabilities.

    The matrix has the product of the two marginal probabilities above the diagonal and the joint probability below it.
    Entries of pairs that were not measured are NaN.
    """
    axes: list[str] = []
    for pair in measured:
        axes += [pair.first, pair.second]
    names = _in_order(axes)
    probabilities = np.full((len(names), len(names)), np.nan)
    for pair in measured:
        row, column = names.index(pair.first), names.index(pair.second)
        probabilities[row, column], probabilities[column, row] = pair.product, pair.joint
    return names, probabilities


def heatmap(measured: Sequence[AxisPair], file: Path) -> None:
    """Plot the matrix of ``matrix`` as a heat map, in the paper's layout, and save it as a PNG file."""
    names, probabilities = matrix(measured)
    figure = Figure(figsize=(1.6 + 0.9 * len(names), 1.2 + 0.8 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    image = axes.imshow(probabilities, cmap="viridis")
    measured_any = np.isfinite(probabilities).any()
    middle = (np.nanmin(probabilities) + np.nanmax(probabilities)) / 2 if measured_any else 0.0
    for row, column in np.argwhere(np.isfinite(probabilities)):
        probability = probabilities[row, column]
        colour = "black" if probability > middle else "white"
        axes.text(column, row, f"{probability:.3f}", ha="center", va="center", color=colour)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.set_title("above: p(i | success) p(j | success)\nbelow: p(i, j | success)", fontsize=10)
    figure.colorbar(image, ax=axes)
    with written(file) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
