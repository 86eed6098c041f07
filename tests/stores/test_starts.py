"""Each field of a start is stored and read by trajectories and HDF5 files."""

from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.formats.hdf5 import layout
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Push, Scene, Start, Trajectory, Verdict

AFTER_RESET = Start(gripper=0.0)
CHANGED = Start(1.0, (0.1,) * 7, Push("robot0_link7", (1.0, 2.0, 3.0, 0.0, 0.0, 0.5), 2, 4))
STARTS = [
    AFTER_RESET,
    *(replace(AFTER_RESET, **{field.name: getattr(CHANGED, field.name)}) for field in fields(Start)),
]
"""A start after LIBERO's reset, and others that each differ in one field."""


def test_each_field_is_tested() -> None:
    assert len({*STARTS}) == len(fields(Start)) + 1


@pytest.mark.parametrize("start", STARTS)
def test_a_trajectory_keeps_its_start(start: Start, tmp_path: Path) -> None:
    none = np.zeros((0, 0), np.float32)
    scene = Scene("<mujoco/>", np.zeros(3), start=start)
    store = TrajectoryStore(tmp_path)
    store.save(Trajectory("one", "open_loop", scene, np.zeros((1, 3)), np.zeros((0, 7)), none, Verdict(True, "kept")))
    assert store.load("one").scene.start == start


@pytest.mark.parametrize("start", STARTS)
def test_an_hdf5_file_keeps_its_start(start: Start, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "file.hdf5", "w") as file:
        file.attrs.update(layout.start_attributes(start))
    with h5py.File(tmp_path / "file.hdf5") as file:
        assert layout.start_of(dict(file.attrs)) == start
