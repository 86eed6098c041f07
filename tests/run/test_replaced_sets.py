"""A kill at any change of the file system while sets of new names replace old ones: the same command ends the same."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import run_in
from synthetic import episode, episodes, files

from pipeline.config import Config
from pipeline.episode_schema import Content
from pipeline.errors import PipelineError
from pipeline.formats.base import Format
from pipeline.formats.episodes import Episodes
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.run import cleaning
from pipeline.run.claim import OWNER
from pipeline.run.dataset_files import reject_deleting_foreign
from pipeline.run.export import _bring_up_to_date, notice_changes
from pipeline.run.run import Run
from pipeline.types import Episode

PLAN = {"axes": {"camera": {}}, "episodes": {"camera": 1}}
RUN = Run(Config.model_validate({"name": "tiny", "plan": PLAN, "compute": {"cluster": "loop"}}))

CHANGES = {"os.rename", "os.remove", "os.rmdir"}
"""What Python's audit reports of rename and replace, of unlink and remove, and of rmdir, before it happens."""


def target(name: str, data: Path, called: str) -> Format[Any]:
    if name == "rlds":
        return Rlds(data, RldsConfig(name=called, shards=2))
    if name == "lerobot":
        return LeRobot(data, LeRobotConfig(name=called))
    return LeRobotV21(data, LeRobotV21Config(name=called, convention="ipec"))


def command(name: str, data: Path) -> None:
    """What a run does with one format: the stage ``inputs``, then that of the export."""
    notice_changes(target(name, data, "new"))
    _bring_up_to_date(target(name, data, "new"), episodes(), RUN)


def aside(edited: Path, data: Path) -> str:
    """Where a file of the RLDS data set is kept, below the run's folder, once its replacement is allowed."""
    return str(Path("rlds.edited_1") / edited.relative_to(data / "rlds"))


@pytest.mark.parametrize("name", ["rlds", "lerobot"])
@pytest.mark.parametrize("damage", [Path.unlink, lambda file: file.write_bytes(b"rot")], ids=["missing", "changed"])
def test_a_file_of_the_user_stays_where_a_damaged_dataset_is_generated_again(
    name: str, damage: Callable[[Path], object], tmp_path: Path
) -> None:
    command(name, tmp_path)
    expected = files(tmp_path)
    folder = target(name, tmp_path, "new").folder
    damaged = max(folder.rglob("*.*"), key=lambda file: file.stat().st_size if file.is_file() else 0)
    note = damaged.with_name("note.csv")
    note.write_text("of the user")
    damage(damaged)
    for _ in range(2):
        with pytest.raises(PipelineError, match=r"note\.csv"):
            command(name, tmp_path)
    assert note.read_text() == "of the user"
    note.unlink()
    damaged.unlink(missing_ok=True)
    command(name, tmp_path)
    assert files(tmp_path) == expected


