"""Recordings of other recorders: what is equal to LIBERO's is used, and what is not is named with its values."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import Once
from recordings import NAME, TASK, as_published, file_in, recording, scene_here
from robosuite.controllers import load_controller_config

from pipeline.libero import hdf5
from pipeline.libero.assets import package_folder
from pipeline.libero.demonstrations import DemoIndex, HDF5Source

LIFT = package_folder("robosuite") / "models/assets/demonstrations/lift/demo.hdf5"
"""A file of the recorder that LIBERO's demonstrations were recorded with."""


@pytest.fixture(scope="module")
def model_file(once: Once) -> str:
    return as_published(scene_here(once))


@pytest.fixture
def root(tmp_path: Path, model_file: str) -> Path:
    hdf5.write(file_in(tmp_path), TASK, [recording(model_file), recording(model_file, seed=1)])
    return tmp_path


def changed(root: Path, change: Callable[[h5py.Group], object]) -> DemoIndex:
    """The index of a file after a change of its group ``data``."""
    with h5py.File(file_in(root), "r+") as file:
        change(file["data"])
    return HDF5Source(root).index([TASK])


def with_arguments(**arguments: Any) -> Callable[[h5py.Group], None]:
    def change(data: h5py.Group) -> None:
        named = json.loads(data.attrs["env_args"])
        named["env_kwargs"] |= arguments
        data.attrs["env_args"] = json.dumps(named)

    return change


def gains(**values: Any) -> dict[str, Any]:
    return {"controller_configs": load_controller_config(default_controller="OSC_POSE") | values}


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"control_freq": 10}, "control_freq 10, not 20"),
        (gains(kp=300), "kp 300, not 150"),
        (gains(output_max=[0.1] * 3 + [0.5] * 3), r"output_max [0.1, 0.1, 0.1, 0.5, 0.5, 0.5], not [0.05"),
        (gains(control_delta=False), "control_delta False, not True"),
        (gains(kp=[150, 150, 150, 300, 300, 300]), "kp [150, 150, 150, 300, 300, 300], not 150"),
        ({"controller_configs": load_controller_config(default_controller="JOINT_VELOCITY")}, "type JOINT_VELOCITY"),
        ({"controller_configs": {"type": "BASIC", "body_parts": {}}}, "type BASIC, not OSC_POSE"),
    ],
)
def test_other_settings_are_rejected_with_their_values(root: Path, arguments: dict[str, Any], told: str) -> None:
    index = changed(root, with_arguments(**arguments))
    assert not index.entries
    (problem,) = index.problems
    assert told in str(problem.error)
    assert f"{file_in(root)} data: the file was recorded with other settings" in str(problem.error)


@pytest.mark.parametrize(
    "change",
    [
        with_arguments(control_freq=20.0),
        with_arguments(**gains(kp=[150] * 6, damping_ratio=1.0)),
        with_arguments(**gains(kp_limits=[0, 500], ramp_ratio=1.0)),
        lambda data: data.attrs.pop("env_args"),
        with_arguments(controller_configs=[load_controller_config(default_controller="OSC_POSE")]),
    ],
)
def test_equal_settings_and_none_are_accepted(root: Path, change: Callable[[h5py.Group], object]) -> None:
    assert len(changed(root, change).entries) == 2


def test_what_robosuite_itself_recorded_has_the_settings_and_the_rate(root: Path) -> None:
    """Its file names them in ``env_info``; its states and actions take the place of ours."""
    with h5py.File(LIFT) as lift:
        told, states, actions = (
            lift["data"].attrs["env_info"],
            *(lift["data/demo_1"][n][:50] for n in ("states", "actions")),
        )

    def change(data: h5py.Group) -> None:
        del data.attrs["env_args"], data["demo_1"], data["demo_0"].attrs["init_state"]
        data.attrs["env_info"] = told
        put(data["demo_0"], states=states, actions=actions)

    index = changed(root, change)
    assert (len(index.entries), index.problems) == (1, [])
    index = changed(root, lambda data: data.attrs.modify("env_info", told.replace('"kp": 150', '"kp": 50')))
    assert "kp 50, not 150 (env_info)" in str(index.problems[0].error)


def put(demo: h5py.Group, **arrays: Any) -> None:
    for name, values in arrays.items():
        del demo[name]
        demo[name] = values


