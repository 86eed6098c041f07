"""Files that are either complete or missing."""

import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import file_digest
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.errors import RUN_AGAIN, PipelineError


def schema_file(name: str) -> Path:
    """Return the path of a file of ``schemas/``: next to the library in a checkout, inside it in an installed wheel."""
    package = Path(__file__).resolve().parent
    inside = package / "schemas" / name
    return inside if inside.exists() else package.parent / "schemas" / name


class Edition(NamedTuple):
    """One content of a file, as a key for caches: another content at the same path is another edition."""

    path: Path
    inode: int
    size_bytes: int
    mtime_ns: int


def edition(path: Path) -> Edition:
    """Return the present edition of a file, with an absolute path.

    Raises:
        OSError: when the file is missing.
    """
    status = path.stat()
    return Edition(path.absolute(), status.st_ino, status.st_size, status.st_mtime_ns)


def checksum(file: Path) -> str:
    """Return the SHA-256 of a file's content, as ``sha256sum`` prints it.

    Raises:
        OSError: when the file cannot be read.
    """
    with file.open("rb") as content:
        return file_digest(content, "sha256").hexdigest()


@cache
def checksum_of(version: Edition) -> str:
    """Return the ``checksum`` of an edition of a file, computed once per process."""
    return checksum(version.path)


def read_json(file: Path, remedy: str = RUN_AGAIN) -> dict[str, Any]:
    """Read a JSON object that a stage wrote.

    Raises:
        PipelineError: when the file is missing, damaged or no JSON object.
    """
    try:
        content = json.loads(file.read_bytes())
        if not isinstance(content, dict):
            raise TypeError(f"it contains {type(content).__name__}")
    except FileNotFoundError as error:
        raise PipelineError("the file is missing", where=file, remedy=remedy) from error
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise PipelineError(
            f"the file is damaged ({error})",
            where=file,
            expected="a JSON object",
            remedy=f"move it to another place, and {remedy}",
        ) from error
    return content


def write_json(file: Path, content: object) -> None:
    """Write a file that ``read_json`` reads; it is complete or missing."""
    write(file, json.dumps(content, indent=1) + "\n")


def write(file: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8; it is complete or missing."""
    with replaced(file) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``; on success sync it to disk and rename it to ``path``.

    Works for a file and for a folder. When the block raises, the content of ``path`` is unchanged. The temporary name
    is random, as two hosts that share a file system have processes with equal numbers. One host may repeat the work of
    the other while that host still writes.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        put_in_place(temporary, path)
    finally:
        _discard(temporary)


def put_in_place(complete: Path, path: Path) -> None:
    """Sync a file or a folder of the same file system to disk, and replace ``path`` with it."""
    sync(complete)
    path.parent.mkdir(parents=True, exist_ok=True)
    if complete.is_dir():
        remove(path)
    os.replace(complete, path)
    _sync(path.parent)


@contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """Yield an empty folder, removed at the end; its name is fixed, so leftovers of a killed run are removed first."""
    remove(folder)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        remove_if_empty(folder.parent)


def sync(path: Path) -> None:
    """Sync a file, or a folder with its whole content, to disk."""
    for entry in (*path.rglob("*"), path):
        _sync(entry)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def keep_below(folder: Path, files: set[Path], is_ours: Callable[[Path], bool] = lambda path: True) -> None:
    """Delete every file below ``folder`` that is neither one of ``files`` nor inside one, then delete empty folders.

    Deleted files are, for example, shards of an earlier plan, and temporaries of a killed run.

    Args:
        is_ours: function that returns True for a file of this project. All other files stay.
    """
    if not folder.is_dir():
        return
    for entry in folder.iterdir():
        if entry in files:
            continue
        if entry.is_dir() and not entry.is_symlink() and not is_temporary(entry.name):
            keep_below(entry, files, is_ours)
            remove_if_empty(entry)
        elif is_temporary(entry.name) or is_ours(entry):
            remove(entry)


def is_temporary(name: str, of: str | None = None) -> bool:
    """Return whether an entry of a folder has the name of a temporary of ``replaced``.

    Args:
        of: the name of the file or folder that the temporary would replace; any name if `None`.
    """
    target = r".+" if of is None else re.escape(of)
    return re.fullmatch(rf"\.{target}\.[0-9a-f]+\.tmp", name) is not None


def remove_leftovers(folder: Path) -> None:
    """Delete temporaries that killed processes left in a folder during ``replaced``.

    The caller must have a lock that keeps all other processes, on every host, from writing to the folder. The name of a
    temporary does not show if its process still lives on another host.
    """
    for entry in folder.glob(".*.tmp"):  # Nothing if the folder does not exist.
        if is_temporary(entry.name):
            _discard(entry)


def _discard(temporary: Path) -> None:
    """Delete a temporary, even while other workers write into it; ``remove_leftovers`` deletes the rest later."""
    if temporary.is_dir():
        shutil.rmtree(temporary, ignore_errors=True)
    else:
        temporary.unlink(missing_ok=True)


def unused_name(path: Path, kind: str) -> Path:
    """Return the first of ``<path>.<kind>_1``, ``<path>.<kind>_2`` and so on that does not exist."""
    names = (path.with_name(f"{path.name}.{kind}_{number}") for number in count(1))
    return next(name for name in names if not os.path.lexists(name))


def remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def remove(path: Path) -> None:
    """Delete a file or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
