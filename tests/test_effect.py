"""The experiment that shows what the data is worth: what an arm holds, what the table says, and one from end to end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import REPOSITORY, STOVE, link_testset, tiny_config

from pipeline.errors import PipelineError

EFFECT = REPOSITORY / "benchmarks" / "effect"
sys.path.append(str(EFFECT))

from arms import chosen, provenance  # noqa: E402
from comparison_table import markdown, table  # noqa: E402
from experiment import TrainingConfig, read  # noqa: E402
from training import train  # noqa: E402


def episode(number: int, demo: int, axis: str, task: str = "stove") -> dict[str, Any]:
    return {
        "episode_index": number,
        "episode_id": f"{task} {number}",
        "suite": "libero_goal",
        "task": task,
        "demo_id": f"{task} {demo}",
        "axis": axis,
    }


ROWS = [
    *(episode(demo, demo, "clean") for demo in range(3)),
    episode(3, 0, "camera"),
    episode(4, 1, "camera+light"),
    *(episode(number, number, "clean", "bowl") for number in (5, 6)),
]


@pytest.mark.parametrize(
    ("perturbed_by", "numbers"),
    [
        ((), [0, 1, 2, 5, 6]),
        (("camera",), [1, 2, 3, 5, 6]),
        (("camera", "camera+light"), [2, 3, 4, 5, 6]),
    ],
)
def test_all_arms_have_as_many_episodes_of_each_task(perturbed_by: tuple[str, ...], numbers: list[int]) -> None:
    """Clean twins come first from demonstrations that the arm has nothing else of."""
    assert [row["episode_index"] for row in chosen(ROWS, perturbed_by)] == numbers


def test_more_perturbed_episodes_than_clean_ones_are_refused() -> None:
    with pytest.raises(PipelineError, match="3 perturbed episodes and 2 clean ones"):
        chosen([*ROWS, *(episode(number, 5, "light", "bowl") for number in (7, 8, 9))], ("light",))


@pytest.mark.parametrize("name", ["two_cores", "one_episode"])
def test_the_experiments_can_be_read(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    experiment = read(EFFECT / f"{name}.yaml")
    assert experiment.dataset_name("clean") == read(EFFECT / f"{name}.yaml").dataset_name("clean")


def result(axis: str, number: int, success: bool) -> dict[str, Any]:
    return {"source": "own", "suite": "libero_goal", "name": f"{axis} {number}", "seed": 0, "axis": axis} | {
        "success": success
    }


def test_the_table_pairs_episodes_seed_by_seed() -> None:
    """Of ten episodes the first arm solves four, the second these and five more: p = 2 / 2**5."""
    first = [result("light", number, number < 2) for number in range(5)]
    second = [result("light", number, True) for number in range(4)] + [result("light", 4, False)]
    (line,) = table({"clean": [first, first], "perturbed": [second, [*second[:4], result("light", 4, True)]]})
    assert line["arms"]["clean"]["successes"] == 4
    assert line["arms"]["perturbed"]["successes"] == 9
    assert line["p_values"] == {"perturbed": 2 / 2**5}
    # Wilson's interval of 4 in 10: (0.4 + 0.19207) / 1.38415 and 0.25958 to either side.
    assert "| light | own draws | 10 | 40 % (17-69) | 90 % (60-98) | 0.062 |" in markdown([line])


def small_experiment(folder: Path, demos: Path) -> Path:
    """A run of the stove's short demonstration, and an experiment of two steps on it."""
    run = tiny_config(demos) | {"name": "effect_tiny"}
    run["demos"] = {"source": "hdf5", "root": str(demos), "tasks": [f"{STOVE.suite}/{STOVE.name}"]}
    run["plan"] = {"seed": 7, "axes": {"noise": {}}, "episodes": {"noise": 1}}
    (folder / "data.yaml").write_text(yaml.safe_dump(run))
    experiment = {
        "data": "data.yaml",
        "arms": {"perturbed": ["noise"]},
        "frame_px": 32,
        "policy": {
            **{"type": "act", "pretrained_backbone_weights": None, "chunk_size": 100, "n_action_steps": 100},
            **{"dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "n_encoder_layers": 1, "use_vae": False},
        },
        "training": {"steps": 2, "batch_size": 2, "save_every": 1},
        "seeds": [0],
        "evaluation": {"episodes": 1},
    }
    file = folder / "experiment.yaml"
    file.write_text(yaml.safe_dump(experiment))
    link_testset(folder)
    return file


@pytest.mark.slow
def test_from_demonstrations_to_the_table(short_demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = small_experiment(tmp_path, short_demos)
    command = [sys.executable, str(EFFECT), str(file), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["episodes_by_axis"] == {"perturbed": {"noise": 1}}
    (line,) = found["table"]
    assert (line["source"], line["axis"], line["arms"]["perturbed"]["episodes"]) == ("libero", "clean", 1)
    assert {*found["hours"]} == {"data", "training", "evaluation"}

    # A training that was stopped goes on from its last checkpoint.
    monkeypatch.chdir(tmp_path)
    experiment = read(file)
    dataset = tmp_path / "out" / "datasets" / experiment.dataset_name("perturbed")
    assert [row["axis"] for row in provenance(dataset)] == ["noise"]
    commands: list[list[str]] = []

    def stopped(command: list[str]) -> None:
        """Only the first step."""
        commands.append(command)
        environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
        subprocess.run([word.replace("--steps=2", "--steps=1") for word in command], env=environment, check=True)
        raise KeyboardInterrupt

    def whole(command: list[str]) -> None:
        commands.append(command)
        subprocess.run(command, env={**os.environ, "HF_HUB_OFFLINE": "1"}, check=True)

    trained = tmp_path / "trained"
    for run in (stopped, whole):
        try:
            train(dataset, trained, experiment.policy, TrainingConfig(steps=2, batch_size=2, save_every=1), 0, run)
        except KeyboardInterrupt:
            assert not trained.exists()
    assert "--resume=true" in commands[1]
    assert json.loads((trained / "train_config.json").read_text())["steps"] == 2
