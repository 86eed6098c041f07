"""Expansion: new demonstrations of a task that differ, succeed, and read back through the ordinary source.

Most tests are of ``--starts wide``; what resets have in common with it is tested there.
"""

import json
import shutil
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest
from checkout import link_testset
from machine_paths import told
from scipy.spatial.transform import Rotation
from short_demonstrations import STOVE, starter_demo

from pipeline import outputs
from pipeline.__main__ import main
from pipeline.compute.pool import loop, runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.libero.assets import libero_assets
from pipeline.libero.demonstrations import HDF5Source
from pipeline.physics.control_env import control_env
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.planning import plan
from pipeline.run.expand import APART_RAD, Expansion, candidates, expand, resets
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
    with h5py.File(next(root.rglob("*.hdf5"))) as file:
        for demo in file["data"].values():
            # As create_dataset.py writes them: the robot's state, fingers and hand, is observed after the action.
            robot, seen = np.array(demo["robot_states"]), demo["obs"]
            np.testing.assert_array_equal(robot[:, :2], seen["gripper_states"])
            np.testing.assert_array_equal(robot[:, 2:5], seen["ee_pos"])
            turned = Rotation.from_quat(robot[:, 5:]) * Rotation.from_rotvec(seen["ee_ori"]).inv()
            np.testing.assert_allclose(turned.magnitude(), 0, atol=1e-3)


def test_the_command_tells_what_is_short_and_fails_where_nothing_was_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pipeline.run.expand.expand", lambda *_: Expansion(short={"libero_goal/turn_on_the_stove": 2}))
    link_testset(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["pipeline", "demos", "expand", "out", "--tasks", *TASKS.tasks, "--per-task", "2"])
    assert main() == 1
    told = capsys.readouterr().out
    assert "libero_goal/turn_on_the_stove: 2 of 2 requested demonstrations are missing" in told
    assert "configuration" not in told


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
    assert attributes["origin_sha256"] == starter_demo(STOVE).sha256
    assert [change["axis"] for change in json.loads(attributes["perturbations"])] == ["robot"]
    assert attributes["replay_mode"] in ("open_loop", "tracked")


def test_what_is_expanded_twice_still_has_the_origin_of_the_human_one(expanded: tuple[Path, Expansion]) -> None:
    entries = HDF5Source(expanded[0]).index([STOVE]).entries
    assert len({entry.sha256 for entry in entries}) == 2
    rows = plan.twins(entries, 1, ReplayConfig())
    assert {row.demo_origin_sha256 for row in rows} == {starter_demo(STOVE).sha256}
    assert plan.count_demonstrations(rows) == {STOVE.suite: 1}


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


@pytest.fixture(scope="module")
def at_resets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("at_resets")
    made = expand(folder, TASKS, resets(TASKS, 2, 1), 2, loop)
    assert (made.written, made.short) == (2, {})
    return made.files[0]


def test_a_start_is_a_reset_of_liberos_own_environment(at_resets: Path) -> None:
    """As its demonstrations and initial states were made: with the arm's noise, which ``ControlEnv`` leaves out."""
    env = control_env()(
        str(STOVE.bddl_file), initialization_noise="default", use_camera_obs=False, has_offscreen_renderer=False
    )
    with h5py.File(at_resets) as file:
        recorded = file["data/demo_1"]
        env.seed(int(recorded.attrs["reset_seed"]))
        env.reset()
        for _ in range(5):
            env.step([0.0] * 6 + [-1.0])
        assert np.array_equal(env.get_sim_state(), recorded["states"][0])
        assert (recorded.attrs["perturbations"], recorded.attrs["replay_mode"]) == ("[]", "tracked")
    demo = HDF5Source(at_resets.parents[1]).load(f"{STOVE.suite}/{STOVE.name}/demo_1")
    written, theirs = mujoco.MjModel.from_xml_string(str(demo.model_xml)), env.sim.model._model
    for name in ("body_pos", "body_quat", "site_pos", "geom_pos", "body_mass"):
        # MJCF has six digits.
        assert np.allclose(getattr(written, name), getattr(theirs, name), rtol=1e-5, atol=1e-6), name
    assert not np.allclose(
        written.body_pos, mujoco.MjModel.from_xml_string(Environment(STOVE).place_fixtures(0)).body_pos
    )


def test_how_many_start_at_resets_and_who_makes_them_changes_none(at_resets: Path, tmp_path: Path) -> None:
    with runner(ComputeConfig(workers=1), tmp_path) as worker:
        alone = expand(tmp_path, TASKS, resets(TASKS, 1, 1), 1, worker).files[0]
    with h5py.File(alone) as one, h5py.File(at_resets) as other:
        for name in ("reset_seed", "model_file"):
            assert one["data/demo_0"].attrs[name] == other["data/demo_0"].attrs[name]
        for name in ("states", "actions", "obs/ee_pos"):
            assert np.array_equal(one[f"data/demo_0/{name}"], other[f"data/demo_0/{name}"])


