"""A stored result is of the policy, settings and versions that it is asked for, or it does not count."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import checkpoints
import numpy as np
import pytest
from episode_results import result
from server_process import running
from short_demonstrations import STOVE

from pipeline import identity
from pipeline.axes.camera import CameraAxis, SphericalRange
from pipeline.compute.pool import loop
from pipeline.errors import PipelineError
from pipeline.evaluation import held_out, results
from pipeline.evaluation.checkpoint import Checkpoint
from pipeline.evaluation.environment import Episode, EpisodeEnvironment, EpisodeSettings, Progress
from pipeline.evaluation.evaluate import EvaluationJob, _open_environment, evaluate
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.setting_checks import check_settings
from pipeline.evaluation.tasks import EvaluationTask, libero_task
from pipeline.libero.tasks import STEP_LIMITS

STEPS = 4
CHOSEN = Selection(suites=(STOVE.suite,), tasks=(STOVE.name,))
SETTINGS = EpisodeSettings()


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Episodes of a few steps; afterwards the process gives back the environment that it keeps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(STEP_LIMITS, STOVE.suite, STEPS)
        yield
    _open_environment(SETTINGS, None).close()


def test_the_table_of_test_tasks_is_of_one_observation(tmp_path: Path) -> None:
    """As where a server with one label is started again, and then does not ask for the state."""
    done = evaluation(PolicyConfig(kind="server", address="ws://localhost:1", label="p"), tmp_path)

    def save(axis: str, wanted: Wanted) -> None:
        for task in select(Selection(source="libero_plus", suites=(STOVE.suite,), axes=(axis,), subset=2)):
            ended = Episode(task, STOVE, STEPS, Progress(9, "success"), looks=5)
            environment: Any = SimpleNamespace(episode=ended, instruction="x")
            done.save(environment, wanted)

    save("camera", Wanted(state=True))
    assert len(done.test_results()) == 2
    save("robot", Wanted(state=False))
    with pytest.raises(PipelineError, match="several policies or settings"):
        done.test_results()


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The first number of every action that the environment takes."""
    actions: list[float] = []
    step = EpisodeEnvironment.step

    def recorded(self: EpisodeEnvironment, action: Any) -> Any:
        actions.append(round(float(np.asarray(action)[0]), 6))
        return step(self, action)

    monkeypatch.setattr(EpisodeEnvironment, "step", recorded)
    return actions


def evaluation(policy: PolicyConfig, out: Path, settings: EpisodeSettings = SETTINGS) -> Evaluation:
    return Evaluation(settings, policy, policy.identity(), out)


def run(out: Path, checkpoint: Path, label: str = "", settings: EpisodeSettings = SETTINGS) -> dict[str, Any]:
    policy = PolicyConfig(kind="checkpoint", address=str(checkpoint), label=label)
    return evaluate(evaluation(policy, out, settings), CHOSEN, loop)


def rescale(folder: Path) -> None:
    """Other statistics in the processor after the network."""
    shutil.copytree(checkpoints.save(folder.with_name("scaled"), 0.1, scale=3.0), folder, dirs_exist_ok=True)


