"""Content of LeRobot's files about an episode and about all episodes of a dataset, common to both versions."""

import base64
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.episode_schema import MATRICES, MOTION, SCHEMA, check, named, provenance_of
from pipeline.errors import PipelineError
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import QUANTILES, Counts, count, describe, listed, of_levels, open_is_one
from pipeline.formats.lerobot_columns import (
    EPISODE_ID,
    INSTANCES,
    LANGUAGE,
    OBJECT_POSES,
    Convention,
    Frames,
    camera_column,
    matrix_columns,
)
from pipeline.formats.lerobot_video import INFO, Video
from pipeline.images.jpeg import decode
from pipeline.types import Episode, Extra

PROVENANCE, LEVELS = "provenance.parquet", "levels.json"
"""Files in a piece's folder, in addition to the files of its version: a row for each episode, and counts of levels."""

ENTRIES = 16
"""Number of a column's entries that are in memory at a time: 300 MB for 28,000 episodes."""

Numbers = Mapping[str, NDArray[Any]]
"""Column to its values at each step, (T,) or (T, D)."""


_TEXT = datasets.Value("string")
_LANGUAGE = datasets.List(
    {
        "role": _TEXT,
        "content": _TEXT,
        "style": _TEXT,
        "timestamp": datasets.Value("float32"),
        "camera": _TEXT,
        "tool_calls": datasets.List(datasets.Json()),
    }
)
"""``language_persistent_column_feature`` in ``datasets/language.py`` of lerobot 0.6.1; older versions lack it."""


def each(
    piece: Piece, load: Load, convention: Convention, extras: Sequence[Extra]
) -> Iterator[tuple[int, int, Episode, Numbers]]:
    """Load and check each episode of a piece.

    Yields:
        Number of the episode, number of preceding steps, the episode, and its numeric columns.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    first_step = piece.first_step
    for index, episode_id in enumerate(piece.ids, piece.first_episode):
        episode = load(episode_id)
        check(episode, extras)
        if convention.open_is_one:
            episode = replace(episode, action=open_is_one(episode.action))
        yield index, first_step, episode, _numbers(episode, index, first_step, piece.tasks[episode.instruction])
        first_step += len(episode)


def summarise(path: Path, made: Sequence[tuple[dict[str, Any], Mapping[str, Counts]]], extras: Sequence[Extra]) -> None:
    """Write ``PROVENANCE`` and ``LEVELS`` of a piece, from the ``provenance`` and the levels of each episode."""
    rows, counts_of_episodes = zip(*made, strict=True)
    pq.write_table(pa.Table.from_pylist(list(rows), schema=_provenance_schema(extras)), path / PROVENANCE)
    levels = {}
    for view in SCHEMA.views:
        total = sum(counts[view] for counts in counts_of_episodes)
        levels[view] = total.tolist()
    (path / LEVELS).write_text(json.dumps(levels))


def finish(
    work: Path, root: Path, pieces: Sequence[Piece], convention: Convention, extras: Sequence[Extra]
) -> dict[str, int]:
    """Write provenance and exact statistics of a dataset whose data files exist, and return its numbered tasks."""
    tables = [pq.read_table(work / piece.path / PROVENANCE) for piece in pieces]
    pq.write_table(pa.concat_tables(tables), root / "meta" / PROVENANCE)
    columns = convention.columns(extras)
    levels_of_pieces = [json.loads((work / piece.path / LEVELS).read_text()) for piece in pieces]
    figures = {}
    for view, spec in SCHEMA.views.items():
        total = np.sum([levels[view] for levels in levels_of_pieces], axis=0)
        figures[convention.name(spec.lerobot_key)] = of_levels(total)
    for name, description in columns.items():
        if description["dtype"] in ("float32", "int64"):
            figures[name] = _exact(root, name, description["shape"][0])
    write_json(root / "meta" / "stats.json", {name: listed(figures[name]) for name in columns if name in figures})
    # The order of the pieces is the order of the numbers, which each text received at its first occurrence.
    return {task: number for piece in pieces for task, number in piece.tasks.items()}


def totals(version: str, last: Piece, tasks: int, convention: Convention) -> dict[str, Any]:
    """Return the first fields of ``meta/info.json`` of a dataset whose last piece is ``last``."""
    return {
        "codebase_version": version,
        "robot_type": convention.robot_type,
        "total_episodes": last.first_episode + len(last.ids),
        "total_frames": last.first_step + last.steps,
        "total_tasks": tasks,
    }


def described(convention: Convention, extras: Sequence[Extra]) -> dict[str, Any]:
    """Describe the columns as ``meta/info.json`` does, videos with the properties of their encoding."""
    columns = {}
    for name, description in convention.columns(extras).items():
        encoding = {"info": INFO} if description["dtype"] == "video" else {}
        columns[name] = {**description, **encoding}
    return columns


def schema(columns: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """Return the schema of the data files, with the metadata by which ``datasets`` and the hub's viewer find images."""
    stored: dict[str, Any] = {}
    for name, description in columns.items():
        dtype, shape = description["dtype"], description["shape"]
        if dtype == "image":
            stored[name] = datasets.Image()
        elif dtype == "language":
            stored[name] = _LANGUAGE
        elif dtype != "video":
            value = datasets.Value(dtype)
            stored[name] = value if shape == (1,) else datasets.Sequence(value, length=shape[0])
    return datasets.Features(stored).arrow_schema


