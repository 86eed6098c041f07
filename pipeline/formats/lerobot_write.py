"""LeRobot v3.0 as its files are published, without lerobot, which only reads and checks them here.

A worker writes the files of some episodes in a row: one of data, one of each video, one of ``meta/episodes``. They are
final, as the number of steps before them is known. Files of the same number hold the same episodes. What is about all
episodes comes at the end: tasks, splits, exact statistics, and ``meta/provenance.parquet`` with a row for each episode,
which lerobot passes by.

lerobot's own writer appends by writing whole files again, and its statistics are averages of per-episode quantiles
(huggingface/lerobot#3804) from a sample of the frames.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.episode_schema import MATRICES, MOTION, SCHEMA, check, named
from pipeline.errors import PipelineError
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.image_statistics import QUANTILES, Counts, count, statistics
from pipeline.formats.lerobot_columns import (
    EPISODE_ID,
    FILE_MB,
    INSTANCES,
    OBJECT_POSES,
    Frames,
    camera_column,
    features,
    matrix_columns,
)
from pipeline.formats.lerobot_video import INFO, Video
from pipeline.formats.motion_statistics import describe
from pipeline.images.jpeg import decode
from pipeline.types import Episode, Extra

FILES_OF_A_CHUNK, PLACE = 1000, "chunk-{chunk_index:03d}/file-{file_index:03d}"

DATA, EPISODES, PROVENANCE, LEVELS = "data.parquet", "episodes.parquet", "provenance.parquet", "levels.json"
"""In a piece's folder, beside ``<view>.mp4``."""

INDEX = (
    '{"index_columns": ["task"], "column_indexes": [{"name": null, "field_name": null, "pandas_type": "unicode", '
    '"numpy_type": "str", "metadata": {"encoding": "UTF-8"}}], "columns": [{"name": "task_index", "field_name": '
    '"task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null}, {"name": "task", "field_name": '
    '"task", "pandas_type": "object", "numpy_type": "str", "metadata": null}], "attributes": {}, "creator": '
    '{"library": "pyarrow", "version": "26.0.1"}, "pandas_version": "3.1.1"}'
)
"""Has pandas take the texts of the tasks as index, as pandas 3.1.1 says it; what it says depends on its version."""

ENTRIES = 16
"""Of a column so many entries are in memory at a time: 300 MB for 28,000 episodes."""


def file_path(kind: str, number: int, suffix: str) -> str:
    """Path of a dataset's file below its root; ``kind`` is ``data``, ``meta/episodes`` or ``videos/<key>``."""
    chunk, file = divmod(number, FILES_OF_A_CHUNK)
    return f"{kind}/{PLACE.format(chunk_index=chunk, file_index=file)}{suffix}"


