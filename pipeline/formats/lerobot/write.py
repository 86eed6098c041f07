"""Writer of LeRobot v3.0 and v2.1 as published, without lerobot, which only reads and checks v3.0 here.

A worker writes a piece: consecutive episodes. Its files are final, because the number of preceding steps is known. The
files about all episodes come at the end: tasks, splits, exact statistics, and ``meta/provenance.parquet`` with a row
for each episode, which lerobot ignores. The bytes depend only on the episodes, their order and the packages.

* v3.0: a piece is one file of data, one of each video, and one of ``meta/episodes``. Files of one number hold the same
  episodes.
* v2.1: every episode is one file of data and one of each video. ``meta/stats.json`` is no part of v2.1, but
  ``gr00t/data/dataset/lerobot_episode_loader.py`` of NVIDIA/Isaac-GR00T at 23ace64 requires it.

lerobot's own writer of v3.0 appends by writing whole files again. Its statistics are averages of per-episode quantiles
(huggingface/lerobot#3804) from a sample of the frames.
"""

import base64
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, Self

import av
import cv2
import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.video.frame import PictureType
from numpy.typing import NDArray

from pipeline.episode_schema import ALL_VIEWS, MATRICES, SCHEMA, STANDARD, Content, check, labels_of
from pipeline.errors import PipelineError
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import QUANTILES, Counts, count, describe, listed, of_levels, open_is_one
from pipeline.formats.lerobot import depth
from pipeline.formats.lerobot.columns import (
    DATA_PATH,
    DATA_PATH_V21,
    ENCODER,
    ENCODER_OPTIONS,
    ENTRIES,
    EPISODE_ID,
    FILE_MB,
    FILES_OF_A_CHUNK,
    INSTANCES,
    IS_SUCCESS,
    OBJECT_POSES,
    PLACE,
    STARVLA_FIGURES,
    STARVLA_STATISTICS,
    VIDEO_INFO,
    VIDEO_PATH,
    VIDEO_PATH_V21,
    Layout,
    camera_column,
    data_path_v21,
    matrix_columns,
    read_matrix,
    video_path_v21,
)
from pipeline.formats.lerobot.language import FEATURES, language_columns
from pipeline.images.jpeg import decode, decode_exactly
from pipeline.types import Episode, Frame

PROVENANCE, LEVELS = "provenance.parquet", "levels.json"
"""Files in a piece's folder, in both versions: a row for each episode, and counts of levels."""

DATA, EPISODES = "data.parquet", "episodes.parquet"
"""Further files of v3.0 in a piece's folder, in addition to ``<view>.mp4``."""

LINES_V21 = ("episodes.jsonl", "episodes_stats.jsonl")
"""Further files of v2.1 in a piece's folder, in addition to the files of its episodes."""

STATISTICS_V21 = ("min", "max", "mean", "std", "count")
"""Statistics of v2.1, for each episode."""

INDEX = (
    '{"index_columns": ["task"], "column_indexes": [{"name": null, "field_name": null, "pandas_type": "unicode", '
    '"numpy_type": "str", "metadata": {"encoding": "UTF-8"}}], "columns": [{"name": "task_index", "field_name": '
    '"task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null}, {"name": "task", "field_name": '
    '"task", "pandas_type": "object", "numpy_type": "str", "metadata": null}], "attributes": {}, "creator": '
    '{"library": "pyarrow", "version": "26.0.1"}, "pandas_version": "3.1.1"}'
)
"""Metadata by which pandas uses the texts of the tasks as index, fixed here as pandas 3.1.1 writes it."""

Numbers = Mapping[str, NDArray[Any]]
"""Column to its values at each step, (T,) or (T, D)."""


