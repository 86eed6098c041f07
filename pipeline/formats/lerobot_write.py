"""The parts of a LeRobot dataset, and their merge, by lerobot 0.4.4 itself.

Two things of lerobot's are replaced: its video encoder (see ``lerobot_video``), and its statistics: of frames (see
``image_statistics``), and in ``meta/stats.json``, where merged quantiles are averages of per-episode quantiles
(huggingface/lerobot#3804). Beside lerobot's own files there is ``meta/provenance.parquet``, one row per episode.
"""

from __future__ import annotations

import base64
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import datasets
import huggingface_hub.constants
import lerobot.datasets.aggregate
import lerobot.datasets.lerobot_dataset
import lerobot.utils.utils
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import get_file_size_in_mb, write_info, write_stats
from lerobot.datasets.video_utils import concatenate_video_files
from numpy.typing import NDArray

from pipeline.episode_schema import MATRICES, SCHEMA, check
from pipeline.errors import PipelineError
from pipeline.formats.episodes import Load
from pipeline.formats.image_statistics import QUANTILES, Counts, count, statistics
from pipeline.formats.lerobot_columns import EPISODE_ID, INSTANCES, OBJECT_POSES, Frames, camera_column, features
from pipeline.formats.lerobot_video import VideoEncoder
from pipeline.formats.motion_statistics import describe
from pipeline.types import Episode, Extra, Floats, Frame

PART_VIDEO_MB = 1e-6
"""A file for each episode's video: lerobot rewrites a file for each that it appends. The merge fills its own 200 MB."""

DATA_MB = 25
"""Size of the data files: lerobot's merge has one in memory over and over, 1.4 GB of images at its own 100 MB."""

EPISODES_MB = 2
"""Size of the files in ``meta/episodes``, which the merge rewrites for each part: an episode is 1 kB in the file and
more than 100 in memory."""


SUMMARY, DATASET = "summary.json", "dataset"
"""In a part's folder: what the merge needs beside the dataset, and the dataset."""


