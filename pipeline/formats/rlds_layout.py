"""Names of RLDS sets, their folders and shards: a set for each suite."""

from pathlib import Path

from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.formats.base import ManifestRow

VERSION = "1.0.0"


def datasets(root: Path) -> list[Path]:
    """List the version folders of the sets below ``root``: TFDS's ``data_dir``, OFT's ``data_root_dir``.

    Raises:
        PipelineError: when no set exists.
    """
    folders = sorted(file.parent for file in root.glob("*/*/dataset_info.json"))
    if not folders:
        raise PipelineError("no RLDS dataset", where=root, expected="NAME/1.0.0/dataset_info.json", remedy=MAKE_AGAIN)
    return folders


def shard_path(name: str, split_name: str, shard: int, shards: int) -> str:
    """Return the path of a shard below the folder of all sets, as TFDS names it."""
    return f"{name}/{VERSION}/{name}-{split_name}.tfrecord-{shard:05d}-of-{shards:05d}"


def split_of(shard: Path) -> str:
    """Return the split, ``train`` or ``val``, that a shard belongs to."""
    return shard.name.partition(".")[0].rpartition("-")[2]


def dataset_of(row: ManifestRow) -> str:
    """Return the name of a kept episode's set, which is the prefix of its shard's name."""
    return str(row["rlds_shard"]).partition("-")[0]
