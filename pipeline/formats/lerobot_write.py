"""Writer of LeRobot v3.0 files as published, without lerobot, which only reads and checks them here.

A worker writes the files of consecutive episodes: one of data, one of each video, one of ``meta/episodes``. They are
final, because the number of preceding steps is known. Files of one number hold the same episodes. The files about all
episodes come at the end: tasks, splits, exact statistics, and ``meta/provenance.parquet`` with a row for each episode,
which lerobot ignores.

lerobot's own writer appends by writing whole files again. Its statistics are averages of per-episode quantiles
(huggingface/lerobot#3804) from a sample of the frames.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA
from pipeline.formats import lerobot_episode as of_episode
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import listed
from pipeline.formats.lerobot_columns import FILE_MB, Convention, Frames
from pipeline.formats.lerobot_episode import link, write_json
from pipeline.formats.lerobot_video import Video
from pipeline.types import Episode, Extra

FILES_OF_A_CHUNK, PLACE = 1000, "chunk-{chunk_index:03d}/file-{file_index:03d}"

DATA, EPISODES = "data.parquet", "episodes.parquet"
"""Files in a piece's folder, in addition to ``<view>.mp4``."""

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


def write_piece(path: Path, piece: Piece, load: Load, convention: Convention, extras: tuple[Extra, ...]) -> None:
    """Write the files of a piece's episodes into a new folder, with one episode at a time in memory.

    The bytes, including those of videos, depend only on the episodes, their order and the encoder's version.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    rows, made = [], []
    with ExitStack() as opened:
        data = opened.enter_context(pq.ParquetWriter(path / DATA, of_episode.schema(convention.columns(extras))))
        videos = {}
        if convention.frames == "video":
            for view in SCHEMA.views:
                videos[view] = opened.enter_context(Video(path / f"{view}.mp4"))
        for index, first_step, episode, numbers in of_episode.each(piece, load, convention, extras):
            levels = {view: of_episode.show(episode, view, videos.get(view)) for view in SCHEMA.views}
            columns = of_episode.columns(episode, numbers, convention.frames)
            if convention.language:
                columns |= of_episode.language(episode, piece.split == "train")
            # Each episode is a row group of its own, so that it can be read alone.
            table = pa.table({name: columns[name] for name in data.schema.names})
            data.write_table(table.cast(data.schema))
            row = _row(episode, piece, index, first_step, convention.frames)
            # lerobot's tools for editing aggregate the statistics of the episodes.
            for name, figures in of_episode.figures(numbers, levels).items():
                row |= {f"stats/{name}/{figure}": value for figure, value in listed(figures).items()}
            rows.append(row)
            made.append((of_episode.provenance(episode, index), levels))
    pq.write_table(pa.Table.from_pylist(rows), path / EPISODES)
    of_episode.summarise(path, made, extras)


def finish(work: Path, root: Path, pieces: Sequence[Piece], convention: Convention, extras: tuple[Extra, ...]) -> None:
    """Link the files of all pieces to their places below ``root``, and write the files about all episodes."""
    for piece in pieces:
        places = {DATA: ("data", ".parquet"), EPISODES: ("meta/episodes", ".parquet")}
        places |= {f"{view}.mp4": (f"videos/{spec.lerobot_key}", ".mp4") for view, spec in SCHEMA.views.items()}
        for name, (kind, suffix) in places.items():
            made = work / piece.path / name
            if made.exists():
                link(made, root / file_path(kind, piece.number, suffix))
    tasks = of_episode.finish(work, root, pieces, convention, extras)
    # lerobot finds a task by the table's index.
    numbered = {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.large_string())}
    table = pa.table(numbered).replace_schema_metadata({"pandas": INDEX})
    pq.write_table(table, root / "meta" / "tasks.parquet")
    of_episode.write_modality(root, convention)
    splits: dict[str, tuple[int, int]] = {}  # Ranges of episodes, in the order of the pieces.
    for piece in pieces:
        first, _ = splits.get(piece.split, (piece.first_episode, 0))
        splits[piece.split] = (first, piece.first_episode + len(piece.ids))
    info = {
        **of_episode.totals("v3.0", pieces[-1], len(tasks), convention),
        "chunks_size": FILES_OF_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": FILE_MB,
        "fps": SCHEMA.fps_hz,
        "splits": {name: f"{first}:{end}" for name, (first, end) in splits.items()},
        "data_path": f"data/{PLACE}.parquet",
        "video_path": f"videos/{{video_key}}/{PLACE}.mp4" if convention.frames == "video" else None,
        "features": of_episode.described(convention, extras),
    }
    write_json(root / "meta" / "info.json", info)


def _row(episode: Episode, piece: Piece, index: int, first_step: int, frames: Frames) -> dict[str, Any]:
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
    before = first_step - piece.first_step
    for view in SCHEMA.views.values() if frames == "video" else ():
        row |= {
            f"videos/{view.lerobot_key}/chunk_index": chunk,
            f"videos/{view.lerobot_key}/file_index": file,
            f"videos/{view.lerobot_key}/from_timestamp": before / SCHEMA.fps_hz,
            f"videos/{view.lerobot_key}/to_timestamp": (before + steps) / SCHEMA.fps_hz,
        }
    return row
