"""Policies act in the own task of docs/own-tasks.md: from resets, from its recording, and in held-out perturbations."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import own_task
import pytest
from checkout import REPOSITORY
from server_process import running

from pipeline.commands.command_line import run as command
from pipeline.compute.pool import loop
from pipeline.config import load
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.results import EpisodeFiles, EpisodeResult
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.setting_checks import check_settings
from pipeline.libero.tasks import select_tasks
from pipeline.physics.control_env import control_env
from pipeline.types import Task, Trajectory

SUITE = "table"
BOWL, PLATE = "akita_black_bowl_1", "plate_1"
FROM_DEMOS = {"own_step_limit": 150, "initial_states": "demonstration", "demos": Path("data/demos")}


@pytest.fixture(scope="module")
def recorded_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Trajectory]]:
    """A folder with the files of the page and a recording of the task, in which commands run."""
    folder = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        own_task.write_files(folder)
        (task,) = select_tasks([f"{SUITE}/*"])
        trajectory = own_task.recorded(task, load(Path("configs/table.yaml")).replay)
        own_task.write(Path("data/demos") / SUITE / f"{task.name}_demo.hdf5", own_task.content_of(task, trajectory))
        yield folder, trajectory


@pytest.fixture
def task(recorded_folder: tuple[Path, Trajectory]) -> Task:
    (task,) = select_tasks([f"{SUITE}/*"])
    return task


def run(out: Path, settings: dict[str, Any], kind: Any = "open_loop", **selection: Any) -> list[EpisodeResult]:
    """Evaluate a replay of the recording, and return the results."""
    policy = PolicyConfig(kind=kind)
    evaluation = Evaluation(EpisodeSettings.model_validate(settings), policy, policy.identity(), out)
    evaluate(evaluation, Selection.model_validate({"suites": (SUITE,), **selection}), loop)
    return evaluation.files.rows()


def places_of_libero(task: Task, seeds: Sequence[int]) -> list[list[float]]:
    """Places (m) of bowl and plate, x and y each, after a reset of LIBERO's own environment under each seed."""
    environment = control_env()(str(task.bddl_file), use_camera_obs=False, has_offscreen_renderer=False)
    places: list[list[float]] = []
    for seed in seeds:
        environment.seed(seed)
        environment.reset()
        data = environment.sim.data
        places.append([*data.get_joint_qpos(f"{BOWL}_joint0")[:2], *data.get_joint_qpos(f"{PLATE}_joint0")[:2]])
    environment.close()
    return places


@pytest.mark.slow
def test_the_replayed_recording_reaches_the_goal_from_its_own_start(
    recorded_folder: tuple[Path, Trajectory], task: Task, tmp_path: Path
) -> None:
    _, trajectory = recorded_folder
    (row,) = run(tmp_path / "out", FROM_DEMOS)
    assert (row.success, row.suite, row.base, row.step_limit) == (True, SUITE, task.name, 150)
    assert row.instruction == "lay the bowl on the plate"
    assert row.steps <= len(trajectory.actions)
    assert "demos" not in row.settings, "results contain no path"
    environment = EpisodeEnvironment(EpisodeSettings.model_validate(FROM_DEMOS))
    (episode,) = select(Selection(suites=(SUITE,)))
    environment.reset(episode)
    model = environment.simulator.sim.model
    for thing in (BOWL, PLATE):
        place = 1 + model.get_joint_qpos_addr(f"{thing}_joint0")[0]
        recorded_m = trajectory.states[0][place:][:3]
        np.testing.assert_allclose(environment.simulator.pose(thing)[:3], recorded_m, atol=1e-3, err_msg=thing)
    assert environment.image("agentview").std() > 10, "the recorded scene is rendered"
    environment.close()


@pytest.mark.slow
def test_an_episode_begins_where_liberos_own_reset_places_things(task: Task) -> None:
    expected_m = places_of_libero(task, (0, 1))
    environment = EpisodeEnvironment(EpisodeSettings(own_step_limit=150))
    episodes = select(Selection(suites=(SUITE,), episodes=2))
    settled_m: list[list[float]] = []
    for episode in (*episodes, episodes[0]):
        assert environment.reset(episode).reason == "running"
        settled_m.append([*environment.simulator.pose(BOWL)[:2], *environment.simulator.pose(PLATE)[:2]])
    # In the ten settling steps, things fall onto the table.
    np.testing.assert_allclose(settled_m[:2], expected_m, atol=1e-3)
    assert settled_m[2] == settled_m[0], "the number of an episode decides its reset"
    assert np.abs(np.subtract(settled_m[0], settled_m[1])).max() > 5e-3
    environment.close()


