"""Tasks are graded as the paper grades them, and a constructed benchmark is balanced and read back as sampled."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from episode_results import analyze, result
from short_demonstrations import STOVE

from pipeline.axes import AXES
from pipeline.axes.camera import CameraAxis, SphericalRange
from pipeline.errors import PipelineError
from pipeline.evaluation import held_out
from pipeline.evaluation.analyses.construction import candidates, construct
from pipeline.evaluation.analyses.grading import difficulty
from pipeline.evaluation.held_out import OWN_AXES
from pipeline.evaluation.results import EpisodeFiles, read
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.task_list import write_tasks
from pipeline.evaluation.tasks import EvaluationTask


def test_difficulty_is_the_papers_for_four_models_and_even_for_others() -> None:
    assert [difficulty(solved, 4) for solved in range(5)] == [5, 4, 3, 2, 1]
    assert [difficulty(solved, 2) for solved in range(3)] == [5, 3, 1]
    assert [difficulty(solved, 3) for solved in range(4)] == [5, 4, 2, 1]
    assert [difficulty(solved, 1) for solved in range(2)] == [5, 1]
    # 8 models: 4 solved / 8 is 0.5 at one model, and goes to the harder.
    assert [difficulty(solved, 8) for solved in range(9)] == [5, 5, 4, 4, 3, 3, 2, 2, 1]


def test_tasks_are_graded_by_the_models_that_solve_them(tmp_path: Path) -> None:
    tasks = select(Selection(suites=(STOVE.suite,)))
    for model in range(4):
        for place, task in enumerate(tasks[: 9 if model == 0 else 10]):
            EpisodeFiles(tmp_path / str(model)).save(result(task, place > 2 * model, f"model {model}"))
    graded = tmp_path / "graded.json"
    assert analyze("grade", *(str(tmp_path / str(model)) for model in range(4)), "--out", str(graded)) == 0
    content = json.loads(graded.read_text())
    expected = {task.name: 5 - sum(place > 2 * model for model in range(4)) for place, task in enumerate(tasks[:9])}
    assert {task["name"]: task["difficulty"] for task in content["tasks"]} == expected
    assert set(select(Selection(file=graded))) == set(tasks[:9])


def test_a_graded_task_keeps_its_name_where_another_component_was_sampled(tmp_path: Path) -> None:
    (task,) = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot",), levels=(3,)))
    (other,) = {"controller_posture", "initial_joints"} - {task.component}
    EpisodeFiles(tmp_path).save(result(replace(task, component=other), True))
    graded = tmp_path / "graded.json"
    assert analyze("grade", str(tmp_path), "--out", str(graded)) == 0
    assert select(Selection(file=graded)) == [task]


def test_a_task_that_was_run_twice_under_one_setting_does_not_count_twice(tmp_path: Path) -> None:
    (task,) = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))
    for episode in ("a", "b"):
        EpisodeFiles(tmp_path).save(result(task, True, episode=episode))
    with pytest.raises(PipelineError, match=r"counts twice: libero/.* by p: episode a and b"):
        read([tmp_path])


def test_grades_count_neither_a_task_nor_a_model_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (task,) = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))
    first, copy, twice = tmp_path / "first", tmp_path / "copy", tmp_path / "twice"
    for folder in (first, copy):
        EpisodeFiles(folder).save(result(task, True))
    for episode in ("a", "b"):
        EpisodeFiles(twice).save(result(task, episode == "a", "q", episode=episode))
    graded = tmp_path / "graded.json"
    for folders, message in (([first, copy], "would count as two models"), ([first, twice], "a task counts twice")):
        assert analyze("grade", *map(str, folders), "--out", str(graded)) == 1
        assert message in capsys.readouterr().err
        assert not graded.exists()


@pytest.mark.slow
def test_a_benchmark_is_sampled_filtered_balanced_and_read_back(tmp_path: Path) -> None:
    sampled = candidates(seed=3, each=20)
    tested = [axis for axis in OWN_AXES if AXES[axis].dimension]
    assert Counter((task.suite, task.axis) for task in sampled) == {
        (suite, axis): 20 for suite in Selection().suites for axis in tested
    }
    assert len(set(sampled)) == len(sampled)
    rejected = [task for task in sampled if task.axis == "layout"][:5]
    chosen, counts = construct(sampled, 3, 210, [result(task, reason="refused", seed=3) for task in rejected])
    assert (counts["candidates"], counts["refused"], counts["overlapping"]) == (560, 5, 0)
    assert set(Counter(task.axis for task in chosen).values()) == {30}
    assert not set(rejected) & set(chosen)
    assert set(chosen) < set(sampled)
    file = tmp_path / "tasks.json"
    write_tasks(chosen, 3, file)
    assert select(Selection(file=file, seed=3)) == chosen
    lights = select(Selection(file=file, seed=3, axes=("light",), subset=10))
    assert len(lights) == 10
    assert {task.axis for task in lights} == {"light"}
    with pytest.raises(PipelineError, match="--seed 3"):
        select(Selection(file=file))
    file.write_text("[]")
    with pytest.raises(PipelineError, match="not a list of tasks"):
        select(Selection(file=file))


def test_a_list_of_tasks_that_are_sampled_otherwise_now_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("camera",)))
    file = tmp_path / "tasks.json"
    write_tasks(tasks, 0, file)
    assert select(Selection(file=file)) == tasks
    ranges = CameraAxis(spherical=SphericalRange(elevation_deg=((0.0, 1.0),)))
    monkeypatch.setattr(held_out, "held_out_axis", lambda _: ranges)
    with pytest.raises(PipelineError, match="this version samples other perturbations"):
        select(Selection(file=file))


def test_a_benchmark_is_filtered_by_results_of_its_own_seed() -> None:
    candidate = EvaluationTask("own", STOVE.suite, STOVE.name, "a", "robot", "initial_joints", 1, 0)
    with pytest.raises(PipelineError, match=r"the result has seed 0(?s:.*)expected: seed 3"):
        construct([candidate], 3, 1, [result(candidate, reason="refused")])
    assert construct([candidate], 3, 1, [result(candidate, reason="refused", seed=3)])[0] == []
