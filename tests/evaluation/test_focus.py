"""Focus of a plan on failures: shares computed by hand, limits, all three forms of results, and a written file."""

import json
import math
from collections import Counter
from itertools import chain
from pathlib import Path

import pytest
import yaml
from episode_results import result

from pipeline.axes import level_of_test
from pipeline.commands.command_line import run
from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.evaluation.analyses.focus import PRIOR, Attempt, Focused, Limits, Reason, attempts, focus
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.formats.rlds import RldsConfig
from pipeline.libero.tasks import tasks
from pipeline.planning.apportion import apportion
from pipeline.seeding import digest
from pipeline.testset import benchmark

STOVE, BOWL = "libero_goal/turn_on_the_stove", "libero_goal/put_the_bowl_on_the_plate"


def config(**plan: object) -> Config:
    wanted = {"episodes": {"camera": 100, "robot": 100, "light+noise": 100}, **plan}
    return Config.model_validate({"name": "a", "demos": {"tasks": [STOVE, BOWL]}, "plan": wanted})


def attempt(axis: str, failures: int, of: int, level: int = 3, task: str = STOVE) -> list[Attempt]:
    """Return ``of`` episodes of a policy, of which the first ``failures`` failed."""
    axes = tuple(axis.split("+")) if axis else ()
    return [Attempt("act", axes, level, task, number < failures) for number in range(of)]


def reasons(focused: Focused, kind: str) -> dict[str, Reason]:
    return {reason.name: reason for reason in focused.reasons if reason.kind == kind}


def test_shares_follow_the_smoothed_rates_of_failures() -> None:
    """30 of 60 fail. Robot: (20 + 5 x 31/62) / (20 + 5) = 0.9; camera: 2.5 / 25 = 0.1; light, noise: 0.5 and 0.5."""
    results = [*attempt("camera", 0, 20), *attempt("robot", 20, 20), *attempt("light", 10, 20)]
    focused = focus(config(), results, None, Limits(0, 10))
    assert PRIOR == 5
    rates = {name: reason.rate for name, reason in reasons(focused, "axis").items()}
    assert rates == pytest.approx({"camera": 0.1, "robot": 0.9, "light": 0.5, "noise": 0.5})
    assert focused.episodes == {"camera": 20, "robot": 180, "light+noise": 100}
    limited = focus(config(), results, 30)
    assert limited.episodes == {"camera": 5, "robot": 16, "light+noise": 9}, "half of 10; 25 x 0.9 / 1.4; the rest"
    notes = {name: reason.note for name, reason in reasons(limited, "episodes").items()}
    assert notes == {"camera": "floor", "robot": "", "light+noise": "no results"}
    robot = reasons(limited, "episodes")["robot"]
    assert (robot.before, robot.after, robot.written) == pytest.approx((1 / 3, 25 / 30 * 0.9 / 1.4, 16))


def test_an_axis_without_results_has_the_mean_rate() -> None:
    focused = focus(config(), [*attempt("camera", 5, 10), *attempt("robot", 5, 10)], None)
    assert focused.episodes == {"camera": 100, "robot": 100, "light+noise": 100}
    assert reasons(focused, "axis")["light"] == Reason("axis", "light", 0, 0, 0.5, note="no results")
    assert focused.levels.keys() == {"camera", "robot"}


def test_joined_axes_have_their_own_results_or_the_mean_of_their_axes() -> None:
    apart = focus(config(), [*attempt("light", 0, 10), *attempt("noise", 10, 10)], None)
    rates = {name: reason.rate for name, reason in reasons(apart, "axis").items()}
    assert reasons(apart, "episodes")["light+noise"].rate == pytest.approx((rates["light"] + rates["noise"]) / 2)
    joined = focus(config(), [*attempt("noise+light", 10, 10), *attempt("camera", 0, 10)], None)
    entry = reasons(joined, "episodes")["light+noise"]
    assert (entry.failures, entry.episodes) == (10, 10), "each episode counts once"
    assert entry.rate == pytest.approx((10 + 5 * 0.5) / 15)
    assert reasons(joined, "axis")["light"].episodes == 0


