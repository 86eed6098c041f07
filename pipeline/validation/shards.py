"""RLDS shards read back without TensorFlow: TFRecord framing, and examples as flat columns."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.writers.rlds import checksum

METADATA = "episode_metadata/"
"""What the names of columns with one value for the whole episode begin with."""


def records(shard: Path) -> Iterator[bytes]:
    """The records of a TFRecord file: length (8 bytes), its checksum (4), data, its checksum (4).

    Raises:
        PipelineError: naming the file and the record, when a checksum is wrong.
    """
    with shard.open("rb") as file:
        for index, head in enumerate(iter(partial(file.read, 12), b"")):
            data = file.read(struct.unpack("<Q", head[:8])[0]) if head[8:] == checksum(head[:8]) else None
            if data is None or file.read(4) != checksum(data):
                raise PipelineError(
                    f"record {index} is damaged", where=shard, expected="its checksum", remedy="write the dataset again"
                )
            yield data


def columns(record: bytes, features: Any) -> dict[str, NDArray[Any]]:
    """An example's columns by path, such as ``observation/image`` or ``episode_metadata/axis``.

    Args:
        record: a serialised ``tf.train.Example``.
        features: the dataset's feature tree (``tfds.features.FeaturesDict``).

    Returns:
        One entry per step, frames left encoded; one entry in all for ``episode_metadata/``. Text is bytes.

    Raises:
        PipelineError: when the record lacks a feature.
    """
    parser = tfds.core.example_parser.ExampleParserNp(features.get_serialized_info())
    try:
        example = parser.parse_example(record)
    except KeyError as error:
        raise PipelineError(
            f"a record has no feature {error}", expected="what features.json names", remedy="write the dataset again"
        ) from error
    return dict(_flat(example["steps"])) | dict(_flat(example["episode_metadata"], METADATA))


def _flat(tree: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{path}{name}/")
        else:
            # An object array keeps bytes whole; numpy's own strings drop final zeros.
            yield path + name, np.array([value], object) if isinstance(value, bytes) else np.atleast_1d(value)
