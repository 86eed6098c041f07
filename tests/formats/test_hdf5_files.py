"""The HDF5 files have LIBERO's layout and the numbers that went in, whoever writes them, and damage is found."""

import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache, partial
from io import BytesIO
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from every_set import spread
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation
from synthetic import EXTRAS, IDS, NAME, TASK, episode, files, loaded_packages, loop, with_extras, write_hdf5

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.base import ManifestRow
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.hdf5 import Hdf5, Hdf5Config
from pipeline.run.export import export
from pipeline.types import Episode, Subtask, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

FILE = f"{TASK}_demo.hdf5"

LIBERO_ARRAYS = {
    "actions", "states", "robot_states", "rewards", "dones", "obs/agentview_rgb", "obs/eye_in_hand_rgb", "obs/ee_pos",
    "obs/ee_ori", "obs/ee_states", "obs/gripper_states", "obs/joint_states",
}  # fmt: skip
"""Arrays that LIBERO's ``create_dataset.py`` writes."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hdf5(tmp_path_factory.mktemp("hdf5")).folder


@pytest.fixture
def written(folder: Path, tmp_path: Path) -> Hdf5:
    """A copy to damage."""
    shutil.copytree(folder, tmp_path / "hdf5")
    shutil.copy(folder.with_suffix(".json"), tmp_path)
    return Hdf5(tmp_path, Hdf5Config(name=NAME))


def arrays(group: h5py.Group) -> set[str]:
    names: set[str] = set()
    group.visititems(lambda name, node: names.add(name) if isinstance(node, h5py.Dataset) else None)
    return names


def raw(jpeg: bytes) -> NDArray[np.uint8]:
    """Decode a stored frame and return it as LIBERO's simulator does: with the first row at the bottom."""
    return np.array(Image.open(BytesIO(jpeg)))[::-1, ::-1]


def test_files_have_liberos_layout_and_the_numbers_of_the_episodes(folder: Path) -> None:
    with h5py.File(folder / FILE) as file:
        data = file["data"]
        assert (data.attrs["num_demos"], data.attrs["total"]) == (6, sum(len(episode(one)) for one in IDS))
        assert data.attrs["macros_image_convention"] == "opengl"
        arguments = json.loads(data.attrs["env_args"])["env_kwargs"]
        assert (arguments["camera_heights"], arguments["camera_widths"]) == (256, 256)
        for number, source in enumerate(map(episode, IDS)):
            demo, replay = data[f"demo_{number}"], source.replay
            assert replay is not None
            assert arrays(demo) == LIBERO_ARRAYS | {"action_absolute"}
            np.testing.assert_array_equal(demo["actions"], replay.actions)
            np.testing.assert_array_equal(demo["states"], replay.states)
            np.testing.assert_array_equal(demo["action_absolute"], source.action_absolute)
            for view, name in (("image", "agentview_rgb"), ("wrist_image", "eye_in_hand_rgb")):
                stored = demo[f"obs/{name}"]
                assert (stored.shape, stored.dtype) == ((len(source), 256, 256, 3), np.uint8)
                for step in (0, len(source) - 1):
                    np.testing.assert_array_equal(stored[step], raw(source.frames[view][step]))
            state = source.state
            for name, values in (
                ("ee_pos", state[:, :3]), ("ee_ori", state[:, 3:6]), ("ee_states", state[:, :6]),
                ("gripper_states", state[:, 6:]), ("joint_states", source.joint_state),
            ):  # fmt: skip
                np.testing.assert_array_equal(demo[f"obs/{name}"], values)
            assert_robot_states(demo["robot_states"][()], state)
            at_end = [0] * (len(source) - 1) + [1]
            assert demo["rewards"][()].tolist() == demo["dones"][()].tolist() == at_end
            attributes = demo.attrs
            assert attributes["num_samples"] == len(source)
            assert attributes["model_file"] == replay.scene.model_xml
            np.testing.assert_array_equal(attributes["init_state"], replay.states[0])
            assert attributes["instruction"] == source.instruction
            assert {name: attributes[name] for name in SCHEMA.provenance} == source.provenance


def assert_robot_states(found: NDArray[Any], state: NDArray[Any]) -> None:
    """LIBERO's order: fingers, position, quaternion with the scalar last."""
    np.testing.assert_array_equal(found[:, :5], np.hstack([state[:, 6:], state[:, :3]]))
    turns = Rotation.from_quat(found[:, 5:]).inv() * Rotation.from_rotvec(state[:, 3:6])
    assert turns.magnitude().max() < 1e-6