def test_levels_and_tasks_get_shares_too() -> None:
    results = [*attempt("camera", 0, 40, level=1), *attempt("camera", 40, 40, level=5, task=BOWL)]
    focused = focus(config(), results, None)
    counts = Counter(focused.levels["camera"])
    assert focused.levels["camera"] == sorted(focused.levels["camera"])
    middle = [counts[level] for level in (2, 3, 4)]
    assert counts[1] < min(middle) <= max(middle) < counts[5], "levels 2 to 4 have no results"
    assert (counts.total(), max(middle) - min(middle)) == (20, 1)
    assert focused.task_weights == {STOVE: 0.5, BOWL: 1.5}, "the floor, and what remains"
    level = reasons(focused, "level")["camera 1"]
    assert (level.before, level.note) == (0.2, "floor")


def test_rates_of_levels_are_smoothed_towards_the_rate_of_their_axis() -> None:
    """4 of 40 camera tests fail and 32 of 40 robot tests, so the mean rate is 37/82."""
    results = [*attempt("camera", 4, 20, level=1), *attempt("camera", 0, 20, level=5), *attempt("robot", 32, 40)]
    levels = reasons(focus(config(), results, None), "level")
    of_camera = (4 + 5 * 37 / 82) / 45
    rates = {level: levels[f"camera {level}"].rate for level in (1, 3, 5)}
    assert rates == pytest.approx({1: (4 + 5 * of_camera) / 25, 3: of_camera, 5: 5 * of_camera / 25})


def test_levels_that_do_not_set_shares_stay() -> None:
    """Rewrites have the levels of a list; half of the backgrounds have level 5 for their own colours."""
    episodes = {"language": 20, "camera": 20, "background": 20}
    results = [*attempt("language", 9, 10), *attempt("camera", 1, 10), *attempt("background", 5, 10)]
    focused = focus(config(episodes=episodes), results, None)
    assert focused.levels.keys() == {"camera"}
    assert focused.episodes["language"] > focused.episodes["background"] > focused.episodes["camera"]
    plain = config(episodes=episodes, axes={"background": {"own_colours": 0.0}})
    assert focus(plain, results, None).levels.keys() == {"camera", "background"}


def test_tasks_are_compared_with_what_their_axes_let_expect() -> None:
    """All robot tests fail and all camera tests succeed; the task with robot tests is no harder than the other."""
    results = [*attempt("robot", 40, 40), *attempt("camera", 0, 40, task=BOWL)]
    ratios = {name: reason.rate for name, reason in reasons(focus(config(), results, None), "task").items()}
    assert ratios == pytest.approx({STOVE: 1.0, BOWL: 1.0})
    unperturbed = focus(config(), [*results, *attempt("", 50, 50, level=0), *attempt("", 0, 50, 0, BOWL)], None)
    assert unperturbed.task_weights[STOVE] > 1.3 > 0.7 > unperturbed.task_weights[BOWL]
    assert unperturbed.episodes == focus(config(), results, None).episodes, "they are about no axis"


def test_results_on_other_tasks_axes_and_levels_do_not_count() -> None:
    weak = config(axes={"camera": {"levels": [1, 2, 3]}})
    plain = [*attempt("camera", 3, 10), *attempt("robot", 5, 10)]
    others = [
        *attempt("camera", 10, 10, level=5),
        *attempt("camera", 10, 10, task="libero_10/LIVING_ROOM_SCENE5_put_the_white_mug_on_the_left_plate"),
        *attempt("pose", 10, 10),
        *attempt("camera+pose", 10, 10),
    ]
    focused = focus(weak, [*plain, *others], None)
    assert (focused.policies, focused.left_out) == ({"act": 20}, 40)
    assert focused.reasons == focus(weak, plain, None).reasons


@pytest.mark.parametrize("name", ["floor", "cap"])
def test_a_limit_that_is_no_number_is_rejected(name: str) -> None:
    with pytest.raises(PipelineError, match=f"--{name}: the limit is not a number"):
        Limits(**{name: math.nan})


