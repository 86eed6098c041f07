"""What a run was begun with, and whether it goes on with the same: else finished work would be thrown away unasked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.files import read_json, replaced
from pipeline.identity import machine

FILE = "machine.json"
"""File of a run's folder that says what its files were made with."""


def same_machine(folder: Path, further: Mapping[str, str] | None = None) -> None:
    """Compare what a run was begun with and what is here; what was not recorded yet is recorded.

    Args:
        folder: of the run.
        further: name to value of what only the caller knows, such as the OpenGL device.

    Raises:
        PipelineError: when anything differs.
    """
    file, here = folder / FILE, machine() | dict(further or {})
    recorded: dict[str, str] = read_json(file) if file.exists() else {}
    if changed := [
        f"{name} {recorded[name]}, here {value}" for name, value in here.items() if recorded.get(name, value) != value
    ]:
        raise PipelineError(
            f"the run was begun with {'; '.join(changed)}",
            where=file,
            expected="the same versions, processor features and OpenGL device for all files of a run",
            remedy=f"go on where it was begun, or delete {file}: then all that was made otherwise is made again",
        )
    if here.keys() - recorded.keys():
        folder.mkdir(parents=True, exist_ok=True)
        with replaced(file) as temporary:
            temporary.write_text(json.dumps(recorded | here, indent=1, sort_keys=True) + "\n")
