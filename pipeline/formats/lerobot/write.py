"""Writer of LeRobot v3.0 as published, without lerobot, which only reads and checks it here.

A worker writes a piece: consecutive episodes. A piece is one file of data, one of each video, and one of
``meta/episodes``. Files of one number hold the same episodes. They are final, because the number of preceding steps is
known. The files about all episodes come at the end: tasks, splits, exact statistics, and ``meta/provenance.parquet``
with a row for each episode, which lerobot ignores.

lerobot's own writer of v3.0 appends by writing whole files again. Its statistics are averages of per-episode quantiles
(huggingface/lerobot#3804) from a sample of the frames.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA, labels_of
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import Counts, listed
from pipeline.formats.lerobot.columns import (
    DATA_PATH,
    FILE_MB,
    FILES_OF_A_CHUNK,
    PLACE,
    SELECTED_BY,
    VIDEO_PATH,
    Layout,
)
from pipeline.formats.lerobot.language import language_columns
from pipeline.formats.lerobot.video import DepthVideo, Video
from pipeline.formats.lerobot.write_shared import (
    NumberedEpisode,
    append_depth,
    append_frames,
    data_schema,
    episode_statistics,
    link,
    load_each,
    provenance_row,
    step_columns,
    totals,
    write_common,
    write_json,
    write_summary,
)
from pipeline.types import Episode

DATA, EPISODES = "data.parquet", "episodes.parquet"
"""Further files in a piece's folder, in addition to ``<view>.mp4``."""

INDEX = (
    '{"index_columns": ["task"], "column_indexes": [{"name": null, "field_name": null, "pandas_type": "unicode", '
    '"numpy_type": "str", "metadata": {"encoding": "UTF-8"}}], "columns": [{"name": "task_index", "field_name": '
    '"task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null}, {"name": "task", "field_name": '
    '"task", "pandas_type": "object", "numpy_type": "str", "metadata": null}], "attributes": {}, "creator": '
    '{"library": "pyarrow", "version": "26.0.1"}, "pandas_version": "3.1.1"}'
)
"""Metadata by which pandas uses the texts of the tasks as index, fixed here as pandas 3.1.1 writes it."""


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
    rows, provenance, levels_of_episodes = [], [], []
    schema = data_schema(layout.columns)
    with ExitStack() as opened:
        data = opened.enter_context(pq.ParquetWriter(path / DATA, schema))
        videos, depth_videos = {}, {}
        if layout.frames == "video":
            for view in layout.content.views:
                videos[view] = opened.enter_context(Video(path / f"{view}.mp4", layout.content))
        for view in layout.depth_videos:
            depth_videos[view] = opened.enter_context(DepthVideo(path / f"{view}_depth.mp4", layout.content))
        for numbered in load_each(piece, load, layout):
            levels = _append_pictures(numbered.episode, videos, depth_videos, layout)
            # Each episode is a row group of its own, so that it can be read alone.
            data.write_table(_steps_table(numbered, piece, layout, schema))
            rows.append(_episode_row(numbered, piece, levels, layout))
            provenance.append(provenance_row(numbered))
            levels_of_episodes.append(levels)
    pq.write_table(_episodes_table(rows), path / EPISODES)
    write_summary(path, provenance, levels_of_episodes, layout.content)


def _append_pictures(
    episode: Episode, videos: Mapping[str, Video], depth_videos: Mapping[str, DepthVideo], layout: Layout
) -> dict[str, Counts]:
    """Append an episode's frames and depth maps to the videos, by view.

    Returns:
        Counts of levels by the names of ``Layout.pictures``, also of frames that are stored as images.
    """
    levels = {}
    for view in layout.content.views:
        levels[view] = append_frames(episode, view, videos.get(view))
    for view, video in depth_videos.items():
        levels[f"{view}_depth"] = append_depth(episode, view, video)
    return levels


def _steps_table(numbered: NumberedEpisode, piece: Piece, layout: Layout, schema: pa.Schema) -> pa.Table:
    """Return the rows of an episode's steps in the data file."""
    columns = step_columns(numbered, layout)
    if layout.language:
        columns |= language_columns(numbered.episode, layout.content.size_px, train=piece.split == "train")
    return pa.table({name: columns[name] for name in schema.names}).cast(schema)


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
            source = work / piece.path / name
            if source.exists():
                link(source, root / file_path(kind, piece.number, suffix))
    tasks = write_common(work, root, pieces, layout)
    # lerobot finds a task by the table's index.
    numbered = {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.large_string())}
    table = pa.table(numbered).replace_schema_metadata({"pandas": INDEX})
    pq.write_table(table, root / "meta" / "tasks.parquet")
    splits: dict[str, tuple[int, int]] = {}  # Ranges of episodes, in the order of the pieces.
    for piece in pieces:
        first, _ = splits.get(piece.split, (piece.first_episode, 0))
        splits[piece.split] = (first, piece.first_episode + len(piece.ids))
    info = {
        **totals("v3.0", pieces[-1], len(tasks), layout),
        "chunks_size": FILES_OF_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": FILE_MB,
        "fps": SCHEMA.fps_hz,
        "splits": {name: f"{first}:{end}" for name, (first, end) in splits.items()},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if layout.videos else None,
        "features": layout.described,
    }
    write_json(root / "meta" / "info.json", info)


def _episode_row(
    numbered: NumberedEpisode, piece: Piece, levels: Mapping[str, Counts], layout: Layout
) -> dict[str, Any]:
    """Return an episode's row of ``meta/episodes``, which states its place and its statistics.

    Args:
        numbered: the episode.
        piece: its piece.
        levels: counts of levels by the names of ``Layout.pictures``.
        layout: layout of the dataset.
    """
    episode, first_step = numbered.episode, numbered.first_step
    chunk, file = divmod(piece.number, FILES_OF_A_CHUNK)
    steps = len(episode)
    row = {
        "episode_index": numbered.episode_index,
        "tasks": [episode.instruction],
        "length": steps,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": first_step,
        "dataset_to_index": first_step + steps,
        "meta/episodes/chunk_index": chunk,
        "meta/episodes/file_index": file,
    }
    row |= {name: episode.provenance[name] for name in SELECTED_BY}
    row |= labels_of(episode)
    before = first_step - piece.first_step
    for key in layout.videos.values():
        row |= {
            f"videos/{key}/chunk_index": chunk,
            f"videos/{key}/file_index": file,
            f"videos/{key}/from_timestamp": before / SCHEMA.fps_hz,
            f"videos/{key}/to_timestamp": (before + steps) / SCHEMA.fps_hz,
        }
    # lerobot's tools for editing aggregate the statistics of the episodes.
    for name, figures in episode_statistics(numbered.numbers, levels, layout).items():
        row |= {f"stats/{name}/{figure}": value for figure, value in listed(figures).items()}
    return row