@pytest.mark.parametrize("limits", [Limits(1, 2), Limits(0.5, 1), Limits(1, 1), Limits(0, 100), Limits(0, 1)])
def test_every_floor_and_cap_is_kept(limits: Limits) -> None:
    """Also if they leave nothing to decide, with the rounding errors of any number of entries."""
    for number in range(1, 25):
        names = [str(task) for task in tasks("libero_90")[:number]]
        results: list[Attempt] = []
        for place, name in enumerate(names):
            results += attempt("camera", place, number, task=name)
        weights = {name: 1.0 + place % 3 for place, name in enumerate(names)}
        plan = {"episodes": {"camera": 100}, "task_weights": weights}
        planned = Config.model_validate({"name": "a", "demos": {"root": "demos", "tasks": names}, "plan": plan})
        shares = reasons(focus(planned, results, None, limits), "task").values()
        assert sum(reason.after or 0 for reason in shares) == pytest.approx(1)
        for reason in shares:
            assert reason.before
            assert reason.after is not None
            assert limits.floor - 1e-9 <= reason.after / reason.before <= limits.cap + 1e-9


@pytest.mark.parametrize(
    ("results", "episodes", "message"),
    [
        (attempt("pose", 5, 10), None, "axis and a task of the plan; the axes of the results: pose"),
        (attempt("", 5, 10), None, "the axes of the results: no axis"),
        (attempt("camera", 5, 10), 2, "2 episodes for 3 entries"),
    ],
)
def test_results_without_a_focus_are_rejected(results: list[Attempt], episodes: int, message: str) -> None:
    with pytest.raises(PipelineError, match=message):
        focus(config(), results, episodes)


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
    """Write results of ``evaluate`` on 20 camera and 20 robot tests, by turns at levels 2 and 4.

    Half of the robot tests fail.
    """
    for axis in ("camera", "robot"):
        tests = [test for test in benchmark.load().on_axis(axis) if test.suite == "libero_goal"]
        weak, strong = ([test for test in tests if level_of_test(test) == level][:10] for level in (2, 4))
        for number, test in enumerate(chain.from_iterable(zip(weak, strong, strict=True))):
            level = level_of_test(test)
            task = EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, level, 0)
            EpisodeFiles(folder).save(result(task, axis == "camera" or number < 10))
    return folder


def test_a_configuration_is_written_and_read_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first = {
        "name": "first",
        "folder": str(tmp_path / "1e5"),
        "demos": {"tasks": ["libero_goal/*"]},
        "plan": {"seed": 3, "axes": {"robot": {"levels": [2, 4]}}, "episodes": {"camera": 10, "robot": 10}},
        "export": {"rlds": {"shards": 2, "name": "libero_mine"}},
    }
    source.write_text(yaml.safe_dump(first))
    folder = evaluated(tmp_path / "results\n of mine")
    words = ["focus", str(folder), "--from", str(source), "--out", str(out)]
    assert run(words) == 0
    printed = capsys.readouterr().out
    focused = json.loads(printed.splitlines()[-1])
    written = load(out)
    assert (written.name, written.plan.seed, written.folder) == ("second", 3, tmp_path / "1e5")
    rlds = written.export.formats["rlds"]
    assert isinstance(rlds, RldsConfig)
    assert (rlds.shards, rlds.name) == (2, "libero_second")
    assert written.plan.episodes == focused["episodes"] == {"camera": 5, "robot": 15}
    assert written.plan.axes.robot is not None
    assert Counter(written.plan.axes.robot.levels) == {2: 10, 4: 10}, "no level that the first configuration leaves out"
    assert len(focused["task_weights"]) == len(tasks("libero_goal"))
    assert written.plan.task_weights == {
        task: weight for task, weight in focused["task_weights"].items() if weight != 1
    }
    assert "10 of 20" in printed
    assert all(line.rstrip() in out.read_text() for line in printed.splitlines()[:-2])
    for name, message in (("second", "may have been edited"), ("first", "exists"), ("Third-Run", "'Third-Run'")):
        assert run([*words[:-1], str(tmp_path / f"{name}.yaml")]) == 1
        assert message in capsys.readouterr().err
    assert run([*words[:-1], str(tmp_path / "elsewhere" / "first.yaml")]) == 1
    assert yaml.safe_load(source.read_text()) == first


