"""The composition gap is the paper's, over trials that have all four combinations of the same perturbations."""

import json
from collections import Counter
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from episode_results import analyze, result
from short_demonstrations import STOVE

from pipeline.axes import to_json
from pipeline.errors import PipelineError
from pipeline.evaluation.analyses import composition
from pipeline.evaluation.analyses.composition import AxisPair
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.held_out import sample_perturbation
from pipeline.evaluation.results import EpisodeFiles, Stored, stored
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask


def some_pairs(**fields: Any) -> list[EvaluationTask]:
    return select(Selection(source="pairs", suites=(STOVE.suite,), tasks=(STOVE.name,), **fields))


def test_the_gap_is_as_worked_by_hand() -> None:
    pair = AxisPair("robot", "camera", trials=100, neither=90, only_first=60, only_second=50, both=20)
    # 220 successes: the joint probability is 20 / 220, the marginal ones are 80 / 220 and 70 / 220.
    assert pair.joint == pytest.approx(1 / 11)
    assert pair.product == pytest.approx(80 * 70 / 220**2)
    assert pair.gap == pytest.approx(-3 / 121)
    # 220 (90 * 20 - 60 * 50)^2 / (140 * 80 * 150 * 70)
    assert pair.chi_square()[0] == pytest.approx(2.693878, abs=1e-6)
    assert pair.chi_square()[1] == pytest.approx(0.100735, abs=1e-6)
    indicators = np.repeat([[0, 0], [1, 0], [0, 1], [1, 1]], [90, 60, 50, 20], axis=0)
    assert pair.gap == pytest.approx(np.cov(indicators.T, bias=True)[0, 1])
    # Where each perturbation keeps its own share, whatever the other does, there is no gap.
    assert AxisPair("robot", "camera", 100, 80, 40, 20, 10).gap == pytest.approx(0)
    assert AxisPair("robot", "camera", 100, 80, 40, 20, 10).chi_square() == pytest.approx((0, 1))
    assert AxisPair("robot", "camera", 10, 0, 0, 0, 0).figures()["gap"] is None


def test_pairs_reuse_the_perturbations_and_initial_states_of_their_singles() -> None:
    tasks = some_pairs(axes=("robot", "camera", "light", "noise"), episodes=5)
    assert Counter(len(task.axis.split("+")) for task in tasks if task.axis != "clean") == {1: 5 * 4, 2: 5 * 6}
    assert sum(task.axis == "clean" for task in tasks) == 5
    assert {task.level for task in tasks if task.axis == "robot"} == {1, 2, 3, 4, 5}
    singles = {(task.axis, task.number): task for task in tasks}
    for task in tasks:
        for axis in task.axis.split("+") if task.axis != "clean" else ():
            single = singles[axis, task.number]
            assert sample_perturbation(task, 0, axis=axis) == sample_perturbation(single, 0)
            assert single.level == task.level
    alone = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot",)))
    assert singles["robot", 0] in alone, "results of held-out perturbations serve pairs too"
    assert some_pairs(axes=("noise", "robot"))[-1].axis == "robot+noise", "in the order in which they apply"
    both_suites = select(Selection(source="pairs", suites=("libero_object", STOVE.suite), axes=("robot", "noise")))
    assert set(some_pairs(axes=("robot", "noise"))) < set(both_suites), "levels do not depend on what else is chosen"
    with pytest.raises(PipelineError, match="combinations"):
        some_pairs(subset=10)


def test_one_initial_state_of_each_task_has_every_level_equally_often() -> None:
    """A suite has ten tasks, of which two have each of the five levels."""
    tasks = select(Selection(source="pairs", suites=(STOVE.suite,), axes=("robot", "noise"), episodes=1))
    joined = [task for task in tasks if task.axis == "robot+noise"]
    assert len({task.base for task in joined}) == 10
    assert Counter(task.level for task in joined) == {1: 2, 2: 2, 3: 2, 4: 2, 5: 2}


def test_the_gap_counts_trials_with_all_four_combinations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = some_pairs(axes=("robot", "noise"), episodes=4)
    for task in tasks:
        # The last trial lacks its pair, that before it was rejected.
        if task.axis == "robot+noise" and task.number == 3:
            continue
        ended = {"reason": "refused"} if task.axis == "robot+noise" and task.number == 2 else {}
        success = task.axis == "clean" or (task.axis == "noise" and task.number == 0)
        EpisodeFiles(tmp_path).save(result(task, success, **ended))
    assert analyze("gap", str(tmp_path)) == 0
    (pair,) = composition.pairs(stored([tmp_path]))
    assert replace(pair, interval=None) == AxisPair("robot", "noise", 2, neither=2, only_first=0, only_second=1, both=0)
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert printed["robot+noise"]["trials"] == 2
    assert printed["robot+noise"]["bootstrap"]["resampled"] == "2 trials"
    assert printed["robot+noise"]["papers_chi_square"] == {"statistic": None, "p_value": None}
    assert json.loads((tmp_path / "gap.json").read_text()) == printed
    assert (tmp_path / "gap.png").read_bytes().startswith(b"\x89PNG")
    names, shown = composition.matrix([pair, AxisPair("robot", "camera", 100, 90, 60, 50, 20)])
    assert names == ["robot", "camera", "noise"]
    assert shown[0, 1] == pytest.approx(80 * 70 / 220**2), "the product stands above the diagonal"
    assert shown[1, 0] == pytest.approx(1 / 11)
    EpisodeFiles(tmp_path).save(result(tasks[0], True, "q"))
    assert analyze("gap", str(tmp_path)) == 1
    assert "several policies" in capsys.readouterr().err


