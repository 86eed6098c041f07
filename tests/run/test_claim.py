"""A run's folder belongs to one configuration file: a copy of the file with the old name cannot touch it."""

import errno
import fcntl
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from checkout import REPOSITORY, link_testset
from faults import limited
from short_demonstrations import BOWL, STOVE, starter_demo
from short_runs import run_stages, tiny_config

from pipeline import __main__ as command_line
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.generated import generated
from pipeline.libero import hdf5
from pipeline.planning import plan
from pipeline.run.claim import LOCK, OWNER, claim_folder, locked, open_run, reject_other_folder


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a configuration, which the process works in."""
    demos = {"source": "starter", "tasks": [f"{STOVE.suite}/{STOVE.name}"]}
    file = tmp_path / "configs" / "tiny.yaml"
    file.parent.mkdir()
    file.write_text(yaml.safe_dump(tiny_config(tmp_path) | {"demos": demos}))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_a_copy_with_the_old_name_is_rejected_before_anything_else(clone: Path) -> None:
    claim_folder(Path("configs/tiny.yaml"))
    trajectory = clone / "data" / "tiny" / "trajectories" / "0123.npz"
    trajectory.parent.mkdir()
    trajectory.write_bytes(b"hours of work")
    shutil.copy("configs/tiny.yaml", "configs/copy.yaml")
    before = {file: file.stat().st_mtime_ns for file in clone.rglob("*")}
    command = [sys.executable, str(REPOSITORY / "stages" / "replay.py"), "configs/copy.yaml"]
    done = subprocess.run(command, cwd=clone, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: data/tiny: the folder belongs to configs/tiny.yaml")
    assert "change `name:` in configs/copy.yaml" in done.stderr
    assert {file: file.stat().st_mtime_ns for file in clone.rglob("*")} == before


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", "other", "`name: other` differs from the name of the file"),
        ("folder", "elsewhere", "`data: data` diff"),
    ],
)
def test_dvc_s_run_must_be_where_dvc_looks(clone: Path, field: str, value: str, message: str) -> None:
    file = Path("configs/tiny.yaml")
    Path("params.yaml").write_text("run: tiny\ndata: data\n")
    reject_other_folder(file)
    file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), field: value}))
    with pytest.raises(PipelineError, match=message):
        reject_other_folder(file)
    Path("params.yaml").write_text("run: starter\ndata: data\n")
    reject_other_folder(file)
    Path("params.yaml").write_text("run: [starter\n")
    with pytest.raises(PipelineError, match=r"params\.yaml: the file is not valid YAML"):
        reject_other_folder(file)


def test_push_rejects_it_too(clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    claim_folder(Path("configs/tiny.yaml"))
    shutil.copy("configs/tiny.yaml", "configs/copy.yaml")
    monkeypatch.setattr(sys, "argv", ["pipeline", "dataset", "push", "rlds", "somebody/tiny", "configs/copy.yaml"])
    assert command_line.main() == 1
    assert "belongs to configs/tiny.yaml" in capsys.readouterr().err


def test_an_edited_file_keeps_its_folder_however_it_is_named(clone: Path) -> None:
    claim_folder(Path("configs/tiny.yaml"))
    file = clone / "configs" / "tiny.yaml"
    config = yaml.safe_load(file.read_text())
    config["plan"]["seed"] = 8
    file.write_text(yaml.safe_dump(config))
    assert claim_folder(file).plan.seed == open_run(Path("configs/../configs/tiny.yaml")).config.plan.seed == 8


def test_no_missing_disk_is_replaced_by_a_new_folder(clone: Path, tmp_path: Path) -> None:
    """With a mistyped absolute path, a run would fill another disk."""
    file, disk = Path("configs/tiny.yaml"), tmp_path / "disk"
    edit(file, folder=str(disk / "me" / "data"))
    for use in (claim_folder, open_run):
        with pytest.raises(PipelineError, match=f"configs/tiny.yaml: folder: {disk}/me does not exist"):
            use(file)
    assert not disk.exists()
    (disk / "me").mkdir(parents=True)
    assert claim_folder(file).run_folder == disk / "me" / "data" / "tiny"


def edit(file: Path, **fields: object) -> None:
    """Change top-level fields of a configuration."""
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | fields))


def test_a_renamed_file_keeps_the_folder_until_it_is_edited(clone: Path) -> None:
    renamed, mark = Path("configs/renamed.yaml"), clone / "data" / "tiny" / OWNER
    claim_folder(Path("configs/tiny.yaml"))
    Path("configs/tiny.yaml").rename(renamed)
    unedited = renamed.read_text()
    edit(renamed, plan={"seed": 6, "episodes": {"noise": 4}})
    with pytest.raises(PipelineError, match=r"belongs to configs/tiny\.yaml, which is missing"):
        claim_folder(renamed)
    renamed.write_text(unedited)
    claim_folder(renamed)
    edit(renamed, plan={"seed": 6, "episodes": {"noise": 4}})
    claim_folder(renamed)

    mark.write_text('{"configuration": "../../configs/gone.yaml", "content": "another"}')
    with pytest.raises(PipelineError, match=r"belongs to configs/gone\.yaml") as caught:
        claim_folder(renamed)
    advised = re.search(r"write ({.*}) into (.*)$", str(caught.value.remedy))
    assert advised is not None
    Path(advised[2]).write_text(advised[1])
    claim_folder(renamed)


@pytest.mark.parametrize("edited", [False, True])
def test_a_checkout_that_was_moved_keeps_its_runs(edited: bool, clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one whose run folders are on another disk, and whose configuration is named from elsewhere."""
    checkout, disk, file = clone / "checkout", clone / "disk", Path("configs/tiny.yaml")
    checkout.mkdir()
    shutil.move("configs", checkout)
    if not edited:
        edit(checkout / file, folder=str(disk))
    monkeypatch.chdir(checkout)
    finished = claim_folder(file).run_folder / "trajectories" / "0123456789abcdef.h5"
    finished.parent.mkdir()
    finished.write_bytes(b"hours of work")
    monkeypatch.chdir(clone)
    checkout.rename(clone / "renamed")
    monkeypatch.chdir(clone / "renamed")
    if edited:
        edit(file, replay={"mode": "open_loop"})
    data = claim_folder(file).run_folder
    assert (data / "trajectories" / finished.name).read_bytes() == b"hours of work"


