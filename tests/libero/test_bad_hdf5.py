"""Unusable recordings and files are named and skipped, and cost no other."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import Once
from recordings import NAME, TASK, as_published, file_in, recording, scene_here, write_eleven

from pipeline.errors import PipelineError
from pipeline.evaluation.recordings import count_of
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.tasks import tasks
from pipeline.types import Floats


@pytest.fixture(scope="module")
def model_file(once: Once) -> str:
    return as_published(scene_here(once))


@pytest.fixture
def root(tmp_path: Path, model_file: str) -> Path:
    return write_eleven(tmp_path, model_file)


def replace(group: h5py.Group, name: str, values: object) -> None:
    del group[name]
    group[name] = values


def test_the_fault_of_a_tasks_own_file_is_named_and_not_that_of_a_copy_next_to_it(root: Path) -> None:
    file = file_in(root)
    shutil.copy(file, file.with_name(f"{TASK.name}_demo_old.hdf5"))
    with h5py.File(file, "r+") as opened:
        for demo in opened["data"].values():
            del demo["actions"]
    with pytest.raises(PipelineError, match="'actions' is missing") as caught:
        count_of(TASK, root)
    assert str(file) in str(caught.value)


def with_value(array: Floats, value: float) -> Floats:
    array = array.copy()
    array[4, 2] = value
    return array


SPOILT: dict[str, tuple[Callable[[h5py.Group], object], str]] = {
    "no actions": (lambda demo: demo.pop("actions"), "'actions' is missing"),
    "no states": (lambda demo: demo.pop("states"), "'states' is missing"),
    "no model": (lambda demo: demo.attrs.pop("model_file"), "'model_file' is missing"),
    "model of another type": (lambda demo: demo.attrs.create("model_file", 3), "'model_file' is not text"),
    "model cut short": (
        lambda demo: demo.attrs.modify("model_file", demo.attrs["model_file"][:-40]),
        "model_file: the model is not XML",
    ),
    "model of foreign files": (
        lambda demo: demo.attrs.create("model_file", '<mujoco><asset><texture file="/etc/passwd"/></asset></mujoco>'),
        'file="/etc/passwd"',
    ),
    "actions are a group": (lambda demo: (demo.pop("actions"), demo.create_group("actions")), "'actions' is a Group"),
    "six-dimensional actions": (lambda demo: replace(demo, "actions", demo["actions"][:, :6]), r"shape \(12, 6\)"),
    "flat actions": (lambda demo: replace(demo, "actions", demo["actions"][0]), r"shape \(7,\)"),
    "integer actions": (lambda demo: replace(demo, "actions", np.zeros((12, 7), int)), "holds int64"),
    "text for actions": (lambda demo: replace(demo, "actions", "none"), "holds object"),
    "no steps": (lambda demo: replace(demo, "actions", np.zeros((0, 7))), r"shape \(0, 7\)"),
    "fewer states": (lambda demo: replace(demo, "states", demo["states"][:-1]), "do not agree"),
    "model of bytes that are not UTF-8": (
        lambda demo: demo.attrs.create("model_file", b"<mujoco model='\xff'/>", dtype=h5py.string_dtype()),
        "'model_file' is not UTF-8",
    ),
    "huge states": (
        lambda demo: replace(demo, "states", with_value(demo["states"][()], 1e200)),
        "states reach 1e\\+200",
    ),
    "NaN": (lambda demo: replace(demo, "states", with_value(demo["states"][()], np.nan)), "NaN"),
    "other init_state": (lambda demo: demo.attrs.modify("init_state", demo["states"][1]), "do not agree"),
    "link to another file": (
        lambda demo: replace(demo, "states", h5py.ExternalLink("/etc/hostname", "states")),
        "'states' is a ExternalLink",
    ),
    "numbers of another file": (
        lambda demo: (
            demo.pop("actions"),
            demo.create_dataset("actions", (12, 7), "f8", external=[("/etc/hostname", 0, 12 * 56)]),
        ),
        "another file",
    ),
    "more than memory holds": (
        lambda demo: (demo.pop("states"), demo.create_dataset("states", (10**9, 79), "f8", chunks=(1, 79))),
        r"shape \(1000000000, 79\)",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_bad_demo_is_named_and_does_not_cost_the_others(root: Path, case: str) -> None:
    spoil, what = SPOILT[case]
    with h5py.File(file_in(root), "r+") as file:
        spoil(file["data/demo_3"])
    source = HDF5Source(root)
    index = source.index([TASK])
    assert len(index.entries) == 10
    (problem,) = index.problems
    assert problem.name == f"{NAME}/demo_3"
    assert re.search(what, str(problem.error)), str(problem.error)
    assert f"{TASK.name}_demo.hdf5 data/demo_3" in str(problem.error)
    assert "delete" not in str(problem.error)
    with pytest.raises(PipelineError, match=what):
        source.load(f"{NAME}/demo_3")
    assert [entry.key for entry in source.index([TASK], per_task=4).entries][-1] == "demo_4"


def test_a_name_that_is_not_utf_8_costs_that_demonstration_only(root: Path) -> None:
    with h5py.File(file_in(root), "r+") as file:
        file["data"].create_group(b"demo_\xff")
    index = HDF5Source(root).index([TASK])
    assert len(index.entries) == 11
    assert [problem.name for problem in index.problems] == [f"{NAME}/demo_\\xff"]


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def drop_data(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["data"]


def rename_to_other_task(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["bddl_file_name"] = (
            "libero/libero/bddl_files/libero_goal/push_the_plate_to_the_front_of_the_stove.bddl"
        )


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (truncate, "truncated"),
        (lambda path: path.write_bytes(b"<html>429 Too Many Requests</html>"), "not readable as HDF5"),
        (lambda path: path.write_bytes(b""), "not readable as HDF5"),
        (drop_data, "'data' is missing"),
        (rename_to_other_task, "recorded for another, 'push_the_plate_to_the_front_of_the_stove'"),
        (Path.unlink, "no such file"),
    ],
)
def test_a_bad_file_is_named_and_does_not_cost_the_others(
    root: Path, model_file: str, spoil: Callable[[Path], None], what: str
) -> None:
    other = tasks("libero_goal")[0]
    hdf5.write(file_in(root, other), other, [recording(model_file)])
    spoil(file_in(root))
    index = HDF5Source(root).index([TASK, other])
    assert [entry.task for entry in index.entries] == [other]
    (problem,) = index.problems
    assert problem.name == NAME
    assert what in str(problem.error)
    assert str(file_in(root)) in str(problem.error)
    assert "try:" in str(problem.error)
    assert "delete" not in str(problem.error)


def test_a_recording_of_another_suites_task_is_sent_to_that_suite(root: Path) -> None:
    """A task of that name exists only there."""
    milk = "pick_up_the_milk_and_place_it_in_the_basket"
    with h5py.File(file_in(root), "r+") as file:
        file["data"].attrs["bddl_file_name"] = f"{milk}.bddl"
    (problem,) = HDF5Source(root).index([TASK]).problems
    assert f"try: move the file to {root / 'libero_object' / milk}_demo.hdf5" in str(problem.error)


def test_a_faulty_definition_of_an_own_task_costs_no_other_demonstration(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    faulty = tmp_path / "tasks" / "my_suite" / "half_written.bddl"
    faulty.parent.mkdir(parents=True)
    faulty.write_text("(define")
    index = HDF5Source(root).index([TASK])
    assert (len(index.entries), index.problems) == (11, [])
    # Its name counts nevertheless.
    with h5py.File(file_in(root), "r+") as file:
        file["data"].attrs["bddl_file_name"] = "half_written.bddl"
    (problem,) = HDF5Source(root).index([TASK]).problems
    assert f"try: move the file to {root / 'my_suite' / 'half_written'}_demo.hdf5" in str(problem.error)


def test_overwritten_bytes_never_raise_anything_else(root: Path) -> None:
    whole, rng = file_in(root).read_bytes(), np.random.default_rng(0)
    for _ in range(25):
        damaged = bytearray(whole)
        for position in rng.integers(0, 40_000, 300):
            damaged[position] = rng.integers(256)
        file_in(root).write_bytes(damaged)
        index = HDF5Source(root).index([TASK])
        assert len(index.entries) <= 11