def test_a_policy_without_views_or_instruction_is_rejected(tmp_path: Path) -> None:
    test = benchmark.load().on_axis("camera")[0]
    task = EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, 1, 0)
    settings = {"prompt": "clean", "seed": 0, "black": "all"}
    EpisodeFiles(tmp_path).save(result(task, settings=settings))
    with pytest.raises(PipelineError, match="black views or no instruction"):
        attempts([tmp_path])


@pytest.mark.parametrize("settings", [{"black": "agentview"}, {"prompt": "blank"}])
def test_such_a_policy_of_vla_eval_is_rejected(tmp_path: Path, settings: dict[str, str]) -> None:
    test = benchmark.load().on_axis("camera")[0]
    task = EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, 1, 0)
    config = {"benchmark": "pipeline.evaluation.harness:PerturbedLibero", "params": {"settings": settings}}
    episode = task.for_harness() | {"metrics": {"success": False}}
    file = tmp_path / "libero_aggregate.json"
    file.write_text(json.dumps({"config": config, "tasks": [{"task": "a", "episodes": [episode]}]}))
    with pytest.raises(PipelineError, match="black views or no instruction"):
        attempts([tmp_path])


def test_goals_count_for_the_task_that_was_asked_for(tmp_path: Path) -> None:
    """LIBERO-Plus asks for another object of a scene, which no plan does; a carried goal is in plans."""
    listed = select(Selection(source="goals", suites=("libero_spatial", "libero_10")))
    carried = [task for task in listed if "_task_" in task.name]
    for task in listed:
        EpisodeFiles(tmp_path).save(result(task, episode=digest(task.name)[:16]))
    counted = attempts([tmp_path])
    assert 0 < len(carried) < len(counted) == len(listed)
    assert Counter(episode.task for episode in counted) == Counter(
        f"{task.suite}/{task.name.split('_task_')[1].split('_state')[0]}" if task in carried else "" for task in listed
    )
    config = Config.model_validate(
        {"name": "goals", "demos": {"tasks": ["libero_spatial/*", "libero_10/*"]}}
        | {"plan": {"axes": {"goal": {}}, "episodes": {"goal": 4}}}
    )
    focused = focus(config, counted, None)
    assert sum(focused.policies.values()) + focused.left_out == len(listed), "all results are counted or named"
    assert all(episode.axes == ("goal",) for episode in counted)


def test_results_of_other_programs_count_as_those_of_evaluate(tmp_path: Path) -> None:
    """lerobot-eval numbers the test tasks of a suite in the benchmark's order."""
    tests = [test for test in benchmark.load().tasks if test.suite == "libero_goal"]
    chosen = [number for number, test in enumerate(tests) if test.axis in ("camera", "robot")][:30]
    per_task = []
    for number in chosen:
        per_task.append({"task_group": "libero_goal", "task_id": number, "metrics": {"successes": [number % 2 == 0]}})
        test = tests[number]
        level = level_of_test(test)
        task = EvaluationTask("libero_plus", test.suite, test.base, test.name, test.axis, test.component, level, 0)
        EpisodeFiles(tmp_path / "own").save(result(task, number % 2 == 0))
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": per_task}))
    ours, theirs = attempts([tmp_path / "own"]), attempts([tmp_path / "eval_info.json"])
    assert len(theirs) == 30
    assert Counter(episode._replace(policy="") for episode in ours) == Counter(
        episode._replace(policy="") for episode in theirs
    )
    assert any(episode.level for episode in theirs), "the level follows from the test's parameters"
    assert len(attempts([tmp_path / "own", tmp_path / "eval_info.json"])) == 60
    with pytest.raises(PipelineError, match="two policies have the name"):
        attempts([tmp_path, tmp_path / "eval_info.json"])


def test_a_level_of_an_earlier_version_does_not_count(tmp_path: Path) -> None:
    """The robot's posture 300 differs by 0.3 rad from the default, which is level 3."""
    test = next(one for one in benchmark.load().on_axis("robot") if one.parameters["id"] == 300)
    for number, old_level in enumerate((1, 3, 5)):
        task = EvaluationTask("libero_plus", test.suite, test.base, test.name, "robot", test.component, old_level, 0)
        EpisodeFiles(tmp_path).save(result(task, policy=f"policy {number}"))
    assert [(episode.axes, episode.level) for episode in attempts([tmp_path])] == [(("robot",), 3)] * 3


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