class Video:
    """A file that is written frame by frame; it is complete when the block ends."""

    encoder: ClassVar[str] = ENCODER
    encoder_options: ClassVar[dict[str, str]] = ENCODER_OPTIONS
    pixel_format: ClassVar[str] = str(VIDEO_INFO["video.pix_fmt"])

    def __init__(self, path: Path, content: Content = STANDARD) -> None:
        self.frames = 0
        self._file = av.open(str(path), "w")
        self._stream = self._file.add_stream(self.encoder, SCHEMA.fps_hz, options=self.encoder_options)
        self._stream.height, self._stream.width, _ = content.frame_shape
        self._stream.pix_fmt = self.pixel_format

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        if raised[0] is None:
            self._file.mux(self._stream.encode())
        self._file.close()

    def add(self, pixels: Frame, *, first: bool) -> None:
        """Append a frame (H, W, 3).

        Args:
            pixels: the frame.
            first: True if it is the first frame of an episode.
        """
        self._append(av.VideoFrame.from_ndarray(planes(pixels), format=self.pixel_format), first)

    def _append(self, frame: av.VideoFrame, first: bool) -> None:
        frame.pts, frame.time_base = self.frames, Fraction(1, SCHEMA.fps_hz)
        if first:
            frame.pict_type = PictureType.I
        self._file.mux(self._stream.encode(frame))
        self.frames += 1


class DepthVideo(Video):
    """Depth maps in lerobot's codes, stored without loss."""

    encoder = depth.ENCODER
    encoder_options = depth.ENCODER_OPTIONS
    pixel_format = depth.PIXEL_FORMAT

    def add_map(self, values: NDArray[np.uint16], *, first: bool) -> None:
        """Append a depth map (H, W) in the schema's unit.

        Args:
            values: the map.
            first: True if it is the first map of an episode.
        """
        self._append(av.VideoFrame.from_ndarray(depth.codes_of(values), format=self.pixel_format), first)


def planes(pixels: Frame) -> NDArray[np.uint8]:
    """Convert a frame to its planes Y, U and V (3 * H / 2, W).

    The conversion takes a third of the time of FFmpeg's, at equal PSNR.
    """
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2YUV_I420), np.uint8)


# Content of an episode.


def _load_each(piece: Piece, load: Load, layout: Layout) -> Iterator[tuple[int, int, Episode, Numbers]]:
    """Load and check each episode of a piece.

    Yields:
        Number of the episode, number of preceding steps, the episode, and its numeric columns.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    first_step = piece.first_step
    for index, episode_id in enumerate(piece.ids, piece.first_episode):
        episode = load(episode_id)
        check(episode, layout.content)
        if layout.convention.open_is_one:
            episode = replace(
                episode,
                action=open_is_one(episode.action),
                action_absolute=open_is_one(episode.action_absolute),
            )
        yield index, first_step, episode, _numbers(episode, index, first_step, piece, layout)
        first_step += len(episode)


def _data_schema(columns: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """Return the schema of the data files, with the metadata by which ``datasets`` and the hub's viewer find images."""
    stored: dict[str, Any] = {}
    for name, description in columns.items():
        dtype, shape = description["dtype"], description["shape"]
        if dtype == "image":
            stored[name] = datasets.Image()
        elif dtype == "language":
            stored[name] = FEATURES[name]
        elif dtype != "video":
            value = datasets.Value(dtype)
            stored[name] = value if shape == (1,) else datasets.Sequence(value, length=shape[0])
    return datasets.Features(stored).arrow_schema


def _append_frames(episode: Episode, view: str, video: Video | None) -> Counts:
    """Append a view's frames to its video, if any, and return the counts of their levels.

    Raises:
        PipelineError: when a frame cannot be decoded.
    """
    counts = np.zeros((3, 256), np.int64)
    for t, packed in enumerate(episode.frames[view]):
        try:
            pixels = decode(packed)
        except ValueError as error:
            raise PipelineError(f"{view} frame {t}: {error}", where=f"episode {episode.episode_id}") from error
        counts += count(pixels)
        if video is not None:
            video.add(pixels, first=t == 0)
    return counts


