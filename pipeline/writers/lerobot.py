"""LeRobotDataset v3.0, written by lerobot 0.4.4 itself: parts in parallel, then merged.

Two things of lerobot's are replaced: its video encoder (see ``video``), and its statistics in ``meta/stats.json``,
whose merged quantiles are averages of per-episode quantiles (huggingface/lerobot#3804). Beside lerobot's own files
there is ``meta/provenance.parquet``, one row per episode.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import cv2
import datasets
import huggingface_hub.constants
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import write_stats
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA, check
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.stats import describe
from pipeline.types import Episode, Floats, Frame
from pipeline.writers.base import Load, folder_bytes, split
from pipeline.writers.video import QUANTILES, Counts, VideoEncoder, statistics

if TYPE_CHECKING:  # export imports no simulator, and this would
    from pipeline.compute import Run

PART_VIDEO_MB = 16
"""lerobot rewrites a video file for each episode that it appends: small files here, its own 200 MB after the merge."""


@dataclass(frozen=True)
class LeRobotReport:
    """What was written.

    Attributes:
        folder: the dataset's root, for ``LeRobotDataset(repo_id, root=folder)``.
        episode_index: episode id to lerobot's ``episode_index``.
        steps: over all episodes.
        bytes: of all files.
    """

    folder: Path
    episode_index: Mapping[str, int]
    steps: int
    bytes: int


@dataclass(frozen=True)
class _Part:
    root: Path
    episode_ids: Sequence[str]


@dataclass(frozen=True)
class _Written:
    steps: int
    provenance: Sequence[Mapping[str, str]]
    counts: Mapping[str, Counts]


def write(episode_ids: Sequence[str], load: Load, out: Path, *, repo_id: str, parts: int, run: Run) -> LeRobotReport:
    """Write a dataset whose root is ``out``, replacing what is there; episode i is ``episode_ids[i]``.

    The bytes, videos included, depend on the episodes, their order, ``parts`` and the encoder's version alone.

    Args:
        episode_ids: ids of the episodes to write.
        load: reads one episode, in a worker; one at a time is in memory.
        out: the dataset's root.
        repo_id: its name on the hub, such as ``user/name``; nothing is sent or fetched.
        parts: pieces written in parallel and merged (fewer when there are fewer episodes).
        run: spreads the work; one call per part.

    Raises:
        PipelineError: when an episode breaks the schema or the ids are unfit. Nothing is left behind.
    """
    slices = split(episode_ids, parts)
    out.parent.mkdir(parents=True, exist_ok=True)
    with replaced(out) as root, tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as scratch:
        jobs = [_Part(Path(scratch) / f"part-{k:05d}", ids) for k, ids in enumerate(slices)]
        written = run(partial(_write_part, load=load, repo_id=repo_id), jobs, "LeRobot parts")
        with _local_only(Path(scratch) / "cache"):
            aggregate_datasets([repo_id] * len(jobs), repo_id, roots=[job.root for job in jobs], aggr_root=root)
        counts = {view: np.sum([part.counts[view] for part in written], axis=0) for view in SCHEMA.views}
        _write_statistics(root, counts)
        _write_provenance(root, [row for part in written for row in part.provenance])
    return LeRobotReport(
        folder=out,
        episode_index={episode_id: index for index, episode_id in enumerate(episode_ids)},
        steps=sum(part.steps for part in written),
        bytes=folder_bytes(out),
    )


def features() -> dict[str, dict[str, Any]]:
    """lerobot's description of the columns."""
    frame = {"dtype": "video", "shape": SCHEMA.frame.shape, "names": list(SCHEMA.frame.names)}
    columns = {view.lerobot_key: dict(frame) for view in SCHEMA.views.values()}
    for vector in (SCHEMA.state, SCHEMA.joint_state, SCHEMA.action):
        columns[vector.lerobot_key] = {"dtype": vector.dtype, "shape": vector.shape, "names": list(vector.names)}
    return columns


