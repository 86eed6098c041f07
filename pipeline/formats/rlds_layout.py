"""Names of RLDS sets, their folders and shards: a set for each suite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.formats.base import Row
from pipeline.formats.episodes import split

VERSION = "1.0.0"


def shard_path(name: str, split_name: str, shard: int, shards: int) -> str:
    """Path of a shard below the folder of all sets, as TFDS names it."""
    return f"{name}/{VERSION}/{name}-{split_name}.tfrecord-{shard:05d}-of-{shards:05d}"


def split_of(shard: Path) -> str:
    """The split, ``train`` or ``val``, that a shard belongs to."""
    return shard.name.partition(".")[0].rpartition("-")[2]


def dataset_of(row: Row) -> str:
    """Name of the set that holds a kept episode: what its shard's name begins with."""
    return str(row["rlds_shard"]).partition("-")[0]


def by_suite(episode_ids: Sequence[str], suites: Mapping[str, str], name: str) -> dict[str, list[str]]:
    """Set name to its episodes, in the caller's order: a set for each suite, so that clients train on one or on all.

    Args:
        episode_ids: ids of the episodes to write.
        suites: episode id to LIBERO suite.
        name: what the sets' names begin with; ``libero_spatial`` comes into ``<name>_spatial``.

    Raises:
        PipelineError: when there is nothing to write.
    """
    split(episode_ids, 1)
    sets: dict[str, list[str]] = {}
    for episode_id in episode_ids:
        sets.setdefault(f"{name}_{suites[episode_id].removeprefix('libero_')}", []).append(episode_id)
    return sets
