"""No edit of a generated folder is lost unasked, whenever the process that generates it again is killed."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import PipelineError
from pipeline.generated import edits, edits_in_words, generated, unchanged


def generate(folder: Path, **files: str) -> None:
    with generated(folder) as unfinished:
        for name, content in files.items():
            (unfinished / f"{name}.txt").write_text(content)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "card"
    generate(folder, one="1", two="2")
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {file.name: file.read_text() for file in folder.iterdir() if not file.name.startswith(".")}


def states(folder: Path) -> dict[Path, tuple[int, int, int]]:
    """Inode, size and time of change of everything below a folder."""
    found = {path: path.lstat() for path in folder.rglob("*")}
    return {path: (state.st_ino, state.st_size, state.st_mtime_ns) for path, state in found.items()}


def changed(folder: Path) -> None:
    (folder / "one.txt").write_text("mine")


def added(folder: Path) -> None:
    (folder / "one.txt.bak").write_text("mine")


def hidden(folder: Path) -> None:
    (folder / ".git").mkdir()
    (folder / ".git" / "config").write_text("mine")


def linked(folder: Path) -> None:
    (folder / "one.txt").rename(folder.parent / "elsewhere.txt")
    (folder / "one.txt").symlink_to(folder.parent / "elsewhere.txt")


def linked_folder(folder: Path) -> None:
    (folder / "keys").symlink_to(folder.parent)


def pipe(folder: Path) -> None:
    (folder / "one.txt").unlink()
    os.mkfifo(folder / "one.txt")


def of_an_earlier_version(folder: Path) -> None:
    (folder / ".generated.json").unlink()


EDITS: dict[Callable[[Path], None], str] = {
    changed: "one.txt (changed)",
    added: "one.txt.bak (added)",
    hidden: ".git/config (added)",
    linked: "one.txt (a link)",
    linked_folder: "keys (a link)",
    pipe: "one.txt (changed)",
    of_an_earlier_version: "one.txt (without a record), two.txt (without a record)",
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_is_named_and_stays_until_it_is_allowed(
    folder: Path, edit: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("REMAKE", raising=False)
    edit(folder)
    before = states(folder)
    with pytest.raises(PipelineError) as caught:
        generate(folder, one="another", two="another")
    for words in (EDITS[edit], "publish:", "copy the files", "REMAKE=1"):
        assert words in str(caught.value)
    assert states(folder) == before
    assert [line.count(EDITS[edit]) for line in edits_in_words(folder.parent)] == [1]
    monkeypatch.setenv("REMAKE", "1")
    generate(folder, one="another", two="another")
    assert EDITS[edit] in capsys.readouterr().out
    assert contents(folder) == {"one.txt": "another", "two.txt": "another"}
    assert edits(folder) == {}
    kept = states(folder.with_name(f"{folder.name}.edited_1"))
    assert sorted(kept.values()) == sorted(before.values()), "the edited files themselves"
    edit(folder)
    generate(folder, one="a third", two="a third")
    assert folder.with_name(f"{folder.name}.edited_2").exists()


def test_what_nobody_edited_is_replaced_without_a_word(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "one.cpython-311.pyc").write_bytes(b"compiled")
    (folder / "two.txt").unlink()
    assert edits(folder) == {}
    generate(folder, one="another")
    assert contents(folder) == {"one.txt": "another"}
    assert capsys.readouterr().out == ""
    assert [entry.name for entry in folder.parent.iterdir()] == ["card"]


def test_an_edit_that_is_generated_now_is_no_loss(folder: Path) -> None:
    (folder / "one.txt").write_text("mine")
    of_an_earlier_version(folder)
    generate(folder, one="mine", two="2")
    assert edits(folder) == {}


@pytest.mark.parametrize("edit", EDITS)
def test_only_files_as_recorded_are_handed_out(folder: Path, edit: Callable[[Path], None]) -> None:
    assert {path: file.read_text() for path, file in unchanged(folder).items()} == {"one.txt": "1", "two.txt": "2"}
    edit(folder)
    with pytest.raises(PipelineError) as caught:
        unchanged(folder)
    assert EDITS[edit] in str(caught.value) or ".generated.json: the file is missing" in str(caught.value)


KILLED = """
import os, pathlib, sys
from pipeline.generated import generated

events = 0
def count(event, arguments):
    global events
    if event in ("os.rename", "os.remove", "os.rmdir", "shutil.rmtree"):
        events += 1
        if events == int(sys.argv[2]):
            os.write(1, b"killed")
            os._exit(9)
sys.addaudithook(count)
with generated(pathlib.Path(sys.argv[1])) as unfinished:
    (unfinished / "one.txt").write_text("new")
"""


@pytest.mark.slow
def test_a_kill_at_any_moment_is_no_edit(folder: Path) -> None:
    """Killed before each rename and deletion, the next process generates the folder again without a question."""
    for moment in range(1, 20):
        generate(folder, one="1", two="2")
        command = [sys.executable, "-c", KILLED, str(folder), str(moment)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode in (0, 9), done.stderr
        assert edits(folder) == {}
        if done.returncode == 0:
            break
    assert moment > 3
    assert contents(folder) == {"one.txt": "new"}
