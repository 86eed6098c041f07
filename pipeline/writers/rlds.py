"""RLDS as OpenVLA and OpenVLA-OFT read it: a TFDS folder of TFRecord shards, written without TensorFlow.

Feature names, shapes and dtypes are those of the ``libero_*_no_noops`` sets that OpenVLA published (hub:
``openvla/modified_libero_rlds``), plus provenance in ``episode_metadata``, which their loaders ignore.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import google_crc32c
import numpy as np
import tensorflow_datasets as tfds

from pipeline.episode_schema import SCHEMA, VectorSpec, check
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.types import Episode
from pipeline.writers.base import Load, folder_bytes, split

if TYPE_CHECKING:  # export imports no simulator, and this would
    from pipeline.run.compute import Run

VERSION = "1.0.0"
SPLIT = "train"


class Location(NamedTuple):
    """Where an episode lies: the shard's file name and the episode's place in it, from 0."""

    shard: str
    position: int


@dataclass(frozen=True)
class RldsReport:
    """What was written.

    Attributes:
        folder: the version folder, for ``tfds.builder_from_directory``.
        locations: episode id to its place.
        steps: over all episodes.
        bytes: of all files.
    """

    folder: Path
    locations: Mapping[str, Location]
    steps: int
    bytes: int


@dataclass(frozen=True)
class _Shard:
    path: Path
    episode_ids: Sequence[str]


@dataclass(frozen=True)
class _Written:
    steps: int
    example_bytes: int


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


def write(episode_ids: Sequence[str], load: Load, out: Path, *, name: str, shards: int, run: Run) -> RldsReport:
    """Write ``out/<name>/1.0.0/``, replacing what is there.

    Shard k holds the k-th contiguous slice of the ids. A reader walks shards in order, so the ids must come shuffled;
    then neighbours in a shard are strangers. The bytes depend on the episodes, their order and ``shards`` alone.

    Args:
        episode_ids: shuffled ids of the episodes to write.
        load: reads one episode, in a worker.
        out: folder of RLDS sets.
        name: the set's TFDS name.
        shards: TFRecord files to spread the episodes over (fewer when there are fewer episodes).
        run: spreads the work; one call per shard.

    Raises:
        PipelineError: when an episode breaks the schema, or the name or the ids are unfit. Nothing is left behind.
    """
    if not name.isidentifier() or name != name.lower():
        raise PipelineError("not a TFDS name", where=f"name={name!r}", expected="lower-case snake_case")
    slices = split(episode_ids, shards)
    with replaced(out / name) as dataset:
        folder = dataset / VERSION
        folder.mkdir(parents=True)
        template = tfds.core.ShardedFileTemplate(
            data_dir=folder, dataset_name=name, split=SPLIT, filetype_suffix="tfrecord"
        )
        names = [template.relative_filepath(shard_index=k, num_shards=len(slices)) for k in range(len(slices))]
        jobs = [_Shard(folder / file, ids) for file, ids in zip(names, slices, strict=True)]
        written = run(partial(_write_shard, load=load), jobs, "RLDS shards")
        split_info = tfds.core.SplitInfo(
            name=SPLIT,
            shard_lengths=[len(ids) for ids in slices],
            num_bytes=sum(shard.example_bytes for shard in written),
            filename_template=template,
        )
        tfds.folder_dataset.write_metadata(
            data_dir=folder,
            features=features(),
            split_infos=[split_info],
            version=VERSION,
            filename_template=template,
            check_data=False,  # the check needs TensorFlow
            description="LIBERO demonstrations, perturbed, replayed in simulation and kept when they solve the task.",
        )
    folder = out / name / VERSION
    return RldsReport(
        folder=folder,
        locations={
            episode_id: Location(file, position)
            for file, ids in zip(names, slices, strict=True)
            for position, episode_id in enumerate(ids)
        },
        steps=sum(shard.steps for shard in written),
        bytes=folder_bytes(folder),
    )


@cache
def features() -> Any:
    """The feature tree (``tfds.features.FeaturesDict``)."""
    frame = partial(
        tfds.features.Image,
        shape=SCHEMA.frame.shape,
        dtype=np.dtype(SCHEMA.frame.dtype),
        encoding_format=SCHEMA.frame.encoding,
    )
    rotated = f"rotated by {SCHEMA.image_rotation_deg} degrees"
    observation = {view: frame(doc=f"{spec.camera}, {rotated}") for view, spec in SCHEMA.views.items()}
    observation |= {"state": _vector(SCHEMA.state), "joint_state": _vector(SCHEMA.joint_state)}
    scalar = tfds.features.Scalar
    step = {
        "observation": observation,
        "action": _vector(SCHEMA.action),
        "discount": scalar(np.float32, doc="always 1"),
        "reward": scalar(np.float32, doc="1 on the last step, else 0"),
        "is_first": scalar(np.bool_, doc="first step of the episode"),
        "is_last": scalar(np.bool_, doc="last step of the episode"),
        "is_terminal": scalar(np.bool_, doc="last step: every episode ends in success"),
        "language_instruction": tfds.features.Text(doc="what the policy is asked to do"),
    }
    metadata = {"file_path": tfds.features.Text(doc="the demonstration's source")}
    metadata |= {column: tfds.features.Text() for column in SCHEMA.provenance}
    return tfds.features.FeaturesDict({"steps": tfds.features.Dataset(step), "episode_metadata": metadata})


def _vector(spec: VectorSpec) -> Any:
    return tfds.features.Tensor(shape=spec.shape, dtype=np.dtype(spec.dtype), doc=", ".join(spec.names))


def _write_shard(shard: _Shard, load: Load) -> _Written:
    steps = example_bytes = 0
    with shard.path.open("wb") as file:
        for episode_id in shard.episode_ids:
            episode = load(episode_id)
            check(episode)
            example = _serialize(episode)
            file.write(_record(example))
            steps += len(episode)
            example_bytes += len(example)
    return _Written(steps, example_bytes)


def _serialize(episode: Episode) -> bytes:
    """``tf.train.Example`` of an episode; left to itself, protobuf orders its map anew in every process."""
    example = _serializer().get_tf_example(features().encode_example(_tree(episode)))
    return bytes(example.SerializeToString(deterministic=True))


@cache
def _serializer() -> Any:
    return tfds.core.ExampleSerializer(features().get_serialized_info())


def _tree(episode: Episode) -> dict[str, Any]:
    last = len(episode) - 1
    steps = [
        {
            "observation": {
                **{view: frames[t] for view, frames in episode.frames.items()},
                "state": episode.state[t],
                "joint_state": episode.joint_state[t],
            },
            "action": episode.action[t],
            "discount": 1.0,
            "reward": float(t == last),
            "is_first": t == 0,
            "is_last": t == last,
            "is_terminal": t == last,
            "language_instruction": episode.instruction,
        }
        for t in range(len(episode))
    ]
    return {
        "steps": steps,
        "episode_metadata": {"file_path": episode.provenance["demo_source"], **episode.provenance},
    }


def _record(data: bytes) -> bytes:
    """One TFRecord: length, its checksum, data, its checksum."""
    length = struct.pack("<Q", len(data))
    return b"".join((length, checksum(length), data, checksum(data)))


def checksum(data: bytes) -> bytes:
    """TFRecord's masked CRC-32C (``tensorflow/core/lib/io/record_writer.h``)."""
    crc = google_crc32c.value(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)
