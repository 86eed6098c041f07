"""TFRecord files without TensorFlow: the framing of records, and examples as flat columns."""

import struct
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import tensorflow_datasets as tfds
from google.protobuf import json_format
from numpy.typing import NDArray

from pipeline.errors import PipelineError

METADATA = "episode_metadata/"
"""Prefix of columns with one value for the whole episode."""


OVERHEAD_BYTES = 16
"""Bytes that the framing adds to a record."""


def framed(data: bytes) -> bytes:
    """Return data framed as a TFRecord: length, its checksum, data, its checksum."""
    length = struct.pack("<Q", len(data))
    return b"".join((length, checksum(length), data, checksum(data)))


def checksum(data: bytes) -> bytes:
    """Compute TFRecord's masked CRC-32C (``tensorflow/core/lib/io/record_writer.h``)."""
    crc = google_crc32c.value(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def records(shard: Path) -> Iterator[bytes]:
    """Read the records of a TFRecord file: length (8 bytes), its checksum (4), data, its checksum (4).

    Raises:
        PipelineError: naming the file and the record, when a checksum is wrong.
    """
    for index, (start, length) in enumerate(spans(shard)):
        yield _read(shard, index, start, length)


def spans(shard: Path) -> Iterator[tuple[int, int]]:
    """Find the offset and the length of each record's data, in bytes, without reading the data.

    Raises:
        PipelineError: naming the file and the record, when a length is damaged or the file is cut short.
    """
    size, start = shard.stat().st_size, 0
    with shard.open("rb") as file:
        for index, head in enumerate(iter(partial(file.read, 12), b"")):
            is_intact = head[8:] == checksum(head[:8])
            length = struct.unpack("<Q", head[:8])[0] if is_intact else size
            end = start + length + OVERHEAD_BYTES
            if end > size:
                raise _damaged(shard, index)
            yield start + 12, length
            start = file.seek(end)


def record_at(shard: Path, index: int) -> bytes | None:
    """Read the record at an index, counted from 0; ``None`` where the file ends or is damaged before it.

    Raises:
        PipelineError: when the record's data is damaged.
    """
    try:
        span = next(islice(spans(shard), index, None), None)
    except (OSError, PipelineError):
        return None
    return None if span is None else _read(shard, index, *span)


def _read(shard: Path, index: int, start: int, length: int) -> bytes:
    with shard.open("rb") as file:
        file.seek(start)
        data = file.read(length)
        if file.read(4) != checksum(data):
            raise _damaged(shard, index)
    return data


def _damaged(shard: Path, index: int) -> PipelineError:
    return PipelineError(
        f"record {index} is damaged", where=shard, expected="its checksum", remedy="write the dataset again"
    )


def info_of(folder: Path) -> Any:
    """Open the description of an RLDS dataset, ``folder`` being that of its version.

    TFDS imports the modules of the classes that ``features.json`` names. No file near the dataset is imported.

    Returns:
        A ``tfds.core.DatasetInfo``.

    Raises:
        OSError, ValueError: if a file is missing or damaged, or names an unknown class, as TFDS raises them.
    """
    try:
        with _no_modules_around(folder):
            return tfds.builder_from_directory(folder).info
    except json_format.Error as error:
        raise ValueError(f"features.json or dataset_info.json: {error}") from error


@contextmanager
def _no_modules_around(folder: Path) -> Iterator[None]:
    """Leave the folders that contain ``folder`` out of ``sys.path``, such as the working folder of ``python -m``."""
    searched = sys.path[:]
    inside = folder.resolve()
    sys.path[:] = [entry for entry in searched if not inside.is_relative_to(Path(entry).resolve())]
    try:
        yield
    finally:
        sys.path[:] = searched


def columns(record: bytes, features: Any) -> dict[str, NDArray[Any]]:
    """Parse a record into its columns by path, such as ``observation/image`` or ``episode_metadata/axis``.

    Args:
        record: a serialised ``tf.train.Example``.
        features: the dataset's feature tree (``tfds.features.FeaturesDict``).

    Returns:
        Columns with one entry per step, or a single entry for ``episode_metadata/``. Frames stay encoded, text is
        bytes.

    Raises:
        PipelineError: when the record lacks a feature.
    """
    try:
        example = _parser(features).parse_example(record)
        steps = dict(_flat(example["steps"]))
        metadata = dict(_flat(example.get("episode_metadata", {}), METADATA))
        return steps | metadata
    except (LookupError, ValueError, TypeError) as error:
        raise PipelineError(
            f"a record cannot be read by features.json ({type(error).__name__}: {error})",
            expected="the features that it names",
            remedy="write the dataset again",
        ) from error


@lru_cache(maxsize=8)
def _parser(features: Any) -> Any:
    return tfds.core.example_parser.ExampleParserNp(features.get_serialized_info())


def _flat(tree: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{path}{name}/")
        else:
            # An object array keeps all bytes; numpy's own strings drop final zeros.
            yield path + name, np.array([value], object) if isinstance(value, bytes) else np.atleast_1d(value)