def _append_depth(episode: Episode, view: str, video: DepthVideo) -> Counts:
    """Append a view's depth maps to its video, and return the counts of their depths.

    Raises:
        PipelineError: when a map cannot be decoded.
    """
    counts = np.zeros(depth.DEPTHS, np.int64)
    for t, packed in enumerate(episode.geometry[view].maps["depth"]):
        try:
            values = decode_exactly(packed)
        except ValueError as error:
            raise PipelineError(f"{view} depth {t}: {error}", where=f"episode {episode.episode_id}") from error
        counts += np.bincount(values.ravel(), minlength=depth.DEPTHS)
        video.add_map(values, first=t == 0)
    return counts[None]


def _numbers(episode: Episode, index: int, first_step: int, piece: Piece, layout: Layout) -> Numbers:
    steps, task = np.arange(len(episode)), piece.tasks[episode.instruction]
    numbers: dict[str, NDArray[Any]] = {key: getattr(episode, name) for name, key in layout.motion_keys.items()}
    if episode.object_poses is not None:
        numbers[OBJECT_POSES] = episode.object_poses.reshape(len(steps), -1)
    for view, geometry in episode.geometry.items():
        if geometry.boxes is not None:
            numbers[camera_column(view, "boxes")] = geometry.boxes.reshape(len(steps), -1)
    return numbers | {
        "timestamp": (steps / SCHEMA.fps_hz).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full_like(steps, index),
        "index": first_step + steps,
        "task_index": np.full_like(steps, task),
    }


