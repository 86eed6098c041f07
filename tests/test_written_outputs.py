"""Files that commands write for a user: their own content is replaced, other content never."""

from pathlib import Path

import pytest

from pipeline import files, outputs
from pipeline.errors import PipelineError


class StoppedError(Exception):
    """The end of a command between the record of a content and the file."""


def stopped(path: Path, content: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a file, and stop after its checksum was recorded."""

    def record_and_stop(file: Path, record: object) -> None:
        write_json(file, record)
        raise StoppedError

    write_json = files.write_json
    with monkeypatch.context() as patch:
        patch.setattr(files, "write_json", record_and_stop)
        with pytest.raises(StoppedError):
            outputs.write(path, content)


def test_a_file_of_a_command_is_replaced_also_after_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "table.md"
    for _ in range(3):
        stopped(table, "first", monkeypatch)
    outputs.write(table, "first")
    for _ in range(3):
        stopped(table, "second", monkeypatch)
    assert table.read_text() == "first"
    outputs.write(table, "second")
    assert table.read_text() == "second"


def test_a_file_of_the_user_is_not_replaced(tmp_path: Path) -> None:
    table = tmp_path / "table.md"
    table.write_text("mine")
    with pytest.raises(PipelineError, match="is edited or was not written by a command"):
        outputs.write(table, "new")
    table.unlink()
    outputs.write(table, "new")
    table.write_text("new, edited")
    with pytest.raises(PipelineError, match="is edited or was not written by a command"):
        outputs.write(table, "newer")
    assert table.read_text() == "new, edited"
    table.unlink()
    table.symlink_to(tmp_path / "other.md")
    with pytest.raises(PipelineError, match="link or folder"):
        outputs.write(table, "new")
