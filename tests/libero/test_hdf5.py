"""Demonstrations are read as recorded, known by what is in them, and written in LIBERO's own layout."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import Once
from recordings import NAME, TASK, as_published, file_in, recording, run, scene_here, write_eleven

from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.libero.assets import relocate
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.tasks import tasks


@pytest.fixture(scope="module")
def scene(once: Once) -> str:
    return scene_here(once)


@pytest.fixture(scope="module")
def model_file(scene: str) -> str:
    return as_published(scene)


@pytest.fixture
def root(tmp_path: Path, model_file: str) -> Path:
    return write_eleven(tmp_path, model_file)


COMPILE = """
import sys
import mujoco
for path in sys.argv[1:]:
    model = mujoco.MjModel.from_xml_path(path)
    print(model.nq, model.ngeom, model.nmesh, model.ntex, model.body_mass.sum(), model.mesh_vert.sum())
"""


@pytest.mark.slow
def test_hdf5_round_trip(root: Path, model_file: str, scene: str) -> None:
    source = HDF5Source(root)
    index = source.index([TASK])
    assert not index.problems
    assert [entry.key for entry in index.entries] == [f"demo_{number}" for number in range(11)]
    for seed, entry in enumerate(index.entries):
        expected, demo = recording(model_file, seed=seed), source.load(entry.demo_id)
        np.testing.assert_array_equal(demo.actions, expected.actions)
        np.testing.assert_array_equal(demo.init_state, expected.states[0])
        assert demo.sha256 == entry.sha256
        assert demo.source == f"{NAME}_demo.hdf5 demo_{seed}"
        assert entry.steps == 12
        assert demo.model_xml is not None
        assert attributes(demo.model_xml) == attributes(scene)
    assert len({entry.sha256 for entry in index.entries}) == 11
    assert [entry.key for entry in source.index([TASK], per_task=2).entries] == ["demo_0", "demo_1"]


def attributes(xml: str) -> list[str]:
    """Every attribute's text in document order, without the folder that absolute paths make void."""
    return re.findall(r'\S+="[^"]*"', xml.replace(' meshdir="meshes/"', ""))


def test_hash_covers_actions_states_and_model_but_not_images(root: Path, model_file: str) -> None:
    def digest(change: Callable[[h5py.Group], None]) -> str:
        with h5py.File(file_in(root), "r+") as file:
            change(file["data/demo_0"])
        return HDF5Source(root).load(f"{NAME}/demo_0").sha256

    def touch_model(group: h5py.Group) -> None:
        group.attrs["model_file"] = model_file.replace("/home/author", "/home/another")

    def touch_action(group: h5py.Group) -> None:
        group["actions"][3, 0] += 1e-9

    def touch_state(group: h5py.Group) -> None:
        group["states"][-1, 5] += 1e-9

    def touch_image(group: h5py.Group) -> None:
        group["obs/agentview_rgb"][0] = 0

    before = digest(lambda _: None)
    assert digest(touch_image) == before
    hashes = [before, digest(touch_action), digest(touch_state), digest(touch_model)]
    assert len(set(hashes)) == 4


def test_written_file_has_liberos_layout_and_is_reproducible(root: Path, tmp_path: Path, model_file: str) -> None:
    with h5py.File(file_in(root)) as file:
        data, demo = file["data"], file["data/demo_0"]
        assert set(data.attrs) == {
            "env_name", "env_args", "problem_info", "bddl_file_name", "bddl_file_content", "macros_image_convention",
            "num_demos", "tag", "total",
        }  # fmt: skip
        assert data.attrs["env_name"] == "Libero_Tabletop_Manipulation"
        assert '"language_instruction": "turn on the stove"' in data.attrs["problem_info"]
        assert (data.attrs["num_demos"], data.attrs["total"]) == (11, 132)
        assert set(demo) == {"actions", "states", "robot_states", "rewards", "dones", "obs"}
        assert set(demo.attrs) == {"num_samples", "model_file", "init_state"}
        assert demo["rewards"][()].tolist() == demo["dones"][()].tolist() == [0] * 11 + [1]
    again = tmp_path / "again.hdf5"
    hdf5.write(again, TASK, (recording(model_file, seed=seed) for seed in range(11)))
    assert again.read_bytes() == file_in(root).read_bytes()