@pytest.mark.parametrize("edit", [b"rot", b"0" * 100_000], ids=["shorter", "longer"])
def test_an_edited_file_is_replaced_only_where_that_is_allowed(
    edit: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command("rlds", tmp_path)
    expected = files(tmp_path)
    edited = next(tmp_path.rglob("dataset_info.json"))
    before = edited.stat()
    edited.write_bytes(edit)
    # As by `cp -p` or `rsync -a` from a copy.
    os.utime(edited, ns=(before.st_atime_ns, before.st_mtime_ns))
    for _ in range(2):
        with pytest.raises(PipelineError, match=r"dataset_info\.json: the file was edited or damaged"):
            command("rlds", tmp_path)
    assert edited.read_bytes() == edit
    edited.write_bytes(expected[str(edited.relative_to(tmp_path))])
    command("rlds", tmp_path)
    assert files(tmp_path) == expected, "its record returned"
    edited.write_bytes(edit)
    monkeypatch.setenv("REMAKE", "1")
    command("rlds", tmp_path)
    assert files(tmp_path) == {**expected, aside(edited, tmp_path): edit}


@pytest.mark.parametrize("content", ["first", "second"], ids=["the same dataset", "another dataset"])
def test_an_edited_file_is_noticed_by_the_stage_of_the_export_alone(content: str, tmp_path: Path) -> None:
    command("rlds", tmp_path)
    edited = next(tmp_path.rglob("dataset_info.json"))
    edited.write_bytes(b"mine")
    for _ in range(2):
        with pytest.raises(PipelineError, match=r"dataset_info\.json: the file was edited or damaged"):
            _bring_up_to_date(target("rlds", tmp_path, "new"), episodes(content=content), RUN)
    assert edited.read_bytes() == b"mine"


def test_an_edit_that_keeps_size_and_time_stops_the_replacement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command("rlds", tmp_path)
    export_target, edited = target("rlds", tmp_path, "new"), next(tmp_path.rglob("dataset_info.json"))
    before, original = edited.stat(), edited.read_bytes()
    mine = original.replace(b"rlds", b"mine") if b"rlds" in original else original[::-1]
    edited.write_bytes(mine)
    os.utime(edited, ns=(before.st_atime_ns, before.st_mtime_ns))
    for _ in range(2):
        with pytest.raises(PipelineError, match=r"dataset_info\.json: the file was edited or damaged") as caught:
            _bring_up_to_date(export_target, episodes(content="second"), RUN)
        assert "REMAKE=1" in str(caught.value)
    assert edited.read_bytes() == mine
    monkeypatch.setenv("REMAKE", "1")
    _bring_up_to_date(export_target, episodes(content="second"), RUN)
    assert edited.read_bytes() == original
    assert (tmp_path / aside(edited, tmp_path)).read_bytes() == mine
    assert not export_target.work.exists()


def test_a_file_that_the_user_edits_during_an_export_stays(tmp_path: Path) -> None:
    command("rlds", tmp_path)
    edited = next(tmp_path.rglob("dataset_info.json"))
    original = edited.read_bytes()

    def load(episode_id: str) -> Episode:
        edited.write_bytes(b"mine")
        return episode(episode_id)

    export_target = target("rlds", tmp_path, "new")
    with pytest.raises(PipelineError, match=r"dataset_info\.json: the file was edited or damaged"):
        _bring_up_to_date(export_target, episodes(load, content="second"), RUN)
    assert edited.read_bytes() == b"mine"
    edited.write_bytes(original)
    _bring_up_to_date(export_target, episodes(content="second"), RUN)
    assert not export_target.work.exists()


@pytest.mark.parametrize("is_allowed", [True, False])
def test_failures_that_no_longer_exist_are_not_deleted_with_an_edit(
    is_allowed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = Content(extras=("outcome",))
    failures = Rlds(tmp_path, RldsConfig(name="new", shards=2), content)
    lost: dict[str, Any] = {"success": False, "reason": "goal_lost"}

    def load(episode_id: str) -> Episode:
        made = episode(episode_id)
        return replace(made, provenance={**made.provenance, **lost})

    _bring_up_to_date(failures, episodes(load), RUN)
    edited = next(tmp_path.rglob("dataset_info.json"))
    before, original = edited.stat(), edited.read_bytes()
    edited.write_bytes(original[::-1])
    os.utime(edited, ns=(before.st_atime_ns, before.st_mtime_ns))
    none = Episodes({}, load)
    with pytest.raises(PipelineError, match=r"dataset_info\.json: the file was edited or damaged"):
        _bring_up_to_date(failures, none, RUN)
    if is_allowed:
        monkeypatch.setenv("REMAKE", "1")
    else:
        edited.write_bytes(original)
    _bring_up_to_date(failures, none, RUN)
    assert not failures.folder.exists()
    assert files(tmp_path) == ({aside(edited, tmp_path): original[::-1]} if is_allowed else {})


def test_cleaning_unfinished_files_keeps_the_record_of_an_edited_dataset(tmp_path: Path) -> None:
    run = run_in(tmp_path)
    (tmp_path / OWNER).write_text("{}")
    command("rlds", tmp_path)
    expected = files(tmp_path)
    edited = next(tmp_path.rglob("dataset_info.json"))
    edited.write_bytes(b"mine")
    unfinished = tmp_path / ".work" / "rlds" / "piece"
    with pytest.raises(PipelineError, match="edited or damaged"):
        command("rlds", tmp_path)
    unfinished.write_bytes(b"of a killed call")
    cleaning.delete(run, ["unfinished"])
    assert not unfinished.exists()
    with pytest.raises(PipelineError, match=r"dataset_info\.json: the file was edited or damaged"):
        command("rlds", tmp_path)
    assert edited.read_bytes() == b"mine"
    edited.write_bytes(expected[str(edited.relative_to(tmp_path))])
    command("rlds", tmp_path)
    assert files(tmp_path).items() >= expected.items(), "its record returned"
    edited.write_bytes(b"mine")
    with pytest.raises(PipelineError, match="edited or damaged"):
        command("rlds", tmp_path)
    cleaning.delete(run, ["unfinished", "rlds"])
    assert not {"rlds", "rlds.json", ".work"} & {path.name for path in tmp_path.iterdir()}


def test_an_unreadable_record_is_named_and_nothing_is_deleted(tmp_path: Path) -> None:
    command("rlds", tmp_path)
    expected = files(tmp_path)
    export_target = target("rlds", tmp_path, "new")
    record = export_target.record_file
    whole = record.read_bytes()
    record.write_bytes(whole[:99])
    for _ in range(2):
        with pytest.raises(PipelineError, match=r"rlds\.json: the record of the dataset cannot be read") as caught:
            command("rlds", tmp_path)
        assert f"try: restore it from a copy, or move it and {export_target.folder} to another" in str(caught.value)
    assert files(tmp_path) == {**expected, "rlds.json": whole[:99]}
    record.write_bytes(whole)
    command("rlds", tmp_path)
    assert files(tmp_path) == expected


def test_a_file_of_the_user_stays_where_the_record_is_lost(tmp_path: Path) -> None:
    command("rlds", tmp_path)
    expected = files(tmp_path)
    note = next(tmp_path.rglob("dataset_info.json")).with_name("note.csv")
    note.write_text("of the user")
    target("rlds", tmp_path, "new").record_file.unlink()
    with pytest.raises(PipelineError, match=r"note\.csv"):
        command("rlds", tmp_path)
    assert note.read_text() == "of the user"
    note.unlink()
    command("rlds", tmp_path)
    assert files(tmp_path) == expected


@pytest.mark.parametrize("is_first", [True, False], ids=["before the first export", "after the record was deleted"])
def test_a_file_with_the_name_of_a_file_to_write_stays(
    is_first: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording of the user has the name that LIBERO gives to it, which is that of our HDF5 file."""
    written = tmp_path / "written"
    command("rlds", written)
    name = next(written.rglob("*.tfrecord*")).relative_to(written)
    folder = tmp_path / "run"
    if not is_first:
        command("rlds", folder)
        target("rlds", folder, "new").record_file.unlink()
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("of the user")
    for _ in range(2):
        with pytest.raises(PipelineError, match=rf"{name.name}.*no record of an export lists the file") as caught:
            command("rlds", folder)
        assert str(caught.value.remedy).startswith("move it to another place, and run the command again; or let ")
    with pytest.raises(PipelineError, match="no record of an export lists the file, and it would be deleted"):
        reject_deleting_foreign(folder / "rlds")
    assert (folder / name).read_text() == "of the user"
    monkeypatch.setenv("REMAKE", "1")
    command("rlds", folder)
    kept = {path: content for path, content in files(folder).items() if path.startswith("rlds.edited_1/")}
    assert kept[aside(folder / name, folder)] == b"of the user"
    assert files(folder) == files(written) | kept


@pytest.mark.parametrize("is_dangling", [True, False])
def test_a_link_with_the_name_of_a_file_to_write_is_named(is_dangling: bool, tmp_path: Path) -> None:
    written, folder, elsewhere = tmp_path / "written", tmp_path / "run", tmp_path / "elsewhere"
    command("rlds", written)
    name = next(written.rglob("*.tfrecord*")).relative_to(written)
    (folder / name).parent.mkdir(parents=True)
    if not is_dangling:
        elsewhere.mkdir()
    (folder / name).symlink_to(elsewhere)
    with pytest.raises(PipelineError, match=rf"{name.name}.*no record of an export lists the file"):
        command("rlds", folder)
    assert (folder / name).is_symlink()


def test_a_file_of_the_user_stays_when_a_run_returns_to_its_finished_dataset(tmp_path: Path) -> None:
    """The export of another name stops because of the file; the first name is asked for again."""
    command("rlds", tmp_path)
    first, second = target("rlds", tmp_path, "new"), target("rlds", tmp_path, "second")
    written = tmp_path / "written"
    _bring_up_to_date(target("rlds", written, "second"), episodes(), RUN)
    theirs = tmp_path / next(written.rglob("*.tfrecord*")).relative_to(written)

    def load(episode_id: str) -> Episode:
        theirs.parent.mkdir(parents=True, exist_ok=True)
        theirs.write_text("of the user")
        return episode(episode_id)

    with pytest.raises(PipelineError, match="no record of an export lists the file"):
        _bring_up_to_date(second, episodes(load), RUN)
    with pytest.raises(PipelineError, match="is not of this run's RLDS"):
        _bring_up_to_date(first, episodes(), RUN)
    assert theirs.read_text() == "of the user"


def test_a_file_that_the_user_stores_during_an_export_stays(tmp_path: Path) -> None:
    command("rlds", tmp_path)
    note = next(tmp_path.rglob("dataset_info.json")).with_name("note.csv")

    def load(episode_id: str) -> Episode:
        note.write_text("of the user")
        return episode(episode_id)

    export_target = target("rlds", tmp_path, "new")
    with pytest.raises(PipelineError, match=r"note\.csv"):
        _bring_up_to_date(export_target, episodes(load, content="second"), RUN)
    assert note.read_text() == "of the user"
    note.unlink()
    _bring_up_to_date(export_target, episodes(content="second"), RUN)
    assert not note.exists()
    assert not export_target.work.exists()


def in_a_fork(action: Callable[[], None]) -> int:
    """The exit status of a process that does this, as ``os.waitstatus_to_exitcode`` tells it."""
    if (process := os.fork()) == 0:
        status = 1
        try:
            action()
            status = 0
        except Exception as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
        finally:
            sys.stderr.flush()
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def killed_before(change: int, name: str, data: Path) -> None:
    """Be killed before a change of the file system, counted from when the new dataset is whole in the work folder."""
    left, whole = change, False

    def count(event: str, _: tuple[object, ...]) -> None:
        nonlocal left, whole
        if event not in CHANGES:
            return
        whole = whole or any(data.glob(".work/*/*/record.json"))
        if whole:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    command(name, data)


def other_actions(episode_id: str) -> Episode:
    source = episode(episode_id)
    return replace(source, action=source.action * np.float32(0.5))


def other_command(name: str, data: Path) -> None:
    """The same with episodes of other actions, under the same names."""
    notice_changes(target(name, data, "new"))
    _bring_up_to_date(target(name, data, "new"), episodes(other_actions, "second"), RUN)


def kill_everywhere(name: str, folder: Path) -> None:
    """In a process of its own: print how many kills there were, and what a command then came to.

    The command is the same one, and for RLDS also one with other episodes.
    """
    expected, before, prepared = (folder / part for part in ("expected", "before", "prepared"))
    command(name, expected)
    other_command(name, folder / "other")
    _bring_up_to_date(target(name, before, "old"), episodes(), RUN)
    shutil.copytree(before, prepared)
    killed = in_a_fork(lambda: killed_before(1, name, prepared))
    assert killed == -signal.SIGKILL
    kills, faults = 0, []
    while killed:
        kills += 1
        data = folder / str(kills)
        shutil.copytree(prepared, data)
        killed = in_a_fork(lambda: killed_before(kills, name, data))  # noqa: B023 - called at once
        if name == "rlds":
            other_data = shutil.copytree(data, folder / f"{kills}_other")
            if in_a_fork(lambda: other_command(name, other_data)):  # noqa: B023 - called at once
                faults.append(f"{kills}: other episodes are rejected")
            elif files(other_data) != files(folder / "other"):
                faults.append(f"{kills}: other episodes differ")
        if in_a_fork(lambda: command(name, data)):  # noqa: B023 - called at once
            faults.append(f"{kills}: rejected")
        elif files(data) != files(expected):
            faults.append(f"{kills}: {sorted(files(data).keys() ^ files(expected).keys())}")
        shutil.rmtree(data)
    print(json.dumps({"kills": kills - 1, "faults": faults}))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rlds", "lerobot", "lerobot_v21"])
def test_a_kill_at_every_change_of_the_file_system_is_taken_up(name: str, tmp_path: Path) -> None:
    code = f"import test_replaced_sets as t, pathlib; t.kill_everywhere({name!r}, pathlib.Path({str(tmp_path)!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(("tests", "tests/run", os.environ.get("PYTHONPATH", "")))},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["faults"] == [], done.stderr
    assert found["kills"] >= 10