def show(episode: Episode, view: str, video: Video | None) -> Counts:
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


def _numbers(episode: Episode, index: int, first_step: int, task: int) -> Numbers:
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


def columns(episode: Episode, found: Numbers, frames: Frames) -> dict[str, pa.Array]:
    """Return the columns of an episode's steps, with its images if ``frames`` is ``images``."""
    texts = {EPISODE_ID: [episode.episode_id] * len(episode)}
    for view, geometry in episode.geometry.items():
        for extra, files in geometry.maps.items():
            texts[camera_column(view, extra)] = [base64.b64encode(file).decode() for file in files]
    images = {}
    if frames == "images":
        image_type = datasets.Image().pa_type
        for view, spec in SCHEMA.views.items():
            cells = [{"bytes": packed, "path": None} for packed in episode.frames[view]]
            images[spec.lerobot_key] = pa.array(cells, image_type)
    stored = {}
    for name, values in found.items():
        if values.ndim == 1:
            stored[name] = pa.array(values)
        else:
            stored[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    return stored | {name: pa.array(values) for name, values in texts.items()} | images


def language(episode: Episode, train: bool) -> dict[str, pa.Array]:
    """Return the language column of an episode, identical in each of its frames, as in lerobot's own annotations.

    ``active_at`` of lerobot's ``language_render.py`` finds the subtask by its time. ``task_aug`` is for training alone;
    its first entry is the episode's own instruction.
    """
    annotations = []
    if train and episode.rewrites:
        wordings = dict.fromkeys([episode.instruction, *episode.rewrites])
        annotations += [("user", "task_aug", 0, text) for text in wordings]
    annotations += [("assistant", "subtask", step, text) for step, text in episode.subtasks]
    rows = []
    for role, style, step, text in annotations:
        rows.append({"role": role, "content": text, "style": style, "timestamp": np.float32(step / SCHEMA.fps_hz)})
    # pyarrow creates no JSON from Python objects; casting the table to the schema creates it from text.
    kinds = {name: pa.string() for name in ("role", "content", "style", "camera")}
    kinds |= {"timestamp": pa.float32(), "tool_calls": pa.list_(pa.string())}
    once = pa.array([rows], pa.list_(pa.struct([(name, kinds[name]) for name in _LANGUAGE.feature])))
    return {LANGUAGE: pa.concat_arrays([once] * len(episode))}


def figures(found: Numbers, shown: Mapping[str, Counts]) -> dict[str, dict[str, NDArray[Any]]]:
    """Compute lerobot's statistics of an episode by column: (D,) of numbers, (3, 1, 1) of frames; ``count`` is (1,)."""
    of_numbers = {}
    for name, values in found.items():
        rows = values.reshape(len(values), -1)
        of_numbers[name] = describe(rows, QUANTILES) | {"count": np.array([len(values)])}
    return of_numbers | {SCHEMA.views[view].lerobot_key: of_levels(counts) for view, counts in shown.items()}


def _provenance_schema(extras: Sequence[Extra]) -> pa.Schema:
    """Return the schema of ``meta/provenance.parquet``, which has a row for each episode, and which lerobot ignores."""
    stored = {"episode_index": pa.int64()}
    stored |= {name: pa.type_for_alias(dtype) for name, dtype in provenance_of(extras).items()}
    stored |= {name: pa.list_(pa.float32(), spec.shape[0] * spec.shape[1]) for name, spec in matrix_columns().items()}
    if named(extras):
        stored[INSTANCES] = pa.string()
    return pa.schema(stored)


def provenance(episode: Episode, index: int) -> dict[str, Any]:
    """Return an episode's row of ``meta/provenance.parquet``."""
    row: dict[str, Any] = {"episode_index": index, **episode.provenance}
    for view, geometry in episode.geometry.items():
        row |= {camera_column(view, name): getattr(geometry, name).ravel().tolist() for name in MATRICES}
    if episode.instances:
        row[INSTANCES] = json.dumps(list(episode.instances))
    return row


def _exact(root: Path, column: str, width: int) -> dict[str, NDArray[Any]]:
    """Compute lerobot's statistics of a column over all steps of the dataset, ``ENTRIES`` of its entries at a time."""
    entries: list[dict[str, NDArray[Any]]] = []
    files = sorted((root / "data").rglob("*.parquet"))
    for first in range(0, width, ENTRIES):
        values = np.concatenate([_entries(file, column)[:, first : first + ENTRIES] for file in files])
        entries += [describe(entry[:, None], QUANTILES) for entry in values.T]
    figures = {}
    for name in entries[0]:
        figures[name] = np.concatenate([entry[name] for entry in entries])
    return figures | {"count": np.array([len(values)])}


def _entries(file: Path, column: str) -> NDArray[Any]:
    """Read the values (N, D) of a file's column."""
    values = pq.ParquetFile(file).read([column], use_threads=False)[column].combine_chunks()
    flat = values.flatten() if pa.types.is_fixed_size_list(values.type) else values
    return np.asarray(flat.to_numpy(zero_copy_only=False).reshape(len(values), -1))


def write_modality(root: Path, convention: Convention) -> None:
    """Write ``meta/modality.json``, by which GR00T and starVLA find their inputs.

    Entries and names are those of ``examples/simBenchmarks/LIBERO/train_files/modality.json`` in starVLA/starVLA at
    0ed0aad. The agent view has a second entry ``image``, its name in NVIDIA/Isaac-GR00T at 23ace64
    (``gr00t/configs/data/embodiment_configs.py``), whose own file has both fingers as the gripper. Both projects call
    the axis-angle roll, pitch and yaw.
    """

    def entries(column: str, *names: str) -> dict[str, Any]:
        return {name: {"start": k, "end": k + 1, "original_key": column} for k, name in enumerate(names)}

    pose = ("x", "y", "z", "roll", "pitch", "yaw")
    views = {view: convention.name(spec.lerobot_key) for view, spec in SCHEMA.views.items()}
    videos = {"primary_image": views["image"], **views}
    content = {
        "state": entries(convention.name(SCHEMA.state.lerobot_key), *pose, "pad", "gripper"),
        "action": entries(convention.name(SCHEMA.action.lerobot_key), *pose, "gripper"),
        "video": {name: {"original_key": column} for name, column in videos.items()},
        "annotation": {"human.action.task_description": {"original_key": "task_index"}},
    }
    write_json(root / "meta" / "modality.json", content)


def link(made: Path, place: Path) -> None:
    """Link a file to a second place; the first place stays, for a call that resumes where this one was killed."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(made, place)
    except OSError:  # a file system without links
        shutil.copyfile(made, place)


def write_json(file: Path, content: Mapping[str, Any]) -> None:
    """Write a file of ``meta/`` with lerobot's indentation."""
    file.write_text(json.dumps(content, indent=4) + "\n")