def test_initial_states_are_resampled_with_both_levels_within_their_base_tasks(tmp_path: Path) -> None:
    """Three base tasks have six initial states each, and the outcomes of an initial state are equal at two levels."""
    axes = ("clean", "robot", "noise", "robot+noise")
    successes_of = np.array(
        [
            [[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 1, 1], [1, 1, 0, 0]],
            [[1, 0, 0, 0], [1, 0, 1, 0], [0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 0, 0]],
            [[1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 1], [1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 0]],
        ]
    )
    results: list[Stored] = []
    for base, of_base in zip(("a", "b", "c"), successes_of.tolist(), strict=True):
        for number, successes in enumerate(of_base):
            outcome_of = dict(zip(axes, successes, strict=True))
            clean = EvaluationTask("libero", STOVE.suite, base, f"{base}{number}", "clean", "clean", 0, number)
            results.append((result(clean, bool(outcome_of.pop("clean"))), EpisodeFiles(tmp_path)))
            for level, axis in product((1, 3), outcome_of):
                name = f"{base}{number} {axis} {level}"
                task = EvaluationTask("own", STOVE.suite, base, name, axis, axis, level, number)
                results.append((result(task, bool(outcome_of[axis])), EpisodeFiles(tmp_path)))
    (pair,) = composition.pairs(results)
    assert pair.trials == 36
    assert pair.interval is not None
    assert pair.interval.resampled == "18 trials within 3 base tasks"
    # Five of six initial states are sampled within each base task; 15 degrees of freedom widen the percentiles.
    picks = np.random.default_rng(1).integers(6, size=(3, 20_000, 5))
    sums = sum(of_base[pick].sum(axis=1) for of_base, pick in zip(successes_of, picks, strict=True))
    _, only_one, only_other, both = sums.T
    whole = sums.sum(axis=1)
    gaps = both / whole - (only_one + both) * (only_other + both) / whole**2
    outside = scipy.stats.norm.cdf(scipy.stats.t.ppf(0.025, 15))
    assert (pair.interval.low, pair.interval.high) == pytest.approx(
        tuple(np.quantile(gaps, (outside, 1 - outside))), abs=0.003
    )


def test_the_gap_leaves_out_a_pair_of_other_perturbations_than_its_singles(tmp_path: Path) -> None:
    for task in some_pairs(axes=("robot", "noise"), episodes=2):
        axes = task.axis.split("+") if task.axis != "clean" else ()
        perturbations = json.loads(
            to_json(sample_perturbation(task, task.number if len(axes) == 2 else 0, axis=axis) for axis in axes)
        )
        EpisodeFiles(tmp_path).save(result(task, perturbations=perturbations))
    (pair,) = composition.pairs(stored([tmp_path]))
    assert pair.trials == 1, "the second pair was sampled under another seed"


def test_the_gap_counts_no_task_twice(tmp_path: Path) -> None:
    for task in some_pairs(axes=("robot", "noise")):
        EpisodeFiles(tmp_path).save(result(task, task.axis == "clean"))
        if task.axis == "robot+noise":
            EpisodeFiles(tmp_path).save(result(task, True, episode="another"))
    with pytest.raises(PipelineError, match=r"a task counts twice: own/.*robot\+noise"):
        composition.pairs(stored([tmp_path]))


@pytest.mark.slow
def test_a_pair_composes_the_perturbations_of_its_singles() -> None:
    evaluated = EpisodeEnvironment()
    tasks = {task.axis: task for task in some_pairs(axes=("layout", "robot", "camera"))}
    evaluated.reset(tasks["robot"])
    robot = evaluated.episode.perturbations
    evaluated.reset(tasks["layout"])
    layout, placed = evaluated.episode.perturbations, evaluated.episode.resolved["layout"]
    evaluated.reset(tasks["layout+robot"])
    assert tuple(evaluated.episode.perturbations) == (*layout, *robot)
    assert evaluated.episode.resolved["layout"] == placed, "objects stand where they stand without the other axis"
    assert evaluated.episode.resolved.keys() == {"layout", "robot"}
    evaluated.reset(tasks["robot+camera"])
    assert [one.axis for one in evaluated.episode.perturbations] == ["robot", "camera"]
    evaluated.close()
