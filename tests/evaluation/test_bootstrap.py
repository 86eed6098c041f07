"""Intervals of paired trials hold what they promise: simulated where the truth is known, and next to SciPy's own."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
import scipy.stats
from episode_results import result
from numpy.typing import NDArray

from pipeline.evaluation import statistics
from pipeline.evaluation.analyses import composition
from pipeline.evaluation.analyses.composition import AxisPair, gap
from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.statistics import Interval, compare, difference, interval, mcnemar
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.seeding import rng

SIMULATIONS = 300
EXPECTED = range(4, 29)
"""Of 300 intervals that miss in 5 % of the cases, so many do with a probability of 0.999."""


class Simulated(NamedTuple):
    """Trials of several base tasks: which base task each is of, and its outcomes."""

    base_tasks: NDArray[np.int64]
    outcomes: NDArray[np.float64]

    def interval(self, statistic: statistics.Statistic) -> Interval:
        bases = self.base_tasks.tolist()
        return interval(bases, list(enumerate(bases)), self.outcomes, statistic)


def simulated(generator: np.random.Generator, rates: NDArray[np.float64], trials: Sequence[int]) -> Simulated:
    """Trials in which the same luck decides 60 % of the outcomes, so that they are paired.

    Args:
        rates: (base tasks, outcomes) probabilities of success.
        trials: of each base task.
    """
    of = np.repeat(np.arange(len(rates)), trials)
    luck, own = generator.random((len(of), 1)), generator.random((len(of), rates.shape[1]))
    outcomes = (np.where(generator.random(own.shape) < 0.6, luck, own) < rates[of]).astype(float)
    return Simulated(of, outcomes)


def missed(intervals: Sequence[Interval], truth: float) -> int:
    return sum(one.low is None or one.high is None or not one.low <= truth <= one.high for one in intervals)


def rejected(intervals: Sequence[Interval]) -> int:
    return sum(one.p_value is not None and one.p_value < 0.05 for one in intervals)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 1_000)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("effect", [0.0, 0.2])
def test_of_a_few_fixed_base_tasks_the_interval_covers_their_own_difference(effect: float) -> None:
    generator = rng("test", "fixed", int(100 * effect))
    first = np.array([0.6, 0.3, 0.6, 0.5])
    rates = np.stack([first, first + effect + np.array([0, 0.2, -0.2, 0])], axis=1)
    found = [
        simulated(generator, rates, (12, 12, 12, 12)).interval(lambda sums: (sums[:, 1] - sums[:, 0]) / 48)
        for _ in range(SIMULATIONS)
    ]
    assert found[0].resampled == "48 trials within 4 base tasks"
    assert missed(found, effect) in EXPECTED
    assert rejected(found) in EXPECTED if effect == 0 else rejected(found) > 100


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("base_tasks", "mean"), [(10, 0.0), (40, 0.1)])
def test_of_a_sample_of_base_tasks_the_interval_covers_what_others_would_show(base_tasks: int, mean: float) -> None:
    generator = rng("test", "sample", base_tasks, int(100 * mean))
    found = []
    for _ in range(SIMULATIONS):
        first = generator.choice([0.5, 0.7], base_tasks)
        second = first + mean + generator.choice([-0.15, 0.0, 0.15], base_tasks)
        trials = simulated(generator, np.stack([first, second], axis=1), generator.integers(3, 9, base_tasks).tolist())
        outcomes = np.column_stack([trials.outcomes, np.ones(len(trials.outcomes))])
        found.append(trials._replace(outcomes=outcomes).interval(difference))
    assert found[0].resampled == f"{base_tasks} base tasks"
    assert missed(found, mean) in EXPECTED
    assert rejected(found) in EXPECTED if mean == 0 else rejected(found) > 150


def gaps(joint_loss: float, base_tasks: int, trials: int, simulations: int) -> tuple[list[AxisPair], float]:
    """Simulated pairs of axes, and the gap that they would have of endless trials.

    Base tasks differ by 4 points in all four rates. Each axis by itself takes 95 % of successes to 90 %; both together
    take ``joint_loss`` more than their product says.
    """
    generator = rng("test", "gap", base_tasks, trials, int(100 * joint_loss))
    rates = np.array([0.95, 0.9, 0.9, 0.9 * 0.9 / 0.95 - joint_loss])
    pairs = []
    for _ in range(simulations):
        harder = generator.choice([-0.04, 0.04], (base_tasks, 1)) if base_tasks >= statistics.SAMPLE else 0
        found = simulated(generator, rates + harder + np.zeros((base_tasks, 4)), [trials] * base_tasks)
        neither, one, other, both = found.outcomes.sum(axis=0).astype(int).tolist()
        interval_of_gap = found.interval(gap)
        pairs.append(AxisPair("robot", "camera", base_tasks * trials, neither, one, other, both, interval_of_gap))
    return pairs, float(gap(rates[None])[0])


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("base_tasks", "trials"), [(4, 25), (40, 5)])
def test_a_gap_of_zero_is_rejected_in_one_case_of_twenty(base_tasks: int, trials: int) -> None:
    pairs, truth = gaps(0.0, base_tasks, trials, SIMULATIONS)
    assert truth == pytest.approx(0, abs=1e-12)
    intervals = [pair.interval for pair in pairs if pair.interval]
    assert missed(intervals, 0) in EXPECTED
    assert rejected(intervals) in EXPECTED
    assert sum(pair.chi_square()[1] < 0.05 for pair in pairs) == 0, "the paper's test never rejects"


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_an_interaction_of_seven_points_is_found_in_the_papers_number_of_trials() -> None:
    pairs, truth = gaps(0.07, 40, 50, 60)
    intervals = [pair.interval for pair in pairs if pair.interval]
    assert rejected(intervals) >= 59
    assert all(one.high is not None and one.high < 0 for one in intervals)
    assert missed(intervals, truth) <= 10
    assert sum(pair.chi_square()[1] < 0.05 for pair in pairs) < 30


def test_scipys_bootstrap_gives_the_same_interval_of_independent_trials() -> None:
    trials = simulated(rng("test", "scipy"), np.array([[0.6, 0.7]]), [400])
    ours = trials.interval(lambda sums: (sums[:, 1] - sums[:, 0]) / 400)
    gains = trials.outcomes[:, 1] - trials.outcomes[:, 0]
    theirs = scipy.stats.bootstrap((gains,), np.mean, n_resamples=10_000, method="percentile", rng=rng("test", "draws"))
    # Both are of 10,000 resamples: ends scatter by less than a hundredth of the width, and move by trials of 1 / 400.
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.004)


def test_scipys_bootstrap_gives_the_same_interval_of_whole_base_tasks() -> None:
    generator = rng("test", "scipy", "base tasks")
    trials = simulated(generator, generator.uniform(0.3, 0.9, (60, 2)), generator.integers(3, 9, 60).tolist())
    outcomes = np.column_stack([trials.outcomes, np.ones(len(trials.outcomes))])
    ours = trials._replace(outcomes=outcomes).interval(difference)
    first, second, episodes = (np.bincount(trials.base_tasks, column) for column in outcomes.T)

    def ratio(one: NDArray[np.float64], other: NDArray[np.float64], of: NDArray[np.float64], axis: int) -> object:
        return (other.sum(axis) - one.sum(axis)) / of.sum(axis)

    theirs = scipy.stats.bootstrap(
        (first, second, episodes), ratio, n_resamples=10_000, method="percentile", paired=True, rng=rng("test", "draws")
    )
    # Student's t and 59 of 60 make ours 3 % wider.
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.012)
    assert ours.high is not None
    assert ours.low is not None
    assert ours.high - ours.low > np.diff(theirs.confidence_interval)[0]


def row(name: str, success: bool, base: str = "base") -> EpisodeResult:
    return result(EvaluationTask("own", "libero_goal", base, name, "light", "colour", 1, 0), success)


def pairs_of(both: int, first: int, second: int, neither: int) -> list[tuple[EpisodeResult, EpisodeResult]]:
    outcomes = [(True, True)] * both + [(True, False)] * first + [(False, True)] * second + [(False, False)] * neither
    return [(row(str(at), one), row(str(at), other)) for at, (one, other) in enumerate(outcomes)]


@pytest.mark.parametrize(("first", "second"), [(60, 40), (30, 30), (45, 20), (20, 30)])
def test_p_is_close_to_mcnemars_where_many_episodes_tell_two_policies_apart(first: int, second: int) -> None:
    found = compare(pairs_of(200, first, second, 100))["all"]
    episodes = 300 + first + second
    assert (found["first_rate"], found["second_rate"]) == ((200 + first) / episodes, (200 + second) / episodes)
    assert found["difference"]["value"] == pytest.approx((second - first) / episodes)
    assert found["difference"]["low"] < found["difference"]["value"] < found["difference"]["high"]
    # The exact test counts all of the probability of what was seen, a bootstrap about half of it.
    assert -0.06 < found["difference"]["p_value"] - mcnemar(first, second) < 0.01


def test_outcomes_that_never_differ_have_no_interval() -> None:
    undefined = {"low": None, "high": None, "p_value": None}
    assert compare(pairs_of(10, 0, 0, 0))["all"]["difference"] == {"value": 0, **undefined, "resampled": "10 trials"}
    assert compare(pairs_of(0, 10, 0, 0))["all"]["difference"]["low"] is None
    assert compare(pairs_of(0, 1, 0, 0))["all"]["difference"]["low"] is None
    assert AxisPair("robot", "camera", 10, 0, 0, 0, 0).figures()["bootstrap"] is None
    assert composition.gap(np.zeros((1, 4)))[0] != 0


def test_neither_the_order_of_results_nor_results_that_come_twice_narrow_the_interval() -> None:
    pairs = pairs_of(20, 8, 2, 10)
    found = compare(pairs)["all"]["difference"]
    assert compare(pairs[::-1])["all"]["difference"] == found
    # Three policies of one arm on the same test tasks are no more test tasks.
    assert compare([pair for pair in pairs for _ in range(3)])["all"]["difference"] == found


def test_base_tasks_of_few_trials_are_resampled_as_one() -> None:
    alone = [(row(str(at), at % 3 == 0, f"base{at}"), row(str(at), at % 2 == 0, f"base{at}")) for at in range(8)]
    found = compare(alone)["all"]["difference"]
    assert found["resampled"] == "8 trials"
    assert found["low"] < 0 < found["high"]
