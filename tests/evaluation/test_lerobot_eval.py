"""lerobot-eval sees what LIBERO's own environment shows, and each of its episodes is one row."""

import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import checkpoints
import numpy as np
import pytest
from lerobot.configs.parser import get_cli_overrides, parse_arg
from libero_environment import OffScreenRenderEnv
from short_demonstrations import STOVE

from pipeline.errors import PipelineError
from pipeline.evaluation import environment
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.gym_environment import PerturbedLiberoEnv, identity_options
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.results import read, reject_different, stored
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import libero_states
from pipeline.libero.tasks import STEP_LIMITS, tasks
from pipeline.seeding import rng
from pipeline.types import Task

ACTIONS = rng("test_lerobot_eval").uniform(-1, 1, (5, 7))


def as_lerobot(env: Any, raw: dict[str, Any]) -> dict[str, Any]:
    """LIBERO's observation as ``LiberoEnv._format_raw_obs`` of lerobot 0.6.1 returns it, by its keys."""
    return {
        "image": raw["agentview_image"],
        "image2": raw["robot0_eye_in_hand_image"],
        "eef/pos": raw["robot0_eef_pos"],
        "eef/quat": raw["robot0_eef_quat"],
        "eef/mat": env.robots[0].controller.ee_ori_mat.copy(),
        "gripper/qpos": raw["robot0_gripper_qpos"],
        "gripper/qvel": raw["robot0_gripper_qvel"],
        "joints/pos": raw["robot0_joint_pos"],
        "joints/vel": raw["robot0_joint_vel"],
    }


def liberos(task: Task) -> list[tuple[Any, dict[str, Any]]]:
    """State and observation of LIBERO's own environment after settling and after each action, as lerobot takes them."""
    # All of them at once: robosuite renders into whichever OpenGL context is current.
    env = OffScreenRenderEnv(bddl_file_name=str(task.bddl_file), camera_heights=256, camera_widths=256)
    env.seed(0)
    env.reset()
    raw = env.set_init_state(libero_states(task)[0])
    for _ in range(10):
        raw, *_ = env.step([0, 0, 0, 0, 0, 0, -1])
    seen = [(env.get_sim_state(), as_lerobot(env, raw))]
    for action in ACTIONS:
        raw, *_ = env.step([*action[:6], np.sign(action[6])])
        seen.append((env.get_sim_state(), as_lerobot(env, raw)))
    env.close()
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["libero_object", "libero_10"])
def test_actions_are_seen_as_in_liberos_own_environment(suite: str) -> None:
    """On the floor and in the living room; on the table of libero_goal, test_evaluation.py compares bit for bit."""
    task = tasks(suite)[0]
    shown = liberos(task)
    ours = PerturbedLiberoEnv(select(Selection(suites=(suite,), tasks=(task.name,))), EpisodeSettings())
    seen, _ = ours.reset(seed=1000)
    for step, (state, expected) in enumerate(shown):
        if step:
            seen, *_ = ours.step(ACTIONS[step - 1])
        # In libero_object the last bits of velocities differ, by 1e-16.
        np.testing.assert_allclose(ours._environment.simulator.state, state, rtol=0, atol=1e-12, err_msg=str(step))
        assert ours.observation_space.contains(seen)
        robot = seen["robot_state"]
        flat = {f"{part}/{name}": value for part, values in robot.items() for name, value in values.items()}
        for name, value in (seen["pixels"] | flat).items():
            if name in seen["pixels"]:
                assert np.array_equal(value, expected[name]), (step, name)
            else:  # positions have the digits of float32, which lerobot's processor leaves of them
                np.testing.assert_allclose(value, expected[name], rtol=1e-6, atol=1e-7, err_msg=f"{step} {name}")
        assert np.array_equal(ours.render(), expected["image"][::-1, ::-1])
    assert ours.task_description == task.instruction
    ours.close()


@pytest.mark.slow
def test_environments_share_episodes_and_each_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STEP_LIMITS, STOVE.suite, 2)
    policy = PolicyConfig(kind="checkpoint", address=str(checkpoints.save(tmp_path / "act", 0.0)), label="act")
    settings = EpisodeSettings(runner="lerobot-eval")
    evaluation = Evaluation(settings, policy, policy.identity(), tmp_path / "rows")
    listed = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,), episodes=3))
    sharing = [PerturbedLiberoEnv(listed, settings, first, 2, (32, 48), evaluation) for first in range(2)]
    stoves_m = {}
    for _ in range(2):
        for env in sharing:
            seen, _ = env.reset()
            simulator, number = env._environment.simulator, env._environment.episode.task.number
            bowl = 1 + simulator.model.joint("akita_black_bowl_1_joint0").qposadr[0]
            np.testing.assert_allclose(
                simulator.state[bowl:][:2], libero_states(STOVE)[number, bowl:][:2], atol=2e-3, err_msg=str(number)
            )
            stoves_m[number] = tuple(simulator.pose("flat_stove_1")[:2])
            assert seen["pixels"]["image2"].shape == (32, 48, 3)
            done = False
            while not done:
                _, _, terminated, done, info = env.step(np.zeros(7, np.float32))
                assert not terminated
                assert not info["is_success"]
    with pytest.raises(PipelineError, match=r"eval\.n_episodes=3"):
        sharing[0].reset()
    # The fourth episode only fills the last round.
    rows = {row.number: row for row, _ in stored([evaluation.folder])}
    assert [(row.steps, row.looks, row.reason) for row in rows.values()] == [(2, 3, "step_limit")] * 3
    assert sorted(rows) == [0, 1, 2]
    assert len({*stoves_m.values()}) == 3, "LIBERO's reset of each number places fixtures of its own"
    assert rows[0].identity == evaluation.identity
    assert rows[0].versions["lerobot"] == version("lerobot")
    (read_back,) = read([evaluation.folder])
    assert read_back.settings["runner"] == "lerobot-eval"
    for env in sharing:
        env.close()


