"""A policy that fails costs the episode that it fails in, and a checkpoint of lerobot's is run as lerobot runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import REPOSITORY
from test_evaluation import rows

from pipeline.errors import PipelineError
from pipeline.evaluation.evaluate import PolicyConfig, _environment, evaluate
from pipeline.evaluation.policies import PolicyError, checked_actions
from pipeline.evaluation.replay_server import running
from pipeline.evaluation.settings import Settings
from pipeline.evaluation.tasks import Selection
from pipeline.run.compute import loop

MILK_THEN_STOVE = Selection(suites=("libero_object", "libero_goal"), tasks=("pick_up_the_milk*", "turn_on*"))
FAULTY_SERVER = str(REPOSITORY / "tests" / "faulty_server.py")
RECORDED = Settings(initial_states="demonstration")


def test_answers_are_checked_before_any_is_taken() -> None:
    assert checked_actions([0.0] * 7, "policy").shape == (1, 7)
    assert checked_actions(np.zeros((8, 7), np.float32), "policy").shape == (8, 7)
    for answer in (None, "left", [[0.0] * 7, [0.0] * 6], np.zeros((2, 6)), np.zeros((0, 7)), [np.inf] * 7):
        with pytest.raises(PolicyError, match="policy"):
            checked_actions(answer, "policy")


@pytest.fixture(scope="module", autouse=True)
def memory_given_back() -> Iterator[None]:
    """A process keeps its environment for the next evaluation."""
    yield
    _environment(RECORDED, None).close()


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "message"), [("hang", "within 10 s"), ("raise", "no such camera")])
def test_other_episodes_are_run_when_one_gets_no_action(tmp_path: Path, fault: str, message: str) -> None:
    with running(FAULTY_SERVER, "--args.fault", fault) as address:
        policy = PolicyConfig(kind="server", address=address, label="faulty", timeout_s=10)
        with pytest.raises(PipelineError, match=f"(?s)1 episodes have no result.*{message}.*milk"):
            evaluate(MILK_THEN_STOVE, RECORDED, policy, tmp_path, loop)
    (row,) = rows(tmp_path).values()
    assert row["base"] == "turn_on_the_stove"
    assert row["success"]
    assert json.loads((tmp_path / "summary.json").read_text())["all"]["episodes"] == 1


@pytest.mark.slow
def test_a_server_that_dies_ends_the_run(tmp_path: Path) -> None:
    suites = ["--suite", *MILK_THEN_STOVE.suites, "--task", *MILK_THEN_STOVE.tasks]
    options = ["--initial-states", "demonstration", "--workers", "1"]
    with running(FAULTY_SERVER, "--args.fault", "die") as address:
        command = [sys.executable, "-m", "pipeline", "evaluate", str(tmp_path), *suites, *options, "--server", address]
        stopped = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert stopped.returncode == 1
    assert "Traceback" not in stopped.stderr
    assert "run the same command again" in stopped.stderr
    assert not any(row["base"].startswith("pick_up_the_milk") for row in rows(tmp_path).values())


@pytest.mark.slow
def test_a_policy_that_lerobot_saved_looks_once_in_its_chunk(tmp_path: Path) -> None:
    checkpoint = untrained_act(tmp_path / "pretrained_model", n_action_steps=40)
    command = [sys.executable, "-m", "pipeline", "evaluate", str(tmp_path / "results"), "--checkpoint", str(checkpoint)]
    chosen = ["--suite", "libero_spatial", "--task", "*next_to_the_plate*", "--workers", "1"]
    subprocess.run([*command, *chosen], cwd=REPOSITORY, check=True)
    (row,) = rows(tmp_path / "results").values()
    assert (row["reason"], row["steps"], row["looks"]) == ("step_limit", 220, 6)
    assert row["policy"] == str(checkpoint)


def untrained_act(folder: Path, n_action_steps: int) -> Path:
    """A small ACT policy with random weights, saved as lerobot's training saves it."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    shapes: dict[str, tuple[int, ...]]
    shapes = {"observation.images.image": (3, 256, 256), "observation.images.image2": (3, 256, 256)}
    inputs = {key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in shapes.items()}
    config = ACTConfig(
        input_features={**inputs, "observation.state": PolicyFeature(FeatureType.STATE, (8,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        chunk_size=50,
        n_action_steps=n_action_steps,
        dim_model=64,
        n_heads=2,
        dim_feedforward=64,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    shapes |= {"observation.state": (8,), "action": (7,)}
    statistics = {key: moments((shape[0], 1, 1) if len(shape) == 3 else shape) for key, shape in shapes.items()}
    ACTPolicy(config).save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=statistics):
        processor.save_pretrained(folder)
    return folder


def moments(shape: tuple[int, ...]) -> dict[str, Any]:
    return {"mean": np.zeros(shape, np.float32), "std": np.ones(shape, np.float32)}