def test_a_quaternion_keeps_the_sign_of_robosuites_axis_angle(tmp_path: Path) -> None:
    """An angle above 180 degrees is that of a quaternion with a negative scalar."""
    expected = np.array([[0.6, 0.0, 0.0, -0.8], [0.0, 0.6, 0.0, 0.8], [0.0, 0.0, 0.0, 1.0]])
    angles = 2 * np.arccos(expected[:, 3:])
    axes = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])

    def turned(episode_id: str) -> Episode:
        source = episode(episode_id)
        state = source.state.copy()
        state[:3, 3:6] = axes * angles
        return replace(source, state=state)

    dataset = write_hdf5(tmp_path, turned)
    with h5py.File(dataset.folder / FILE) as file:
        np.testing.assert_allclose(file["data/demo_0/robot_states"][:3, 5:], expected, atol=1e-6)


BOXED = (2, 9)
"""Instances with pixels and boxes."""


@cache
def with_boxes(episode_id: str) -> Episode:
    """Generate the episode of ``with_extras`` with two moving rectangles as masks, and their boxes."""
    source = with_extras(episode_id)
    masks = np.zeros((len(source), 256, 256), np.uint8)
    boxes = np.zeros((len(source), 24, 4), np.float32)
    for step in range(len(source)):
        for instance, (x, y) in zip(BOXED, ((step, 40), (100, 200 + step)), strict=True):
            masks[step, y : y + 30, x : x + 10 + step] = instance
            boxes[step, instance] = x, y, 10 + step, 30
    files = [cv2.imencode(".png", mask)[1].tobytes() for mask in masks]
    views = {}
    for view, geometry in source.geometry.items():
        views[view] = replace(geometry, maps={**geometry.maps, "segmentation": files}, boxes=boxes)
    return replace(source, geometry=views)


def test_extras_and_matrices_are_those_of_the_raw_frames(tmp_path: Path) -> None:
    dataset = write_hdf5(tmp_path, with_boxes, extras=EXTRAS)
    source = with_boxes(IDS[0])
    with h5py.File(dataset.folder / FILE) as file:
        demo = file["data/demo_0"]
        for view, name in (("image", "agentview"), ("wrist_image", "eye_in_hand")):
            geometry = source.geometry[view]
            for extra, dtype in (("depth", np.uint16), ("segmentation", np.uint8)):
                stored = demo[f"obs/{name}_{extra}"]
                assert (stored.shape, stored.dtype) == ((len(source), 256, 256, 1), dtype)
                png = geometry.maps["depth" if extra == "depth" else "segmentation"][3]
                np.testing.assert_array_equal(stored[3, ..., 0], np.array(Image.open(BytesIO(png)))[::-1, ::-1])
            expected = np.zeros((len(source), 24, 4), np.float32)
            for step, mask in enumerate(demo[f"obs/{name}_segmentation"][..., 0]):
                for instance in BOXED:
                    expected[step, instance] = cv2.boundingRect((mask == instance).astype(np.uint8))
            np.testing.assert_array_equal(demo[f"obs/{name}_boxes"], expected)
            # The pixel (10, 20) of a rotated frame is the pixel (245, 235) of the raw frame.
            point = np.linalg.solve(geometry.intrinsics.astype(float), [10.0, 20.0, 1.0])
            np.testing.assert_allclose(demo.attrs[f"{name}_intrinsics"] @ point, [245.0, 235.0, 1.0], atol=1e-6)
            np.testing.assert_array_equal(demo.attrs[f"{name}_extrinsics"], geometry.extrinsics)
        np.testing.assert_array_equal(demo["obs/object_poses"], source.object_poses)
        assert json.loads(demo.attrs["instances"]) == list(source.instances)
    assert faults(dataset, source=with_boxes) == {}


def test_rewrites_subtasks_and_a_missed_goal_are_stored(tmp_path: Path) -> None:
    subtasks = (Subtask(0, "approach the bowl"), Subtask(4, "öffne"))
    rewrites = ("first wording", "zweite Formulierung")

    def labelled(episode_id: str) -> Episode:
        source = episode(episode_id)
        failed = {**source.provenance, "success": False, "reason": "goal_not_reached"}
        return replace(source, subtasks=subtasks, rewrites=rewrites, provenance=failed)

    dataset = write_hdf5(tmp_path, labelled, extras=("outcome",))
    with h5py.File(dataset.folder / FILE) as file:
        demo = file["data/demo_0"]
        assert demo.attrs["subtask_starts"].tolist() == [0, 4]
        assert demo.attrs["subtask_texts"].tolist() == ["approach the bowl", "öffne"]
        assert demo.attrs["rewrites"].tolist() == list(rewrites)
        assert not demo.attrs["success"]
        assert demo["rewards"][()].sum() == 0
        assert demo["dones"][()].sum() == 1
    copy = dataset.read({"episode_id": IDS[2]})
    assert copy is not None
    assert (copy.episode.subtasks, copy.episode.rewrites) == (subtasks, rewrites)