def write_piece(path: Path, piece: Piece, load: Load, frames: Frames, extras: tuple[Extra, ...]) -> None:
    """Write the files of some episodes into a new folder; one episode at a time is in memory.

    The bytes, videos included, depend on the episodes, their order and the encoder's version alone.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    levels: dict[str, Counts] = {view: np.zeros((3, 256), np.int64) for view in SCHEMA.views}
    rows, provenance = [], []
    first_step = piece.first_step
    with ExitStack() as opened:
        data = opened.enter_context(pq.ParquetWriter(path / DATA, _schema(features(frames, extras))))
        videos = {view: opened.enter_context(Video(path / f"{view}.mp4")) for view in SCHEMA.views if frames == "video"}
        for index, episode_id in enumerate(piece.ids, piece.first_episode):
            episode = load(episode_id)
            check(episode, extras)
            shown = {view: _show(episode, view, videos.get(view)) for view in SCHEMA.views}
            numbers = _numbers(episode, index, first_step, piece.tasks[episode.instruction])
            columns = {name: pa.array(list(values)) for name, values in numbers.items()} | _texts(episode)
            if not videos:
                columns |= _images(episode)
            # A row group for each episode, so that one is read without the others.
            data.write_table(pa.table({name: columns[name] for name in data.schema.names}).cast(data.schema))
            rows.append(_row(episode, piece, index, first_step, frames) | _described(numbers, shown))
            provenance.append(_provenance(episode, index))
            levels = {view: counts + shown[view] for view, counts in levels.items()}
            first_step += len(episode)
    pq.write_table(pa.Table.from_pylist(rows), path / EPISODES)
    pq.write_table(pa.Table.from_pylist(provenance, schema=_provenance_schema(extras)), path / PROVENANCE)
    (path / LEVELS).write_text(json.dumps({view: counts.tolist() for view, counts in levels.items()}))


def finish(work: Path, root: Path, pieces: Sequence[Piece], frames: Frames, extras: tuple[Extra, ...]) -> None:
    """Put the files of all pieces in their places below ``root``, and write what is about all of them."""
    for piece in pieces:
        places = {DATA: ("data", ".parquet"), EPISODES: ("meta/episodes", ".parquet")}
        places |= {f"{view}.mp4": (f"videos/{of.lerobot_key}", ".mp4") for view, of in SCHEMA.views.items()}
        for name, (kind, suffix) in places.items():
            if (made := work / piece.path / name).exists():
                _link(made, root / file_path(kind, piece.number, suffix))
    tables = [pq.read_table(work / piece.path / PROVENANCE) for piece in pieces]
    pq.write_table(pa.concat_tables(tables), root / "meta" / PROVENANCE)
    # In order, as numbers were given when a text first came. lerobot finds a task by the table's index.
    tasks = {task: number for piece in pieces for task, number in piece.tasks.items()}
    numbered = {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.large_string())}
    pq.write_table(pa.table(numbered).replace_schema_metadata({"pandas": INDEX}), root / "meta" / "tasks.parquet")
    columns = features(frames, extras)
    levels = [json.loads((work / piece.path / LEVELS).read_text()) for piece in pieces]
    counts = {view: np.sum([of_piece[view] for of_piece in levels], axis=0) for view in SCHEMA.views}
    figures = {of.lerobot_key: statistics(counts[view]) for view, of in SCHEMA.views.items()}
    figures |= {name: _exact(root, name, of["shape"][0]) for name, of in columns.items() if _is_number(of)}
    _write_json(root / "meta" / "stats.json", {name: _listed(figures[name]) for name in columns if name in figures})
    _write_json(root / "meta" / "info.json", _info(pieces, columns, len(tasks), frames))


def _link(made: Path, place: Path) -> None:
    """Have a file in a second place too: the first stays, for a call that goes on where this one is killed."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(made, place)
    except OSError:  # a file system without links
        shutil.copyfile(made, place)


def _is_number(column: Mapping[str, Any]) -> bool:
    return column["dtype"] in ("float32", "int64")