def test_unknown_starts_are_rejected(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["pipeline", "demos", "expand", "out", "--starts", "far"])
    assert main() == 2
    assert "Invalid value for '--starts': 'far' is not one of 'wide', 'reset'" in capsys.readouterr().err


def test_a_reserve_takes_the_place_of_one_that_starts_like_another(
    at_resets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three candidates for two demonstrations, all start alike here, so the third is tried as well."""
    for name, value in {"APART_RAD": 10.0, "APART_M": 10.0, "RESERVE": 0.5}.items():
        monkeypatch.setattr(f"pipeline.run.expand.{name}", value)
    shutil.copytree(at_resets.parents[1] / ".replays", tmp_path / ".replays")
    made = expand(tmp_path, TASKS, resets(TASKS, 2, 1), 2, loop)
    assert (made.written, made.dropped) == (1, {"duplicate": 2})


def test_what_is_rougher_than_the_human_is_dropped(
    at_resets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here whatever takes longer than a tenth of the human's steps."""
    monkeypatch.setattr("pipeline.run.expand.ROUGH", {"steps": 0.1})
    monkeypatch.setattr("pipeline.run.expand.RESERVE", 0.0)
    shutil.copytree(at_resets.parents[1] / ".replays", tmp_path / ".replays")
    made = expand(tmp_path, TASKS, resets(TASKS, 2, 1), 2, loop)
    assert (made.written, made.dropped) == (0, {"not_smooth": 2})


FROM = {hdf5.EXPANDED_FROM: "libero_goal/turn_on_the_stove/demo_0"}


@pytest.mark.parametrize("attrs", [{}, FROM, {**FROM, hdf5.EXPANDED_BY: "perturbed-libero 0.3.0"}])
def test_only_what_an_expansion_made_is_replaced_and_only_if_that_is_allowed(
    tmp_path: Path, attrs: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here by nothing, as if no candidate reached the goal. An exported episode names its source, but no expansion."""
    file = tmp_path / STOVE.suite / f"{STOVE.name}_demo.hdf5"
    demo = starter_demo(STOVE)
    states = np.tile(demo.init_state, (len(demo.actions), 1))
    with outputs.written(file) as temporary:
        hdf5.write(temporary, STOVE, [hdf5.Recording(demo.actions, states, states[:, :9], "<mujoco/>", {}, attrs)])
    before = file.read_bytes()
    if hdf5.EXPANDED_BY in attrs:
        with pytest.raises(PipelineError, match="1 demonstrations of an earlier expansion would be deleted"):
            expand(tmp_path, TASKS, resets(TASKS, 1, 1), 1, loop)
        assert not (tmp_path / ".replays").exists(), "the replays take hours, and come after this error"
        assert file.read_bytes() == before
        monkeypatch.setenv("REMAKE", "1")
        assert expand(tmp_path, TASKS, [], 1, loop).short == {f"{STOVE.suite}/{STOVE.name}": 1}
        assert not file.exists()
    else:
        with pytest.raises(PipelineError, match="that no expansion generated"):
            expand(tmp_path, TASKS, [], 1, loop)
        assert file.read_bytes() == before


def test_an_edited_file_of_an_expansion_stays(expanded: tuple[Path, Expansion], tmp_path: Path) -> None:
    folder = shutil.copytree(expanded[0], tmp_path / "expanded")
    (file,) = folder.rglob("*.hdf5")
    with h5py.File(file, "a") as content:
        content["data/demo_0/obs/my_force_n"] = np.arange(10)
    before = file.read_bytes()
    with pytest.raises(PipelineError, match="the command would overwrite the file, which is edited"):
        expand(folder, TASKS, [], 1, loop)
    assert file.read_bytes() == before


def test_a_file_without_demonstrations_is_not_taken_for_an_expansion(tmp_path: Path) -> None:
    """As a recorder leaves one that stores demonstrations under other names at its end."""
    file = tmp_path / STOVE.suite / f"{STOVE.name}_demo.hdf5"
    file.parent.mkdir()
    with h5py.File(file, "w") as content:
        content.create_group("data")
        content["raw"] = np.arange(10)
    before = file.read_bytes()
    with pytest.raises(PipelineError, match="that no expansion generated"):
        expand(tmp_path, TASKS, [], 1, loop)
    assert file.read_bytes() == before