def _write_part(part: _Part, load: Load, repo_id: str) -> _Written:
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)  # lerobot restores FFmpeg's own log, which tells of every append
    shutil.rmtree(part.root, ignore_errors=True)  # of a worker that died
    dataset = LeRobotDataset.create(
        repo_id,
        SCHEMA.fps_hz,
        features(),
        root=part.root,
        robot_type=SCHEMA.robot_type,
        video_backend="pyav",
        vcodec="h264",
    )
    dataset.meta.update_chunk_settings(video_files_size_in_mb=PART_VIDEO_MB)
    encoder = VideoEncoder()
    # The slot that streaming_encoding=True fills; it has no public name.
    dataset._streaming_encoder = encoder
    steps = 0
    provenance = []
    try:
        for episode_id in part.episode_ids:
            episode = load(episode_id)
            check(episode)
            _add(dataset, episode)
            steps += len(episode)
            provenance.append(dict(episode.provenance))
    finally:
        dataset.finalize()
    counts = {name: encoder.counts[view.lerobot_key] for name, view in SCHEMA.views.items()}
    return _Written(steps, provenance, counts)


def _add(dataset: LeRobotDataset, episode: Episode) -> None:
    for t in range(len(episode)):
        frame: dict[str, Any] = {
            SCHEMA.state.lerobot_key: episode.state[t],
            SCHEMA.joint_state.lerobot_key: episode.joint_state[t],
            SCHEMA.action.lerobot_key: episode.action[t],
            "task": episode.instruction,
        }
        frame |= {view.lerobot_key: _pixels(episode, name, t) for name, view in SCHEMA.views.items()}
        dataset.add_frame(frame)
    dataset.save_episode()


def _pixels(episode: Episode, view: str, t: int) -> Frame:
    pixels = cv2.imdecode(np.frombuffer(episode.frames[view][t], np.uint8), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise PipelineError(f"{view} frame {t} cannot be decoded", where=f"episode {episode.episode_id}")
    return pixels.astype(np.uint8, copy=False)


def _column_statistics(values: Floats) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of a (N, D) column, each (D,); ``count`` is (1,)."""
    return describe(values, QUANTILES) | {"count": np.array([len(values)])}


def _write_statistics(root: Path, counts: Mapping[str, Counts]) -> None:
    """Write ``meta/stats.json`` over lerobot's, from every row and every pixel."""
    exact = {}
    for name, view in SCHEMA.views.items():
        # (3, 1, 1) in [0, 1], as lerobot hands out images.
        exact[view.lerobot_key] = {
            key: value if key == "count" else value.reshape(3, 1, 1) / 255
            for key, value in statistics(counts[name]).items()
        }
    data = pq.ParquetDataset(root / "data")
    for column in data.schema.names:
        values = data.read(columns=[column])[column].combine_chunks()
        flat = values.flatten() if pa.types.is_list(values.type) else values
        exact[column] = _column_statistics(flat.to_numpy().astype(np.float64).reshape(len(values), -1))
    write_stats(exact, root)


def _write_provenance(root: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write ``meta/provenance.parquet``: one row per episode; lerobot reads the files it knows and passes this by."""
    columns: dict[str, Any] = {"episode_index": pa.array(range(len(rows)), pa.int64())}
    columns |= {column: pa.array([row[column] for row in rows], pa.string()) for column in SCHEMA.provenance}
    pq.write_table(pa.table(columns), root / "meta" / "provenance.parquet")


@contextmanager
def _local_only(cache: Path) -> Iterator[None]:
    """Keep the copies that ``datasets`` makes of what lerobot reads out of the home folder, and lerobot off the hub."""
    saved = datasets.config.HF_DATASETS_CACHE, huggingface_hub.constants.HF_HUB_OFFLINE
    datasets.config.HF_DATASETS_CACHE, huggingface_hub.constants.HF_HUB_OFFLINE = cache, True
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE, huggingface_hub.constants.HF_HUB_OFFLINE = saved
