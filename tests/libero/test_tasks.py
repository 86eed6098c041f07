"""LIBERO's task list, read without importing LIBERO, and tasks of one's own."""

import shutil
from pathlib import Path

import pytest
from libero.libero import get_libero_path
from libero.libero.benchmark import task_maps

from pipeline.errors import PipelineError
from pipeline.evaluation.selection import Selection, select
from pipeline.libero.tasks import SUITES, find_task, select_tasks, suites, tasks


@pytest.mark.parametrize("suite", SUITES)
def test_names_instructions_and_files_are_liberos(suite: str) -> None:
    folder = Path(get_libero_path("bddl_files")).resolve() / suite
    theirs = [(known.name, known.language, folder / known.bddl_file) for known in task_maps[suite].values()]
    assert [(task.name, task.instruction, task.bddl_file) for task in tasks(suite)] == theirs
    assert all(task.bddl_file.is_file() for task in tasks(suite))


def test_tasks_are_selected_by_pattern_in_order() -> None:
    assert select_tasks(["libero_goal/turn_on*", "libero_goal/*stove"]) == [
        task for task in tasks("libero_goal") if task.name.endswith("stove")
    ]
    with pytest.raises(PipelineError, match="no task matches 'libero_gaol/") as caught:
        select_tasks(["libero_goal/*", "libero_gaol/*"])
    assert "libero_goal/" in str(caught.value)


def test_a_faulty_file_of_another_suite_stops_no_selection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stove = find_task("libero_goal", "turn_on_the_stove")
    for suite, text in {"half": "(define", "whole": stove.bddl_file.read_text().replace("Turn on", "Light")}.items():
        file = tmp_path / "tasks" / suite / "light_it.bddl"
        file.parent.mkdir(parents=True)
        file.write_text(text)
    assert [str(task) for task in select_tasks(["whole/*"])] == ["whole/light_it"]
    assert select_tasks(["libero_goal/turn_on_the_stove"]) == [stove]
    for names in (("light_it",), ("whole/light_it",), ("whole/*",), ()):
        assert [(task.suite, task.base) for task in select(Selection(suites=("whole",), tasks=names))] == [
            ("whole", "light_it")
        ]
    assert [task.base for task in select(Selection(tasks=("libero_goal/turn_on*",)))] == [stove.name]
    for pattern in ("half/*", "*/light_it", "*light*"):
        with pytest.raises(PipelineError, match=r"half/light_it\.bddl: the file is not a BDDL file"):
            select_tasks([pattern])


def test_unknown_task_names_the_closest() -> None:
    with pytest.raises(PipelineError, match="turn_on_the_stove"):
        find_task("libero_goal", "turn_on_stove")
    with pytest.raises(PipelineError, match="libero_spatial or libero_object"):
        tasks("libero_kitchen")


def own_task(folder: Path, language: str = "Put the bowl down") -> Path:
    """The definition of LIBERO's task of the bowl, told otherwise, as a task of one's own."""
    text = find_task("libero_goal", "put_the_bowl_on_the_plate").bddl_file.read_text()
    folder.mkdir(parents=True)
    file = folder / "bowl_down.bddl"
    file.write_text(text.replace("(:language Put the bowl on the plate)", f"(:language {language})"))
    return file


def test_own_tasks_stand_next_to_liberos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = own_task(tmp_path / "tasks" / "my_suite")
    assert suites() == (*SUITES, "my_suite")
    (task,) = select_tasks(["my_suite/*"])
    assert (task.suite, task.name, task.bddl_file) == ("my_suite", "bowl_down", file)
    assert task.instruction == "put the bowl down"
    assert find_task("my_suite", "bowl_down") == task
    with pytest.raises(PipelineError, match="my_suite has no task 'bowl_up'"):
        find_task("my_suite", "bowl_up")
    for name in ("My suite", "goal", "libero_mine", "mine_val", "val", "my_aloha"):
        own_task(tmp_path / "tasks" / name)
        with pytest.raises(PipelineError, match=f"a suite cannot have the name '{name}'"):
            suites()
        shutil.rmtree(tmp_path / "tasks" / name)


def test_an_own_task_with_the_name_of_a_carried_task_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = own_task(tmp_path / "tasks" / "my_suite")
    file.rename(file.with_name("bowl__in__there.bddl"))
    with pytest.raises(PipelineError, match=r"bowl__in__there\.bddl: the name has '__in__'"):
        select_tasks(["my_suite/*"])


@pytest.mark.parametrize("language", ["", "  "])
def test_an_own_task_without_an_instruction_is_rejected_when_it_is_read(
    language: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = own_task(tmp_path / "tasks" / "my_suite", language)
    with pytest.raises(PipelineError, match="the instruction is empty") as caught:
        select_tasks(["my_suite/*"])
    assert str(file) in str(caught.value)
