"""Names of RLDS sets, their folders and shards: a set for each suite."""

from pathlib import Path

from pipeline.formats.base import Row

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
