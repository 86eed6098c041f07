"""A file is whole or not there, also where two hosts share a file system and number their processes alike."""

import resource
from pathlib import Path

import pytest
from faults import limited

from pipeline.files import keep_below, remove_leftovers, replaced


def test_two_that_write_the_same_file_do_not_disturb_each_other(tmp_path: Path) -> None:
    """A job that a cluster gives out again, while its first worker still writes; both may have the same number."""
    path = tmp_path / "0123.npz"
    with replaced(path) as first:
        first.write_text("first")
        with replaced(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "counts.json"
    path.write_text("whole")
    with pytest.raises(OSError, match="too large"), limited(resource.RLIMIT_FSIZE, 2), replaced(path) as temporary:
        temporary.write_text("half")
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_the_program_did_not_make_stay(tmp_path: Path) -> None:
    """As where a person stores one while a stage runs, which looked for such files when it began."""
    places = ("a/kept.npz", "a/old.npz", "b/old.npz", "c/old.npz", "c/notes.txt", ".a.npz.01ef.tmp", "d/.x.0a.tmp/y")
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    keep_below(tmp_path, {tmp_path / "a/kept.npz"}, lambda file: file.suffix == ".npz")
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")) == [
        *("a", "a/kept.npz", "c", "c/notes.txt")
    ]
    keep_below(tmp_path, {tmp_path / "a"})
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "kept.npz"]


def test_leftovers_of_a_folder_that_is_not_there_are_none(tmp_path: Path) -> None:
    """As before the first object of a user's own is converted."""
    remove_leftovers(tmp_path / "objects")
    kept, left = tmp_path / ".notes.tmp", tmp_path / ".model.01ef.tmp"
    kept.touch()
    left.touch()
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [kept]
