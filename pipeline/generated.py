"""Folders that a stage generates and a person may edit (``card/``, ``finetune/``). No edit is overwritten silently.

The SHA-256 of every generated file is recorded in the folder itself, so that one rename puts both in place.
"""

import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import checksum, read_json, remove, replaced, unused_name, write_json
from pipeline.identity import ALLOW, remake_allowed
from pipeline.record import Basis, Record

RECORD = ".generated.json"
"""File of a generated folder that lists its other files."""

FOLDERS = ("finetune", "card")
"""The generated folders of a run."""

MAX_NAMED = 20


@contextmanager
def generated(
    folder: Path, made_from: Mapping[str, str] | None = None, settings: Mapping[str, Any] | None = None
) -> Iterator[Path]:
    """Yield an empty folder to write into; on success record its files and give it the place of ``folder``.

    A killed process leaves the old folder, the new one or none. If ``REMAKE=1`` allows the replacement of edits, the
    edited folder stays next to the new one, as ``<folder>.edited_<number>``.

    Args:
        made_from: name of each file of the run that the content is generated from, to SHA-256.
        settings: sections of the configuration to record, JSON-serialisable.

    Raises:
        PipelineError: if edits would be lost and ``REMAKE=1`` does not allow it; ``folder`` is then unchanged.
    """
    old = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.tmp")  # Deleted by the next stage after a kill.
    with replaced(folder) as unfinished:
        unfinished.mkdir()
        yield unfinished
        files = {path: checksum(file) for path, file in _files(unfinished).items()}
        lost = _lost_edits(folder, files)
        if lost:
            # The permission may have been given for other work.
            old = unused_name(folder, "edited")
            print(f"generated {folder} again; the edited files {in_words(lost)} are now in {old}")
        record = {"files": files, "made_from": dict(made_from or {}), "settings": dict(settings or {})}
        write_json(unfinished / RECORD, record)
        if folder.exists():
            os.replace(folder, old)
    if not lost:
        remove(old)


def read_record(folder: Path) -> Record:
    """Read the record of a generated folder.

    Returns:
        The record. Its request has ``files``, which are ``made_from`` of ``generated``, and ``settings``, which are
        empty in records of earlier versions.

    Raises:
        PipelineError: if the record is missing or damaged.
    """
    file = folder / RECORD
    content = read_json(file)
    try:
        files, made_from = dict(content["files"]), dict(content["made_from"])
        settings = dict(content.get("settings", {}))
    except (KeyError, TypeError, ValueError) as error:
        raise PipelineError(
            f"the record is damaged ({error!r})", where=file, expected="the fields files and made_from"
        ) from error
    return Record(Basis.of({"files": made_from, "settings": settings}, {}), files)


def edits(folder: Path) -> dict[str, str]:
    """List the files that differ from the folder's record.

    Returns:
        Path below the folder to ``changed``, ``added``, ``a link`` or ``without a record``; only the folder's name,
        with ``not a folder``, if it is a link or a file. A deleted file is no edit: generating it again loses nothing.
    """
    if folder.is_symlink() or folder.is_file():
        return {folder.name: "not a folder"}
    try:
        recorded = dict(read_record(folder).files)
        unknown = "added"
    except PipelineError:
        recorded, unknown = {}, "without a record"
    states: dict[str, str] = {}
    for path, file in _files(folder).items():
        if file.is_symlink():
            states[path] = "a link"
        elif path not in recorded:
            states[path] = unknown
        elif not file.is_file() or checksum(file) != recorded[path]:
            states[path] = "changed"
    return states


def unchanged(folder: Path, below: str = "") -> dict[str, Path]:
    """Return the recorded files of a folder if they are all that it has.

    Args:
        below: subfolder to check, such as ``rlds`` of ``card``; by default the whole folder.

    Returns:
        Path below the folder to file.

    Raises:
        PipelineError: naming files that were changed, added, linked or deleted since the folder was generated.
    """
    if folder.is_symlink():
        raise PipelineError("the folder is a symbolic link", where=folder, expected="the folder that a stage generated")
    recorded = [path for path in read_record(folder).files if PurePosixPath(path).is_relative_to(below)]
    faults = {path: how for path, how in edits(folder).items() if PurePosixPath(path).is_relative_to(below)}
    faults |= {path: "missing" for path in recorded if not os.path.lexists(folder / path)}
    if faults:
        raise PipelineError(
            f"{len(faults)} files differ from the generated ones: {in_words(faults)}",
            where=folder,
            expected=f"exactly the files that {folder / RECORD} lists",
            remedy=f"{REMEDY}; generate missing files again by `{MAKE_AGAIN}`",
        )
    return {path: folder / path for path in recorded}


REMEDY = (
    "move the changes into the configuration (`publish:` has licence, author and notes), or copy the files to another "
    f"folder and allow this one to be generated again: {ALLOW}"
)
"""The two ways to keep an edit."""


def edits_in_words(data: Path) -> Iterator[str]:
    """Yield a sentence for each generated folder of a run that has edits."""
    for name in FOLDERS:
        edits_of_folder = edits(data / name)
        if edits_of_folder:
            words = in_words(edits_of_folder)
            yield f"edited files in {data / name}: {words}. A run stops before it overwrites them: {REMEDY}"


def reject_edits(data: Path) -> None:
    """Stop before the generated folders of a run are deleted with edits in them.

    Raises:
        PipelineError: naming the edited files of one folder.
    """
    for name in FOLDERS:
        edits_of_folder = edits(data / name)
        if edits_of_folder:
            raise PipelineError(
                f"{len(edits_of_folder)} edited files would be deleted: {in_words(edits_of_folder)}",
                where=data / name,
                expected=f"the files that {data / name / RECORD} lists, unchanged",
                remedy="move these files to another folder; a run generates missing files again",
            )


def in_words(found: Mapping[str, str]) -> str:
    """Join paths and states, at most ``MAX_NAMED`` of them."""
    named = [f"{path} ({state})" for path, state in sorted(found.items())]
    further = [f"and {len(named) - MAX_NAMED} more"] if len(named) > MAX_NAMED else []
    return ", ".join(named[:MAX_NAMED] + further)


def _lost_edits(folder: Path, files: Mapping[str, str]) -> dict[str, str]:
    """Return the edited files that differ from the new files, with the kind of edit.

    Raises:
        PipelineError: if there are such files, and ``REMAKE=1`` is not set.
    """
    lost: dict[str, str] = {}
    for path, how in edits(folder).items():
        file = folder / path
        same = file.is_file() and not file.is_symlink() and checksum(file) == files.get(path)
        if not same:
            lost[path] = how
    if not lost or remake_allowed():
        return lost
    raise PipelineError(
        f"{len(lost)} edited files would be overwritten or deleted: {in_words(lost)}",
        where=folder,
        expected=f"the files that {folder / RECORD} lists, unchanged",
        remedy=REMEDY,
    )


def _files(folder: Path) -> dict[str, Path]:
    """Map paths to files and links below a folder: hidden ones too, without the record and compiled Python."""
    files: dict[str, Path] = {}
    for file in sorted(folder.rglob("*")):
        path = file.relative_to(folder)
        compiled = path.parent.name == "__pycache__" and path.suffix == ".pyc"
        if (file.is_symlink() or not file.is_dir()) and not compiled and path != Path(RECORD):
            files[path.as_posix()] = file
    return files
