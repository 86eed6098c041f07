"""Files and columns that writers of LeRobot v3.0 and v2.1 share.

The bytes depend only on the episodes, their order and the packages.
"""

import base64
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.episode_check import check
from pipeline.episode_schema import ALL_VIEWS, MATRICES, SCHEMA, Content
from pipeline.errors import PipelineError
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import QUANTILES, Counts, count, describe, listed, of_levels, open_is_one
from pipeline.formats.lerobot import depth
from pipeline.formats.lerobot.columns import (
    ENTRIES,
    EPISODE_ID,
    INSTANCES,
    IS_SUCCESS,
    OBJECT_POSES,
    Layout,
    camera_column,
    matrix_columns,
    read_matrix,
)
from pipeline.formats.lerobot.language import FEATURES
from pipeline.formats.lerobot.video import DepthVideo, Video
from pipeline.images.jpeg import decode, decode_exactly
from pipeline.types import Episode

PROVENANCE, LEVELS = "provenance.parquet", "levels.json"
"""Files in a piece's folder: a row for each episode, and counts of levels."""

Numbers = Mapping[str, NDArray[Any]]
"""Column to its values at each step, (T,) or (T, D)."""


class NumberedEpisode(NamedTuple):
    """An episode with its place in the dataset.

    Attributes:
        episode_index: number of the episode in the dataset.
        first_step: number of preceding steps of the dataset.
        episode: the episode, with LIBERO's gripper.
        numbers: its columns of numbers, under the names of v3.0 and with the gripper of the convention.
    """

    episode_index: int
    first_step: int
    episode: Episode
    numbers: Numbers


def load_each(piece: Piece, load: Load, layout: Layout) -> Iterator[NumberedEpisode]:
    """Load and check each episode of a piece.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    first_step = piece.first_step
    for index, episode_id in enumerate(piece.ids, piece.first_episode):
        episode = load(episode_id)
        check(episode, layout.content)
        numbers = _numbers(episode, index, first_step, piece, layout)
        yield NumberedEpisode(index, first_step, episode, numbers)
        first_step += len(episode)


def data_schema(columns: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
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


def append_frames(episode: Episode, view: str, video: Video | None) -> Counts:
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


def append_depth(episode: Episode, view: str, video: DepthVideo) -> Counts:
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
    numbers: dict[str, NDArray[Any]] = {}
    for name, key in layout.motion_keys.items():
        values = getattr(episode, name)
        has_gripper = name in ("action", "action_absolute")
        numbers[key] = open_is_one(values) if has_gripper and layout.convention.open_is_one else values
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


def step_columns(numbered: NumberedEpisode, layout: Layout) -> dict[str, pa.Array]:
    """Return the columns of an episode's steps, with its images if they are stored as such."""
    episode = numbered.episode
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
    for name, values in numbered.numbers.items():
        if values.ndim == 1:
            stored[name] = pa.array(values)
        else:
            stored[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    if layout.content.is_of_failures:
        stored[IS_SUCCESS] = pa.array([episode.provenance["success"]] * len(episode))
    columns = stored | {name: pa.array(values) for name, values in texts.items()} | images
    return {layout.name(name): values for name, values in columns.items()}


def _picture_statistics(counts: Counts, frames: int) -> dict[str, NDArray[Any]]:
    """Compute lerobot's statistics of frames, in [0, 1], or of depth maps, which have one channel, in metres."""
    return of_levels(counts, frames) if len(counts) == 3 else of_levels(counts, frames, depth.UNITS_PER_M)


def episode_statistics(
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


def provenance_row(numbered: NumberedEpisode) -> dict[str, Any]:
    """Return an episode's row of ``meta/provenance.parquet``."""
    episode = numbered.episode
    row: dict[str, Any] = {"episode_index": numbered.episode_index, **episode.provenance}
    for view, geometry in episode.geometry.items():
        row |= {camera_column(view, name): getattr(geometry, name).ravel().tolist() for name in MATRICES}
    if episode.instances:
        row[INSTANCES] = json.dumps(list(episode.instances))
    return row


def write_summary(
    path: Path,
    provenance: Sequence[dict[str, Any]],
    levels_of_episodes: Sequence[Mapping[str, Counts]],
    content: Content,
) -> None:
    """Write ``PROVENANCE`` and ``LEVELS`` of a piece.

    Args:
        path: folder of the piece.
        provenance: row of each episode.
        levels_of_episodes: counts of levels of each episode, by the names of ``Layout.pictures``.
        content: content of the episodes.
    """
    table = pa.Table.from_pylist(list(provenance), schema=_provenance_schema(content))
    pq.write_table(table, path / PROVENANCE)
    total_levels = {}
    for name in levels_of_episodes[0]:
        total = np.sum([levels[name] for levels in levels_of_episodes], axis=0)
        total_levels[name] = total.tolist()
    (path / LEVELS).write_text(json.dumps(total_levels))


def write_common(work: Path, root: Path, pieces: Sequence[Piece], layout: Layout) -> dict[str, int]:
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
    write_json(root / "meta" / "stats.json", {name: listed(figures[name]) for name in columns if name in figures})
    # The order of the pieces is the order of the numbers, which each text received at its first occurrence.
    return {task: number for piece in pieces for task, number in piece.tasks.items()}


def totals(version: str, last: Piece, tasks: int, layout: Layout) -> dict[str, Any]:
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


def link(source: Path, target: Path) -> None:
    """Link a file to a second place; the first place stays, for a call that resumes where this one was killed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)


def write_json(file: Path, content: Mapping[str, Any]) -> None:
    """Write a file of ``meta/`` with lerobot's indentation."""
    file.write_text(json.dumps(content, indent=4) + "\n")
