"""What can be evaluated is what LIBERO and LIBERO-Plus define, and choosing is fair and repeatable."""

import io
import json
import pickle
import re
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from episode_results import result
from libero.libero.benchmark import get_benchmark_dict
from short_demonstrations import STOVE

from pipeline import seeding
from pipeline.axes import level_of_test
from pipeline.axes.robot import benchmark_offsets_rad
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus, tasks
from pipeline.evaluation.analyses.grading import grade
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.harness import PerturbedLibero
from pipeline.evaluation.held_out import sample_perturbation
from pipeline.evaluation.libero_plus import moved_state, saved_array
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.statistics import summary, wilson
from pipeline.evaluation.task_list import write_tasks
from pipeline.evaluation.tasks import EvaluationTask, balanced, libero_states, libero_task
from pipeline.libero.starts import HOME_RAD
from pipeline.libero.tasks import STEP_LIMITS, SUITES, find_task
from pipeline.testset import benchmark


def test_libero_has_an_episode_for_each_task_and_initial_state() -> None:
    assert len(select(Selection())) == 40
    assert len(select(Selection(suites=("libero_goal",), episodes=3))) == 30
    assert libero_states(STOVE).shape[0] == 50


def test_what_is_chosen_twice_is_selected_once() -> None:
    once = {"source": "own", "suites": ("libero_goal",), "axes": ("camera", "noise"), "levels": (2, 1)}
    twice = {name: value if name == "source" else 2 * value for name, value in once.items()}  # type: ignore[operator]
    assert select(Selection.model_validate(twice)) == select(Selection.model_validate(once))
    pairs = Selection(source="pairs", suites=("libero_goal",), axes=("camera", "camera", "noise"))
    assert select(pairs) == select(pairs.model_copy(update={"axes": ("camera", "noise")}))


def test_a_folder_of_another_program_is_rejected_and_one_of_a_stopped_evaluation_is_not(tmp_path: Path) -> None:
    files = EpisodeFiles(tmp_path)
    files.video("an episode").parent.mkdir()
    files.video("an episode").touch()
    files.reject_other_folder()
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(PipelineError, match="the folder has files but no results of an evaluation: model"):
        files.reject_other_folder()


@pytest.mark.slow
def test_test_tasks_that_need_no_archive_are_all_there(capsys: pytest.CaptureFixture[str]) -> None:
    tasks = select(Selection(source="libero_plus"))
    counts = Counter(task.axis for task in tasks)
    assert counts == {"camera": 1599, "robot": 1550, "noise": 1601, "language": 1537, "pose": 696, "background": 62}
    assert "light 1142" in capsys.readouterr().out
    with pytest.raises(PipelineError, match="asset archive"):
        select(Selection(source="libero_plus", axes=("light", "camera")))
    with pytest.raises(PipelineError, match="no 'colour'"):
        select(Selection(source="libero_plus", axes=("colour",)))


def test_tasks_are_chosen_by_axis_component_level_suite_and_name() -> None:
    chosen = select(
        Selection(
            source="libero_plus",
            suites=("libero_goal",),
            axes=("noise",),
            components=("glass",),
            levels=(5,),
            tasks=("turn_on*",),
        )
    )
    assert chosen
    kinds = {(task.suite, task.component, task.level, task.base) for task in chosen}
    assert kinds == {("libero_goal", "glass", 5, "turn_on_the_stove")}
    severities = {benchmark.load().by_name[task.suite, task.name].parameters["severity"] for task in chosen}
    assert severities <= {9, 10}


@pytest.mark.slow
def test_a_subset_is_balanced_and_holds_the_smaller_ones() -> None:
    tasks = select(Selection(source="libero_plus"))
    chosen = balanced(tasks, 50, seed=0)
    assert set(Counter(task.axis for task in chosen).values()) == {8, 9}
    assert set(Counter(task.component for task in chosen if task.axis == "noise").values()) <= {1, 2}
    assert set(balanced(tasks, 20, seed=0)) < set(chosen)
    assert balanced(reversed(tasks), 50, seed=0) == chosen != balanced(tasks, 50, seed=1)


