"""Files of others that are fetched once and checked by hash, whatever program fetches them."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.files import checksum


def fetched(path: Path, sha256: str, command: Sequence[str], content: str, remedy: str) -> Path:
    """The file ``path``, which is fetched unless it is there. Processes may do this at the same time.

    Args:
        path: where it belongs.
        sha256: of the file.
        command: leaves it, under its name, in the folder that it runs in.
        content: what it is fetched for, in words.
        remedy: what to do where it cannot be had.

    Raises:
        PipelineError: when it cannot be downloaded, or is not the file that this project was made with.
    """
    if path.exists():
        check(path, sha256, content)
        return path
    print(f"fetching {path.name}, {content}, into {path.parent}", file=sys.stderr)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        try:
            subprocess.run(command, cwd=scratch, check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
            raise PipelineError(f"{content} could not be downloaded ({reason})", where=path, remedy=remedy) from error
        downloaded = Path(scratch) / path.name
        check(downloaded, sha256, content)
        os.replace(downloaded, path)
    return path


def check(path: Path, sha256: str, content: str) -> None:
    """Compare a file with its hash.

    Raises:
        PipelineError: when it is another, or not there.
    """
    try:
        found = checksum(path)
    except OSError as error:
        raise PipelineError(f"cannot be read ({error})", where=path, remedy="run it again") from error
    if found != sha256:
        raise PipelineError(
            f"not the file that this project was made with, {content}: its SHA-256 is {found}",
            where=path,
            expected=sha256,
            remedy="delete the file and run it again",
        )
