"""Focus of a plan on failures: shares computed by hand, limits, all three forms of results, and a written file."""

import json
from collections import Counter
from pathlib import Path

import pytest
import yaml
from episode_results import result

from pipeline.commands.command_line import run
from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.evaluation.focus import PRIOR, Attempt, Limits, attempts, focus
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import tasks
from pipeline.planning.plan import apportion
from pipeline.testset import benchmark

STOVE, BOWL = "libero_goal/turn_on_the_stove", "libero_goal/put_the_bowl_on_the_plate"


def config(**plan: object) -> Config:
    wanted = {"episodes": {"camera": 100, "robot": 100, "light+noise": 100}, **plan}
    return Config.model_validate({"name": "a", "demos": {"tasks": [STOVE, BOWL]}, "plan": wanted})


def tried(axis: str, failed: int, of: int, level: int = 3, task: str = STOVE) -> list[Attempt]:
    axes = tuple(axis.split("+")) if axis else ()
    return [Attempt(axes, level, task, number < failed) for number in range(of)]


def test_shares_follow_the_smoothed_rates_of_failures() -> None:
    """30 of 60 fail. Robot: (20 + 5 x 31/62) / (20 + 5) = 0.9; camera: 2.5 / 25 = 0.1; light, noise: 0.5 and 0.5."""
    results = [*tried("camera", 0, 20), *tried("robot", 20, 20), *tried("light", 10, 20)]
    found = focus(config(), results, limits=Limits(0, 10))
    assert PRIOR == 5
    rates = {reason.name: reason.rate for reason in found.reasons if reason.kind == "episodes"}
    assert rates == pytest.approx({"camera": 0.1, "robot": 0.9, "light+noise": 0.5})
    assert found.episodes == {"camera": 20, "robot": 180, "light+noise": 100}
    limited = focus(config(), results, episodes=30)
    assert limited.episodes == {"camera": 5, "robot": 16, "light+noise": 9}, "half of 10; 25 x 0.9 / 1.4; the rest"
    notes = {reason.name: reason.note for reason in limited.reasons if reason.kind == "episodes"}
    assert notes == {"camera": "floor", "robot": "", "light+noise": ""}


def test_an_axis_without_results_has_the_mean_rate() -> None:
    found = focus(config(), [*tried("camera", 5, 10), *tried("robot", 5, 10)])
    assert found.episodes == {"camera": 100, "robot": 100, "light+noise": 100}
    (reason,) = (reason for reason in found.reasons if reason.name == "light+noise")
    assert (reason.episodes, reason.interval, reason.note) == (0, None, "no results")
    assert found.levels.keys() == {"camera", "robot"}


def test_levels_and_tasks_get_shares_too() -> None:
    results = [*tried("camera", 0, 40, level=1), *tried("camera", 40, 40, level=5, task=BOWL)]
    found = focus(config(), results)
    counts = Counter(found.levels["camera"])
    assert found.levels["camera"] == sorted(found.levels["camera"])
    middle = [counts[level] for level in (2, 3, 4)]
    assert counts[1] < min(middle) <= max(middle) < counts[5], "levels 2 to 4 have no results"
    assert (counts.total(), max(middle) - min(middle)) == (20, 1)
    assert found.task_weights[STOVE] == 0.5, "the floor"
    assert found.task_weights[BOWL] == 1.5


def test_levels_that_only_select_rewrites_stay() -> None:
    found = focus(config(episodes={"language": 20, "camera": 20}), [*tried("language", 9, 10), *tried("camera", 1, 10)])
    assert found.levels.keys() == {"camera"}
    assert found.episodes["language"] > found.episodes["camera"]


def test_unperturbed_episodes_count_for_their_tasks_alone() -> None:
    perturbed = [*tried("camera", 5, 10), *tried("camera", 5, 10, task=BOWL)]
    found = focus(config(), [*perturbed, *tried("", 50, 50, level=0)])
    assert found.episodes == {"camera": 100, "robot": 100, "light+noise": 100}
    assert found.task_weights[STOVE] > 1 > found.task_weights[BOWL]


@pytest.mark.parametrize(
    ("results", "episodes", "limits", "message"),
    [
        (tried("pose", 5, 10), None, Limits(), "the results are about pose\n  expected: results on axes of the plan"),
        (tried("", 5, 10), None, Limits(), "the results are about no axis"),
        (tried("camera", 5, 10), 2, Limits(), "2 episodes for 3 entries"),
        (tried("camera", 5, 10), None, Limits(1.5, 2), "floor 1.5, cap 2"),
        (tried("camera", 5, 10), None, Limits(0.5, 0.9), "floor 0.5, cap 0.9"),
    ],
)
def test_what_has_no_focus_is_refused(results: list[Attempt], episodes: int, limits: Limits, message: str) -> None:
    with pytest.raises(PipelineError, match=message):
        focus(config(), results, episodes, limits)