def shorten(folder: Path) -> None:
    file = folder / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"n_action_steps": 1}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "actions", "looks"),
    [
        (lambda folder: checkpoints.retrain(folder, 0.2), [0.2] * STEPS, STEPS // checkpoints.CHUNK),
        (rescale, [0.3] * STEPS, STEPS // checkpoints.CHUNK),
        (shorten, [0.1] * STEPS, STEPS),
    ],
    ids=["weights", "processor", "configuration"],
)
def test_a_checkpoint_that_changes_where_it_is_is_evaluated_again(
    tmp_path: Path, taken: list[float], change: Callable[[Path], None], actions: list[float], looks: int
) -> None:
    checkpoint, out = checkpoints.save(tmp_path / "policy", 0.1), tmp_path / "out"
    first = run(out, checkpoint)
    assert taken == [0.1] * STEPS
    assert run(out, checkpoint) == first
    assert len(taken) == STEPS, "a finished episode is not run again"
    taken.clear()
    change(checkpoint)
    second = run(out, checkpoint)
    assert taken == actions
    assert second["all"]["episodes"] == 1
    assert second["policy"] != first["policy"]
    both = results.read([out])
    assert [policy.rows[0].looks for policy in sorted(both, key=lambda one: one.rows[0].looks)] == sorted(
        [STEPS // checkpoints.CHUNK, looks]
    )
    assert len({policy.name for policy in both}) == 2, "the old results are another policy's"


@pytest.mark.slow
def test_a_copy_is_the_same_policy(tmp_path: Path, taken: list[float]) -> None:
    checkpoint, out = checkpoints.save(tmp_path / "policy", 0.1), tmp_path / "out"
    run(out, checkpoint)
    copy = shutil.copytree(checkpoint, tmp_path / "elsewhere" / "copied")
    (copy / "train_config.json").write_text('{"job": "another"}')
    (copy / "README.md").write_text("a card")
    run(out, copy)
    assert len(taken) == STEPS
    run(tmp_path / "other_out", copy)
    (policy,) = results.read([out, tmp_path / "other_out"])
    assert len(policy.rows) == 1


@pytest.mark.slow
def test_one_name_is_not_given_to_two_policies(tmp_path: Path, taken: list[float]) -> None:
    one, two = (checkpoints.save(tmp_path / f"policy_{action}", action) for action in (0.1, 0.2))
    run(tmp_path / "one", one, "act")
    with pytest.raises(PipelineError, match="two policies have the name 'act'") as caught:
        run(tmp_path / "one", two, "act")
    assert "--label" in str(caught.value)
    assert len(taken) == STEPS, "it says so before anything is run"
    run(tmp_path / "two", two, "act")
    with pytest.raises(PipelineError, match="two policies have the name 'act'") as caught:
        results.read([tmp_path / "one", tmp_path / "two"])
    assert str(tmp_path / "one") in str(caught.value)
    assert str(tmp_path / "two") in str(caught.value)


@pytest.fixture
def next_recipe() -> Iterator[Callable[[], None]]:
    """Makes this the next version, whose episodes are others."""
    with pytest.MonkeyPatch.context() as patch:

        def change() -> None:
            patch.setitem(identity.RECIPES, "evaluation", identity.RECIPES["evaluation"] + 1)
            identity._parts.cache_clear()

        yield change
    identity._parts.cache_clear()


@pytest.mark.slow
def test_results_of_other_versions_are_made_again_where_that_is_asked_for(
    tmp_path: Path, taken: list[float], next_recipe: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint, out = checkpoints.save(tmp_path / "policy", 0.1), tmp_path / "out"
    first = run(out, checkpoint)
    (before,) = EpisodeFiles(out).rows()
    number = identity.RECIPES["evaluation"]
    next_recipe()
    monkeypatch.delenv(identity.REMAKE, raising=False)
    told = f"1 episodes, generated with recipe of evaluation {number}, here {number + 1}"
    with pytest.raises(PipelineError, match=rf"{told}(?s:.*)REMAKE=1"):
        run(out, checkpoint)
    assert len(taken) == STEPS, "it says so before anything is run"
    assert EpisodeFiles(out).rows() == [before]
    monkeypatch.setenv(identity.REMAKE, "1")
    second = run(out, checkpoint)
    assert len(taken) == 2 * STEPS
    assert second == first
    assert len(list(EpisodeFiles(out).rows())) == 1, "in the place of the old ones"


@pytest.mark.slow
def test_a_checkpoint_that_changes_during_the_run_stops_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = checkpoints.save(tmp_path / "policy", 0.1)

    def retrained_first(fn: Any, items: Any, description: str) -> Any:
        checkpoints.retrain(checkpoint, 0.2)
        return loop(fn, items, description)

    policy = PolicyConfig(kind="checkpoint", address=str(checkpoint))
    with pytest.raises(PipelineError, match="has changed since the evaluation began"):
        evaluate(evaluation(policy, tmp_path / "out"), CHOSEN, retrained_first)
    assert not list(EpisodeFiles(tmp_path / "out").rows())


@pytest.mark.slow
def test_a_video_shows_what_the_policy_does_not_look_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(STEP_LIMITS, STOVE.suite, 20)
    chosen = CHOSEN.model_copy(update={"episodes": 2})
    evaluate(replace(evaluation(PolicyConfig(kind="open_loop"), tmp_path), videos="all"), chosen, loop)
    assert "evaluate, episodes: 2/2, " in capsys.readouterr().err, "progress is counted in episodes"
    for row in EpisodeFiles(tmp_path).rows():
        assert row.looks == 0
        with av.open(str(EpisodeFiles(tmp_path).video(row.episode))) as video:
            assert [round(frame.time * 20) for frame in video.decode(video=0)] == [0, 8, 16, 20]


@pytest.mark.slow
def test_a_policy_that_samples_random_numbers_samples_them_by_the_task(tmp_path: Path) -> None:
    """So that an episode's result depends neither on those before it nor on the worker. It sees what lerobot's datasets
    hand out: the agent view at its own size, channels first, from 0 to 1."""
    policy = Checkpoint(checkpoints.save_random(tmp_path / "policy"))
    one, other = select(CHOSEN.model_copy(update={"episodes": 2}))
    small = np.resize(np.arange(251, dtype=np.uint8), (64, 64, 3))
    shown = {
        "images": {"agentview": small.repeat(4, axis=0).repeat(4, axis=1), "wrist": np.zeros((256, 256, 3), np.uint8)},
        "states": np.zeros(8, np.float32),
        "task_description": "",
    }

    def actions(task: EvaluationTask) -> list[list[float]]:
        policy.begin(task)
        return [policy.act(lambda _: shown).tolist()[0] for _ in range(2)]

    first = actions(one)
    assert first != actions(other)
    assert actions(one) == first
    seen: dict[str, Any] = {}
    processed = policy._before
    policy._before = lambda batch: processed(seen.setdefault("batch", batch))
    actions(one)
    image = seen["batch"]["observation.images.image"].numpy()
    np.testing.assert_array_equal(image[0], small.transpose(2, 0, 1).astype(np.float32) / 255)


def test_what_a_lost_worker_leaves_has_no_result(tmp_path: Path) -> None:
    tasks = tuple(select(CHOSEN.model_copy(update={"episodes": 2})))
    replayed = evaluation(PolicyConfig(kind="open_loop"), tmp_path)
    job = EvaluationJob(replayed, tasks, "")
    assert job.size() == 2
    assert job.limit_s() > 3600
    assert job.lost() == dict.fromkeys(tasks, "worker_lost")
    episode, versions = replayed.episode(tasks[0]), replayed.versions(tasks[0])
    EpisodeFiles(tmp_path).save(result(tasks[0], episode=episode, versions=versions))
    assert job.lost() == {tasks[1]: "worker_lost"}


def test_a_perturbation_that_is_sampled_otherwise_now_is_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where its name stays; and said once, not for each task."""
    chosen = CHOSEN.model_copy(update={"source": "own", "axes": ("camera",), "levels": (4,), "episodes": 9})
    tasks = select(chosen)
    replayed = evaluation(PolicyConfig(kind="open_loop"), tmp_path)
    for task in tasks:
        EpisodeFiles(tmp_path).save(result(task, episode=replayed.episode(task), versions=replayed.versions(task)))
    replayed.check(tasks)
    assert all(replayed.result(task) for task in tasks)
    ranges = CameraAxis(spherical=SphericalRange(elevation_deg=((0.0, 1.0),)))
    monkeypatch.setattr(held_out, "held_out_axis", lambda _: ranges)
    assert select(chosen) == tasks
    changed = sum(replayed.result(task) is None for task in tasks)
    assert 0 < changed < len(tasks), "of one component alone"
    with pytest.raises(PipelineError, match=rf"again: {changed} episodes, generated with other draws\n"):
        replayed.check(tasks)


def test_results_of_a_renamed_component_still_count(tmp_path: Path) -> None:
    """The blur was called gaussian; its results are named and read as before."""
    chosen = CHOSEN.model_copy(update={"source": "libero_plus", "components": ("gaussian_blur",), "subset": 1})
    (task,) = select(chosen)
    former = replace(task, component="gaussian")
    replayed = evaluation(PolicyConfig(kind="open_loop"), tmp_path)
    assert replayed.episode(former) == replayed.episode(task)
    EpisodeFiles(tmp_path).save(result(former, episode=replayed.episode(former), versions=replayed.versions(task)))
    stored = replayed.result(task)
    assert stored is not None
    assert stored.component == "gaussian_blur"


def test_a_folder_has_frames_of_one_device(tmp_path: Path) -> None:
    (task,) = select(CHOSEN)
    replayed = evaluation(PolicyConfig(kind="open_loop"), tmp_path)
    versions = replayed.versions(task) | {"OpenGL": "another GPU"}
    EpisodeFiles(tmp_path).save(result(task, episode=replayed.episode(task), versions=versions))
    with pytest.raises(PipelineError, match=r"1 episodes, generated with OpenGL another GPU, here (?s:.*)REMAKE=1"):
        replayed.check([task])


def test_results_without_an_identity_are_rejected(tmp_path: Path) -> None:
    """As the versions before wrote them."""
    old = {"episode": "a", "source": "libero", "policy": "policy", "settings": {}, "success": True, "reason": "success"}
    file = EpisodeFiles(tmp_path).path("a")
    file.parent.mkdir()
    file.write_text(json.dumps(old))
    for use in (lambda: results.read([tmp_path]), lambda: run(tmp_path, checkpoints.save(tmp_path / "policy", 0.1))):
        with pytest.raises(PipelineError, match="not a result of this version") as caught:
            use()
        assert "a.json" in str(caught.value)
        assert "another folder" in str(caught.value)


def test_a_server_needs_a_label(tmp_path: Path) -> None:
    policy = PolicyConfig(kind="server", address="ws://localhost:1")
    with pytest.raises(PipelineError, match="no label") as caught:
        evaluate(evaluation(policy, tmp_path), CHOSEN, loop)
    assert "--label" in str(caught.value)


@pytest.mark.slow
def test_a_server_that_is_shown_something_else_is_not_counted_as_the_same(tmp_path: Path) -> None:
    """One label for two servers, of which the second looks at the state too."""
    server = ("-m", "pipeline.evaluation.harness", "--args.tracked")
    with running(*server, "false") as address:
        policy = PolicyConfig(kind="server", address=address, label="act")
        found = evaluate(evaluation(policy, tmp_path), CHOSEN, loop)
    assert found["settings"] | {"state": False, "images": True} == found["settings"]
    assert found["policy"] == {"name": "act", "identity": "claimed:act"}
    more = CHOSEN.model_copy(update={"episodes": 2})
    with running(*server, "true") as address, pytest.raises(PipelineError, match="several policies or settings: state"):
        evaluate(evaluation(PolicyConfig(kind="server", address=address, label="act"), tmp_path), more, loop)
    assert json.loads((tmp_path / "summary.json").read_text()) == found, "no summary of both together"
    assert {policy.name for policy in results.read([tmp_path])} == {"act, state False", "act, state True"}


def test_what_a_policy_does_not_use_is_no_setting_of_its_results(tmp_path: Path) -> None:
    policy = PolicyConfig(kind="open_loop")
    with pytest.raises(PipelineError, match="look_every"):
        evaluate(evaluation(policy, tmp_path, EpisodeSettings(look_every=8)), CHOSEN, loop)
    plan = tmp_path / "plan.parquet"
    with pytest.raises(PipelineError, match="cannot be read"):
        evaluate(evaluation(policy, tmp_path, EpisodeSettings(plan=plan)), CHOSEN, loop)
    plan.touch()
    with pytest.raises(PipelineError, match="plan"):
        evaluate(evaluation(policy, tmp_path, EpisodeSettings(plan=plan)), CHOSEN, loop)
    with pytest.raises(PipelineError, match="seed"):
        evaluate(evaluation(policy, tmp_path, EpisodeSettings(seed=1)), CHOSEN, loop)
    with pytest.raises(PipelineError, match="instruction of the benchmark"):
        evaluate(evaluation(policy, tmp_path, EpisodeSettings(prompt="benchmark")), CHOSEN, loop)
    with pytest.raises(PipelineError, match="only in libero_spatial"):
        evaluate(evaluation(policy, tmp_path, EpisodeSettings(step_limits="lerobot")), CHOSEN, loop)


@pytest.mark.parametrize(
    ("tasks", "told"),
    [
        (
            [EvaluationTask("libero_plus", STOVE.suite, STOVE.name, "a", "camera", "", 1, 0)],
            "tasks of libero_plus do not start",
        ),
        ([EvaluationTask("goals", STOVE.suite, STOVE.name, "a", "goal", "", 0, 0)], "tasks of goals do not start"),
        ([libero_task(STOVE, 0), libero_task(STOVE, 1)], "1 of 2 episodes of libero_goal/.* would be repetitions"),
    ],
    ids=["test tasks", "goals", "libero"],
)
def test_a_demonstrations_start_is_one_a_task_and_not_every_tasks(tasks: list[EvaluationTask], told: str) -> None:
    settings = EpisodeSettings(initial_states="demonstration")
    with pytest.raises(PipelineError, match=told) as caught:
        check_settings(CHOSEN, tasks, settings)
    assert "leave --initial-states out" in str(caught.value)
    held_out_tasks = [replace(libero_task(STOVE, number), source="own", axis="robot") for number in (0, 1)]
    check_settings(CHOSEN, [libero_task(STOVE, 0), *held_out_tasks], settings)


def test_a_list_without_held_out_perturbations_is_not_compared_with_a_plan(tmp_path: Path) -> None:
    plan = tmp_path / "plan.parquet"
    plan.touch()
    with pytest.raises(PipelineError, match="no task has held-out perturbations"):
        check_settings(Selection(file=tmp_path), [libero_task(STOVE, 0)], EpisodeSettings(plan=plan))
