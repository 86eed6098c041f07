"""Folder of a run: its mark, which states the configuration file, and the lock that keeps other processes out."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.config import Config, load
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import is_temporary, read_json, remove_leftovers, write_json
from pipeline.run.run import Run
from pipeline.seeding import digest
from pipeline.strict_yaml import StrictLoader
from pipeline.types import find_home

OWNER = "configuration.json"
"""Mark of a run's folder: a file that states the configuration file of the folder."""

PLACES = ("name", "folder", "compute")
"""Fields of a configuration that state where a run is stored and computed. Their values change with a moved folder."""

PARAMS = Path("params.yaml")
"""File that states the run of `dvc repro` and its folder."""

LOCK = ".lock"
"""Empty file of a run's folder that a stage locks while it runs."""


class Mark(NamedTuple):
    """Mark of a run's folder, which states its configuration file.

    Attributes:
        file: absolute path of the configuration file.
        content: digest of the file's fields, without ``PLACES``; `None` in the mark of an earlier version.
    """

    file: Path
    content: str | None


def claim_folder(file: Path) -> Config:
    """Load a configuration for a run, and mark the run's folder as belonging to it.

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
    _reject_other_owner(config, file)
    config.run_folder.mkdir(parents=True, exist_ok=True)
    _reject_links(config.run_folder)
    wanted = Mark(file.resolve(), _content(file))
    if _mark(config.run_folder) != wanted:
        with locked(config.run_folder):
            _reject_other_owner(config, file)  # Another stage may have claimed the folder in the meantime.
            path = os.path.relpath(wanted.file, config.run_folder.resolve())
            content = {"configuration": path, "name": config.name, "content": wanted.content}
            write_json(config.run_folder / OWNER, content)
    return config


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other stages out of a run's folder, and delete the temporary files of killed stages in it.

    The system releases the lock when this process ends for any reason.

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
                expected="one stage at a time, as each stage reads the results of the stages before it",
                remedy=f"wait for the other stage, or stop it; `{MAKE_AGAIN}` runs all stages in order",
            ) from error
        except OSError as error:  # Lustre, for example, can be mounted without locks.
            raise PipelineError(
                f"the file system cannot lock a file ({error.strerror})",
                where=folder,
                expected="a file system whose locks are valid on all machines that see the folder",
                remedy="mount it with locks (Lustre: -o flock), or set `folder:` to a folder on another file system",
            ) from error
        remove_leftovers(folder)
        yield


def open_run(file: Path) -> Run:
    """Open the run of a configuration to read it; nothing is written.

    Raises:
        PipelineError: when the configuration is not valid, or the folder belongs to another file.
    """
    config = load(file)
    _reject_missing_parent(config, file)
    if (config.run_folder / OWNER).exists():
        _reject_other_owner(config, file)
    return Run(config)


def reject_unusable_folder(file: Path) -> None:
    """Reject a configuration whose folder ``claim_folder`` would not claim; nothing is written.

    Raises:
        PipelineError: as ``claim_folder``.
    """
    config = load(file)
    _reject_other_owner(config, file)
    if config.run_folder.exists():
        _reject_links(config.run_folder)


def reject_unmarked(folder: Path) -> None:
    """Reject a folder with files that no configuration has claimed, as the files do not belong to a run.

    Raises:
        PipelineError: naming the folder and some of its files.
    """
    if folder.exists() and not folder.is_dir():
        raise PipelineError(
            "the path is not a folder",
            where=folder,
            expected="a new or empty folder",
            remedy="change `name:` or `folder:`",
        )
    mark = folder / OWNER
    if not folder.exists() or mark.exists():
        return
    # A killed claim leaves the lock, and a temporary file of the mark.
    names = [entry.name for entry in folder.iterdir() if entry.name != LOCK and not is_temporary(entry.name, OWNER)]
    if names:
        raise PipelineError(
            f"the folder contains files and is not the folder of a run, as it has no {OWNER}: "
            f"{', '.join(sorted(names)[:3])}",
            where=folder,
            expected="a new or empty folder, or the folder of this run",
            remedy="change `name:` or `folder:`; if a run generated these files and its mark is lost, write "
            f'{{"configuration": "configs/<name>.yaml"}} into {mark}',
        )


def _params() -> Any:
    """Return the content of ``params.yaml``; `None` if there is no such file.

    Raises:
        PipelineError: when the file is not YAML.
    """
    if not PARAMS.is_file():
        return None
    try:
        return yaml.safe_load(PARAMS.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise PipelineError(
            f"the file is not valid YAML ({error})", where=PARAMS, expected="run: <name> and data: <folder>"
        ) from error


def reject_other_folder(file: Path) -> None:
    """Reject a configuration whose run is not where DVC looks for the files of stages, by params.yaml.

    Raises:
        PipelineError: naming both folders, or both names.
    """
    config = load(file)
    chosen = _params()
    if not isinstance(chosen, dict) or chosen.get("run") != file.stem:
        return
    if config.name != file.stem:
        raise PipelineError(
            f"`name: {config.name}` differs from the name of the file, and DVC would look into another folder",
            where=file,
            expected=f"name: {file.stem}",
            remedy=f"rename the file to {config.name}.yaml and write `run: {config.name}` into {PARAMS}; or use "
            "`python -m pipeline run`",
        )
    if chosen.get("data") != config.folder.as_posix():
        raise PipelineError(
            f"`data: {chosen.get('data')}` differs from `folder: {config.folder}` in {file}",
            where=PARAMS,
            expected="the same folder in both files",
            remedy=f"write `data: {config.folder}` into {PARAMS}",
        )


def find_missing_parent(folder: Path) -> Path | None:
    """Return the parent of an absolute folder outside of the home folder if it does not exist.

    With a mistyped path, a run would fill the disk of the system.
    """
    home = find_home()
    is_elsewhere = folder.is_absolute() and (home is None or not folder.is_relative_to(home))
    return folder.parent if is_elsewhere and not folder.parent.exists() else None


def _reject_missing_parent(config: Config, file: Path) -> None:
    missing = find_missing_parent(config.folder)
    if missing is not None:
        raise PipelineError(
            f"folder: {missing} does not exist",
            where=file,
            expected="a folder in an existing one",
            remedy=f"correct `folder:`, or create {missing}",
        )


def _reject_other_owner(config: Config, file: Path) -> None:
    """Reject a folder that must not be given to a configuration file."""
    folder = config.run_folder
    _reject_missing_parent(config, file)
    reject_unmarked(folder)
    _reject_folder_in_run(folder)
    mark = _mark(folder)
    if mark is None or mark.file == file.resolve():
        return
    this, owner = _shown(file.resolve(), mark.file)
    if mark.file.exists():
        raise PipelineError(
            f"the folder belongs to {owner}, and {this} has the same name: {config.name}",
            where=folder,
            expected="a separate folder for each configuration file, as a run deletes files that it did not plan",
            remedy=f"change `name:` in {this}, or `folder:`",
        )
    if mark.content != _content(file):
        raise PipelineError(
            f"the folder belongs to {owner}, which is missing, and {this} has different content",
            where=folder,
            expected="the configuration of the last run, after a move of the folder or of the configuration file",
            remedy=f"change `name:` in {this}, or `folder:`; to assign the folder to {this}, write "
            f'{{"configuration": "{this}"}} into {folder / OWNER}',
        )


def _reject_folder_in_run(folder: Path) -> None:
    for parent in folder.resolve().parents:
        if (parent / OWNER).is_file() and (parent / LOCK).is_file():
            raise PipelineError(
                f"the folder is inside {parent}, the folder of another run",
                where=folder,
                expected="a folder that is not inside the folder of another run",
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
    remedy = f'write {{"configuration": "configs/<name>.yaml"}}, with the configuration file of the folder, into {path}'
    try:
        stored = read_json(path, remedy)
        content = stored.get("content")
        # A mark of an earlier version, or one that a person wrote, names the file as seen from here.
        base = Path.cwd() if content is None else folder.resolve()
        return Mark((base / str(stored["configuration"])).resolve(), content)
    except (PipelineError, KeyError) as error:
        raise PipelineError(
            "the mark of the folder does not name a configuration file",
            where=path,
            expected='a JSON object with the field "configuration"',
            remedy=remedy,
        ) from error


def _content(file: Path) -> str:
    """Return a digest of the fields of a valid configuration file, without ``PLACES``."""
    fields = yaml.load(file.read_text(encoding="utf-8"), StrictLoader)
    return digest({name: value for name, value in fields.items() if name not in PLACES})


def _reject_links(folder: Path) -> None:
    links = [entry for entry in folder.iterdir() if entry.is_symlink()]
    if links:
        raise PipelineError(
            "the entry of the run's folder is a symbolic link",
            where=links[0],
            expected="real files and folders, as a stage deletes files that it did not plan",
            remedy=f"replace the link by its target; {folder} as a whole may be a link to another disk",
        )


def _shown(*files: Path) -> list[str]:
    """Return absolute paths for a message: as seen from here if all files are below this folder."""
    here = Path.cwd().resolve()
    below = all(file.is_relative_to(here) for file in files)
    return [(file.relative_to(here) if below else file).as_posix() for file in files]
