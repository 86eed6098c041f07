"""Folder of a run: its mark, which states the configuration file, and the lock that keeps other processes out."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import yaml

from pipeline.config import Config, load
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import is_temporary, read_json, remove_leftovers, write_json
from pipeline.run.run import Run
from pipeline.seeding import digest
from pipeline.strict_yaml import StrictLoader

OWNER = "configuration.json"
"""File of a run's folder, its mark: states which configuration file the folder belongs to."""

PLACES = ("name", "folder", "compute")
"""Fields of a configuration that state where a run is stored and computed. A folder that was moved has others."""

PARAMS = Path("params.yaml")
"""File that states which run `dvc repro` makes, and in which folder."""

LOCK = ".lock"
"""Empty file of a run's folder that a stage holds while it runs."""


class Mark(NamedTuple):
    """Mark of a run's folder, which states its configuration file.

    Attributes:
        file: absolute path of the configuration file.
        content: digest of what the file states, without ``PLACES``; `None` in the mark of an earlier version.
    """

    file: Path
    content: str | None


def claimed(file: Path) -> Config:
    """Load a configuration that is about to be run; its run's folder belongs to it from now on.

    A stage deletes finished work that its plan does not name, so two configuration files must never share a folder.
    The folder's mark records the path of its configuration file, as seen from the folder, and a digest of its content.
    A configuration file may use the folder in two cases:

    * It is the file at the recorded path. It may have been edited, and file and folder may have moved together.
    * No file is at the recorded path, and the content is the recorded content: the file or the folder was moved.

    Any other file is rejected. A folder without a mark is claimed only if it is empty.

    Raises:
        PipelineError: when the configuration is not valid, or the folder belongs to another file, or holds files and no
            mark.
    """
    config = load(file)
    _refuse_other_owner(config, file)
    config.data.mkdir(parents=True, exist_ok=True)
    _refuse_links(config.data)
    wanted = Mark(file.resolve(), _content(file))
    if _mark(config.data) != wanted:
        with locked(config.data):
            _refuse_other_owner(config, file)  # Another stage may have claimed the folder in the meantime.
            path = os.path.relpath(wanted.file, config.data.resolve())
            content = {"configuration": path, "name": config.name, "content": wanted.content}
            write_json(config.data / OWNER, content)
    return config


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other stages out of a run's folder, and delete what killed stages left in it.

    The system ends the lock with this process, however the process ends.

    Raises:
        PipelineError: when another stage runs in the folder, or the file system has no locks.
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
        except OSError as error:  # Lustre, for example, can be mounted without locks.
            raise PipelineError(
                f"the file system cannot lock a file ({error.strerror})",
                where=folder,
                expected="locks that hold on all machines that see the folder",
                remedy="have it mounted with them (Lustre: -o flock), or set `folder:` to one that has them",
            ) from error
        remove_leftovers(folder)
        yield


def owned(file: Path) -> Run:
    """Open the run of a configuration to read it; nothing is written.

    Raises:
        PipelineError: when the configuration is not valid, or the folder belongs to another file.
    """
    config = load(file)
    if (config.data / OWNER).exists():
        _refuse_other_owner(config, file)
    return Run(config)


def refuse_unmarked(folder: Path) -> None:
    """Reject a folder that holds files and that no configuration has claimed, as the files are not of a run.

    Raises:
        PipelineError: naming the folder and some of its files.
    """
    if folder.exists() and not folder.is_dir():
        raise PipelineError(
            "not a folder", where=folder, expected="a new or empty folder", remedy="change `name:` or `folder:`"
        )
    mark = folder / OWNER
    if not folder.exists() or mark.exists():
        return
    # A killed claim leaves the lock, and a temporary file of the mark.
    names = [entry.name for entry in folder.iterdir() if entry.name != LOCK and not is_temporary(entry.name, OWNER)]
    if names:
        raise PipelineError(
            f"holds files and is not the folder of a run, as it has no {OWNER}: {', '.join(sorted(names)[:3])}",
            where=folder,
            expected="a new or empty folder, or the folder of this run",
            remedy="change `name:` or `folder:`; if a run made these files and its mark is lost, write "
            f'{{"configuration": "configs/<name>.yaml"}} into {mark}',
        )


