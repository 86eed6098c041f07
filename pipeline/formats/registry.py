"""Registry of the output formats, one line each."""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from pipeline.formats.base import Format
from pipeline.formats.hdf5 import Hdf5
from pipeline.formats.lerobot import LeRobot, LeRobotOpenpi, LeRobotV21
from pipeline.formats.rlds import Rlds

FORMATS: tuple[type[Format[Any]], ...] = (
    Rlds,
    LeRobot,
    LeRobotV21,
    LeRobotOpenpi,
    Hdf5,
)


GROUPS = tuple(dict.fromkeys(kind.group for kind in FORMATS))
"""Groups of formats, in their order; one stage writes a group."""


def formats_in(group: str) -> list[type[Format[Any]]]:
    """List the formats of a group, which has the name of the first."""
    return [kind for kind in FORMATS if kind.group == group]


def columns() -> list[pa.Field]:
    """List the manifest's columns of all formats."""
    return [column for kind in FORMATS for column in kind.columns]


def places(datasets: Sequence[Format[Any]]) -> dict[str, dict[str, Any]]:
    """Return the place of each episode in each format.

    Returns:
        Episode id to the values of the manifest's columns.

    Raises:
        PipelineError: when a dataset is not finished.
    """
    merged: dict[str, dict[str, Any]] = {}
    for dataset in datasets:
        for episode_id, place in dataset.record().places.items():
            merged.setdefault(episode_id, {}).update(place)
    return merged
