"""Episodes are LIBERO's own: the same start, states and frames, whatever was run before and however it is spread."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import av
import numpy as np
import pandas as pd
import pytest
from checkout import REPOSITORY
from episode_results import result
from libero_environment import OffScreenRenderEnv, transform
from numpy.typing import NDArray
from server_process import replaying
from short_demonstrations import STOVE
from vla_eval.rotation import matrix_to_quat, quat_to_axisangle

from pipeline.__main__ import main
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.corruptions import Gaussian
from pipeline.axes.noise import NoisePerturbation
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.evaluate import _open_environment
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.simulator import Simulator
from pipeline.evaluation.statistics import summary
from pipeline.evaluation.tasks import EvaluationTask, libero_states
from pipeline.images.jpeg import to_policy
from pipeline.physics.control_env import control_env
from pipeline.seeding import rng
from pipeline.testset.benchmark import load

ACTIONS = rng("test_evaluation").uniform(-1, 1, (4, 7))
FIRST = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))[0]


@pytest.fixture(scope="module")
def libero() -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:  # type: ignore[type-arg]
    """State and observation after settling and after each action, by LIBERO's own code as OpenVLA evaluates.

    The observation also has ``controller_states``, as vla-eval's class for LIBERO computes them.
    """
    env = OffScreenRenderEnv(bddl_file_name=str(STOVE.bddl_file), camera_heights=256, camera_widths=256)
    env.seed(0)
    env.reset()
    env.set_init_state(libero_states(STOVE)[0])
    for _ in range(10):
        observation, *_ = env.step([0.0] * 6 + [-1.0])
    controller = env.robots[0].controller

    def of_controller() -> NDArray[np.float32]:
        angles = quat_to_axisangle(matrix_to_quat(np.asarray(controller.ee_ori_mat, np.float32)))
        return np.array([*controller.ee_pos, *angles, *observation["robot0_gripper_qpos"]], np.float32)

    seen = [(env.get_sim_state(), {**observation, "controller_states": of_controller()})]
    for action in ACTIONS:
        observation, *_ = env.step([*action[:6], -1.0 if action[6] < 0 else 1.0])
        seen.append((env.get_sim_state(), {**observation, "controller_states": of_controller()}))
    env.close()
    return seen


@pytest.fixture(scope="module")
def evaluated() -> Iterator[EpisodeEnvironment]:
    environment = EpisodeEnvironment()
    yield environment
    environment.close()


def some_test_task(axis: str, component: str) -> EvaluationTask:
    selection = Selection(
        source="libero_plus", suites=(STOVE.suite,), axes=(axis,), components=(component,), tasks=(STOVE.name,)
    )
    return select(selection)[0]


@pytest.mark.slow
def test_episodes_are_liberos_bit_for_bit(
    libero: list[tuple[Any, dict[str, Any]]], evaluated: EpisodeEnvironment
) -> None:
    turned_over = 0
    for _ in range(2):  # the second from what the first left behind
        evaluated.reset(FIRST)
        for step, (state, theirs) in enumerate(libero):
            if step:
                evaluated.step(ACTIONS[step - 1])
            assert np.array_equal(evaluated.simulator.state, state), f"state at step {step}"
            quat_xyzw = theirs["robot0_eef_quat"].copy()
            shortest = evaluated.observation(Wanted(images=False, shortest_rotation=True))["states"][3:6]
            np.testing.assert_allclose(shortest, quat_to_axisangle(quat_xyzw), atol=1e-5)
            turned_over += quat_xyzw[3] < 0
            ours = evaluated.observation(Wanted())
            expected = [theirs["robot0_eef_pos"], transform.quat2axisangle(quat_xyzw), theirs["robot0_gripper_qpos"]]
            assert np.array_equal(ours["states"], np.concatenate(expected).astype(np.float32))
            np.testing.assert_allclose(ours["controller_states"], theirs["controller_states"], atol=1e-5)
            assert np.array_equal(ours["images"]["agentview"], to_policy(theirs["agentview_image"])), step
            assert np.array_equal(ours["images"]["wrist"], to_policy(theirs["robot0_eye_in_hand_image"])), step
        assert ours["task_description"] == STOVE.instruction
    assert turned_over, "the angle is above pi somewhere"


@pytest.mark.slow
def test_what_mujoco_resets_by_itself_ends_the_episode(evaluated: EpisodeEnvironment) -> None:
    evaluated.reset(FIRST)
    evaluated.simulator.sim.data.qvel[-1] = 1e8
    assert evaluated.step(np.zeros(7)).reason == "simulation_unstable"


@pytest.mark.slow
def test_a_test_scene_that_does_not_settle_is_a_failure(
    evaluated: EpisodeEnvironment, monkeypatch: pytest.MonkeyPatch
) -> None:
    (task,) = select(Selection(source="libero_plus", suites=("libero_goal",), axes=("robot",), subset=1))
    settle = Simulator.settle

    def thrown(simulator: Simulator, steps: int) -> None:
        simulator.sim.data.qvel[-1] = 1e8
        settle(simulator, steps)

    monkeypatch.setattr(Simulator, "settle", thrown)
    progress = evaluated.reset(task)
    assert (progress.over, progress.success, progress.reason) == (True, False, "simulation_unstable")
    assert summary([result(task, reason=progress.reason)])["all"]["episodes"] == 1
    own = select(Selection(source="own", suites=("libero_goal",), axes=("robot",), tasks=(STOVE.name,), levels=(1,)))
    assert evaluated.reset(own[0]).reason == "refused"


@pytest.mark.slow
def test_a_camera_task_is_seen_from_the_axis_camera(evaluated: EpisodeEnvironment) -> None:
    task = some_test_task("camera", "spherical")
    evaluated.reset(FIRST)
    clean = evaluated.observation(Wanted())["images"]
    evaluated.reset(task)
    moved = evaluated.observation(Wanted())["images"]
    assert evaluated._picture._opened._renderer is not None
    camera = evaluated._picture._opened._renderer.model.camera("agentview")
    test = load().by_name[task.suite, task.name]
    own = CameraPerturbation.model_validate({"component": test.component, "level": 1, **test.parameters})
    nominal = evaluated.simulator.model.camera("agentview")
    pos_m, quat_wxyz = own.pose(nominal.pos, nominal.quat)
    assert np.abs(camera.pos - pos_m).max() < 1.1e-4
    same_sign = np.sign(camera.quat @ quat_wxyz) * quat_wxyz  # of opposite sign, a quaternion is the same turn
    assert np.abs(camera.quat - same_sign).max() < 1.1e-4
    assert np.array_equal(clean["wrist"], moved["wrist"])
    assert not np.array_equal(clean["agentview"], moved["agentview"])
    evaluated.reset(FIRST)
    assert np.array_equal(evaluated.image("agentview"), clean["agentview"]), "the camera is put back"


@pytest.mark.slow
def test_a_robot_task_starts_at_the_state_and_drifts_to_its_posture(evaluated: EpisodeEnvironment) -> None:
    evaluated.reset(FIRST)
    clean = evaluated.simulator.observed.joint_state
    task = some_test_task("robot", "controller_posture")
    evaluated.reset(task)
    drift_rad = np.linalg.norm(evaluated.simulator.observed.joint_state - clean)
    # The benchmark's postures are 0.1 to 0.5 rad away; ten settling steps reach some of it.
    assert 0.01 < drift_rad < 0.6
    # By LIBERO's own code, with the posture in place of its own.
    env = control_env()(str(STOVE.bddl_file), use_camera_obs=False, has_offscreen_renderer=False)
    number = int(load().by_name[task.suite, task.name].parameters["id"])
    env.env.robot_configs[0]["initial_qpos"] = np.array(libero_plus.postures_rad()[number])
    env.seed(0)
    env.reset()
    env.set_init_state(libero_states(STOVE)[0])
    for _ in range(10):
        env.step([0.0] * 6 + [-1.0])
    assert np.array_equal(evaluated.simulator.state, env.get_sim_state())
    env.close()


@pytest.mark.slow
def test_moved_scenes_noise_and_held_out_perturbations_can_be_seen(evaluated: EpisodeEnvironment) -> None:
    pictures = {}
    for task in (FIRST, some_test_task("noise", "gaussian_blur"), some_test_task("pose", "pose")):
        evaluated.reset(task)
        evaluated.step(np.zeros(7))
        pictures[task.axis] = evaluated.image("agentview").copy()
    chosen = Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot", "light"), levels=(4,))
    for task in select(chosen):
        evaluated.reset(task)
        pictures[f"own {task.axis}"] = evaluated.image("agentview").copy()
    listed = list(pictures.values())
    assert len(pictures) == 5
    assert all(not np.array_equal(one, other) for at, one in enumerate(listed) for other in listed[:at])


class WristNoise(NoisePerturbation):
    """Noise of the other view than the shipped axis changes."""

    views: ClassVar[frozenset[str]] = frozenset({"wrist_image"})


@pytest.mark.slow
def test_noise_changes_the_views_that_it_names(evaluated: EpisodeEnvironment) -> None:
    evaluated.reset(FIRST)
    clean = evaluated.observation(Wanted())["images"]
    for kind, noisy in ((NoisePerturbation, "agentview"), (WristNoise, "wrist")):
        evaluated.reset(FIRST)
        noise = kind(component="gaussian_blur", effect=Gaussian(sigma_px=3), level=1, seed=0)
        evaluated._picture.show(evaluated.simulator.model, (noise,))
        seen = evaluated.observation(Wanted())["images"]
        assert {view for view in clean if not np.array_equal(seen[view], clean[view])} == {noisy}


@pytest.mark.slow
def test_a_scene_whose_first_sample_has_no_place_for_an_object_is_sampled_again(evaluated: EpisodeEnvironment) -> None:
    name = "pick_up_the_milk_and_place_it_in_the_basket_level4_sample3"
    (crowded,) = select(Selection(source="libero_plus", suites=("libero_object",), tasks=(name,)))
    assert not evaluated.reset(crowded).over


@pytest.mark.slow
@pytest.mark.parametrize(
    ("action", "message"),
    [(np.zeros(6), "shape"), (np.full(7, np.nan), "NaN"), (["left"] * 7, "not numbers")],
)
def test_bad_actions_are_rejected(evaluated: EpisodeEnvironment, action: Any, message: str) -> None:
    evaluated.reset(FIRST)
    with pytest.raises(PipelineError, match=message):
        evaluated.step(action)


OTHER_SUITE = ["--suite", "libero_object"]


def command(out: Path, *arguments: str) -> list[str]:
    shared = ["--suite", "libero_goal", "--task", "turn_on*", "--task", "pick_up_the_milk*"]
    start = ["--initial-states", "demonstration"]
    return [sys.executable, "-m", "pipeline", "evaluate", str(out), *shared, *start, *arguments]


Evaluate = Callable[..., None]
"""The command in this process, which keeps its environment from one to the next."""


@pytest.fixture(scope="module")
def evaluate_here() -> Iterator[Evaluate]:
    def run(out: Path, *arguments: str) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", command(out, *arguments, "--workers", "1")[2:])
            assert main() == 0

    yield run
    _open_environment(EpisodeSettings(initial_states="demonstration"), None).close()
    _open_environment.cache_clear()


def rows(out: Path) -> dict[str, dict[str, Any]]:
    return {path.stem: json.loads(path.read_text()) for path in sorted((out / "episodes").glob("*.json"))}


@pytest.mark.slow
def test_a_killed_evaluation_goes_on_and_workers_do_not_matter(tmp_path: Path, evaluate_here: Evaluate) -> None:
    begun, alone = tmp_path / "begun", tmp_path / "alone"
    killed = subprocess.Popen(command(begun, *OTHER_SUITE, "--replay", "--workers", "1"), cwd=REPOSITORY)
    while killed.poll() is None and not list(begun.glob("episodes/*.json")):
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    first = {path: path.stat().st_mtime_ns for path in begun.glob("episodes/*.json")}
    assert len(first) == 1
    resumed = command(begun, *OTHER_SUITE, "--replay", "--workers", "2", "--videos", "failures")
    subprocess.run(resumed, cwd=REPOSITORY, check=True)
    assert all(path.stat().st_mtime_ns == when for path, when in first.items()), "a finished episode is kept"
    assert not (begun / "videos").exists(), "nothing failed"
    evaluate_here(alone, *OTHER_SUITE, "--replay")
    assert len(rows(alone)) == 2
    assert rows(alone) == rows(begun)
    found = json.loads((begun / "summary.json").read_text())
    assert found["all"]["successes"] == found["all"]["episodes"] == 2
    evaluate_here(begun, "--replay")  # one of the two again, which runs nothing
    assert json.loads((begun / "summary.json").read_text())["all"]["episodes"] == 1
    table = pd.read_csv(begun / "episodes.csv", index_col="episode")
    assert {*table.index} == rows(begun).keys(), "the episodes of both calls"
    for episode, row in rows(begun).items():
        columns = ("source", "suite", "name", "axis", "level", "number", "success", "reason", "steps")
        assert {column: table.loc[episode, column] for column in columns} == {column: row[column] for column in columns}


@pytest.mark.slow
def test_a_model_server_is_evaluated_by_us_and_by_its_harness(tmp_path: Path, evaluate_here: Evaluate) -> None:
    with replaying(8) as address:
        ours = tmp_path / "ours"
        arguments = ["--server", address, "--label", "replay"]
        evaluate_here(ours, *arguments, "--videos", "all")
        ((episode, row),) = rows(ours).items()
        assert row["success"]
        assert row["looks"] == -(-row["steps"] // 8), "a chunk of eight actions takes one look"
        with av.open(str(ours / "videos" / f"{episode}.mp4")) as video:
            steps = [round(frame.time * 20) for frame in video.decode(video=0)]
        assert steps == [*range(0, row["steps"], 8), row["steps"]], "what it looked at, and the end"
        config = tmp_path / "harness.yaml"
        params = {
            "selection": {"suites": ["libero_goal"], "tasks": ["turn_on*"]},
            "settings": {"initial_states": "demonstration"},
            "out": str(tmp_path / "rows"),
            "label": "replay",
        }
        benchmark = {"benchmark": "pipeline.evaluation.harness:PerturbedLibero", "params": params}
        # YAML holds JSON.
        config.write_text(
            json.dumps({"server": {"url": address}, "output_dir": str(tmp_path / "theirs"), "benchmarks": [benchmark]})
        )
        harness = [sys.executable, "-m", "vla_eval.cli.main", "run", "--no-docker", "--config", str(config)]
        done = subprocess.run(harness, cwd=REPOSITORY, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        (result,) = (tmp_path / "theirs").rglob("*.json")
        assert json.loads(result.read_text())["tasks"][0]["episodes"][0]["metrics"]["success"]
        assert rows(tmp_path / "rows") == {episode: row}, "and writes the same of it"


@pytest.mark.slow
def test_a_path_is_followed_by_what_an_observation_has(tmp_path: Path, evaluate_here: Evaluate) -> None:
    evaluate_here(tmp_path, "--replay", "tracked")
    (row,) = rows(tmp_path).values()
    assert row["success"]
    assert row["looks"] == row["steps"], "feedback at every step"