def refuse_other_folder(file: Path) -> None:
    """Reject a configuration whose folder is not that of params.yaml, where DVC would look for a stage's files.

    Raises:
        PipelineError: naming both folders.
    """
    config = load(file)
    chosen = yaml.safe_load(PARAMS.read_text()) if PARAMS.is_file() else None
    if isinstance(chosen, dict) and chosen.get("run") == file.stem and chosen.get("data") != config.folder.as_posix():
        raise PipelineError(
            f"says `data: {chosen.get('data')}`, and {file} says `folder: {config.folder}`",
            where=PARAMS,
            expected="the same folder in both",
            remedy=f"write `data: {config.folder}` into {PARAMS}",
        )


def _refuse_other_owner(config: Config, file: Path) -> None:
    """Reject a folder that ``claimed`` must not give to a configuration file."""
    folder = config.data
    refuse_unmarked(folder)
    _refuse_folder_in_run(folder)
    mark = _mark(folder)
    if mark is None or mark.file == file.resolve():
        return
    this, owner = _shown(file.resolve(), mark.file)
    adopt = f'to have the folder belong to {this}, write {{"configuration": "{this}"}} into {folder / OWNER}'
    if mark.file.exists():
        raise PipelineError(
            f"the folder belongs to {owner}, and {this} has the same name: {config.name}",
            where=folder,
            expected="a folder for each configuration file, as a run deletes what it did not plan",
            remedy=f"change `name:` in {this}, or `folder:`; {adopt}",
        )
    if mark.content != _content(file):
        raise PipelineError(
            f"the folder belongs to {owner}, which is not there, and {this} has another content",
            where=folder,
            expected="the content of the last run, where a folder or a configuration file was moved",
            remedy=f"change `name:` in {this}, or `folder:`; {adopt}",
        )


def _refuse_folder_in_run(folder: Path) -> None:
    for parent in folder.resolve().parents:
        if (parent / OWNER).is_file() and (parent / LOCK).is_file():
            raise PipelineError(
                f"is inside {parent}, the folder of another run",
                where=folder,
                expected="folders of runs next to each other",
                remedy="change `folder:`",
            )


def _mark(folder: Path) -> Mark | None:
    """Return the mark of a run's folder, `None` if it has none.

    Raises:
        PipelineError: when the mark cannot be read.
    """
    path = folder / OWNER
    if not path.exists():
        return None
    remedy = f'write {{"configuration": "configs/<name>.yaml"}}, the file that the folder belongs to, into {path}'
    try:
        stored = read_json(path, remedy)
        content = stored.get("content")
        # A mark of an earlier version, or one that a person wrote, names the file as seen from here.
        base = Path.cwd() if content is None else folder.resolve()
        return Mark((base / str(stored["configuration"])).resolve(), content)
    except (PipelineError, KeyError) as error:
        raise PipelineError(
            "cannot read which configuration the folder belongs to",
            where=path,
            expected='a JSON object with the field "configuration"',
            remedy=remedy,
        ) from error


def _content(file: Path) -> str:
    """Return a digest of what a valid configuration file states, without ``PLACES``."""
    fields = yaml.load(file.read_text(encoding="utf-8"), StrictLoader)
    return digest({name: value for name, value in fields.items() if name not in PLACES})


def _refuse_links(folder: Path) -> None:
    links = [entry for entry in folder.iterdir() if entry.is_symlink()]
    if links:
        raise PipelineError(
            "is a symbolic link",
            where=links[0],
            expected="the run's own files and folders, as a stage deletes what it did not plan",
            remedy=f"put what it leads to in its place; {folder} as a whole may be a link to another disk",
        )


def _shown(*files: Path) -> list[str]:
    """Return absolute paths for a message: as seen from here if all files are below this folder."""
    here = Path.cwd().resolve()
    below = all(file.is_relative_to(here) for file in files)
    return [(file.relative_to(here) if below else file).as_posix() for file in files]
