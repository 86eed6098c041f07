"""Inputs of a run that DVC does not find in a configuration: its defaults, and the content of the files that it names.

These files are demonstrations, the user's own tasks, a bank of rewrites, folders of textures and objects. A stage
writes out the configuration and lists these files each time, and other stages depend on both. A changed file is
noticed; if nothing has changed, nothing runs again.
"""

import json
from collections.abc import Iterator, Mapping, Set
from glob import glob
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from pydantic import BaseModel

from pipeline.config import Config
from pipeline.export_config import ExportConfig
from pipeline.files import checksum
from pipeline.libero.tasks import OWN, SUITES, select_tasks, tasks
from pipeline.run.machine import host

HASHED_BYTES = 16_000_000
"""Largest size of a file that is listed by its content; larger files are listed by size and time of change."""


SECTIONS = ("demos", "plan", "replay", "filter", "render", "export", "finetune", "compute", "publish")
"""Sections of a configuration, in the order of ``settings.json``."""

PUBLISHED = tuple(name for name in SECTIONS if name != "compute")
"""Sections on which the content of datasets and cards depends."""


def listing(config: Config) -> dict[str, list[str | int]]:
    """Map each file that the configuration's paths lead to, to a state that differs once the file has changed.

    A file's name is the field of the configuration and the file's path in the folder that the field names, such as
    ``demos.root/libero_goal/turn_on_the_stove_demo.hdf5``. The place of that folder changes nothing.
    """
    states: dict[str, list[str | int]] = {}
    sections = {name: section for name, section in config if name != "folder"}
    for field, path in _paths(sections):
        for file in sorted(_files(path)):
            states[(PurePosixPath(field) / file.relative_to(path)).as_posix()] = _state(file)
    own_tasks = [task for task in select_tasks(config.demos.tasks) if task.suite not in SUITES]
    if config.plan.axes.goal:
        # The axis carries tasks to the scenes of all tasks of their suite.
        own_tasks = [task for suite in dict.fromkeys(task.suite for task in own_tasks) for task in tasks(suite)]
    for task in own_tasks:
        states[f"{OWN}/{task}.bddl"] = _state(task.bddl_file)
    return states


def settings(config: Config) -> dict[str, Any]:
    """Return this machine and every section that affects the generated files, with all fields.

    Paths are reduced to their last name, as ``listing`` lists their files.
    """
    sections = {name: settings_of(getattr(config, name)) for name in SECTIONS}
    # Fields that are left out at their default; DVC stops where a parameter is missing.
    defaults = {name: field.default for name, field in ExportConfig.model_fields.items() if field.exclude_if}
    return {**sections, "export": {**defaults, **sections["export"]}, "host": host()}


def published_settings(config: Config) -> dict[str, Any]:
    """Return the sections of ``PUBLISHED`` with all fields, which a card records."""
    sections = settings(config)
    return {name: sections[name] for name in PUBLISHED}


def settings_of(section: BaseModel, but: Set[str] = frozenset()) -> dict[str, Any]:
    """Return the fields of a section, JSON-serialisable.

    Paths are reduced to their last name, as ``listing`` lists their files.

    Args:
        but: fields to leave out.
    """
    # Aliases are the field names of the first version that wrote them.
    dumped = section.model_dump(exclude=set(but), by_alias=True)
    listed: dict[str, Any] = json.loads(json.dumps(dumped, default=lambda path: PurePath(path).name))
    return listed


def _paths(value: Any, field: str = "") -> Iterator[tuple[str, Path]]:
    """Yield every path in a configuration, however deep, with its field: ``plan.axes.layout.sources.1.folder``."""
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
        # glob skips hidden files, which are records that downloads leave, and follows folders that are links.
        for name in glob("**", root_dir=path, recursive=True):
            file = path / name
            if file.is_file():
                yield file
    elif path.exists():
        yield path


def _state(file: Path) -> list[str | int]:
    status = file.stat()
    if status.st_size <= HASHED_BYTES:
        return [checksum(file)]
    return [status.st_size, status.st_mtime_ns]