@pytest.mark.parametrize("total", [5, 17, 300])
@pytest.mark.parametrize("weights", [[1.0] * 5, [0.1, 0.2, 3.0, 0.0, 1.0], [5.0, 1.0, 1.0, 1.0, 1e-9]])
def test_a_number_is_apportioned_whole(total: int, weights: list[float]) -> None:
    parts = apportion(total, weights)
    assert sum(parts) == total
    exact = [total * weight / sum(weights) for weight in weights]
    assert all(abs(part - wanted) < 1 for part, wanted in zip(parts, exact, strict=True)), "largest remainders"
    with_least = apportion(total, weights, least=1)
    assert (sum(with_least), min(with_least) >= 1) == (total, True)


def test_equal_weights_spread_evenly() -> None:
    assert apportion(7, [1.0] * 3) == [3, 2, 2]
    assert apportion(9, [0.3] * 3) == [3, 3, 3]


def evaluated(folder: Path) -> Path:
    """Write results of ``evaluate`` on 20 camera and 20 robot tests; half of the robot tests fail."""
    for axis in ("camera", "robot"):
        tests = [test for test in benchmark.load().on_axis(axis) if test.suite == "libero_goal"]
        for number, test in enumerate(tests[:20]):
            task = EvaluationTask(
                "libero_plus", test.suite, test.base, test.name, test.axis, test.component, 1 + number % 5, 0
            )
            EpisodeFiles(folder).save(result(task, axis == "camera" or number % 2 == 0))
    return folder


def test_a_configuration_is_written_and_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first = {
        "name": "first",
        "demos": {"tasks": ["libero_goal/*"]},
        "plan": {"seed": 3, "axes": {"robot": {"levels": [2, 4]}}, "episodes": {"camera": 10, "robot": 10}},
        "export": {"rlds": {"shards": 2}},
    }
    source.write_text(yaml.safe_dump(first))
    words = ["focus", str(evaluated(tmp_path / "results")), "--from", str(source), "--out", str(out)]
    assert run(words) == 0
    printed = capsys.readouterr().out
    changed = json.loads(printed.splitlines()[-1])
    written = load(out)
    assert (written.name, written.plan.seed, written.export.formats["rlds"].shards) == ("second", 3, 2)
    assert written.plan.episodes == changed["episodes"] == {"camera": 5, "robot": 15}
    assert {*written.plan.axes.robot.levels} == {2, 4}, "no level that the first configuration leaves out"
    assert len(written.plan.task_weights) == len(tasks("libero_goal"))
    text = out.read_text()
    assert "10 of 20" in text
    assert all(line in text.replace("# ", "") for line in printed.splitlines()[:-1])
    assert run(words) == 0, "its own file is written again"
    assert run([*words[:-1], str(source)]) == 1
    assert "choose another name" in capsys.readouterr().err
    assert yaml.safe_load(source.read_text()) == first


def test_results_of_other_programs_count_as_those_of_evaluate(tmp_path: Path) -> None:
    """lerobot-eval numbers the test tasks of a suite in the benchmark's order."""
    tests = [test for test in benchmark.load().tasks if test.suite == "libero_goal"]
    chosen = [number for number, test in enumerate(tests) if test.axis in ("camera", "robot")][:30]
    per_task = []
    for number in chosen:
        per_task.append({"task_group": "libero_goal", "task_id": number, "metrics": {"successes": [number % 2 == 0]}})
        test = tests[number]
        task = EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, 0, 0)
        EpisodeFiles(tmp_path / "own").save(result(task, number % 2 == 0))
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": per_task}))
    ours, theirs = attempts([tmp_path / "own"]), attempts([tmp_path / "eval_info.json"])
    assert len(theirs) == 30
    assert Counter(one._replace(level=0) for one in ours) == Counter(one._replace(level=0) for one in theirs)
    assert any(one.level for one in theirs), "the level follows from the test's parameters"
    assert len(attempts([tmp_path / "own", tmp_path / "eval_info.json"])) == 60


def test_weights_of_tasks_shift_their_episodes(tmp_path: Path) -> None:
    from pipeline.planning import plan

    wanted = config(episodes={"light": 12}, task_weights={STOVE: 3.0})
    rows = plan.make(wanted.demos.index().entries, wanted.plan, wanted.replay, benchmark.load())
    assert Counter(row.task for row in rows if row.wanted and row.role == "perturbed") == {
        STOVE.split("/")[1]: 9,
        BOWL.split("/")[1]: 3,
    }
    with pytest.raises(ValueError, match=r"task_weights: demos\.tasks does not select 'libero_goal/dance'"):
        config(task_weights={"libero_goal/dance": 2.0})
