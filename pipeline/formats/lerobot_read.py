"""LeRobot datasets read back through lerobot itself, without the hub."""

from __future__ import annotations

import base64
import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import datasets
import lerobot.datasets.video_utils
import numpy as np
import pyarrow.parquet as pq
import torchvision
from datasets.exceptions import DatasetsError
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from pipeline.episode_schema import MAPS, MATRICES, MOTION, SCHEMA, named
from pipeline.errors import PipelineError
from pipeline.formats.base import Row
from pipeline.formats.lerobot_columns import INSTANCES, OBJECT_POSES, camera_column, geometry_columns
from pipeline.formats.lerobot_write import local_only, temporarily
from pipeline.formats.read_back import Copy, Fault, sampled
from pipeline.types import Episode, Extra, Geometry

UNREADABLE = (
    AssertionError,
    AttributeError,
    DatasetsError,
    IndexError,
    KeyError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What lerobot raises on files that are damaged, missing or do not belong together."""

MARKS = ("frame_index", "timestamp")
"""LeRobot's columns that tell steps apart."""


@dataclass(frozen=True)
class LeRobotSet:
    """A LeRobot dataset opened.

    Attributes:
        data: as lerobot opens it.
        provenance: episode id to its row of ``meta/provenance.parquet``, ``episode_index`` included.
    """

    data: LeRobotDataset
    provenance: Mapping[str, Mapping[str, Any]]


def check(root: Path, cache: Path, kept: Mapping[str, Row], columns: Mapping[str, Any]) -> Iterator[tuple[str, Fault]]:
    """Frame rate, robot, the columns' names and shapes, the videos' own frame rate; as many episodes as were kept.

    Raises:
        PipelineError: when the dataset cannot be opened.
    """
    with _readable(root):
        opened = _open(root, cache)
        meta = opened.data.meta
        read: dict[str, Any] = {"fps": meta.fps, "robot_type": meta.robot_type}
        wanted: dict[str, Any] = {"fps": SCHEMA.fps_hz, "robot_type": SCHEMA.robot_type}
        for key, spec in columns.items():
            has = meta.features.get(key, {})
            read[key] = (has.get("dtype"), tuple(has.get("shape", ())), tuple(has.get("names") or ()))
            wanted[key] = (spec["dtype"], tuple(spec["shape"]), tuple(spec["names"] or ()))
        for file in sorted(meta.root.glob("videos/**/*.mp4")):
            name = str(file.relative_to(meta.root))
            with av.open(str(file)) as video:
                read[name], wanted[name] = float(video.streams.video[0].average_rate or 0), SCHEMA.fps_hz
        stored = (meta.total_episodes, opened.data.num_frames)
    for key, expected in wanted.items():
        if read[key] != expected:
            yield "format", Fault("lerobot", None, f"{key} is {read[key]}", f"{expected}")
    steps = sum(row["steps"] for row in kept.values())
    if stored != (len(kept), steps):
        yield "ids", Fault("lerobot", None, f"{stored[0]} episodes of {stored[1]} steps", f"{len(kept)} of {steps}")
    # One that is missing is told where it is looked for.
    for episode_id in sorted(opened.provenance.keys() - kept.keys()):
        yield "ids", Fault("lerobot", episode_id, "is in the dataset", "kept episodes alone")


def read(root: Path, cache: Path, episode_id: str, extras: tuple[Extra, ...]) -> Copy | None:
    """An episode with these extras; None when the dataset does not have it.

    Raises:
        PipelineError: when it cannot be read.
    """
    with _readable(root), temporarily(lerobot.datasets.video_utils, "torchvision", _TORCHVISION):
        opened = _open(root, cache)
        return _copy(opened, episode_id, extras) if episode_id in opened.provenance else None


@contextmanager
def _readable(root: Path) -> Iterator[None]:
    try:
        yield
    except UNREADABLE as error:
        raise PipelineError(
            f"{type(error).__name__}: {error}", where=root, expected="what lerobot reads", remedy="dvc repro"
        ) from error


def _open(root: Path, cache: Path) -> LeRobotSet:
    return _opened(root, cache, (root / "meta" / "info.json").stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _opened(root: Path, cache: Path, modified_ns: int) -> LeRobotSet:
    datasets.disable_progress_bars()
    # lerobot decodes through it, and each worker would print that it will go.
    warnings.filterwarnings("ignore", message="The video decoding", category=UserWarning)
    with local_only(cache):
        data = LeRobotDataset(root.name, root=root, video_backend="pyav")
    rows = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    return LeRobotSet(data, {row["episode_id"]: row for row in rows})


class _KeptOpen:
    """A video file that stays open when lerobot closes it: it opens the file anew for each frame that it decodes, which
    takes 14 times as long as the frame where the file has 200 MB."""

    def __init__(self, file: Any):
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def close(self) -> None:
        pass


def _video(path: str, stream: str) -> torchvision.io.VideoReader:
    return _opened_video(path, stream, Path(path).stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _opened_video(path: str, stream: str, modified_ns: int) -> torchvision.io.VideoReader:
    reader = torchvision.io.VideoReader(path, stream)
    reader.container = _KeptOpen(reader.container)
    return reader


_TORCHVISION = SimpleNamespace(io=SimpleNamespace(VideoReader=_video), set_video_backend=torchvision.set_video_backend)
"""What lerobot uses of torchvision to decode."""


@lru_cache(maxsize=1)
def _steps(data: LeRobotDataset, extras: tuple[Extra, ...]) -> datasets.Dataset:
    """The rows of all steps, without the images where they are not videos."""
    vectors = [getattr(SCHEMA, name).lerobot_key for name in MOTION]
    plain = [*vectors, "episode_index", "task_index", *MARKS, *geometry_columns(extras)]
    return data.hf_dataset.select_columns(plain).with_format("numpy")


def _copy(opened: LeRobotSet, episode_id: str, extras: tuple[Extra, ...]) -> Copy:
    data = opened.data
    provenance = opened.provenance[episode_id]
    index = provenance["episode_index"]
    rows = data.meta.episodes[index]
    start, stop = rows["dataset_from_index"], rows["dataset_to_index"]
    table = _steps(data, extras)[start:stop]
    if set(table["episode_index"].tolist()) != {index} or len(table["action"]) != rows["length"]:
        raise ValueError(f"rows {start} to {stop} are not the {rows['length']} steps of episode {index}")
    decoded = {}
    for step in sampled(stop - start):
        item = data[start + step]
        for view, spec in SCHEMA.views.items():
            # lerobot hands out floats in [0, 1], channels first.
            pixels = np.rint(item[spec.lerobot_key].numpy().transpose(1, 2, 0) * 255)
            decoded[view, step] = np.ascontiguousarray(pixels, np.uint8)
    instructions = [str(data.meta.tasks.iloc[task].name) for task in table["task_index"].tolist()]
    episode = Episode(
        episode_id=episode_id,
        frames={},
        **{name: table[getattr(SCHEMA, name).lerobot_key] for name in MOTION},
        instruction=instructions[0],
        provenance=provenance,
        geometry={view: _geometry(table, view, extras) for view in SCHEMA.views},
        object_poses=table[OBJECT_POSES].reshape(-1, *SCHEMA.object_poses.shape) if OBJECT_POSES in table else None,
        instances=json.loads(_constant(table, INSTANCES)) if named(extras) else (),
    )
    return Copy(
        dataset="lerobot",
        episode=episode,
        instructions=instructions,
        decoded=decoded,
        marks={name: table[name] for name in MARKS},
        place={"lerobot_episode_index": index},
    )


def _geometry(table: Mapping[str, Any], view: str, extras: tuple[Extra, ...]) -> Geometry:
    matrices = {
        name: _constant(table, camera_column(view, name)).reshape(getattr(SCHEMA, name).shape) for name in MATRICES
    }
    texts = {name: table[camera_column(view, name)] for name in MAPS if name in extras}
    return Geometry(**matrices, maps={name: list(map(base64.b64decode, files)) for name, files in texts.items()})


def _constant(table: Mapping[str, Any], column: str) -> Any:
    """What a column has at every step of an episode."""
    first, *others = table[column]
    if any(np.any(other != first) for other in others):
        raise ValueError(f"{column} is not the same at every step")
    return first