def _schema(columns: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """Of the data files, with what ``datasets`` and the hub's viewer know images by."""
    stored: dict[str, Any] = {}
    for name, of in columns.items():
        if of["dtype"] == "image":
            stored[name] = datasets.Image()
        elif of["dtype"] != "video":
            value = datasets.Value(of["dtype"])
            stored[name] = value if of["shape"] == (1,) else datasets.Sequence(value, length=of["shape"][0])
    return datasets.Features(stored).arrow_schema


def _show(episode: Episode, view: str, video: Video | None) -> Counts:
    """Append a view's frames to its video, and return their levels."""
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


def _numbers(episode: Episode, index: int, first_step: int, task: int) -> dict[str, NDArray[Any]]:
    """Column to what it has at each step, (T,) or (T, D)."""
    steps = np.arange(len(episode))
    numbers: dict[str, NDArray[Any]] = {getattr(SCHEMA, name).lerobot_key: getattr(episode, name) for name in MOTION}
    if episode.object_poses is not None:
        numbers[OBJECT_POSES] = episode.object_poses.reshape(len(steps), -1)
    return numbers | {
        "timestamp": (steps / SCHEMA.fps_hz).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full_like(steps, index),
        "index": first_step + steps,
        "task_index": np.full_like(steps, task),
    }


def _texts(episode: Episode) -> dict[str, pa.Array]:
    texts = {EPISODE_ID: [episode.episode_id] * len(episode)}
    for view, seen in episode.geometry.items():
        for name, files in seen.maps.items():
            texts[camera_column(view, name)] = [base64.b64encode(file).decode() for file in files]
    return {name: pa.array(values) for name, values in texts.items()}


def _images(episode: Episode) -> dict[str, pa.Array]:
    kind = datasets.Image().pa_type
    return {
        view.lerobot_key: pa.array([{"bytes": packed, "path": None} for packed in episode.frames[name]], kind)
        for name, view in SCHEMA.views.items()
    }


def _row(episode: Episode, piece: Piece, index: int, first_step: int, frames: Frames) -> dict[str, Any]:
    """Of ``meta/episodes``: where an episode lies."""
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
    before = first_step - piece.first_step
    for view in SCHEMA.views.values() if frames == "video" else ():
        row |= {
            f"videos/{view.lerobot_key}/chunk_index": chunk,
            f"videos/{view.lerobot_key}/file_index": file,
            f"videos/{view.lerobot_key}/from_timestamp": before / SCHEMA.fps_hz,
            f"videos/{view.lerobot_key}/to_timestamp": (before + steps) / SCHEMA.fps_hz,
        }
    return row


def _described(numbers: Mapping[str, NDArray[Any]], shown: Mapping[str, Counts]) -> dict[str, Any]:
    """Of ``meta/episodes``: an episode's statistics, which lerobot's tools for editing put together again."""
    figures = {name: _statistics(values.reshape(len(values), -1)) for name, values in numbers.items()}
    figures |= {SCHEMA.views[view].lerobot_key: statistics(counts) for view, counts in shown.items()}
    return {f"stats/{name}/{of}": values for name, found in figures.items() for of, values in _listed(found).items()}


def _statistics(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of (N, D) numbers, each (D,); ``count`` is (1,)."""
    return describe(values, QUANTILES) | {"count": np.array([len(values)])}


def _exact(root: Path, column: str, width: int) -> dict[str, NDArray[Any]]:
    """lerobot's statistics of a column over all steps of the dataset, ``ENTRIES`` of its entries at a time."""
    found = []
    for first in range(0, width, ENTRIES):
        values = np.concatenate([_entries(file, column)[:, first : first + ENTRIES] for file in _data_files(root)])
        found.append([describe(entry[:, None], QUANTILES) for entry in values.T])
    entries = [entry for block in found for entry in block]
    together = {name: np.concatenate([entry[name] for entry in entries]) for name in entries[0]}
    return together | {"count": np.array([len(values)])}


def _data_files(root: Path) -> list[Path]:
    return sorted((root / "data").rglob("*.parquet"))


def _entries(file: Path, column: str) -> NDArray[Any]:
    """(N, D) of a file's column."""
    values = pq.read_table(file, columns=[column])[column].combine_chunks()
    flat = values.flatten() if pa.types.is_fixed_size_list(values.type) else values
    return np.asarray(flat.to_numpy(zero_copy_only=False).reshape(len(values), -1))


def _listed(figures: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    return {name: values.tolist() for name, values in figures.items()}


def _provenance_schema(extras: Sequence[Extra]) -> pa.Schema:
    columns = {"episode_index": pa.int64()}
    columns |= {name: pa.type_for_alias(dtype) for name, dtype in SCHEMA.provenance.items()}
    columns |= {name: pa.list_(pa.float32(), spec.shape[0] * spec.shape[1]) for name, spec in matrix_columns().items()}
    return pa.schema(columns | ({INSTANCES: pa.string()} if named(extras) else {}))


def _provenance(episode: Episode, index: int) -> dict[str, Any]:
    row: dict[str, Any] = {"episode_index": index, **episode.provenance}
    for view, seen in episode.geometry.items():
        row |= {camera_column(view, name): getattr(seen, name).ravel().tolist() for name in MATRICES}
    return row | ({INSTANCES: json.dumps(list(episode.instances))} if episode.instances else {})


def _info(
    pieces: Sequence[Piece], columns: Mapping[str, Mapping[str, Any]], tasks: int, frames: Frames
) -> dict[str, Any]:
    """``meta/info.json``; a split is a range of episodes, in the order of the pieces."""
    splits: dict[str, tuple[int, int]] = {}
    for piece in pieces:
        first, _ = splits.get(piece.split, (piece.first_episode, 0))
        splits[piece.split] = (first, piece.first_episode + len(piece.ids))
    last = pieces[-1]
    return {
        "codebase_version": "v3.0",
        "robot_type": SCHEMA.robot_type,
        "total_episodes": last.first_episode + len(last.ids),
        "total_frames": last.first_step + last.steps,
        "total_tasks": tasks,
        "chunks_size": FILES_OF_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": FILE_MB,
        "fps": SCHEMA.fps_hz,
        "splits": {name: f"{first}:{end}" for name, (first, end) in splits.items()},
        "data_path": f"data/{PLACE}.parquet",
        "video_path": f"videos/{{video_key}}/{PLACE}.mp4" if frames == "video" else None,
        "features": {
            name: {**of, **({"info": INFO} if of["dtype"] == "video" else {})} for name, of in columns.items()
        },
    }


def _write_json(file: Path, content: Mapping[str, Any]) -> None:
    file.write_text(json.dumps(content, indent=4) + "\n")