@pytest.mark.slow
def test_bytes_do_not_depend_on_the_workers(folder: Path, tmp_path: Path) -> None:
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        again = write_hdf5(tmp_path, run=partial(spread, executor))
        modules = executor.submit(loaded_packages).result()
    assert files(again.folder) == files(folder)
    assert str(tmp_path).encode() not in (again.folder / FILE).read_bytes()
    assert not {"mujoco", "robosuite", "libero", "torch", "tensorflow"} & modules


def test_validation_episodes_are_in_files_of_their_own(tmp_path: Path) -> None:
    known: dict[str, EpisodeFacts] = {}
    for number, one in enumerate(IDS):
        source = episode(one)
        known[one] = EpisodeFacts(
            "libero_spatial", "content", f"{TASK}/demo_{number // 2}", source.instruction, len(source)
        )
    dataset = Hdf5(tmp_path, Hdf5Config(name=NAME, validation=0.34))
    export(dataset, Episodes(known, episode), loop)
    assert sorted(files(dataset.folder)) == [FILE, f"val/{FILE}"]
    rows = {one: {**row(one), "demo_id": facts.demo, "demo_origin_sha256": facts.demo} for one, facts in known.items()}
    assert list(dataset.check(rows, tmp_path)) == []
    copies = [dataset.read(rows[one]) for one in IDS]
    assert sorted(copy.train for copy in copies if copy) == [False, False, True, True, True, True]


@pytest.mark.parametrize(("validation", "is_goal"), [(0.0, False), (0.34, False), (0.0, True)])
def test_the_example_of_the_card_names_a_file_of_the_dataset(validation: float, is_goal: bool, tmp_path: Path) -> None:
    """Also where all episodes are carried to another scene, and the card's first task has no file of its own."""
    suite, task = "libero_object", "pick_up_the_bbq_sauce_and_place_it_in_the_basket"
    scene = "pick_up_the_ketchup_and_place_it_in_the_basket"
    goal = {"axis": "goal", "component": "other_scene", "level": 2, "scene": scene, "start": 3}
    known: dict[str, EpisodeFacts] = {}
    rows: list[dict[str, Any]] = []
    for number, one in enumerate(IDS):
        demo = f"{suite}/{task}/demo_{number}"
        source = episode(one)
        known[one] = EpisodeFacts(suite, one, demo, source.instruction, len(source), scene=scene if is_goal else "")
        perturbations = json.dumps([goal] if is_goal else [])
        rows.append({"suite": suite, "task": task, "perturbations": perturbations})
        rows[-1] |= {"demo_id": demo, "demo_origin_sha256": ""}
    dataset = Hdf5(tmp_path, Hdf5Config(name=NAME, validation=validation))
    export(dataset, Episodes(known, episode), loop)
    (named,) = re.findall(r"/hdf5/(.*hdf5)", dataset.loading(NAME, "me/one", rows).partition("```python")[2])
    assert named in files(dataset.folder)
    assert ("__in__" in named) == is_goal


def row(episode_id: str, source: Callable[[str], Episode] = episode) -> dict[str, Any]:
    made = source(episode_id)
    stated = {**made.provenance, "instruction": made.instruction, "steps": len(made), "kept": True}
    return {**stated, "demo_origin_sha256": "origin"}


def faults(dataset: Hdf5, source: Callable[[str], Episode] = episode) -> Mapping[str, Sequence[str]]:
    """Return what is found in the dataset as a whole and in its first episode, by check."""
    rows = {one: row(one, source) for one in IDS}
    found: dict[str, list[str]] = {}
    for name, fault in dataset.check({one: {**rows[one], "demo_id": one} for one in IDS}, dataset.data):
        found.setdefault(name, []).append(fault.what)
    made = source(IDS[0])
    copy = dataset.read(rows[IDS[0]])
    if copy is None:
        return {**found, "missing": [IDS[0]]}
    replay = made.replay
    assert replay is not None
    states = np.vstack([replay.states, replay.states[-1:]])
    motion = (states, replay.actions, np.zeros((len(states), 0), np.float32), Verdict(True, "kept"))
    case = Case(rows[IDS[0]], made, Trajectory("", "open_loop", replay.scene, *motion), [copy], None)
    for name in ("length", "instruction", "provenance", "jpeg", "geometry", "flags"):
        found.setdefault(name, []).extend(fault.what for fault in CHECKS[name].find(case))
    # The synthetic actions are not those of the synthetic states.
    of_copy = [fault.what for fault in CHECKS["motion"].find(case) if fault.dataset == "hdf5"]
    found.setdefault("motion", []).extend(of_copy)
    return {name: texts for name, texts in found.items() if texts}


def test_nothing_is_found_in_what_was_written(written: Hdf5) -> None:
    written.open()
    assert faults(written) == {}