def test_held_out_perturbations_are_none_of_a_plan() -> None:
    (task, *_) = select(Selection(source="own", axes=("camera",), levels=(3,), suites=("libero_goal",)))
    assert sample_perturbation(task, 0) == sample_perturbation(task, 0) != sample_perturbation(task, 1)
    assert sample_perturbation(task, 0).level == task.level == 3
    assert sample_perturbation(task, 0, attempt=1) != sample_perturbation(task, 0)
    others = select(Selection(source="own", axes=("camera",), levels=(3,)))
    assert len({sample_perturbation(other, 0) for other in others}) == len(others) == 40, "each task has its own"
    with pytest.raises(PipelineError, match="language"):
        select(Selection(source="own", axes=("language",)))


def test_instructions_are_clean_or_the_benchmarks() -> None:
    def told(axis: str, suite: str, prompt: tasks.Prompt) -> str:
        tests = [test for test in benchmark.load().by_name.values() if (test.axis, test.suite) == (axis, suite)]
        return libero_plus.instruction(tests[0], prompt)

    clean = told("camera", "libero_10", "clean")
    polluted = told("camera", "libero_10", "benchmark")
    assert polluted.startswith(clean)
    assert " view " in polluted
    assert "SCENE" not in polluted
    assert told("language", "libero_goal", "clean") == told("language", "libero_goal", "benchmark")


def test_a_test_task_that_a_suite_does_not_have_is_rejected() -> None:
    (test, *_) = (test for (suite, _), test in benchmark.load().by_name.items() if suite == "libero_goal")
    assert benchmark.load().find("libero_goal", test.name) is test
    with pytest.raises(PipelineError, match="libero_10: LIBERO-Plus has no test task"):
        benchmark.load().find("libero_10", test.name)


def test_postures_are_the_benchmarks_tables() -> None:
    postures = libero_plus.postures_rad()
    listed = np.array([postures[number] for number in range(1, 501)])
    assert np.abs(listed - HOME_RAD - benchmark_offsets_rad()).max() < 1e-8


def test_states_of_moved_scenes_are_read_without_running_a_pickle() -> None:
    pose = [test for test in benchmark.load().by_name.values() if test.axis == "pose" and test.suite == "libero_goal"]
    state = moved_state("libero_goal", pose[0].name)
    assert np.isfinite(state).all()
    assert state.ndim == 1

    class Hostile:
        def __reduce__(self) -> tuple[object, ...]:
            return print, ("run",)

    packed = io.BytesIO()
    torch.save(Hostile(), packed)
    with pytest.raises(pickle.UnpicklingError, match="print"):
        saved_array(packed.getvalue())


def test_intervals_are_wilsons() -> None:
    # 8 of 10 by the formula's worked example: 0.490 to 0.943.
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10)[0] == 0
    assert wilson(0, 0) == (0, 1)
    rng = seeding.rng("test")
    rows = [
        result(EvaluationTask("own", "libero_goal", "b", "n", axis, "c", level, 0), bool(rng.integers(2)))
        for axis in ("camera", "noise")
        for level in (1, 2)
    ]
    found = summary(
        [*rows, result(EvaluationTask("own", "libero_goal", "b", "n", "robot", "c", 1, 0), reason="refused")]
    )
    assert (found["all"]["episodes"], found["refused"]) == (4, 1)
    assert found["by_axis"].keys() == {"camera", "noise"}, "no policy acted in what was rejected"
    assert found["by_axis_and_level"].keys() == {"camera/1", "camera/2", "noise/1", "noise/2"}
    assert sum(group["successes"] for group in found["by_axis"].values()) == found["all"]["successes"]


def test_a_task_whose_scene_was_rejected_for_a_model_is_not_graded(tmp_path: Path) -> None:
    acted, rejected = select(Selection(suites=(STOVE.suite,)))[:2]
    files = EpisodeFiles(tmp_path)
    one = [(result(acted, True), files), (result(rejected, reason="refused"), files)]
    graded = grade([one, [(result(task, True, "other"), files) for task in (acted, rejected)]])
    assert [(task["name"], task["solved"]) for task in graded] == [(acted.name, 2)]


