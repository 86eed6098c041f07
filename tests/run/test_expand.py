"""Expansion: new demonstrations of a task that differ, succeed, and read back through the ordinary source."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest
from conftest import STOVE, link_testset, starter_demo
from machine_paths import told

from pipeline.compute.pool import loop
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.libero.assets import libero_assets
from pipeline.libero.demonstrations import HDF5Source
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.run.expand import APART_RAD, Expansion, candidates, expand
from pipeline.testset import benchmark

TASKS = DemosConfig(tasks=(f"{STOVE.suite}/{STOVE.name}",))


@pytest.fixture(scope="module")
def expanded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Expansion]:
    folder = tmp_path_factory.mktemp("expanded")
    link_testset(folder)
    rows = candidates(TASKS, 2, 1, benchmark.load(folder / benchmark.FOLDER))
    return folder / "demos", expand(folder / "demos", TASKS, rows, 2, loop)


def test_as_many_as_asked_for_in_liberos_layout(expanded: tuple[Path, Expansion]) -> None:
    root, made = expanded
    assert (made.written, made.short) == (2, {})
    index = HDF5Source(root).index([STOVE])
    assert not index.problems
    assert [entry.origin for entry in index.entries] == ["expanded", "expanded"]


def test_each_succeeds_again_open_loop_and_starts_elsewhere(expanded: tuple[Path, Expansion]) -> None:
    """The executed actions are the demonstration: sent from the recorded state they give the recorded states."""
    source, environment = HDF5Source(expanded[0]), Environment(STOVE)
    arms = []
    for entry in source.index([STOVE]).entries:
        demo = source.load(entry.demo_id)
        trajectory = replay(environment, demo, "t", ReplayConfig(noops="keep", settle_steps=0))
        assert trajectory.verdict.kept
        assert demo.states is not None
        assert np.array_equal(trajectory.states[:-1], demo.states)
        arms.append(demo.init_state[1:8])
    assert np.linalg.norm(arms[0] - arms[1]) > APART_RAD


def test_a_second_time_nothing_is_replayed_and_the_bytes_are_the_same(expanded: tuple[Path, Expansion]) -> None:
    root, made = expanded
    before = made.files[0].read_bytes()
    replays = {file: file.stat().st_mtime_ns for file in (root / ".replays").iterdir()}
    rows = candidates(TASKS, 2, 1, benchmark.load(root.parent / benchmark.FOLDER))
    again = expand(root, TASKS, rows, 2, loop)
    assert again.written == 2
    assert made.files[0].read_bytes() == before
    assert {file: file.stat().st_mtime_ns for file in (root / ".replays").iterdir()} == replays


def test_the_file_says_what_was_changed(expanded: tuple[Path, Expansion]) -> None:
    with h5py.File(expanded[1].files[0]) as file:
        attributes = dict(file["data/demo_0"].attrs)
    assert attributes["expanded_from"] == starter_demo(STOVE).demo_id
    assert [change["axis"] for change in json.loads(attributes["perturbations"])] == ["robot"]
    assert attributes["replay_mode"] in ("open_loop", "tracked")


def test_the_file_tells_nobody_s_folders_and_liberos_own_reader_finds_its_assets(
    expanded: tuple[Path, Expansion], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from libero.libero.envs.utils import postprocess_model_xml

    (file,) = expanded[1].files
    assert told(file) == set()
    with h5py.File(file) as opened:
        model_file = opened["data/demo_0"].attrs["model_file"]
    # LIBERO's looks for its assets in the folder ``libero`` of the working directory, as in a checkout.
    (tmp_path / "libero").mkdir()
    (tmp_path / "libero" / "assets").symlink_to(libero_assets())
    monkeypatch.chdir(tmp_path)
    theirs = mujoco.MjModel.from_xml_string(postprocess_model_xml(model_file, {}, demo_generation=True))
    demo = HDF5Source(expanded[0]).load(f"{STOVE.suite}/{STOVE.name}/demo_0")
    ours = mujoco.MjModel.from_xml_string(str(demo.model_xml))
    for name in ("mesh_vert", "tex_data", "body_mass"):
        assert np.array_equal(getattr(theirs, name), getattr(ours, name)), name
