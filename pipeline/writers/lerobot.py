"""LeRobotDataset v3.0, written by lerobot 0.4.4 itself: parts in parallel, then merged.

Three things of lerobot's are replaced:

- its streaming encoder, which drops frames when it falls behind, has its quality built in (33 dB with H.264) and takes
  longer for its histograms than for the video;
- the statistics in ``meta/stats.json``: the ``std`` of images overflows uint8 (huggingface/lerobot#3697) and merged
  quantiles are averages of per-episode quantiles (#3804), so exact ones are written over them;
- the cache folder of ``datasets`` while it merges, so that nothing is left in the user's home.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

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
from pipeline.files import replaced
from pipeline.types import Episode, Floats, Frame
from pipeline.writers.base import Load, folder_bytes, split

if TYPE_CHECKING:  # export imports no simulator, and this would
    from pipeline.compute import Run

ENCODER: Final = "libx264"
ENCODER_OPTIONS = {
    # Measured on LIBERO frames: 40 dB (agent view) and 39 dB (wrist) at 7 kB a frame, no frame below 36 dB;
    # "superfast" saves a tenth of the bytes for twice the time.
    "preset": "ultrafast",
    "crf": "20",
    # lerobot's own choice: any frame is at most one frame away from a key frame, for random access in training.
    "g": "2",
    # The bytes depend on the number of threads; parts are parallel already.
    "threads": "1",
}
PART_VIDEO_MB = 16
"""lerobot rewrites a video file for each episode that it appends: small files here, its own 200 MB after the merge."""

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
LEVELS = np.arange(256.0)
Counts = NDArray[np.int64]
"""(3, 256) how often each level occurs in each channel."""


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
    encoder = _VideoEncoder()
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
        frame |= {view.lerobot_key: _pixels(episode.frames[name][t]) for name, view in SCHEMA.views.items()}
        dataset.add_frame(frame)
    dataset.save_episode()


def _pixels(data: bytes) -> Frame:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB).astype(np.uint8, copy=False)


class _VideoEncoder:
    """Fills lerobot's slot for a ``StreamingVideoEncoder``: encodes each frame as it comes and counts its levels."""

    def __init__(self) -> None:
        self.counts: dict[str, Counts] = {}
        self._streams: dict[str, _Stream] = {}

    def start_episode(self, video_keys: Sequence[str], temp_dir: Path) -> None:
        # lerobot removes the folder of a file that it has taken over, so each file gets a folder of its own.
        self._streams = {key: _Stream(Path(tempfile.mkdtemp(dir=temp_dir)) / "episode.mp4") for key in video_keys}

    def feed_frame(self, video_key: str, image: Frame) -> None:
        self._streams[video_key].add(image)

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, Floats]]]:
        """Per video: its file, and statistics in grey levels, which lerobot scales to [0, 1]."""
        finished = {}
        for key, stream in self._streams.items():
            stream.close()
            self.counts[key] = self.counts.get(key, 0) + stream.counts
            finished[key] = stream.path, _count_statistics(stream.counts)
        self._streams = {}
        return finished

    def cancel_episode(self) -> None:
        for stream in self._streams.values():
            stream.close()
        self._streams = {}

    close = cancel_episode


class _Stream:
    """One video file in the making."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: Counts = np.zeros((3, 256), np.int64)
        self._frames = 0
        self._file = av.open(str(path), "w")
        self._video = self._file.add_stream(ENCODER, SCHEMA.fps_hz, options=ENCODER_OPTIONS)
        self._video.height, self._video.width, _ = SCHEMA.frame.shape
        self._video.pix_fmt = "yuv420p"
        self._video.time_base = Fraction(1, SCHEMA.fps_hz)

    def add(self, image: Frame) -> None:
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, SCHEMA.fps_hz)
        self._file.mux(self._video.encode(frame))
        self._frames += 1
        for channel in range(3):
            self.counts[channel] += cv2.calcHist([image], [channel], None, [256], [0, 256])[:, 0].astype(np.int64)

    def close(self) -> None:
        self._file.mux(self._video.encode())
        self._file.close()


def _count_statistics(counts: Counts) -> dict[str, Floats]:
    """lerobot's statistics of an image, each (3,) in grey levels, exact; ``count`` is the number of frames."""
    height, width, _ = SCHEMA.frame.shape
    pixels = counts.sum(axis=1)
    mean = counts @ LEVELS / pixels
    return {
        "min": LEVELS[(counts > 0).argmax(axis=1)],
        "max": LEVELS[255 - (counts > 0)[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt((counts * (LEVELS - mean[:, None]) ** 2).sum(axis=1) / pixels),
        "count": pixels[:1] // (height * width),
        **{
            name: np.array([np.quantile(LEVELS, q, weights=row, method="inverted_cdf") for row in counts])
            for name, q in QUANTILES.items()
        },
    }


def _column_statistics(values: Floats) -> dict[str, Floats]:
    """lerobot's statistics of a (N, D) column, each (D,), exact."""
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **{name: np.quantile(values, q, axis=0) for name, q in QUANTILES.items()},
    }


def _write_statistics(root: Path, counts: Mapping[str, Counts]) -> None:
    """Write ``meta/stats.json`` over lerobot's, every column from every row and every pixel."""
    statistics = {}
    for name, view in SCHEMA.views.items():
        levels = _count_statistics(counts[name])
        statistics[view.lerobot_key] = {
            key: value if key == "count" else value.reshape(3, 1, 1) / 255 for key, value in levels.items()
        }
    data = pq.ParquetDataset(root / "data")
    for column in data.schema.names:
        values = data.read(columns=[column])[column].combine_chunks()
        flat = values.flatten() if pa.types.is_list(values.type) else values
        statistics[column] = _column_statistics(flat.to_numpy().astype(np.float64).reshape(len(values), -1))
    write_stats(statistics, root)


def _write_provenance(root: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write ``meta/provenance.parquet``: one row per episode; lerobot reads the files it knows and passes this by."""
    columns: dict[str, Any] = {"episode_index": pa.array(range(len(rows)), pa.int64())}
    columns |= {column: pa.array([row[column] for row in rows], pa.string()) for column in SCHEMA.provenance}
    pq.write_table(pa.table(columns), root / "meta" / "provenance.parquet")


@contextmanager
def _local_only(cache: Path) -> Iterator[None]:
    """lerobot reads through ``datasets``, which copies to a cache in the home folder; what it misses it asks the hub for."""
    saved = datasets.config.HF_DATASETS_CACHE, huggingface_hub.constants.HF_HUB_OFFLINE
    datasets.config.HF_DATASETS_CACHE, huggingface_hub.constants.HF_HUB_OFFLINE = cache, True
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE, huggingface_hub.constants.HF_HUB_OFFLINE = saved