def test_attributes_are_of_a_task_as_libero_reads_its_file(tmp_path: Path) -> None:
    plain = hdf5.task_attributes(TASK)
    odd = tmp_path / TASK.bddl_file.name
    text = TASK.bddl_file.read_text()
    text = text.replace("(problem", "( Problem").replace("(:language", "; (:language (problem other)\n(:Language  ")
    odd.write_text(text)
    written = hdf5.task_attributes(replace(TASK, bddl_file=odd))
    assert written.pop("bddl_file_content") == text
    assert written == {name: value for name, value in plain.items() if name != "bddl_file_content"}
    assert json.loads(plain["problem_info"])["language_instruction"] == TASK.instruction


def test_an_exact_copy_is_left_out_and_both_are_named(root: Path, model_file: str) -> None:
    other = tasks("libero_goal")[0]
    with h5py.File(file_in(root), "r+") as file:
        file.copy("data/demo_1", file["data"], "demo_2a")
        del file["data/demo_2"]
        file["data"].move("demo_2a", "demo_2")
    # Also where it is said to solve another task: an episode's id is a hash of the content alone.
    hdf5.write(file_in(root, other), other, [recording(model_file, seed=1), recording(model_file, seed=99)])
    index = HDF5Source(root).index([TASK, other])
    assert [entry.key for entry in index.entries if entry.task == TASK] == [f"demo_{n}" for n in range(11) if n != 2]
    assert [entry.key for entry in index.entries if entry.task == other] == ["demo_1"]
    assert not index.problems
    for note, copy in zip(index.notes, ("demo_2", "demo_0"), strict=True):
        assert f"1 demonstrations are left out, as copies in actions, states and model (first: data/{copy}" in note
        assert f"of {NAME}/demo_1" in note
    assert len(HDF5Source(root).index([TASK], per_task=3).entries) == 3


@pytest.mark.parametrize(("axis", "used"), [("layout", 10), ("robot", 11)])
def test_exported_episodes_with_added_objects_are_left_out(root: Path, axis: str, used: int) -> None:
    with h5py.File(file_in(root), "r+") as file:
        attributes = file["data/demo_3"].attrs
        attributes["expanded_from"] = f"{NAME}/demo_0"
        attributes["origin_sha256"] = "0" * 64
        attributes["perturbations"] = json.dumps([{"axis": "noise"}, {"axis": axis}])
    index = HDF5Source(root).index([TASK])
    assert (len(index.entries), index.problems) == (used, [])
    assert [note for note in index.notes if "episodes of the axis layout" in note] == list(index.notes)
    assert len(index.notes) == 11 - used


@pytest.mark.parametrize("damaged", ["", "{}x", "5", '["layout"]'])
def test_a_damaged_list_of_perturbations_is_named(root: Path, damaged: str) -> None:
    with h5py.File(file_in(root), "r+") as file:
        attributes = file["data/demo_3"].attrs
        attributes["expanded_from"] = f"{NAME}/demo_0"
        attributes["origin_sha256"] = "0" * 64
        attributes["perturbations"] = damaged
    (problem,) = HDF5Source(root).index([TASK]).problems
    assert "'perturbations' is no list of perturbations" in str(problem.error)
    assert "data/demo_3" in str(problem.error)


def test_earlier_names_of_a_task_are_accepted(root: Path) -> None:
    with h5py.File(file_in(root), "r+") as file:
        file["data"].attrs["bddl_file_name"] = "chiliocosm/bddl_files/libero_goal/switch_the_stove_on.bddl"
    assert len(HDF5Source(root).index([TASK]).entries) == 11


def test_files_of_no_task_and_members_of_no_number_are_named(root: Path) -> None:
    file_in(root).with_name("turn_on_the_stoves_demo.hdf5").touch()
    with h5py.File(file_in(root), "r+") as file:
        file["data"].create_group("mask")
    stray, member = HDF5Source(root).index([TASK]).problems
    assert "turn_on_the_stove" in str(stray.error)
    assert stray.name == "libero_goal/turn_on_the_stoves_demo.hdf5"
    assert member.name == f"{NAME}/mask"


def test_missing_folder_names_the_layout(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=r"<root>/<suite>/<task>_demo\.hdf5"):
        HDF5Source(tmp_path).index([TASK])


@pytest.mark.slow
def test_relocated_model_compiles_to_the_original(tmp_path: Path, scene: str, model_file: str) -> None:
    assert "/home/author/" in model_file
    assert "/scenes/../textures/" in model_file
    relocated = relocate(model_file, "test")
    assert "author" not in relocated
    (tmp_path / "scene.xml").write_text(scene)
    (tmp_path / "relocated.xml").write_text(relocated)
    original, moved = run(COMPILE, tmp_path / "scene.xml", tmp_path / "relocated.xml").splitlines()
    assert moved == original
    assert int(original.split()[2]) > 50
    assert relocate(relocated, "test") == relocated