@pytest.mark.slow
def test_held_out_perturbations_of_an_own_task_are_run_and_followed(task: Task, tmp_path: Path) -> None:
    rows = run(
        tmp_path / "out",
        {"own_step_limit": 150, "demos": Path("data/demos")},
        "tracked",
        source="own",
        axes=("robot", "noise"),
        levels=(2,),
    )
    assert {row.axis: row.success for row in rows} == {"robot": True, "noise": True}
    assert all(row.perturbations for row in rows)


@pytest.mark.slow
def test_a_model_server_acts_in_an_own_task(
    recorded_folder: tuple[Path, Trajectory], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = REPOSITORY / "examples" / "model_server.py"
    with running(str(example)) as address:
        options = ["--server", address, "--label", "closed_eyes", "--suite", SUITE, "--own-step-limit", "20"]
        assert command(["evaluate", str(tmp_path / "out"), *options, "--workers", "1"]) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    (row,) = EpisodeFiles(tmp_path / "out").rows()
    assert (row.reason, row.steps, row.instruction) == ("step_limit", 20, "lay the bowl on the plate")
    assert last["all"] == {"episodes": 1, "successes": 0, "rate": 0.0, "low": 0.0, "high": 0.7935}


@pytest.mark.parametrize(
    ("settings", "selection", "where", "part"),
    [
        ({}, {}, "own_step_limit", "--own-step-limit N"),
        ({"demos": Path("data/demos")}, {}, "own_step_limit", "longest demonstration of lay_the_bowl_on_the_plate"),
        ({"own_step_limit": 9, "initial_states": "demonstration"}, {}, "demos", "table/lay_the_bowl_on_the_plate_demo"),
        ({"own_step_limit": 9}, {"source": "own", "axes": ("noise",)}, "demos", "add --demos DIR"),
        (FROM_DEMOS, {"episodes": 2}, "initial_states", "set --episodes 1"),
        (FROM_DEMOS | {"demos": Path("data")}, {}, "data/table/lay_the_bowl", "correct --demos"),
        ({"own_step_limit": 9}, {"suites": ("libero_goal",)}, "own_step_limit", "leave --own-step-limit out"),
    ],
)
@pytest.mark.slow
def test_a_setting_that_does_not_fit_own_tasks_is_named(
    task: Task, settings: dict[str, Any], selection: dict[str, Any], where: str, part: str
) -> None:
    chosen = Selection.model_validate({"suites": (SUITE,), **selection})
    with pytest.raises(PipelineError) as caught:
        check_settings(chosen, select(chosen), EpisodeSettings.model_validate(settings))
    assert where in str(caught.value.where)
    assert part in str(caught.value)


@pytest.mark.slow
def test_goals_are_liberos_alone(task: Task) -> None:
    with pytest.raises(PipelineError, match="goals has no 'table'"):
        select(Selection(source="goals", suites=(SUITE,)))


@pytest.mark.slow
def test_a_changed_definition_or_recording_is_noticed(task: Task, tmp_path: Path) -> None:
    policy = PolicyConfig(kind="open_loop")
    (episode,) = select(Selection(suites=(SUITE,)))
    evaluation = Evaluation(EpisodeSettings.model_validate(FROM_DEMOS), policy, policy.identity(), tmp_path)
    before = evaluation.versions(episode)
    text = task.bddl_file.read_text()
    task.bddl_file.write_text(text + "; changed\n")
    try:
        after = evaluation.versions(episode)
    finally:
        task.bddl_file.write_text(text)
    assert before["definition of the task"] != after["definition of the task"]
    file = Path("data/demos") / SUITE / f"{task.name}_demo.hdf5"
    content = file.read_bytes()
    with h5py.File(file, "r+") as recording:
        recording["data/demo_0/actions"][0, 0] += 0.25
    try:
        assert evaluation.versions(episode)["demonstration"] != before["demonstration"]
    finally:
        file.write_bytes(content)