def write_part(
    path: Path, episode_ids: Sequence[str], load: Load, *, repo_id: str, frames: Frames, extras: tuple[Extra, ...] = ()
) -> None:
    """Write a dataset of some of the episodes, and a summary; a process writes one at a time.

    The bytes, videos included, depend on the episodes, their order and the encoder's version alone.

    Args:
        path: new folder.
        episode_ids: ids of the episodes to write.
        load: reads one episode; one at a time is in memory.
        repo_id: the dataset's name, as on the hub; nothing is sent or fetched.
        frames: how frames are stored.
        extras: what the episodes have beside them.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)  # lerobot restores FFmpeg's own log, which tells of every append
    path.mkdir()
    dataset = LeRobotDataset.create(
        repo_id,
        SCHEMA.fps_hz,
        features(frames, extras),
        root=path / DATASET,
        robot_type=SCHEMA.robot_type,
        use_videos=frames == "video",
        video_backend="pyav",
        vcodec="h264",
    )
    dataset.meta.update_chunk_settings(data_files_size_in_mb=DATA_MB, video_files_size_in_mb=PART_VIDEO_MB)
    # The slot that streaming_encoding=True fills; it has no public name.
    dataset._streaming_encoder = VideoEncoder() if frames == "video" else None
    provenance = []
    counts: dict[str, Counts] = {view: np.zeros((3, 256), np.int64) for view in SCHEMA.views}
    try:
        for episode_id in episode_ids:
            episode = load(episode_id)
            check(episode, extras)
            for view, counted in _add(dataset, episode).items():
                counts[view] += counted
            provenance.append(dict(episode.provenance))
    finally:
        dataset.finalize()
    levels = {view: counted.tolist() for view, counted in counts.items()}
    (path / SUMMARY).write_text(json.dumps({"provenance": provenance, "levels": levels}))


def merge(parts: Sequence[Path], root: Path, cache: Path, *, repo_id: str) -> None:
    """Merge parts, in their order, into a dataset with exact statistics and a table of provenance.

    Args:
        parts: folders of ``write_part``.
        root: new folder of the dataset.
        cache: folder for the copies that ``datasets`` makes of what lerobot reads.
        repo_id: as of the parts.
    """
    with (
        local_only(cache),
        temporarily(lerobot.datasets.aggregate, "DEFAULT_DATA_FILE_SIZE_IN_MB", EPISODES_MB),
        _videos_joined_once(),
    ):
        aggregate_datasets(
            [repo_id] * len(parts),
            repo_id,
            roots=[part / DATASET for part in parts],
            aggr_root=root,
            data_files_size_in_mb=DATA_MB,
        )
    _number_episode_files(root)
    summaries = [json.loads((part / SUMMARY).read_text()) for part in parts]
    counts = {view: np.sum([summary["levels"][view] for summary in summaries], axis=0) for view in SCHEMA.views}
    _write_statistics(root, counts)
    _write_provenance(root, [row for summary in summaries for row in summary["provenance"]])


def name_splits(root: Path, lengths: Mapping[str, int]) -> None:
    """Write into ``meta/info.json`` which episodes each split has: ranges, one after the other.

    Args:
        root: of a dataset, as merged.
        lengths: split to its number of episodes.
    """
    file = root / "meta" / "info.json"
    info = json.loads(file.read_text())
    ends = np.cumsum(list(lengths.values())).tolist()
    info["splits"] = {name: f"{end - length}:{end}" for (name, length), end in zip(lengths.items(), ends, strict=True)}
    write_info(info, root)


def _add(dataset: LeRobotDataset, episode: Episode) -> dict[str, Counts]:
    """Save an episode, and return the levels of each view's frames."""
    steps = len(episode)
    columns = dataset.create_episode_buffer()
    columns |= {"size": steps, "task": [episode.instruction] * steps}
    columns |= {"frame_index": list(range(steps)), "timestamp": [t / SCHEMA.fps_hz for t in range(steps)]}
    columns[EPISODE_ID] = [episode.episode_id] * steps
    for name in ("state", "joint_state", "action"):
        columns[getattr(SCHEMA, name).lerobot_key] = list(getattr(episode, name))
    for view_name, seen in episode.geometry.items():
        columns |= {camera_column(view_name, name): [getattr(seen, name).ravel()] * steps for name in MATRICES}
        for name, files in seen.maps.items():
            columns[camera_column(view_name, name)] = [base64.b64encode(file).decode() for file in files]
    if episode.object_poses is not None:
        columns[OBJECT_POSES] = [poses.ravel() for poses in episode.object_poses]
    if episode.instances:
        columns[INSTANCES] = [json.dumps(list(episode.instances))] * steps
    encoder = dataset._streaming_encoder
    if encoder is None:
        # ``datasets``, which lerobot hands the columns to, takes a whole image file for an image.
        columns |= {view.lerobot_key: episode.frames[name] for name, view in SCHEMA.views.items()}
    else:
        encoder.start_episode([view.lerobot_key for view in SCHEMA.views.values()], dataset.root)
    counts: dict[str, Counts] = {}
    for name, view in SCHEMA.views.items():
        counts[name] = np.zeros((3, 256), np.int64)
        for t in range(steps):
            pixels = _pixels(episode, name, t)
            counts[name] += count(pixels)
            if encoder is not None:
                encoder.feed_frame(view.lerobot_key, pixels)
    ours = {view.lerobot_key: statistics(counts[name]) for name, view in SCHEMA.views.items()}
    described = partial(_episode_statistics, frames=ours)
    saving = lerobot.datasets.lerobot_dataset
    # The columns hold whole files already; lerobot would go through all rows of each episode to look for paths.
    with (
        temporarily(saving, "compute_episode_stats", described),
        temporarily(saving, "embed_images", lambda columns: columns),
    ):
        dataset.save_episode(columns)
    return counts