def _step_columns(episode: Episode, numbers: Numbers, layout: Layout) -> dict[str, pa.Array]:
    """Return the columns of an episode's steps, with its images if they are stored as such.

    Args:
        numbers: the columns of numbers, under the names of v3.0.
    """
    texts = {EPISODE_ID: [episode.episode_id] * len(episode)}
    for view, geometry in episode.geometry.items():
        for extra in layout.text_maps:
            texts[camera_column(view, extra)] = [base64.b64encode(file).decode() for file in geometry.maps[extra]]
    images = {}
    if layout.frames == "images":
        image_type = datasets.Image().pa_type
        for view, files in episode.frames.items():
            cells = [{"bytes": packed, "path": None} for packed in files]
            images[ALL_VIEWS[view].lerobot_key] = pa.array(cells, image_type)
    stored = {}
    for name, values in numbers.items():
        if values.ndim == 1:
            stored[name] = pa.array(values)
        else:
            stored[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    if "outcome" in layout.content.extras:
        stored[IS_SUCCESS] = pa.array([episode.provenance["success"]] * len(episode))
    columns = stored | {name: pa.array(values) for name, values in texts.items()} | images
    return {layout.name(name): values for name, values in columns.items()}


def _picture_statistics(counts: Counts, frames: int) -> dict[str, NDArray[Any]]:
    """Compute lerobot's statistics of frames, in [0, 1], or of depth maps, which have one channel, in metres."""
    return of_levels(counts, frames) if len(counts) == 3 else of_levels(counts, frames, depth.UNITS_PER_M)


def _episode_statistics(
    numbers: Numbers, levels: Mapping[str, Counts], layout: Layout
) -> dict[str, dict[str, NDArray[Any]]]:
    """Compute lerobot's statistics of an episode by column: (D,) of numbers, (3, 1, 1) of frames; ``count`` is (1,).

    Args:
        numbers: the columns of numbers, under the names of v3.0.
        levels: counts of levels by the names of ``Layout.pictures``.
    """
    columns = layout.pictures
    of_numbers = {}
    for name, values in numbers.items():
        rows = values.reshape(len(values), -1)
        of_numbers[layout.name(name)] = describe(rows, QUANTILES) | {"count": np.array([len(values)])}
    steps = len(numbers["timestamp"])
    return of_numbers | {columns[name]: _picture_statistics(counts, steps) for name, counts in levels.items()}


def _provenance_schema(content: Content) -> pa.Schema:
    """Return the schema of ``meta/provenance.parquet``, which has a row for each episode, and which lerobot ignores."""
    stored = {"episode_index": pa.int64()}
    stored |= {name: pa.type_for_alias(dtype) for name, dtype in content.provenance.items()}
    stored |= {
        name: pa.list_(pa.float32(), spec.shape[0] * spec.shape[1]) for name, spec in matrix_columns(content).items()
    }
    if content.has_names:
        stored[INSTANCES] = pa.string()
    return pa.schema(stored)


def _provenance_row(episode: Episode, index: int) -> dict[str, Any]:
    """Return an episode's row of ``meta/provenance.parquet``."""
    row: dict[str, Any] = {"episode_index": index, **episode.provenance}
    for view, geometry in episode.geometry.items():
        row |= {camera_column(view, name): getattr(geometry, name).ravel().tolist() for name in MATRICES}
    if episode.instances:
        row[INSTANCES] = json.dumps(list(episode.instances))
    return row


# Files of both versions.


def _write_summary(
    path: Path, summaries: Sequence[tuple[dict[str, Any], Mapping[str, Counts]]], content: Content
) -> None:
    """Write ``PROVENANCE`` and ``LEVELS`` of a piece, from the provenance and the levels of each episode."""
    rows, counts_of_episodes = zip(*summaries, strict=True)
    pq.write_table(pa.Table.from_pylist(list(rows), schema=_provenance_schema(content)), path / PROVENANCE)
    levels = {}
    for name in counts_of_episodes[0]:
        total = sum(counts[name] for counts in counts_of_episodes)
        levels[name] = total.tolist()
    (path / LEVELS).write_text(json.dumps(levels))


def _write_common(work: Path, root: Path, pieces: Sequence[Piece], layout: Layout) -> dict[str, int]:
    """Write provenance and exact statistics of a dataset whose data files exist, and return its numbered tasks."""
    tables = [pq.read_table(work / piece.path / PROVENANCE) for piece in pieces]
    pq.write_table(pa.concat_tables(tables), root / "meta" / PROVENANCE)
    columns = layout.columns
    levels_of_pieces = [json.loads((work / piece.path / LEVELS).read_text()) for piece in pieces]
    figures = {}
    for picture, column in layout.pictures.items():
        total = np.sum([levels[picture] for levels in levels_of_pieces], axis=0)
        steps = pieces[-1].first_step + pieces[-1].steps
        figures[column] = _picture_statistics(total, steps)
    for name, description in columns.items():
        if description["dtype"] in ("float32", "int64"):
            figures[name] = _exact(root, name, description["shape"][0])
    _write_json(root / "meta" / "stats.json", {name: listed(figures[name]) for name in columns if name in figures})
    # The order of the pieces is the order of the numbers, which each text received at its first occurrence.
    return {task: number for piece in pieces for task, number in piece.tasks.items()}


def _totals(version: str, last: Piece, tasks: int, layout: Layout) -> dict[str, Any]:
    """Return the first fields of ``meta/info.json`` of a dataset whose last piece is ``last``."""
    return {
        "codebase_version": version,
        "robot_type": layout.convention.robot_type,
        "total_episodes": last.first_episode + len(last.ids),
        "total_frames": last.first_step + last.steps,
        "total_tasks": tasks,
    }


def _exact(root: Path, column: str, width: int) -> dict[str, NDArray[Any]]:
    """Compute lerobot's statistics of a column over all steps of the dataset, ``ENTRIES`` of its entries at a time."""
    entries: list[dict[str, NDArray[Any]]] = []
    files = sorted((root / "data").rglob("*.parquet"))
    for first in range(0, width, ENTRIES):
        values = np.concatenate([read_matrix(file, column)[:, first : first + ENTRIES] for file in files])
        entries += [describe(entry[:, None], QUANTILES) for entry in values.T]
    figures = {}
    for name in entries[0]:
        figures[name] = np.concatenate([entry[name] for entry in entries])
    return figures | {"count": np.array([len(values)])}


def _write_modality(root: Path, layout: Layout) -> None:
    """Write ``meta/modality.json``, by which GR00T and starVLA find their inputs.

    Both expect 1 for an open gripper and 0 for a closed one, so only datasets with this gripper have the file.

    Entries and names are those of ``examples/simBenchmarks/LIBERO/train_files/modality.json`` in starVLA/starVLA at
    0ed0aad. The agent view has a second entry ``image``, its name in NVIDIA/Isaac-GR00T at 23ace64
    (``gr00t/configs/data/embodiment_configs.py``), whose own file has both fingers as the gripper. Both projects call
    the axis-angle roll, pitch and yaw.
    """

    def entries(column: str, *names: str) -> dict[str, Any]:
        return {name: {"start": k, "end": k + 1, "original_key": column} for k, name in enumerate(names)}

    pose = ("x", "y", "z", "roll", "pitch", "yaw")
    views = layout.views
    videos = {"primary_image": views["image"], **views}
    modality = {
        "state": entries(layout.name(SCHEMA.state.lerobot_key), *pose, "pad", "gripper"),
        "action": entries(layout.name(SCHEMA.action.lerobot_key), *pose, "gripper"),
        "video": {name: {"original_key": column} for name, column in videos.items()},
        "annotation": {"human.action.task_description": {"original_key": "task_index"}},
    }
    _write_json(root / "meta" / "modality.json", modality)


def _write_starvla_statistics(root: Path, layout: Layout) -> None:
    """Write the part of ``meta/stats.json`` that starVLA normalises by, in the form of its cache.

    InternVLA-M1 and DiT4DiT have another form of a file of this name. They reject this one and write theirs over it.
    """
    stats = json.loads((root / "meta" / "stats.json").read_text())
    statistics = {}
    for spec in (SCHEMA.state, SCHEMA.action):
        column = layout.name(spec.lerobot_key)
        statistics[column] = {figure: stats[column][figure] for figure in STARVLA_FIGURES}
    content = {"__format_version": 2, "__cache_config": {"mode": "abs"}, "statistics": statistics}
    _write_json(root / "meta" / STARVLA_STATISTICS, content)


def _link(made: Path, place: Path) -> None:
    """Link a file to a second place; the first place stays, for a call that resumes where this one was killed."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(made, place)
    except OSError:  # a file system without links
        shutil.copyfile(made, place)


def _write_json(file: Path, content: Mapping[str, Any]) -> None:
    """Write a file of ``meta/`` with lerobot's indentation."""
    file.write_text(json.dumps(content, indent=4) + "\n")


# Version 3.0.


def file_path(kind: str, number: int, suffix: str) -> str:
    """Return a file's path below the dataset's root; ``kind`` is ``data``, ``meta/episodes`` or ``videos/<key>``."""
    chunk, file = divmod(number, FILES_OF_A_CHUNK)
    return f"{kind}/{PLACE.format(chunk_index=chunk, file_index=file)}{suffix}"


def write_piece(path: Path, piece: Piece, load: Load, layout: Layout) -> None:
    """Write the files of a piece's episodes into a new folder, with one episode at a time in memory.

    The bytes, including those of videos, depend only on the episodes, their order and the encoder's version.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    rows, summaries = [], []
    with ExitStack() as opened:
        data = opened.enter_context(pq.ParquetWriter(path / DATA, _data_schema(layout.columns)))
        videos, depth_videos = {}, {}
        if layout.frames == "video":
            for view in layout.content.views:
                videos[view] = opened.enter_context(Video(path / f"{view}.mp4", layout.content))
        for view in layout.depth_videos:
            depth_videos[view] = opened.enter_context(DepthVideo(path / f"{view}_depth.mp4", layout.content))
        for index, first_step, episode, numbers in _load_each(piece, load, layout):
            levels = {view: _append_frames(episode, view, videos.get(view)) for view in layout.content.views}
            for view, video in depth_videos.items():
                levels[f"{view}_depth"] = _append_depth(episode, view, video)
            columns = _step_columns(episode, numbers, layout)
            if layout.language:
                columns |= language_columns(episode, layout.content.size_px, train=piece.split == "train")
            # Each episode is a row group of its own, so that it can be read alone.
            table = pa.table({name: columns[name] for name in data.schema.names})
            data.write_table(table.cast(data.schema))
            row = _episode_row(episode, piece, index, first_step, layout.videos.values())
            # lerobot's tools for editing aggregate the statistics of the episodes.
            for name, figures in _episode_statistics(numbers, levels, layout).items():
                row |= {f"stats/{name}/{figure}": value for figure, value in listed(figures).items()}
            rows.append(row)
            summaries.append((_provenance_row(episode, index), levels))
    pq.write_table(_episodes_table(rows), path / EPISODES)
    _write_summary(path, summaries, layout.content)


def _episodes_table(rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Return the rows of ``meta/episodes`` as a table, with the types of all lists of labels.

    An empty list has no type of its own, and lerobot reads all files as one table.
    """
    table = pa.Table.from_pylist(list(rows))
    for name, dtype in SCHEMA.labels.items():
        place = table.schema.get_field_index(name)
        values = pa.array(table[name].to_pylist(), pa.list_(pa.type_for_alias(dtype)))
        table = table.set_column(place, name, values)
    return table


def finish(work: Path, root: Path, pieces: Sequence[Piece], layout: Layout) -> None:
    """Link the files of all pieces to their places below ``root``, and write the files about all episodes."""
    for piece in pieces:
        places = {DATA: ("data", ".parquet"), EPISODES: ("meta/episodes", ".parquet")}
        places |= {f"{name}.mp4": (f"videos/{column}", ".mp4") for name, column in layout.videos.items()}
        for name, (kind, suffix) in places.items():
            made = work / piece.path / name
            if made.exists():
                _link(made, root / file_path(kind, piece.number, suffix))
    tasks = _write_common(work, root, pieces, layout)
    # lerobot finds a task by the table's index.
    numbered = {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.large_string())}
    table = pa.table(numbered).replace_schema_metadata({"pandas": INDEX})
    pq.write_table(table, root / "meta" / "tasks.parquet")
    splits: dict[str, tuple[int, int]] = {}  # Ranges of episodes, in the order of the pieces.
    for piece in pieces:
        first, _ = splits.get(piece.split, (piece.first_episode, 0))
        splits[piece.split] = (first, piece.first_episode + len(piece.ids))
    info = {
        **_totals("v3.0", pieces[-1], len(tasks), layout),
        "chunks_size": FILES_OF_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": FILE_MB,
        "fps": SCHEMA.fps_hz,
        "splits": {name: f"{first}:{end}" for name, (first, end) in splits.items()},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if layout.videos else None,
        "features": layout.described,
    }
    _write_json(root / "meta" / "info.json", info)


