"""Registry of the output formats, one line each."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.export_config import ExportConfig
from pipeline.formats.base import Format
from pipeline.formats.lerobot import LeRobot, LeRobotV21
from pipeline.formats.rlds import Rlds
from pipeline.types import Extra

FORMATS: tuple[type[Format[Any]], ...] = (
    Rlds,
    LeRobot,
    LeRobotV21,
)


GROUPS = tuple(dict.fromkeys(kind.group for kind in FORMATS))
"""Groups of formats, in their order; one stage writes a group."""


def formats_in(group: str) -> list[type[Format[Any]]]:
    """List the formats of a group, which has the name of the first."""
    return [kind for kind in FORMATS if kind.group == group]


def formats_of(data: Path, options: ExportConfig, extras: Sequence[Extra] = ()) -> list[Format[Any]]:
    """List the requested datasets of a run whose folder is ``data`` and whose episodes have these extras."""
    return [kind(data, options.formats[kind.name], extras) for kind in FORMATS if kind.name in options.formats]


FAILURES = "failures"
"""Folder of a run with the datasets of replays that missed their goal."""


def failures_of(data: Path, options: ExportConfig, extras: Sequence[Extra] = ()) -> list[Format[Any]]:
    """List the datasets of failures; the list is empty if failures are not requested."""
    if not options.failures:
        return []
    return formats_of(data / FAILURES, options.of_failures(), (*extras, "outcome"))


def recorded(data: Path, options: ExportConfig, extras: Sequence[Extra] = ()) -> list[Format[Any]]:
    """List the datasets of a run, and its datasets of failures that have a record: a run may have no failures."""
    failures = failures_of(data, options, extras)
    written_failures = [target for target in failures if target.record_file.exists()]
    return [*formats_of(data, options, extras), *written_failures]


def columns() -> list[pa.Field]:
    """List the manifest's columns of all formats."""
    return [column for kind in FORMATS for column in kind.columns]


def places(formats: list[Format[Any]]) -> dict[str, dict[str, Any]]:
    """Return the place of each episode in each format.

    Returns:
        Episode id to the values of the manifest's columns.

    Raises:
        PipelineError: when a dataset is not finished.
    """
    merged: dict[str, dict[str, Any]] = {}
    for target in formats:
        for episode_id, place in target.record().places.items():
            merged.setdefault(episode_id, {}).update(place)
    return merged
