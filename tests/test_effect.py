"""The experiment that shows what the data is worth: what an arm holds, what the table says, and one from end to end."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import REPOSITORY, STOVE, link_testset, tiny_config
from episode_results import result

from pipeline.errors import PipelineError
from pipeline.evaluation import results
from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.tasks import EvaluationTask

EFFECT = REPOSITORY / "benchmarks" / "effect"
sys.path.append(str(EFFECT))

from arms import chosen  # noqa: E402
from comparison_table import markdown, table  # noqa: E402
from experiment import read  # noqa: E402
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


def light(number: int, success: bool) -> EpisodeResult:
    return result(EvaluationTask("own", "libero_goal", "stove", f"light {number}", "light", "colour", 1, 0), success)


def test_the_table_pairs_episodes_seed_by_seed() -> None:
    """Of ten episodes the first arm solves four, the second these and five more: p = 2 / 2**5."""
    first = [light(number, number < 2) for number in range(5)]
    second = [light(number, True) for number in range(4)] + [light(4, False)]
    (line,) = table({"clean": [first, first], "perturbed": [second, [*second[:4], light(4, True)]]})
    assert line["arms"]["clean"]["successes"] == 4
    assert line["arms"]["perturbed"]["successes"] == 9
    assert line["p_values"] == {"perturbed": 2 / 2**5}
    assert line["differences"]["perturbed"]["value"] == 0.5
    assert line["differences"]["perturbed"]["resampled"] == "5 trials", "both seeds act in the same five"
    # Wilson's interval of 4 in 10: (0.4 + 0.19207) / 1.38415 and 0.25958 to either side.
    assert "| light | own draws | 10 | 40 % (17-69) | 90 % (60-98) | 0.062 |" in markdown([line])


def small_experiment(folder: Path, demos: Path) -> Path:
    """A run of the stove's short demonstration, and an experiment of two steps on it."""
    run = tiny_config(demos) | {"name": "effect_tiny"}
    run["demos"] = {"source": "hdf5", "root": str(demos), "tasks": [f"{STOVE.suite}/{STOVE.name}"]}
    run["plan"] = {"seed": 7, "axes": {"noise": {}}, "episodes": {"noise": 1}}
    run["export"] = {
        "rlds": {"name": "libero_tiny", "shards": 1},
        "lerobot": {"name": "tiny", "shards": 1, "frames": "images"},
    }
    (folder / "data.yaml").write_text(yaml.safe_dump(run))
    experiment = {
        "data": "data.yaml",
        "arms": {"perturbed": ["noise"]},
        "frame_px": 32,
        "policy": {
            **{"type": "act", "pretrained_backbone_weights": None, "chunk_size": 100, "n_action_steps": 40},
            **{"dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "n_encoder_layers": 1, "use_vae": False},
        },
        "training": {
            **{"steps": 2, "batch_size": 2, "save_every": 1},
            **{"learning_rate": 1e-3, "mixed_precision": "bf16", "at_once": 2},
        },
        "seeds": [0],
        "evaluation": {"episodes": 1},
    }
    file = folder / "experiment.yaml"
    file.write_text(yaml.safe_dump(experiment))
    link_testset(folder)
    return file


def test_a_run_with_videos_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = small_experiment(tmp_path, tmp_path / "demos")
    run = yaml.safe_load((tmp_path / "data.yaml").read_text())
    run["export"]["lerobot"]["frames"] = "video"
    (tmp_path / "data.yaml").write_text(yaml.safe_dump(run))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PipelineError, match="write frames: images there"):
        read(file)


@pytest.mark.slow
def test_from_demonstrations_to_the_table(short_demos: Path, tmp_path: Path) -> None:
    file = small_experiment(tmp_path, short_demos)
    command = [sys.executable, str(EFFECT), str(file), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["episodes_by_axis"] == {"perturbed": {"noise": 1}}
    (line,) = found["table"]
    assert (line["source"], line["axis"], line["arms"]["perturbed"]["episodes"]) == ("libero", "clean", 1)
    (row,) = results.read([*(tmp_path / "out" / "evaluations").iterdir()])[0].rows
    assert (row.reason, row.steps, row.looks) == ("step_limit", 300, 8), "it looks once in its chunk"
    assert {*found["hours"]} == {"data", "training", "evaluation"}


class StoppedError(Exception):
    """The training's process was killed."""


def test_a_training_that_was_stopped_goes_on_from_its_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """lerobot's part is a stand-in that leaves the files of a checkpoint."""
    started = tmp_path / ".policy.training" / "start"
    started.mkdir(parents=True)
    outputs = started.parent / "lerobot"
    commands: list[list[str]] = []

    def stopped_after(step: int, command: list[str]) -> None:
        commands.append(command)
        checkpoint = outputs / "checkpoints" / f"{step:06d}"
        (checkpoint / "training_state").mkdir(parents=True)
        (checkpoint / "training_state" / "training_step.json").write_text(json.dumps({"step": step}))
        (checkpoint / "pretrained_model").mkdir()
        (outputs / "checkpoints" / "last").unlink(missing_ok=True)
        (outputs / "checkpoints" / "last").symlink_to(checkpoint)
        if step < 2:
            raise StoppedError

    file = small_experiment(tmp_path, tmp_path / "demos")
    monkeypatch.chdir(tmp_path)
    experiment = read(file)

    def run(command: Callable[[list[str]], None]) -> None:
        train({tmp_path / "policy": tmp_path / "dataset"}, experiment, 0, command)

    with pytest.raises(StoppedError):
        run(partial(stopped_after, 1))
    assert not (tmp_path / "policy").exists()
    run(partial(stopped_after, 2))
    assert (tmp_path / "policy").is_dir()
    assert not started.parent.exists()
    assert "--resume=true" not in commands[0]
    assert {"--resume=true", "--steps=2"} <= set(commands[1])