def test_a_file_may_be_named_by_its_absolute_path_and_from_elsewhere(
    clone: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here with a run's folder inside the checkout that `folder:` names in full."""
    file = Path("configs/tiny.yaml")
    edit(file, folder=str(clone / "results"))
    claim_folder(file)
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert claim_folder(clone / file).run_folder == open_run(clone / file).folder == clone / "results" / "tiny"
    monkeypatch.chdir(clone)
    claim_folder(file)


def test_a_folder_is_not_to_be_assigned_to_a_copy_while_its_configuration_exists(clone: Path) -> None:
    """Each run would delete finished work of the other one."""
    claim_folder(Path("configs/tiny.yaml"))
    shutil.copy("configs/tiny.yaml", "configs/copy.yaml")
    with pytest.raises(PipelineError, match=r"belongs to configs/tiny\.yaml") as caught:
        claim_folder(Path("configs/copy.yaml"))
    assert caught.value.remedy == "change `name:` in configs/copy.yaml, or `folder:`"


def test_marks_of_earlier_versions_count(clone: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    file, mark = Path("configs/tiny.yaml"), clone / "data" / "tiny" / OWNER
    claim_folder(file)
    for owner in ("configs/tiny.yaml", str(clone / "configs" / "tiny.yaml")):
        mark.write_text(json.dumps({"configuration": owner, "name": "tiny"}))
        claim_folder(file)
    mark.write_text(json.dumps({"configuration": "configs/other.yaml", "name": "tiny"}))
    with pytest.raises(PipelineError, match=r"belongs to configs/other\.yaml"):
        claim_folder(file)


def test_a_moved_folder_stays_its_configurations_through_a_link(
    clone: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file, disk, data = Path("configs/tiny.yaml"), tmp_path_factory.mktemp("disk") / "tiny", Path("data/tiny")
    claim_folder(file)
    shutil.move(data, disk)
    data.symlink_to(disk)
    claim_folder(file)
    data.unlink()
    shutil.move(disk, data)
    claim_folder(file)


def test_a_folder_that_was_moved_to_where_the_configuration_says_is_found(
    clone: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file, disk = Path("configs/tiny.yaml"), tmp_path_factory.mktemp("disk")
    claim_folder(file)
    shutil.move("data/tiny", disk / "tiny")
    edit(file, folder=str(disk))
    assert claim_folder(file).run_folder == open_run(file).folder == disk / "tiny"
    edit(file, plan={"seed": 6, "episodes": {"noise": 4}})
    claim_folder(file)
    shutil.move(disk / "tiny", "data/tiny")
    edit(file, folder="data")
    claim_folder(file)


def test_a_folder_whose_configuration_is_out_of_sight_is_not_for_another_content(clone: Path) -> None:
    """As a folder on a shared disk, claimed by a checkout that another machine has on its own disk."""
    claim_folder(Path("configs/tiny.yaml"))
    mark = Path("data/tiny") / OWNER
    mark.write_text(json.dumps(json.loads(mark.read_text()) | {"configuration": "../../../machine/configs/tiny.yaml"}))
    edit(Path("configs/tiny.yaml"), plan={"seed": 6, "episodes": {"noise": 4}})
    with pytest.raises(PipelineError, match=r"which is missing, and .*configs/tiny\.yaml has different content"):
        claim_folder(Path("configs/tiny.yaml"))


@pytest.mark.parametrize("place", ["frames/1.png", "notes.txt", ".hidden/key", "configuration.yaml"])
def test_a_folder_with_files_that_no_run_made_is_not_claimed(place: str, clone: Path) -> None:
    theirs = clone / "data" / "tiny" / place
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"mine")
    before = {path: path.lstat().st_mtime_ns for path in clone.rglob("*")}
    with pytest.raises(
        PipelineError, match=f"data/tiny: the folder contains files and is not the folder of a run.*{place[:6]}"
    ):
        claim_folder(Path("configs/tiny.yaml"))
    assert {path: path.lstat().st_mtime_ns for path in clone.rglob("*")} == before


def test_a_file_in_place_of_the_folder_is_named(clone: Path) -> None:
    (clone / "data").mkdir()
    (clone / "data" / "tiny").write_bytes(b"mine")
    with pytest.raises(PipelineError, match="data/tiny: the path is not a folder"):
        claim_folder(Path("configs/tiny.yaml"))


def test_a_folder_inside_another_runs_is_rejected(clone: Path) -> None:
    claim_folder(Path("configs/tiny.yaml"))
    inner = Path("configs/frames.yaml")
    shutil.copy("configs/tiny.yaml", inner)
    edit(inner, name="frames", folder="data/tiny")
    with pytest.raises(PipelineError, match=r"is inside .*data/tiny, the folder of another run"):
        claim_folder(inner)
    assert not Path("data/tiny/frames").exists()


def test_of_two_checkouts_with_one_folder_elsewhere_the_second_is_rejected(
    clone: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared, other, file = tmp_path_factory.mktemp("disk"), tmp_path_factory.mktemp("other"), Path("configs/tiny.yaml")
    file.write_text(file.read_text() + f"folder: {shared}\n")
    shutil.copytree("configs", other / "configs")
    claim_folder(file)
    monkeypatch.chdir(other)
    with pytest.raises(PipelineError, match=f"the folder belongs to {clone / file}, and {other / file} has the same"):
        claim_folder(file)


@pytest.mark.parametrize("stage", ["replay", "render"])
def test_a_plan_of_other_replay_settings_is_rejected(clone: Path, stage: str) -> None:
    """Else their replays would be stored under the ids of the settings before, and stay when these are put back."""
    config = Config.model_validate(yaml.safe_load(Path("configs/tiny.yaml").read_text()))
    rows = plan.twins(config.demos.index().entries, 0, config.replay)
    claim_folder(Path("configs/tiny.yaml"))
    plan.write(rows, clone / "data" / "tiny" / "plan.parquet")
    edited = config.model_dump(mode="json") | {"replay": {"mode": "open_loop", "settle_steps": 10}}
    with pytest.raises(AssertionError, match="the section replay has changed since the plan"):
        run_stages(clone, edited, [stage])
    plan.reject_other_settings(rows, config.replay)


def test_a_plan_without_a_task_that_was_asked_for_is_rejected(clone: Path) -> None:
    """Else the other task would get its episodes, and the stage replay would delete what was finished of it."""
    link_testset(clone)
    for task in (STOVE, BOWL):
        demo = starter_demo(task)
        states = np.tile(demo.init_state, (len(demo.actions), 1))
        recording = hdf5.Recording(demo.actions, states, states[:, :9], "<mujoco/>", {})
        hdf5.write(clone / "demos" / task.suite / f"{task.name}_demo.hdf5", task, [recording])
    demos = {"root": str(clone / "demos"), "tasks": [f"{task.suite}/{task.name}" for task in (STOVE, BOWL)]}
    config = tiny_config(clone) | {"demos": demos, "plan": {"episodes": {"noise": 4}}}
    run_stages(clone, config, ["plan"])
    plan_of_both = (clone / "data" / "tiny" / "plan.parquet").read_bytes()
    (clone / "demos" / BOWL.suite / f"{BOWL.name}_demo.hdf5").unlink()
    with pytest.raises(AssertionError, match=rf"1 of the selected tasks have no usable demonstration: .*{BOWL.name}"):
        run_stages(clone, config, ["plan"])
    assert (clone / "data" / "tiny" / "plan.parquet").read_bytes() == plan_of_both


def test_reading_a_run_writes_nothing(clone: Path) -> None:
    open_run(Path("configs/tiny.yaml"))
    assert not (clone / "data").exists()


def test_a_mark_that_cannot_be_read_is_named(clone: Path) -> None:
    claim_folder(Path("configs/tiny.yaml"))
    mark = Path("data/tiny") / OWNER
    mark.write_text("")
    with pytest.raises(PipelineError, match=f"{mark}: the mark of the folder does not name a configuration file"):
        claim_folder(Path("configs/tiny.yaml"))


def test_one_stage_of_a_run_works_at_a_time(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(PipelineError, match="another stage of this run is running"), locked(tmp_path):
        pass
    with locked(tmp_path):
        pass


def test_a_file_system_without_locks_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Lustre answers when it is mounted without them; there, two machines would clear each other's work."""

    def reject(*_: object) -> None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", reject)
    with pytest.raises(PipelineError, match="cannot lock a file"), locked(tmp_path):
        pass


WRITING = """
import os, signal, sys
from pathlib import Path
from pipeline.files import replaced
with replaced(Path(sys.argv[1])) as temporary:
    (temporary / "libero_goal").mkdir(parents=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_stage_left_goes_with_the_next_one(tmp_path: Path) -> None:
    """A stage that found nothing to do would leave it for ever."""
    whole = tmp_path / "previews"
    (whole / "libero_goal").mkdir(parents=True)
    subprocess.run([sys.executable, "-c", WRITING, str(whole)], cwd=REPOSITORY, check=False)
    assert len(list(tmp_path.iterdir())) == 2
    # As another host's process may have left it, whose number a process has here too.
    (tmp_path / f".report.html.{os.getpid()}.tmp").touch()
    with locked(tmp_path):
        assert {entry.name for entry in tmp_path.iterdir()} == {"previews", LOCK}


def test_a_full_disk_leaves_no_half_of_the_mark(clone: Path) -> None:
    with pytest.raises(OSError, match="File too large"), limited(resource.RLIMIT_FSIZE, 10):
        claim_folder(Path("configs/tiny.yaml"))
    claim_folder(Path("configs/tiny.yaml"))
    assert json.loads((clone / "data" / "tiny" / OWNER).read_text())["configuration"] == "../../configs/tiny.yaml"


def test_a_link_in_place_of_a_runs_folder_is_rejected(clone: Path) -> None:
    """A stage deletes what it did not plan: what the link leads to may be somebody else's."""
    data = claim_folder(Path("configs/tiny.yaml")).run_folder
    (data / "frames").symlink_to(clone / "configs")
    with pytest.raises(PipelineError, match="data/tiny/frames: the entry of the run's folder is a symbolic link"):
        claim_folder(Path("configs/tiny.yaml"))


FOREIGN = (
    "trajectories/notes.txt",
    "trajectories/0123456789abcdef (copy).npz",
    "frames/0123456789abcdef/backup/0123456789abcdef.npz",
    "frames/mine.png",
    "sheets/for the paper.png",
    "previews/libero_goal/LICENSE",
)


@pytest.mark.parametrize("place", FOREIGN)
def test_a_file_that_no_stage_made_stops_every_stage_and_stays(place: str, clone: Path) -> None:
    theirs = claim_folder(Path("configs/tiny.yaml")).run_folder / place
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"mine")
    with pytest.raises(
        AssertionError, match=rf"data/tiny: the folder contains files that no stage .* generated.*{theirs.name[:9]}"
    ):
        run_stages(clone, yaml.safe_load(Path("configs/tiny.yaml").read_text()), ["inputs"])
    assert theirs.read_bytes() == b"mine"


def test_a_link_among_a_runs_files_is_foreign(clone: Path) -> None:
    data = claim_folder(Path("configs/tiny.yaml")).run_folder
    link = data / "trajectories" / "0123456789abcdef.npz"
    link.parent.mkdir()
    link.symlink_to(clone / "configs" / "tiny.yaml")
    with pytest.raises(AssertionError, match=r"no stage of this run generated.*trajectories/0123456789abcdef\.npz"):
        run_stages(clone, yaml.safe_load(Path("configs/tiny.yaml").read_text()), ["inputs"])


@pytest.mark.parametrize("place", FOREIGN)
def test_clean_names_a_file_that_no_stage_made(
    place: str, clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = claim_folder(Path("configs/tiny.yaml")).run_folder / place
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"mine")
    monkeypatch.setattr(sys, "argv", ["pipeline", "clean", "--yes", "configs/tiny.yaml"])
    assert command_line.main() == 1
    assert f"would be deleted: {place}" in capsys.readouterr().err
    assert theirs.read_bytes() == b"mine"


@pytest.mark.parametrize("state", ["added", "changed", "without a record"])
@pytest.mark.parametrize("part", ["uploads", None])
@pytest.mark.parametrize("place", ["card/rlds/LICENSE", "finetune/checkpoints/last/model.safetensors", "finetune/.env"])
def test_clean_names_an_edited_file(
    place: str,
    part: str | None,
    state: str,
    clone: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = claim_folder(Path("configs/tiny.yaml")).run_folder
    edited, folder = data / place, data / place.partition("/")[0]
    edited.parent.mkdir(parents=True)
    if state != "without a record":
        with generated(folder) as new:
            (new / "generated.txt").write_text("ours")
            if state == "changed":
                (new / edited.relative_to(folder)).parent.mkdir(parents=True, exist_ok=True)
                (new / edited.relative_to(folder)).write_text("ours")
        edited.parent.mkdir(parents=True, exist_ok=True)
    edited.write_bytes(b"mine")
    only = ["--only", part] if part else []
    monkeypatch.setattr(sys, "argv", ["pipeline", "clean", "--yes", *only, "configs/tiny.yaml"])
    assert command_line.main() == 1
    assert f"would be deleted: {edited.relative_to(folder)} ({state})" in capsys.readouterr().err
    assert edited.read_bytes() == b"mine"
    edited.rename(clone / "kept")
    assert command_line.main() == 0
    assert not folder.exists()


@pytest.mark.parametrize("place", ["rlds/notes.txt", "lerobot_v21/mine/weights.bin", "failures/rlds/notes.txt"])
@pytest.mark.parametrize("recorded", [True, False])
def test_clean_names_a_file_that_no_export_recorded(
    place: str, recorded: bool, clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = claim_folder(Path("configs/tiny.yaml")).run_folder
    theirs = data / place
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"mine")
    dataset = next(folder for folder in theirs.parents if folder.name in ("rlds", "lerobot_v21"))
    (dataset / "data.bin").write_bytes(b"ours")
    if recorded:
        record = {"identity": "", "files": {"data.bin": "hash"}, "places": {}}
        dataset.with_name(f"{dataset.name}.json").write_text(json.dumps(record))
    monkeypatch.setattr(sys, "argv", ["pipeline", "clean", "--yes", "configs/tiny.yaml"])
    assert command_line.main() == 1
    assert "no record of an export lists the file" in capsys.readouterr().err
    assert theirs.read_bytes() == b"mine"
    if recorded:
        theirs.unlink()
        assert command_line.main() == 0
        assert not dataset.exists()


def test_clean_needs_a_mark_and_names_foreign_files(
    clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pipeline", "clean", "--yes", "configs/tiny.yaml"])
    theirs = clone / "data" / "tiny" / "frames" / "holiday.jpg"
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"mine")
    assert command_line.main() == 1
    assert "data/tiny: the folder contains files and is not the folder of a run" in capsys.readouterr().err
    theirs.rename("holiday.jpg")
    theirs.parent.rmdir()
    claim_folder(Path("configs/tiny.yaml"))
    theirs.parent.mkdir()
    Path("holiday.jpg").rename(theirs)
    assert command_line.main() == 1
    assert "would be deleted: frames/holiday.jpg" in capsys.readouterr().err
    assert theirs.read_bytes() == b"mine"