def change(name: str) -> Callable[[h5py.File], None]:
    def add(file: h5py.File) -> None:
        values = file["data/demo_0"][name]
        values[1] = values[1] + 1

    return add


def black(name: str) -> Callable[[h5py.File], None]:
    """Lose all frames but the first, the middle and the last."""

    def clear(file: h5py.File) -> None:
        frames = file["data/demo_0"][name]
        for step in {*range(len(frames))} - {0, len(frames) // 2, len(frames) - 1}:
            frames[step] = 0

    return clear


def set_attribute(name: str, value: Any, group: str = "data/demo_0") -> Callable[[h5py.File], None]:
    def assign(file: h5py.File) -> None:
        file[group].attrs[name] = value

    return assign


def remove(name: str) -> Callable[[h5py.File], None]:
    def delete(file: h5py.File) -> None:
        del file[name]

    return delete


def repeat_an_episode(file: h5py.File) -> None:
    file.copy("data/demo_1", file["data"], "demo_6")


DAMAGE: dict[str, tuple[Callable[[h5py.File], None], str, str]] = {
    "action": (change("actions"), "motion", "actions in double precision"),
    "absolute action": (change("action_absolute"), "motion", "action_absolute of step 1"),
    "state": (change("states"), "motion", "has other states"),
    "proprioception": (change("obs/ee_pos"), "motion", "state of step 1"),
    "robot's state": (change("robot_states"), "format", "robot_states differs from"),
    "hand's state": (change("obs/ee_states"), "format", "obs/ee_states differs from"),
    "source": (set_attribute("expanded_from", "other/demo"), "provenance", "expanded_from is 'other/demo'"),
    "hash": (set_attribute("expanded_from_sha256", "0" * 64), "provenance", "expanded_from_sha256 is '000"),
    "scene": (set_attribute("model_file", "<mujoco model='other'/>"), "motion", "another scene"),
    "gripper": (set_attribute("start_gripper", 1.0), "motion", "another start"),
    "posture": (set_attribute("start_posture_rad", np.zeros(7)), "motion", "another start"),
    "push": (set_attribute("start_push", '["robot0_link7", [1, 2, 3, 0, 0, 0], 2, 5]'), "motion", "another start"),
    "origin": (set_attribute("origin_sha256", "other"), "motion", "origin_sha256"),
    "frame": (change("obs/agentview_rgb"), "jpeg", "image has other pixels at 1 steps, first at 1"),
    "further frames": (
        black("obs/eye_in_hand_rgb"),
        "jpeg",
        f"wrist_image has other pixels at {len(episode(IDS[0])) - 3} ",
    ),
    "reward": (change("rewards"), "flags", "reward of step 1"),
    "end": (change("dones"), "flags", "is_last of step 1"),
    "instruction": (set_attribute("instruction", "another"), "instruction", "another"),
    "label": (set_attribute("axis", "another"), "provenance", "axis"),
    "matrix": (set_attribute("agentview_extrinsics", np.eye(4, dtype=np.float32)), "geometry", "image_extrinsics"),
    "array": (remove("data/demo_2/robot_states"), "format", "arrays"),
    "samples": (set_attribute("num_samples", 3), "format", "total"),
    "first state": (set_attribute("init_state", np.zeros(30)), "format", "init_state"),
    "number of demonstrations": (set_attribute("num_demos", 5, "data"), "format", "num_demos"),
    "task": (set_attribute("bddl_file_content", "(define)", "data"), "format", "bddl_file_content"),
    "environment": (set_attribute("env_args", "{}", "data"), "format", "env_args"),
    "missing episode": (remove("data/demo_0"), "missing", IDS[0]),
    "repeated episode": (repeat_an_episode, "ids", "7 episodes"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_damage_is_found(what: str, written: Hdf5) -> None:
    damage, check, words = DAMAGE[what]
    with h5py.File(written.folder / FILE, "r+") as file:
        damage(file)
    assert any(words in text for text in faults(written)[check])


def test_a_truncated_or_missing_file_is_named(written: Hdf5) -> None:
    file = written.folder / FILE
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 3])
    with pytest.raises(PipelineError, match=r"(?s)next_to_the_plate.*not readable as HDF5"):
        written.open()
    file.unlink()
    with pytest.raises(PipelineError, match="no HDF5 file"):
        written.open()


@pytest.mark.parametrize(
    ("attribute", "words"), [("start_state", "start_state"), ("start_gripper", "gripper: Field required")]
)
def test_an_attribute_that_is_lost_is_named(attribute: str, words: str, written: Hdf5) -> None:
    with h5py.File(written.folder / FILE, "r+") as file:
        del file["data/demo_0"].attrs[attribute]
    wanted: ManifestRow = row(IDS[0])
    with pytest.raises(PipelineError, match=rf"(?s)data/demo_0.*{words}"):
        written.read(wanted)