def _pixels(episode: Episode, view: str, t: int) -> Frame:
    pixels = cv2.imdecode(np.frombuffer(episode.frames[view][t], np.uint8), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise PipelineError(f"{view} frame {t} cannot be decoded", where=f"episode {episode.episode_id}")
    return pixels.astype(np.uint8, copy=False)


def _episode_statistics(
    columns: dict[str, Any], features: dict[str, Any], *, frames: Mapping[str, Any]
) -> dict[str, Any]:
    """lerobot's statistics of an episode, with ``frames`` in place of its own for the cameras."""
    vectors = {name: values for name, values in columns.items() if name not in frames}
    return {**compute_episode_stats(vectors, features), **frames}


def _column_statistics(values: Floats) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of a (N, D) column, each (D,); ``count`` is (1,)."""
    return describe(values, QUANTILES) | {"count": np.array([len(values)])}


def _number_episode_files(root: Path) -> None:
    """Have each row of ``meta/episodes`` name its own file: lerobot 0.4.4 names the one before where it begins one."""
    for file in (root / "meta" / "episodes").rglob("*.parquet"):
        table = pq.read_table(file)
        for name, part in (("chunk_index", file.parent.name), ("file_index", file.stem)):
            column = f"meta/episodes/{name}"
            number = pa.array([int(part.rpartition("-")[2])] * len(table), pa.int64())
            table = table.set_column(table.schema.get_field_index(column), column, number)
        pq.write_table(table, file)


def _write_statistics(root: Path, counts: Mapping[str, Counts]) -> None:
    """Write ``meta/stats.json`` over lerobot's, from every row and every pixel."""
    exact = {view.lerobot_key: statistics(counts[name]) for name, view in SCHEMA.views.items()}
    data = pq.ParquetDataset(root / "data")
    texts = {field.name for field in data.schema if field.type in (pa.string(), pa.large_string())}
    for column in [name for name in data.schema.names if name not in {*exact, *texts}]:
        values = data.read(columns=[column])[column].combine_chunks()
        flat = values.flatten() if pa.types.is_nested(values.type) else values
        exact[column] = _column_statistics(flat.to_numpy().astype(np.float64).reshape(len(values), -1))
    write_stats(exact, root)


def _write_provenance(root: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write ``meta/provenance.parquet``: one row per episode; lerobot reads the files it knows and passes this by."""
    columns: dict[str, Any] = {"episode_index": pa.array(range(len(rows)), pa.int64())}
    columns |= {column: pa.array([row[column] for row in rows], pa.string()) for column in SCHEMA.provenance}
    pq.write_table(pa.table(columns), root / "meta" / "provenance.parquet")


@contextmanager
def _videos_joined_once() -> Iterator[None]:
    """Write each video file of a merge in one go: lerobot rewrites it for each source that it appends."""
    sources: defaultdict[Path, list[Path]] = defaultdict(list)
    # Of the files with sources: to add up the sources' again for each that comes would take time with their square.
    sizes_mb: dict[Path, float] = {}

    def size_mb(file: Path) -> float:
        return sizes_mb[file] if file in sizes_mb else float(get_file_size_in_mb(file))

    def append(paths: Sequence[Path], joined: Path) -> None:
        sizes_mb[joined] = size_mb(joined) + size_mb(paths[-1])
        sources[joined].append(paths[-1])

    merging = lerobot.datasets.aggregate
    with temporarily(merging, "concatenate_video_files", append), temporarily(merging, "get_file_size_in_mb", size_mb):
        yield
    for joined, rest in sources.items():
        concatenate_video_files([joined, *rest], joined)


@contextmanager
def local_only(cache: Path) -> Iterator[None]:
    """Keep the copies that ``datasets`` makes of what lerobot reads out of the home folder, and lerobot off the hub."""
    with (
        temporarily(datasets.config, "HF_DATASETS_CACHE", cache),
        temporarily(huggingface_hub.constants, "HF_HUB_OFFLINE", True),
        # lerobot would turn the bars of ``datasets`` on after each file that it reads.
        temporarily(lerobot.utils.utils, "enable_progress_bar", datasets.disable_progress_bars),
    ):
        datasets.disable_progress_bars()
        yield


@contextmanager
def temporarily(owner: object, name: str, value: object) -> Iterator[None]:
    """Give an attribute another value for a while: where a library has no argument for it."""
    saved = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, saved)
