"""Files that a command writes to a path that the user names, such as tables, reports and lists of tasks.

The user may store other files there, or edit these. A command replaces only a file that has the content that a command
wrote: their checksums are in the hidden file ``RECORD`` of the same folder.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline import files
from pipeline.errors import PipelineError

RECORD = ".perturbed_libero.json"
"""File with the SHA-256 of the present and the next content of each file that a command writes into the folder.

The checksum is recorded before the file is replaced. After a kill in between, the file has the content before it.
"""


def reject_other_file(path: Path) -> None:
    """Reject a file that a command would replace although no command wrote its content.

    Raises:
        PipelineError: naming the file.
    """
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_file():
        what = "the command would replace this link or folder by a file"
    elif files.checksum(path) in _recorded(path.parent).get(path.name, []):
        return
    else:
        what = "the command would overwrite the file, which is edited or was not written by a command"
    raise PipelineError(
        what,
        where=path,
        expected=f"a new name, or a file that {path.parent / RECORD} lists with its content",
        remedy="choose another name, or move the file to another place",
    )


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield a temporary path, whose file replaces ``path`` and is recorded.

    Raises:
        PipelineError: as ``reject_other_file``.
    """
    reject_other_file(path)
    with files.replaced(path) as temporary:
        yield temporary
        contents = [path, temporary] if path.exists() else [temporary]
        recorded = _recorded(path.parent) | {path.name: [files.checksum(file) for file in contents]}
        files.write_json(path.parent / RECORD, recorded)


def write(path: Path, content: str) -> None:
    """Write a text file as ``written`` does."""
    with written(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Write a JSON file as ``written`` does."""
    write(path, json.dumps(content, indent=1) + "\n")


def _recorded(folder: Path) -> dict[str, list[str]]:
    """Return the names of the files that commands wrote into a folder, with the checksums of their contents."""
    file = folder / RECORD
    return files.read_json(file, "run the command again") if file.exists() else {}
