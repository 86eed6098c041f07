"""What the scripts in ``stages/`` share: one argument, the configuration, and errors that a person can act on."""

import argparse
import fcntl
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml

from pipeline.config import Config, load
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.exit_status import exit_status
from pipeline.files import remove_leftovers, write_json
from pipeline.identity import REMAKE

OWNER = "configuration.json"
"""File of a run's folder that says which configuration file the folder belongs to."""

PARAMS = Path("params.yaml")
"""Says which run `dvc repro` makes, and in which folder."""

LOCK = ".lock"
"""Empty file of a run's folder that a stage holds while it runs."""


def main(stage: Callable[[Config], None], description: str) -> None:
    """Run ``stage`` on the configuration named on the command line."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("config", type=Path, help="a file of configs/, such as configs/starter.yaml")
    parser.add_argument("--remake", action="store_true", help=f"make finished work anew, as does {REMAKE}=1 before it")
    arguments = parser.parse_args()
    if arguments.remake:
        os.environ[REMAKE] = "1"

    def run() -> int:
        config = claimed(arguments.config)
        with locked(config.data):
            stage(config)
        return 0

    if status := exit_status(run):
        sys.exit(status)


def claimed(file: Path) -> Config:
    """Load a configuration that is about to be run; a run's folder that is new belongs to it from now on.

    A stage deletes what its plan does not name, so two configurations must never share a folder. The same file may
    change as it likes.

    Raises:
        PipelineError: when the configuration is not valid, or the folder belongs to another file.
    """
    config = load(file)
    _refuse_other_folder(config, file)
    config.data.mkdir(parents=True, exist_ok=True)
    mark = config.data / OWNER
    if not mark.exists():
        with locked(config.data):
            if not mark.exists():  # Of two stages that start at the same time, the second finds it.
                write_json(mark, {"configuration": _named(file, config.data.resolve()), "name": config.name})
    _refuse_foreign(config, file)
    _refuse_links(config.data)
    return config


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other stages out of a run's folder, and clear what killed ones left in it.

    The system ends the lock with this process, however it ends.

    Raises:
        PipelineError: when a stage runs there.
    """
    with (folder / LOCK).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise PipelineError(
                "another stage of this run is running, here or on another machine",
                where=folder,
                expected="one stage at a time, as each reads what the one before it has finished",
                remedy=f"wait for it, or stop it; `{MAKE_AGAIN}` runs all stages in order",
            ) from error
        except OSError as error:  # Such as Lustre, mounted without them.
            raise PipelineError(
                f"the file system cannot lock a file ({error.strerror})",
                where=folder,
                expected="locks that hold on all machines that see the folder",
                remedy="have it mounted with them (Lustre: -o flock), or set `folder:` to one that has them",
            ) from error
        remove_leftovers(folder)
        yield


def owned(file: Path) -> Config:
    """Load a configuration whose finished run is to be read; nothing is written.

    Raises:
        PipelineError: as ``claimed``.
    """
    config = load(file)
    if (config.data / OWNER).exists():
        _refuse_foreign(config, file)
    return config


def _refuse_other_folder(config: Config, file: Path) -> None:
    """DVC knows the folder from params.yaml alone, and would look for a stage's files there."""
    chosen = yaml.safe_load(PARAMS.read_text()) if PARAMS.is_file() else None
    if isinstance(chosen, dict) and chosen.get("run") == file.stem and chosen.get("data") != config.folder.as_posix():
        raise PipelineError(
            f"says `data: {chosen.get('data')}`, and {file} says `folder: {config.folder}`",
            where=PARAMS,
            expected="the same folder in both",
            remedy=f"python -m pipeline run {file}, which writes it into {PARAMS}",
        )


def _refuse_foreign(config: Config, file: Path) -> None:
    mark, own = config.data / OWNER, _named(file, config.data.resolve())
    # In full where the folder was elsewhere and is here now; from here where a link has taken its place.
    known_as = {own, file.resolve().as_posix(), _named(file, Path(os.path.abspath(config.data)))}
    try:
        owner = str(json.loads(mark.read_text())["configuration"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PipelineError(
            f"cannot read which configuration the folder belongs to ({error})",
            where=mark,
            remedy=f"delete the file if the folder is that of {own}",
        ) from error
    if owner not in known_as:
        raise PipelineError(
            f"the folder belongs to {owner}, and {own} has the same name: {config.name}",
            where=config.data,
            expected="a folder for each configuration file, as a run deletes what it did not plan",
            remedy=f"change `name:` in {own}, or rename or delete the folder; if you moved the folder, or renamed "
            f"{owner} to {own}, delete {mark}, and the folder goes with {own}",
        )


def _refuse_links(folder: Path) -> None:
    if links := [entry for entry in folder.iterdir() if entry.is_symlink()]:
        raise PipelineError(
            "is a symbolic link",
            where=links[0],
            expected="the run's own files and folders, as a stage deletes what it did not plan",
            remedy=f"put what it leads to in its place; {folder} as a whole may be a link to another disk",
        )


def _named(file: Path, folder: Path) -> str:
    """The configuration's path from here where the run's folder is here too, and moves with it; else in full.

    Args:
        folder: absolute.
    """
    file, here = file.resolve(), Path.cwd().resolve()
    together = file.is_relative_to(here) and folder.is_relative_to(here)
    return file.relative_to(here).as_posix() if together else file.as_posix()
