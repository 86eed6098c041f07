"""Files in a run's folder that no stage of the run generated, and that a stage would delete."""

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from pipeline.axes import AXES
from pipeline.errors import PipelineError
from pipeline.files import is_temporary
from pipeline.run.layout import FRAMES, PREVIEWS, SHEETS, TRAJECTORIES
from pipeline.stores.store import EARLIER_SUFFIX, ID, SUFFIX, TABLE

_AXIS = rf"({'|'.join(AXES)})"
_SHEET = rf"{_AXIS}(\+{_AXIS})*\.png"
_STORED = rf"({re.escape(SUFFIX)}|{re.escape(EARLIER_SUFFIX)})"

CLEARED = {
    TRAJECTORIES: rf"{re.escape(TABLE)}|{ID}{_STORED}",
    FRAMES: rf"{re.escape(TABLE)}|{ID}/{ID}{_STORED}",
    SHEETS: _SHEET,
    PREVIEWS: rf"[a-z0-9_]+/{_AXIS}\.png",
}
"""Map of the folders that stages clear to a pattern of the paths that stages write in them."""

SHOWN = 3
"""Number of files that an error names at most."""

FILE_IN_USE = re.compile(r"\.nfs[0-9a-f]+")
"""Name that NFS gives to a deleted file until the last process closes it."""


def reject_foreign_files(data: Path, folders: Iterable[str] = tuple(CLEARED)) -> None:
    """Stop before a stage, or ``clean``, would delete files that no stage generated.

    Args:
        data: the run's folder.
        folders: keys of ``CLEARED``; other names are ignored.

    Raises:
        PipelineError: naming some of the files.
    """
    foreign = sorted(foreign_files(data, folders))
    if foreign:
        names = ", ".join(path.relative_to(data).as_posix() for path in foreign[:SHOWN])
        more = f" and {len(foreign) - SHOWN} more" if len(foreign) > SHOWN else ""
        raise PipelineError(
            f"the folder contains files that no stage of this run generated, and that would be deleted: {names}{more}",
            where=data,
            expected=f"only the run's own files in {', '.join(CLEARED)}",
            remedy="move these files to another folder; files next to the listed folders are never deleted",
        )


def foreign_files(data: Path, folders: Iterable[str] = tuple(CLEARED)) -> Iterator[Path]:
    """Yield the files and links in ``folders`` of a run's folder that no stage generated."""
    for name in CLEARED.keys() & {*folders}:
        pattern, folder = re.compile(CLEARED[name]), data / name
        if folder.is_file():
            yield folder
        for entry in _entries(folder):
            path = entry.path[len(str(folder)) + 1 :]
            temporary = any(is_temporary(part) for part in path.split(os.sep))
            generated = pattern.fullmatch(path) and not entry.is_symlink()
            if not (generated or temporary or FILE_IN_USE.fullmatch(entry.name)):
                yield folder / path


def _entries(folder: Path | str) -> Iterator[os.DirEntry[str]]:
    """Yield all entries below a folder that are not folders; links are not followed."""
    if not os.path.isdir(folder):
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                yield from _entries(entry.path)
            else:
                yield entry
