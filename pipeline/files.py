"""Files that are either whole or not there."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple


def schema_file(name: str) -> Path:
    """A file of ``schemas/``: beside the library in a checkout, inside of it in an installed wheel."""
    package = Path(__file__).resolve().parent
    inside = package / "schemas" / name
    return inside if inside.exists() else package.parent / "schemas" / name


class Edition(NamedTuple):
    """One content of a file, for what is kept in memory of it: another content at the same path is another edition."""

    path: Path
    inode: int
    size_bytes: int
    mtime_ns: int


def edition(path: Path) -> Edition:
    """The file as it lies there now; its path absolute.

    Raises:
        OSError: when it is not there.
    """
    status = path.stat()
    return Edition(path.resolve(), status.st_ino, status.st_size, status.st_mtime_ns)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it is synced to disk and takes the place of ``path``.

    Works for a file and for a folder. When the block raises, what was at ``path`` before is untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    _remove(temporary)
    try:
        yield temporary
        for made in (*temporary.rglob("*"), temporary):
            _sync(made)
        if temporary.is_dir():
            _remove(path)
        os.replace(temporary, path)
        _sync(path.parent)
    finally:
        # After a failure other workers may still be writing into a folder: what they leave is removed next time.
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def keep_only(folder: Path, names: set[str]) -> None:
    """Delete what ``folder`` holds beside ``names``: shards of an earlier plan, temporaries of a killed run."""
    if folder.is_dir():
        for entry in folder.iterdir():
            if entry.name not in names:
                _remove(entry)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
