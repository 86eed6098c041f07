"""What a run's files were made with, and whether it goes on with the same: else finished work would be thrown away
unasked. What nothing was made with yet may change: a login node may plan for the nodes that replay and render."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.files import read_json, write_json
from pipeline.identity import machine

FILE = "machine.json"
"""File of a run's folder that says what its files were made with."""


_PIXELS = ("OpenGL device", "one frame")
"""What only frames depend on; trajectories are made without OpenGL."""


def same_machine(folder: Path, further: Mapping[str, str] | None = None) -> None:
    """Record what is here, unless files of the run were made with something else.

    Args:
        folder: of the run.
        further: name to value of what only the caller knows, such as the OpenGL device.

    Raises:
        PipelineError: as ``refuse_another_machine``.
    """
    refuse_another_machine(folder, further)
    recorded, here = _recorded(folder), machine() | dict(further or {})
    if any(recorded.get(name, value) != value for name, value in here.items()):
        # Of another machine, on which nothing was made with it.
        recorded = {name: value for name, value in recorded.items() if _used(folder, name)}
    if recorded != (together := recorded | here):
        write_json(folder / FILE, dict(sorted(together.items())))


def refuse_another_machine(folder: Path, further: Mapping[str, str] | None = None) -> None:
    """Compare what a run's files were made with and what is here; nothing is written.

    Args:
        folder, further: as for ``same_machine``.

    Raises:
        PipelineError: when anything differs that a stored trajectory or frame was made with.
    """
    recorded, here = _recorded(folder), machine() | dict(further or {})
    if changed := [
        f"{name} {recorded[name]}, here {value}"
        for name, value in here.items()
        if recorded.get(name, value) != value and _used(folder, name)
    ]:
        file = folder / FILE
        raise PipelineError(
            f"the run was begun with {'; '.join(changed)}",
            where=file,
            expected="the same versions, processor features and OpenGL device for all files of a run",
            remedy=f"go on where it was begun, or delete {file}: then all that was made otherwise is made again",
        )


def _recorded(folder: Path) -> dict[str, str]:
    file = folder / FILE
    return read_json(file) if file.exists() else {}


def _used(folder: Path, name: str) -> bool:
    """Whether files were made that depend on this part of the record."""
    stores = ("frames",) if name in _PIXELS else ("trajectories", "frames")
    return any(next((folder / store).rglob("*.h5"), None) for store in stores)