def _episode_row(
    episode: Episode, piece: Piece, index: int, first_step: int, video_columns: Iterable[str]
) -> dict[str, Any]:
    """Return an episode's row of ``meta/episodes``, which states its place."""
    chunk, file = divmod(piece.number, FILES_OF_A_CHUNK)
    steps = len(episode)
    row = {
        "episode_index": index,
        "tasks": [episode.instruction],
        "length": steps,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": first_step,
        "dataset_to_index": first_step + steps,
        "meta/episodes/chunk_index": chunk,
        "meta/episodes/file_index": file,
    }
    row |= labels_of(episode)
    before = first_step - piece.first_step
    for key in video_columns:
        row |= {
            f"videos/{key}/chunk_index": chunk,
            f"videos/{key}/file_index": file,
            f"videos/{key}/from_timestamp": before / SCHEMA.fps_hz,
            f"videos/{key}/to_timestamp": (before + steps) / SCHEMA.fps_hz,
        }
    return row


# Version 2.1.


def write_piece_v21(path: Path, piece: Piece, load: Load, layout: Layout) -> None:
    """Write the files of a piece's episodes into a new folder, under the paths of their set.

    The bytes, including those of videos, depend only on the episodes, their order and the encoder's version.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    summaries = []
    with ExitStack() as opened:
        episodes, stats = (opened.enter_context((path / name).open("w")) for name in LINES_V21)
        for index, _, episode, numbers in _load_each(piece, load, layout):
            levels = _write_episode_v21(path, index, episode, numbers, layout)
            figures = {}
            for name, all_figures in _episode_statistics(numbers, levels, layout).items():
                figures[name] = listed({figure: all_figures[figure] for figure in STATISTICS_V21})
            row = {"episode_index": index, "tasks": [episode.instruction], "length": len(episode)}
            row |= {"episode_id": episode.episode_id, **labels_of(episode)}
            episodes.write(json.dumps(row) + "\n")
            stats.write(json.dumps({"episode_index": index, "stats": figures}) + "\n")
            summaries.append((_provenance_row(episode, index), levels))
    _write_summary(path, summaries, layout.content)


def _write_episode_v21(
    path: Path,
    index: int,
    episode: Episode,
    numbers: Numbers,
    layout: Layout,
) -> dict[str, Counts]:
    """Write the files of one episode and return the counts of levels of its views."""
    levels = {}
    for view, column in layout.views.items():
        if layout.frames == "video":
            file = path / video_path_v21(index, column)
            file.parent.mkdir(parents=True, exist_ok=True)
            with Video(file, layout.content) as video:
                levels[view] = _append_frames(episode, view, video)
        else:
            levels[view] = _append_frames(episode, view, None)
    columns = _step_columns(episode, numbers, layout)
    schema = _data_schema_v21(layout)
    file = path / data_path_v21(index)
    file.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({name: columns[name] for name in schema.names})
    pq.write_table(table.cast(schema), file)
    return levels


def _data_schema_v21(layout: Layout) -> pa.Schema:
    schema = _data_schema(layout.columns)
    # datasets 4 names a list differently from the clients' versions 2 and 3, but also reads their name.
    metadata = schema.metadata or {}
    return schema.with_metadata({name: value.replace(b'"List"', b'"Sequence"') for name, value in metadata.items()})


def finish_v21(work: Path, root: Path, pieces: Sequence[Piece], layout: Layout) -> None:
    """Link the files of a set's pieces to their places below ``root``, and write the files about all episodes."""
    (root / "meta").mkdir(parents=True)
    for piece in pieces:
        for made in sorted((work / piece.path).glob("*/**/episode_*")):
            _link(made, root / made.relative_to(work / piece.path))
    for name in LINES_V21:
        texts = [(work / piece.path / name).read_text() for piece in pieces]
        (root / "meta" / name).write_text("".join(texts))
    tasks = _write_common(work, root, pieces, layout)
    rows = [{"task_index": number, "task": task} for task, number in tasks.items()]
    (root / "meta" / "tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if layout.convention.open_is_one:
        _write_modality(root, layout)
        _write_starvla_statistics(root, layout)
    totals = _totals("v2.1", pieces[-1], len(tasks), layout)
    episodes, videos = totals["total_episodes"], layout.frames == "video"
    info = {
        **totals,
        "total_videos": episodes * len(layout.content.views) if videos else 0,
        "total_chunks": -(-episodes // FILES_OF_A_CHUNK),
        "chunks_size": FILES_OF_A_CHUNK,
        "fps": SCHEMA.fps_hz,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH_V21,
        "video_path": VIDEO_PATH_V21 if videos else None,
        "features": layout.described,
    }
    _write_json(root / "meta" / "info.json", info)