@pytest.mark.slow
def test_options_that_change_the_policy_are_part_of_its_identity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def identity_of(*words: str, size_px: tuple[int, int] = (256, 256)) -> str:
        command = [f"--policy.path={tmp_path}", "--env.type=perturbed_libero", *words]
        return identity_options(
            get_cli_overrides("policy", command) or (), parse_arg("rename_map", command), size_px=size_px
        )

    assert identity_of() == identity_of("--policy.device=cpu") == ""
    # As lerobot 0.6.1 returns an option and its value in two words.
    assert identity_options(["--n_action_steps", "5", "--device", "cuda"], None, (256, 256)) == identity_of(
        "--policy.n_action_steps=5"
    )
    both = ["--policy.n_action_steps=5", "--policy.temporal_ensemble_coeff=0.01"]
    assert identity_of(*both) == identity_of(*both[::-1]) == f" {both[0][2:]} {both[1][2:]}"
    assert identity_of("--rename_map={}", size_px=(360, 360)) == " observation=360x360 rename_map={}"
    # Results of both under one label are rejected.
    policy = PolicyConfig(kind="checkpoint", address=str(checkpoints.save(tmp_path / "act", 0.0)), label="act")
    settings, rows = EpisodeSettings(runner="lerobot-eval"), tmp_path / "rows"
    listed = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))
    monkeypatch.setitem(STEP_LIMITS, STOVE.suite, 1)
    env = PerturbedLiberoEnv(listed, settings, evaluation=Evaluation(settings, policy, policy.identity(), rows))
    env.reset()
    env.step(np.zeros(7, np.float32))
    env.close()
    with_options = Evaluation(settings, policy, policy.identity() + identity_of(both[0]), rows)
    with pytest.raises(PipelineError, match=r"two policies have the name 'act'(?s:.*)n_action_steps=5"):
        with_options.check(listed)


@pytest.mark.slow
def test_limits_of_openvla_and_lerobot_are_not_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STEP_LIMITS, "libero_spatial", 1)
    monkeypatch.setattr(environment, "LEROBOT_SPATIAL", 2)
    policy = PolicyConfig(kind="open_loop")
    listed = select(Selection(suites=("libero_spatial",)))[:1]
    for whose in ("openvla", "lerobot"):
        settings = EpisodeSettings.model_validate({"step_limits": whose})
        evaluation = Evaluation(settings, policy, policy.identity(), tmp_path / whose)
        env = PerturbedLiberoEnv(listed, settings, evaluation=evaluation)
        env.reset()
        while not any(env.step(np.zeros(7, np.float32))[2:4]):
            pass
        env.close()
    both = stored([tmp_path / "openvla", tmp_path / "lerobot"])
    assert [row.step_limit for row, _ in both] == [1, 2]
    assert both[0][0].episode != both[1][0].episode
    with pytest.raises(PipelineError, match="step_limit 1 and 2"):
        reject_different(both)
    reject_different(both, across=["step_limit"])


def test_it_registers_where_lerobot_takes_environments() -> None:
    name = "pipeline.evaluation.lerobot_eval"
    if sys.version_info < (3, 12):  # with lerobot 0.4.4
        with pytest.raises(ImportError, match=r"use lerobot 0\.6"):
            import_module(name)
        return
    config = import_module(name).PerturbedLibero(observation_height=224, observation_width=224)
    own = import_module("lerobot.envs.configs").LiberoEnv(observation_height=224, observation_width=224)
    assert config.type == "perturbed_libero"
    assert (config.features, config.features_map) == (own.features, own.features_map)
    with pytest.raises(PipelineError, match=r"different numbers of episodes: libero_goal 4\d\d, libero_spatial 3\d\d"):
        import_module(name).PerturbedLibero(
            task="libero_goal,libero_spatial", source="libero_plus", axes=["camera"]
        ).create_envs(1)
    with pytest.raises(PipelineError, match="no source"):
        import_module(name).PerturbedLibero(source="own").create_envs(1)