@pytest.mark.parametrize(("spacing_s", "told"), [(0.1, "0.1 s apart (10 Hz)"), (0.01, "0.01 s apart (100 Hz)")])
def test_states_of_another_rate_are_rejected(root: Path, spacing_s: float, told: str) -> None:
    def change(data: h5py.Group) -> None:
        states = data["demo_0/states"][()]
        states[:, 0] = states[0, 0] + spacing_s * np.arange(len(states))
        put(data["demo_0"], states=states)

    index = changed(root, change)
    assert [entry.key for entry in index.entries] == ["demo_1"]
    (problem,) = index.problems
    assert problem.name == f"{NAME}/demo_0"
    assert told in str(problem.error)
    assert "0.05 s (20 Hz)" in str(problem.error)


def test_a_gap_and_a_time_that_stands_still_are_accepted(root: Path) -> None:
    def change(data: h5py.Group) -> None:
        with_gap, still = data["demo_0/states"][()], data["demo_1/states"][()]
        with_gap[6:, 0] += 0.15
        still[:, 0] = still[0, 0]
        put(data["demo_0"], states=with_gap)
        put(data["demo_1"], states=still)

    assert len(changed(root, change).entries) == 2


def test_states_in_single_precision_after_a_first_state_in_double(root: Path) -> None:
    index = changed(root, lambda data: put(data["demo_0"], states=data["demo_0/states"][()].astype(np.float32)))
    assert [entry.key for entry in index.entries] == ["demo_0", "demo_1"]


def test_large_actions_are_limited_and_counted(root: Path) -> None:
    """To robosuite's own limits; a gripper's command in single precision is the command that it was."""
    with h5py.File(file_in(root)) as file:
        actions = file["data/demo_0/actions"][()]
    large = actions.copy()
    large[2, 0], large[5, 1], large[5, 6] = 1.8, -1.2, 1.2
    large[:, 6] *= 1 - 6e-8

    index = changed(root, lambda data: put(data["demo_0"], actions=large))
    assert (len(index.entries), index.problems) == (2, [])
    (note,) = index.notes
    assert note == (
        f"{file_in(root)}: 2 actions of 1 demonstrations are limited to [-1, 1], as robosuite does when it executes "
        "them (first: demo_0)"
    )
    executed = HDF5Source(root).load(f"{NAME}/demo_0").actions
    expected = large.copy()
    expected[2, 0], expected[5, 1] = 1.0, -1.0
    expected[:, 6] = actions[:, 6]
    expected[5, 6] = 1.0
    np.testing.assert_array_equal(executed, expected)
    index = changed(root, lambda data: put(data["demo_0"], actions=np.where(actions == 1.0, 0.5, actions * 0.5)))
    assert "the gripper has the command" in str(index.problems[0].error)
    assert "delete" not in str(index.problems[0].error)


def test_mask_groups_are_named_as_ignored(root: Path) -> None:
    with h5py.File(file_in(root), "r+") as file:
        file["mask/train"], file["mask/valid"] = [b"demo_0"], [b"demo_1"]
    index = HDF5Source(root).index([TASK])
    assert len(index.entries) == 2
    assert index.notes == (f"{file_in(root)}: mask/ (train, valid) is ignored: all demonstrations of data/ are used",)


def test_a_file_of_a_killed_recorder_is_cleared_and_not_deleted(root: Path) -> None:
    """As HDF5 marks it in its newer formats while it is open for writing."""
    code = """
import h5py, os, sys
file = h5py.File(sys.argv[1], "w", libver="latest")
file.create_group("data/demo_0")
file.flush()
os._exit(1)
"""
    subprocess.run([sys.executable, "-c", code, str(file_in(root))], check=False)
    told = str(HDF5Source(root).index([TASK]).problems[0].error)
    assert "h5clear -s" in told
    assert "delete" not in told


def test_a_filter_that_is_missing_is_named(root: Path) -> None:
    def change(data: h5py.Group) -> None:
        del data["demo_0/actions"]
        blosc = {"chunks": (12, 7), "compression": 32001, "allow_unknown_filter": True}
        actions = data.create_dataset("demo_0/actions", (12, 7), "f8", **blosc)
        actions.id.write_direct_chunk((0, 0), b"compressed")

    told = str(changed(root, change).problems[0].error)
    assert "h5repack -f NONE" in told
    assert "blosc" in told
    assert "delete" not in told
