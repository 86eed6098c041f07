"""No command overwrites a file that it has not written: a person's, or another program's."""

import io
import json
import sys
from pathlib import Path

import pytest
from checkout import REPOSITORY
from episode_results import result
from PIL import Image
from short_demonstrations import STOVE

from pipeline import __main__ as command_line
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection, select

ONE_TASK = Selection(source="pairs", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot", "noise"), episodes=1)


def picture(kind: str) -> bytes:
    """A person's picture."""
    written = io.BytesIO()
    Image.new("RGB", (8, 8), "red").save(written, format=kind)
    return written.getvalue()


def called(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["pipeline", *words])
    return command_line.main()


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Results of one policy."""
    folder = tmp_path / "results"
    for task in select(ONE_TASK):
        EpisodeFiles(folder).save(result(task, success=True))
    return folder


STARTER = str(REPOSITORY / "configs" / "starter.yaml")
PREVIEW = ("preview", f"{STOVE.suite}/{STOVE.name}", "noise", STARTER, "--out")
REWRITE = ("rewrite", str(STOVE.bddl_file), "--endpoint", "http://127.0.0.1:9/v1", "--model", "-")
HTML = b"<!doctype html><title>Mine</title>"
CASES = (
    ("sheet.png", picture("PNG"), (*PREVIEW, "sheet.png")),
    ("mine.jpg", picture("JPEG"), (*PREVIEW, "mine.jpg")),
    ("report.html", HTML, ("analyze", "report", "results")),
    ("report.json", b'{"loss": [1.0]}', ("analyze", "report", "results")),
    ("tasks.json", b'{"tasks": ["mine"]}', ("analyze", "construct", "--out", "tasks.json")),
    ("tasks.json", b'{"tasks": ["mine"]}', ("analyze", "grade", "results", "--out", "tasks.json")),
    ("results/gap.png", picture("PNG"), ("analyze", "gap", "results")),
    ("results/gap.json", b'{"gap": 1}', ("analyze", "gap", "results")),
    ("bank.yaml", b"mine: true\n", (*REWRITE, "--out", "bank.yaml")),
    ("policy/summary.json", b"{}", ("evaluate", "policy", "--replay", "--task", STOVE.name, "--workers", "1")),
    ("policy/episodes.csv", b"mine\n1\n", ("evaluate", "policy", "--replay", "--task", STOVE.name, "--workers", "1")),
    ("policy/config.json", b"{}", ("evaluate", "policy", "--replay", "--task", STOVE.name, "--workers", "1")),
)


@pytest.mark.parametrize(("name", "content", "words"), CASES, ids=[f"{words[0]} {name}" for name, _, words in CASES])
def test_a_file_of_another_kind_is_named_and_stays(
    name: str,
    content: bytes,
    words: tuple[str, ...],
    results: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(results.parent)
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_bytes(content)
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    assert called(monkeypatch, *words) == 1
    error = capsys.readouterr().err
    assert Path(name).name in error
    assert "Traceback" not in error
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


WRITES = {
    "report.html": ("analyze", "report", "results"),
    "report.json": ("analyze", "report", "results"),
    "results/gap.json": ("analyze", "gap", "results"),
    "results/gap.png": ("analyze", "gap", "results"),
    "tasks.json": ("analyze", "grade", "results", "--out", "tasks.json"),
}
"""File to the command that writes it."""


def test_what_a_command_wrote_it_overwrites(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    for _ in range(2):
        for words in dict.fromkeys(WRITES.values()):
            assert called(monkeypatch, *words) == 0
    assert json.loads(Path("tasks.json").read_text())["tasks"]


@pytest.mark.parametrize("name", WRITES)
def test_an_edit_of_such_a_file_is_named_and_stays(
    name: str, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also as part of a document of the user, in which all of the command's text still is."""
    monkeypatch.chdir(results.parent)
    assert called(monkeypatch, *WRITES[name]) == 0
    edited = b"My own notes.\n" + Path(name).read_bytes()
    Path(name).write_bytes(edited)
    assert called(monkeypatch, *WRITES[name]) == 1
    assert f"{Path(name).name}: the command would overwrite the file" in capsys.readouterr().err
    assert Path(name).read_bytes() == edited


def test_a_copy_in_another_folder_is_a_file_of_the_user(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    assert called(monkeypatch, "analyze", "report", "results") == 0
    copy = Path("kept/report.html")
    copy.parent.mkdir()
    copy.write_bytes(Path("report.html").read_bytes())
    assert called(monkeypatch, "analyze", "report", "results", "--out", str(copy)) == 1


def test_a_link_is_not_replaced_by_a_file(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(results.parent)
    assert called(monkeypatch, "analyze", "report", "results") == 0
    Path("report.html").rename("elsewhere.html")
    Path("report.html").symlink_to("elsewhere.html")
    assert called(monkeypatch, "analyze", "report", "results") == 1
    assert Path("report.html").is_symlink()
