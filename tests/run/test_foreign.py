"""What lies next to a run's sets, and is none of them, is named and never deleted."""

import re
from pathlib import Path
from typing import Any

import pytest
from synthetic import episode, episodes, write_lerobot, write_lerobot_v21, write_rlds

from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.formats.rlds import Rlds
from pipeline.report import sheets
from pipeline.run.export import _bring_up_to_date
from pipeline.run.run import Run
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore

PLAN = {"axes": {"camera": {}}, "episodes": {"camera": 1}}
RUN = Run(Config.model_validate({"name": "tiny", "plan": PLAN, "compute": {"cluster": "loop"}}))


@pytest.mark.parametrize("content", ["first", "second"], ids=["nothing to do", "another dataset to write"])
def test_liberos_sets_next_to_ours_are_rejected_and_stay(content: str, tmp_path: Path) -> None:
    target, elsewhere = write_rlds(tmp_path / "run"), tmp_path / "elsewhere"
    target.folder.joinpath("libero_goal_no_noops", "1.0.0").mkdir(parents=True)
    elsewhere.mkdir()
    target.folder.joinpath("libero_10_no_noops").symlink_to(elsewhere)
    before = {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")}
    message = re.escape("rlds/libero_10_no_noops: the entry is not of this run's RLDS")
    with pytest.raises(PipelineError, match=message) as error:
        _bring_up_to_date(target, episodes(content=content), RUN)
    assert "(2 such entries)" in str(error.value)
    assert f"move it out of {target.folder}" in str(error.value)
    assert {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")} == before


@pytest.mark.parametrize("write", [write_lerobot, write_lerobot_v21])
def test_another_lerobot_set_is_rejected(write: Any, tmp_path: Path) -> None:
    target = write(tmp_path)
    (target.folder / "libero").mkdir()
    with pytest.raises(PipelineError, match="not of this run's LeRobot"):
        _bring_up_to_date(target, episodes(), RUN)
    assert (target.folder / "libero").is_dir()


def test_sets_of_the_run_are_no_foreign_ones(tmp_path: Path) -> None:
    """Not those under a former name, nor where a damaged file has cost the record."""
    target = write_rlds(tmp_path)
    renamed = Rlds(tmp_path, target.options.model_copy(update={"name": "other"}))
    _bring_up_to_date(renamed, episodes(), RUN)
    renamed.record_file.unlink()
    _bring_up_to_date(renamed, episodes(), RUN)
    assert [path.name for path in renamed.folder.iterdir()] == ["other_spatial"]


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_rlds, write_lerobot, write_lerobot_v21])
@pytest.mark.parametrize("content", ["first", "second"], ids=["nothing to do", "another dataset to write"])
def test_a_file_inside_a_set_is_rejected_and_stays(content: str, write: Any, tmp_path: Path) -> None:
    """As a card that the user wrote, or a checkpoint that a training stored there."""
    target = write(tmp_path)
    theirs = next(path for path in target.folder.rglob("*.json")).parent / "README.md"
    theirs.write_text("mine")
    with pytest.raises(PipelineError, match=r"README\.md: the entry is not of this run's"):
        _bring_up_to_date(target, episodes(content=content), RUN)
    assert theirs.read_text() == "mine"


@pytest.mark.parametrize("theirs", ["mine.npz", "notes/mine.npz", "0123456789abcdef/mine.npz", "mine.txt"])
@pytest.mark.parametrize("store", [TrajectoryStore, FrameStore])
def test_a_file_that_is_stored_among_replays_or_frames_during_a_stage_stays(
    theirs: str, store: type[TrajectoryStore | FrameStore], tmp_path: Path
) -> None:
    """As a stage ends, it deletes what a changed plan no longer needs. It looked for foreign files as it began."""
    file, unneeded = tmp_path / theirs, tmp_path / "0123456789abcdef.npz"
    file.parent.mkdir(exist_ok=True)
    for path in (file, unneeded):
        path.write_bytes(b"mine")
    (TrajectoryStore(tmp_path) if store is TrajectoryStore else FrameStore(tmp_path, RUN.config.render)).keep([])
    assert file.read_bytes() == b"mine"
    assert not unneeded.exists()


def test_a_file_that_is_stored_among_sheets_during_the_stage_stays(tmp_path: Path) -> None:
    theirs = tmp_path / "sheets" / "notes.txt"
    theirs.parent.mkdir()
    theirs.write_text("mine")
    with pytest.raises(PipelineError, match=r"sheets/notes\.txt"):
        sheets.write([], lambda name: episode(name), theirs.parent)
    assert theirs.read_text() == "mine"
