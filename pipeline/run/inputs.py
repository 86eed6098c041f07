"""What DVC cannot read off a configuration: what it leaves to defaults, and what lies in the files that it names.

Those are demonstrations, tasks of one's own, a bank of rewrites, folders of textures and objects. A stage writes out
the configuration and lists these files each time, and other stages depend on that: a changed file is noticed, and where
both are the same nothing runs again.
"""

from collections.abc import Iterator, Mapping
from glob import glob
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel

from pipeline.config import Config
from pipeline.files import checksum
from pipeline.libero.tasks import OWN, SUITES, select_tasks
from pipeline.run.finished import host, settings_of

HASHED_BYTES = 16_000_000
"""Files up to this size are listed by their content; larger ones by size and time of change, as hashing takes long."""


SECTIONS = ("demos", "plan", "replay", "filter", "render", "export", "compute", "publish")
"""Sections of a configuration, in the order of ``settings.json``."""


def listing(config: Config) -> dict[str, list[str | int]]:
    """Each file that the configuration's paths lead to, and what shows whether it has changed.

    A file is named by the field of the configuration and its path in the folder that stands there, such as
    ``demos.root/libero_goal/turn_on_the_stove_demo.hdf5``: where that folder lies changes nothing.
    """
    own = (task for task in select_tasks(config.demos.tasks) if task.suite not in SUITES)
    return {
        (PurePosixPath(field) / file.relative_to(path)).as_posix(): _state(file)
        for field, path in _paths({name: section for name, section in config if name != "folder"})
        for file in sorted(_files(path))
    } | {f"{OWN}/{task}.bddl": _state(task.bddl_file) for task in own}


def settings(config: Config) -> dict[str, Any]:
    """Every section that decides what is made, with all fields, and this machine.

    Of a path the last name, as for ``listing``.
    """
    sections = {name: settings_of(getattr(config, name)) for name in SECTIONS}
    export = {"where": None, "lerobot_v21": None, "failures": False, **sections["export"]}
    return {**sections, "export": export, "host": host()}


def _paths(value: Any, field: str = "") -> Iterator[tuple[str, Path]]:
    """Every path in a configuration, however deep, and its field, such as ``plan.axes.layout.sources.1.folder``."""
    if isinstance(value, Path):
        yield field.removeprefix("."), value
    elif isinstance(value, BaseModel):
        yield from _paths(dict(value), field)
    elif isinstance(value, Mapping):
        for name, member in value.items():
            yield from _paths(member, f"{field}.{name}")
    elif isinstance(value, list | tuple):
        for number, member in enumerate(value):
            yield from _paths(member, f"{field}.{number}")


def _files(path: Path) -> Iterator[Path]:
    if path.is_dir():
        # Without hidden files, which are records that downloads leave; with those of folders that are links.
        yield from (file for name in glob("**", root_dir=path, recursive=True) if (file := path / name).is_file())
    elif path.exists():
        yield path


def _state(file: Path) -> list[str | int]:
    status = file.stat()
    if status.st_size <= HASHED_BYTES:
        return [checksum(file)]
    return [status.st_size, status.st_mtime_ns]