def test_the_harness_names_tasks_by_our_form_or_by_its_own() -> None:
    (test, *_) = select(Selection(source="libero_plus", suites=("libero_goal",)))
    assert EvaluationTask.of_harness(test.for_harness()) == test
    clean = select(Selection(suites=("libero_goal",), tasks=("turn_on_the_stove",), episodes=4))
    own_class = {"name": "turn on the stove", "suite": "libero_goal", "task_id": 7}
    assert [EvaluationTask.of_harness({**own_class, "episode_idx": number}) for number in range(4)] == clean


@pytest.mark.parametrize("suite", SUITES)
def test_the_harness_gets_the_task_that_liberos_list_has_at_its_number(suite: str) -> None:
    """Of LIBERO-90, 16 tasks share their instruction with a task of another scene."""
    theirs = get_benchmark_dict()[suite]()
    for number in range(theirs.n_tasks):
        known = theirs.get_task(number)
        named = {"name": known.language, "suite": suite, "task_id": number}
        assert EvaluationTask.of_harness(named).base == known.name
    for other in ({"task_id": theirs.n_tasks}, {"task_id": -1}, {"name": "fly to the moon"}):
        with pytest.raises(PipelineError, match=f"{suite} has no task"):
            EvaluationTask.of_harness(named | other)


LEVELS = {
    "camera": (0, 133, 256, 362, 406, 442),
    "robot": (0, 156, 307, 350, 366, 371),
    "layout": (0, 106, 151, 180, 185, 207),
    "pose": (0, 89, 97, 108, 111, 291),
    "light": (1142, 0, 0, 0, 0, 0),
    "background": (1076, 0, 0, 0, 0, 0),
}
"""Test tasks of unknown level and of levels 1 to 5; robot, layout and pose as counted from the benchmark's names."""


