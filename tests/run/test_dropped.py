"""A changed configuration deletes no more than a tenth of the finished work unless that was allowed."""

import hashlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from short_runs import run_stages

from pipeline import status
from pipeline.config import Config, load
from pipeline.identity import REMAKE
from pipeline.run import cleaning, dropped, machine, plan_stage
from pipeline.run.run import Run
from pipeline.run.work_time import REFERENCE
from pipeline.stores.frame_store import FrameStore
from pipeline.types import Jpeg, Rendered
from pipeline.validation import doctor

Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def clone(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a finished run, which the process works in."""
    folder = shutil.copytree(finished.parent.parent, tmp_path / "clone", symlinks=True)
    monkeypatch.chdir(folder)
    monkeypatch.delenv(REMAKE, raising=False)
    return folder


def changed(clone: Path, change: Change) -> dict[str, Any]:
    fields: dict[str, Any] = yaml.safe_load((clone / "configs" / "tiny.yaml").read_text())
    change(fields)
    (clone / "configs" / "tiny.yaml").write_text(yaml.safe_dump(fields))
    return fields


def work(clone: Path) -> dict[str, str]:
    """Every finished file to its SHA-256."""
    folders = [clone / "data" / "tiny" / name for name in ("trajectories", "frames", "rlds", "lerobot")]
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file()]
    files.append(clone / "data" / "tiny" / "plan.parquet")
    return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def other_seed(fields: dict[str, Any]) -> None:
    fields["plan"]["seed"] = 6


def other_range(fields: dict[str, Any]) -> None:
    fields["plan"]["axes"]["noise"] = {"levels": [5]}
    fields["plan"]["axes"]["camera"] = {"levels": [5]}


def other_quality(fields: dict[str, Any]) -> None:
    fields["render"]["jpeg_quality"] = 90


def fewer_episodes(fields: dict[str, Any]) -> None:
    fields["plan"] |= {"episodes": {"camera": 1, "noise": 1, "language": 3}, "reserve": 9.0}


@pytest.mark.parametrize("change", [other_seed, other_range, other_quality, fewer_episodes])
def test_a_run_stops_before_it_deletes_and_status_and_doctor_say_the_same(
    change: Change, clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = work(clone)
    fields = changed(clone, change)
    run_stages(clone, fields, ["inputs"])
    stages = ["render"] if change is other_quality else ["plan"]
    with pytest.raises(AssertionError, match=r"no longer needed|no longer needs") as error:
        run_stages(clone, fields, stages)
    assert "REMAKE=1" in str(error.value)
    assert work(clone) == before, "nothing was deleted or replaced"
    run = Run(load(Path("configs/tiny.yaml")))
    amount = str(dropped.measure(plan_stage.upcoming(run), run))
    assert amount in str(error.value)
    assert any(amount in part for part in status.describe(run) if isinstance(part, str))
    finding = doctor._finished(run)
    assert finding.status == "warn"
    assert amount in finding.detail
    monkeypatch.setenv(REMAKE, "1")
    assert "later stages delete finished work that is no longer needed" in run_stages(clone, fields, stages)


def run_of_quality(folder: Path, jpeg_quality: int) -> Run:
    content = {
        "name": "tiny",
        "folder": str(folder),
        "demos": {"tasks": ["libero_goal/turn_on_the_stove"]},
        "plan": {"episodes": {"camera": 1}},
        "render": {"jpeg_quality": jpeg_quality},
    }
    return Run(Config.model_validate(content))


@pytest.mark.parametrize("change", ["killed before its second table", "finished", "one file touched", "one file lost"])
def test_frames_of_another_quality_count_whatever_the_table_lists(change: str, tmp_path: Path) -> None:
    frames = run_of_quality(tmp_path, 95).frames
    frames.root.mkdir(parents=True)
    frames.refresh()
    none = np.zeros((100, 8), np.float32)
    for number in range(10):
        rendered = Rendered("open_loop", none, none[:, :7], none[:, :7], none, streams={"a" * 16: [Jpeg(b"x")] * 100})
        frames.save(f"{number:016x}", rendered, "device")
    left = 10
    if change != "killed before its second table":
        time.sleep(0.05)  # A file counts as unchanged if it is older than the table.
        frames.refresh()
    file = frames.path(frames.names()[0])
    if change == "one file touched":
        file.touch()
    elif change == "one file lost":
        file.unlink()
        left = 9
    run = run_of_quality(tmp_path, 90)
    run.frames.notice_changes()
    measured = dropped.measure([], run)
    assert (measured.streams, measured.share, measured.asks) == (left, 1.0, True)
    run.frames.keep([])
    assert run.frames.rows_of_all_settings() == {}
    assert run.frames.changed_file() is None


def test_datasets_count_as_finished_work_after_their_frames_were_deleted(clone: Path) -> None:
    """Another seed replaces no dataset unasked. The same configuration makes what was deleted without a question."""
    cleaning.delete(Run(load(Path("configs/tiny.yaml"))), ["frames", "trajectories"])
    before = work(clone)
    run = Run(load(Path("configs/tiny.yaml")))
    assert not dropped.measure(plan_stage.upcoming(run), run)
    fields = changed(clone, other_seed)
    run_stages(clone, fields, ["inputs"])
    with pytest.raises(AssertionError, match=r"no longer needs.*10 episodes of the datasets, 77%") as error:
        run_stages(clone, fields, ["plan"])
    assert work(clone) == before
    run = Run(load(Path("configs/tiny.yaml")))
    amount = str(dropped.measure(plan_stage.upcoming(run), run))
    assert amount in str(error.value)
    assert any(amount in part for part in status.describe(run) if isinstance(part, str))
    assert amount in doctor._finished(run).detail


def test_a_replay_alone_deletes_nothing_unasked(clone: Path) -> None:
    """As where the plan is of a stage that was called alone, with permission."""
    fields = changed(clone, other_seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(REMAKE, "1")
        run_stages(clone, fields, ["inputs", "plan", "leakage"])
    before = work(clone)
    for stage in ("replay", "render"):
        with pytest.raises(AssertionError, match="no longer needs"):
            run_stages(clone, fields, [stage])
    assert work(clone) == before


def test_what_drops_little_or_nothing_is_not_asked_for(clone: Path) -> None:
    run = Run(load(Path("configs/tiny.yaml")))
    rows = plan_stage.upcoming(run)
    assert plan_stage.is_up_to_date(run)
    assert dropped.measure(rows, run) == dropped.Dropped()
    fields = changed(clone, lambda fields: fields["plan"].update(reserve=2.0))
    assert "no longer" not in run_stages(clone, fields, ["inputs", "plan", "leakage", "replay"])
    shutil.rmtree(clone / "data" / "tiny" / "frames")
    assert "no longer" not in run_stages(clone, fields, ["inputs", "replay"])


@pytest.mark.parametrize(("share", "asks"), [(0.0, False), (0.09, False), (0.1, False), (0.11, True), (0.2, True)])
def test_a_person_is_asked_about_more_than_a_tenth(share: float, asks: bool) -> None:
    assert dropped.Dropped(trajectories=1, share=share).asks == asks
    assert dropped.Dropped(episodes=1, episode_share=share).asks == asks


def test_the_hours_are_those_of_the_frames_that_would_be_rendered_again(clone: Path) -> None:
    """All frames of the run under another JPEG quality, at the measured cost of a frame on the reference machine."""
    config = load(Path("configs/tiny.yaml"))
    machine.keep_speed(Run(config), REFERENCE)
    stored = FrameStore(config.run_folder / "frames", config.render).rows().values()
    frames = sum(len(row["streams"]) * row["steps"] for row in stored)
    assert frames > 100
    changed(clone, other_quality)
    run = Run(load(Path("configs/tiny.yaml")))
    found = dropped.measure(plan_stage.upcoming(run), run)
    mean_s = (0.032 + 0.041 + 0.022 + 0.034 + 0.041 + 0.033 + 0.024 + 0.047 + 0.028 + 0.035) / 10 + 0.004
    assert found.work_s == pytest.approx(frames * mean_s)
    assert found.trajectories == 0
