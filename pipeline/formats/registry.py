"""The output formats: one line each."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.export_config import ExportConfig
from pipeline.formats.base import Format
from pipeline.formats.lerobot import LeRobot
from pipeline.formats.lerobot_v21 import LeRobotV21
from pipeline.formats.rlds import Rlds
from pipeline.types import Extra

FORMATS: tuple[type[Format[Any]], ...] = (
    Rlds,
    LeRobot,
    LeRobotV21,
)


def formats_of(data: Path, options: ExportConfig, extras: Sequence[Extra] = ()) -> list[Format[Any]]:
    """The datasets that are asked for, of a run whose folder is ``data`` and whose episodes have these extras."""
    return [kind(data, options.formats[kind.name], extras) for kind in FORMATS if kind.name in options.formats]


FAILURES = "failures"
"""Folder of a run with the datasets of replays that missed their goal."""


def failures_of(data: Path, options: ExportConfig, extras: Sequence[Extra] = ()) -> list[Format[Any]]:
    """The datasets of failures; none where they are not asked for."""
    return formats_of(data / FAILURES, options.of_failures(), (*extras, "outcome")) if options.failures else []


def recorded(data: Path, options: ExportConfig, extras: Sequence[Extra] = ()) -> list[Format[Any]]:
    """The datasets of a run, and those of failures as far as there are some: a run may have none."""
    failures = failures_of(data, options, extras)
    return [*formats_of(data, options, extras), *(one for one in failures if one.record_file.exists())]


def columns() -> list[pa.Field]:
    """The manifest's columns of all formats."""
    return [column for kind in FORMATS for column in kind.columns]


def places(formats: list[Format[Any]]) -> dict[str, dict[str, Any]]:
    """Episode id to where it lies in each format, by the manifest's columns.

    Raises:
        PipelineError: when one of the datasets is not finished.
    """
    merged: dict[str, dict[str, Any]] = {}
    for one in formats:
        for episode_id, place in one.record().places.items():
            merged.setdefault(episode_id, {}).update(place)
    return merged