def test_every_axis_states_the_level_of_its_test_tasks() -> None:
    counts = Counter((one.axis, level_of_test(one)) for one in benchmark.load().tasks)
    assert {axis: tuple(counts[axis, level] for level in range(6)) for axis in LEVELS} == LEVELS
    added = benchmark.load().on_axis("layout")
    # The benchmark's names number 30 layouts of a task; six in a row add equally many objects.
    assert all(level_of_test(one) == -(-int(one.name.rpartition("_add_")[2]) // 6) for one in added)
    for test in benchmark.load().on_axis("pose"):
        # In the goal suite, the benchmark moves objects by up to 35 cm at each of its levels.
        assert level_of_test(test) == 5 if test.suite == "libero_goal" else f"_level{level_of_test(test)}_" in test.name


def edits(one: str, other: str) -> int:
    """Levenshtein distance by its definition."""
    row = list(range(len(other) + 1))
    for i, letter in enumerate(one, 1):
        before, row = row, [i]
        for j, another in enumerate(other, 1):
            row.append(min(before[j] + 1, row[-1] + 1, before[j - 1] + (letter != another)))
    return row[-1]


def test_the_level_of_a_language_test_is_its_share_of_edits() -> None:
    for tested in benchmark.load().on_axis("language")[::97]:
        text, original = (
            re.sub(r"[^a-z0-9 ]", "", text.lower())
            for text in (str(tested.parameters["text"]), find_task(tested.suite, tested.base).instruction)
        )
        share = edits(text, original) / max(len(text), len(original))
        assert level_of_test(tested) == 1 + sum(share >= least for least in (0.5, 0.6, 0.67, 0.72)), text


def test_tasks_of_unknown_level_are_counted_where_a_level_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    chosen = select(Selection(source="libero_plus", levels=(1, 2, 3, 4, 5)))
    counts = Counter(task.axis for task in chosen)
    assert counts == {"camera": 1599, "robot": 1550, "noise": 1601, "language": 1537, "pose": 696}
    assert "left out, because their parameters do not state their level (0): background 1076, light 1142" in (
        capsys.readouterr().out
    )
    select(Selection(source="libero_plus", axes=("background",), levels=(0,)))
    assert "level" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("chosen", "told"),
    [
        ({"episodes": 60}, "at most 50"),
        ({"source": "pairs", "episodes": 51}, "at most 50"),
        ({"source": "own", "levels": (9,)}, "1 or 2 or 3 or 4 or 5"),
        ({"source": "libero_plus", "levels": (9,)}, "0 or 1 or 2 or 3 or 4 or 5"),
        ({"source": "libero_plus", "episodes": 2}, "leave --episodes out"),
        ({"file": Path("tasks.json"), "episodes": 2}, "leave --episodes out"),
        ({"file": Path("tasks.json"), "source": "libero"}, "leave --source or --tasks-from out"),
        ({"levels": (3,)}, "expected: 0"),
        ({"source": "libero_plus", "components": ("dist",)}, "distance or fog or gaussian_blur"),
        ({"source": "own", "axes": ("camera",), "components": ("dist",)}, "distance or orientation or spherical"),
        ({"components": ("distance",)}, "expected: clean"),
        ({"suites": ("libero_gaol",)}, "libero_10 or libero_90 or libero_goal"),
        ({"axes": ("camera",)}, "expected: clean"),
        ({"tasks": ("turn_on*", "turn_of_the_stove")}, "turn_on_the_stove"),
        ({"source": "libero_plus", "axes": ("camera",), "components": ("fog",)}, "axes noise; or components distance"),
    ],
)
def test_restrictions_without_a_match_are_rejected_with_the_known_values(chosen: dict[str, object], told: str) -> None:
    with pytest.raises(PipelineError) as caught:
        select(Selection.model_validate(chosen))
    assert told in str(caught.value)


def test_held_out_perturbations_can_be_more_than_initial_states() -> None:
    chosen = {"source": "own", "axes": ("robot",), "levels": (3,), "suites": (STOVE.suite,), "tasks": (STOVE.name,)}
    fifty, more = (select(Selection.model_validate(chosen | {"episodes": count})) for count in (50, 53))
    assert more[:50] == fifty
    assert [task.number for task in more[50:]] == [50, 51, 52]
    assert len({sample_perturbation(task, 0).model_dump_json() for task in more}) == 53


def test_a_list_of_tasks_is_checked(tmp_path: Path) -> None:
    (task,) = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))
    file = tmp_path / "tasks.json"
    for wrong in ({"level": "high"}, {"source": "libero_pro"}, {"number": None}):
        file.write_text(json.dumps({"seed": 0, "tasks": [asdict(task) | wrong]}))
        with pytest.raises(PipelineError, match="not a list of tasks"):
            select(Selection(file=file))
    file.write_text(json.dumps({"seed": 0, "tasks": [asdict(task)]}))
    assert select(Selection(file=file)) == [task]
    with pytest.raises(PipelineError, match="expected: clean"):
        select(Selection(file=file, axes=("camera",)))


def test_a_list_of_tasks_is_whole_unless_suites_are_named(tmp_path: Path) -> None:
    listed = [select(Selection(suites=(suite,)))[0] for suite in (STOVE.suite, "libero_90")]
    file = tmp_path / "tasks.json"
    write_tasks(listed, 0, file)
    whole = Selection(file=file)
    assert whole.suites == ()
    assert select(whole) == listed
    assert select(Selection(file=file, suites=("libero_90",))) == listed[1:]
    assert PerturbedLibero({"file": str(file)}).get_metadata()["max_steps"] == max(STEP_LIMITS.values())


def test_an_environment_rejects_a_task_of_an_unknown_source_and_states_that_no_episode_has_begun() -> None:
    environment = EpisodeEnvironment()
    unknown = replace(libero_task(STOVE, 0), source="others")  # type: ignore[arg-type]
    with pytest.raises(PipelineError, match="there is no source 'others' of tasks"):
        environment.reset(unknown)
    assert environment.progress.reason == "not_begun"
    with pytest.raises(PipelineError, match="no episode has begun"):
        environment.observation(Wanted())
