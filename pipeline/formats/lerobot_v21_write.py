"""Writer of LeRobot v2.1 files as published, without lerobot, which no longer writes this version.

Every episode is one data file and one file per video; a worker writes them in their final form. ``meta/stats.json`` is
no part of v2.1, but ``gr00t/data/dataset/lerobot_episode_loader.py`` of NVIDIA/Isaac-GR00T at 23ace64 requires it.
"""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA
from pipeline.formats import lerobot_episode as of_episode
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import Counts, listed
from pipeline.formats.lerobot_columns import Convention
from pipeline.formats.lerobot_episode import link, write_json
from pipeline.formats.lerobot_video import Video
from pipeline.types import Episode, Extra

EPISODES_OF_A_CHUNK = 1000
DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"

LINES = ("episodes.jsonl", "episodes_stats.jsonl")
"""Files in a piece's folder, in addition to the files of its episodes."""

STATISTICS = ("min", "max", "mean", "std", "count")
"""Statistics of v2.1, for each episode."""


def data_path(index: int) -> str:
    """Return the path of an episode's data below its set's root."""
    return DATA_PATH.format(episode_chunk=index // EPISODES_OF_A_CHUNK, episode_index=index)


def video_path(index: int, key: str) -> str:
    """Return the path of an episode's video below its set's root."""
    return VIDEO_PATH.format(episode_chunk=index // EPISODES_OF_A_CHUNK, episode_index=index, video_key=key)


def write_piece(path: Path, piece: Piece, load: Load, convention: Convention, extras: tuple[Extra, ...]) -> None:
    """Write the files of a piece's episodes into a new folder, under the paths of their set.

    The bytes, including those of videos, depend only on the episodes, their order and the encoder's version.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    made = []
    with ExitStack() as opened:
        episodes, stats = (opened.enter_context((path / name).open("w")) for name in LINES)
        for index, _, episode, numbers in of_episode.each(piece, load, convention, extras):
            levels = _write_episode(path, index, episode, numbers, convention, extras)
            figures = {}
            for name, all_figures in of_episode.figures(numbers, levels).items():
                figures[convention.name(name)] = listed({figure: all_figures[figure] for figure in STATISTICS})
            row = {"episode_index": index, "tasks": [episode.instruction], "length": len(episode)}
            episodes.write(json.dumps(row | {"episode_id": episode.episode_id}) + "\n")
            stats.write(json.dumps({"episode_index": index, "stats": figures}) + "\n")
            made.append((of_episode.provenance(episode, index), levels))
    of_episode.summarise(path, made, extras)


def _write_episode(
    path: Path,
    index: int,
    episode: Episode,
    numbers: of_episode.Numbers,
    convention: Convention,
    extras: tuple[Extra, ...],
) -> dict[str, Counts]:
    """Write the files of one episode and return the counts of levels of its views."""
    levels = {}
    for view, spec in SCHEMA.views.items():
        if convention.frames == "video":
            file = path / video_path(index, convention.name(spec.lerobot_key))
            file.parent.mkdir(parents=True, exist_ok=True)
            with Video(file) as video:
                levels[view] = of_episode.show(episode, view, video)
        else:
            levels[view] = of_episode.show(episode, view, None)
    v30_columns = of_episode.columns(episode, numbers, convention.frames)
    columns = {convention.name(name): values for name, values in v30_columns.items()}
    schema = _schema(convention, extras)
    file = path / data_path(index)
    file.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({name: columns[name] for name in schema.names})
    pq.write_table(table.cast(schema), file)
    return levels


def _schema(convention: Convention, extras: tuple[Extra, ...]) -> pa.Schema:
    schema = of_episode.schema(convention.columns(extras))
    # datasets 4 names a list differently from the clients' versions 2 and 3, but also reads their name.
    metadata = schema.metadata or {}
    return schema.with_metadata({name: value.replace(b'"List"', b'"Sequence"') for name, value in metadata.items()})


def finish(work: Path, root: Path, pieces: Sequence[Piece], convention: Convention, extras: tuple[Extra, ...]) -> None:
    """Link the files of a set's pieces to their places below ``root``, and write the files about all episodes."""
    (root / "meta").mkdir(parents=True)
    for piece in pieces:
        for made in sorted((work / piece.path).glob("*/**/episode_*")):
            link(made, root / made.relative_to(work / piece.path))
    for name in LINES:
        texts = [(work / piece.path / name).read_text() for piece in pieces]
        (root / "meta" / name).write_text("".join(texts))
    tasks = of_episode.finish(work, root, pieces, convention, extras)
    rows = [{"task_index": number, "task": task} for task, number in tasks.items()]
    (root / "meta" / "tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if convention.open_is_one:  # The readers of modality.json expect this gripper.
        of_episode.write_modality(root, convention)
    totals = of_episode.totals("v2.1", pieces[-1], len(tasks), convention)
    episodes, videos = totals["total_episodes"], convention.frames == "video"
    info = {
        **totals,
        "total_videos": episodes * len(SCHEMA.views) if videos else 0,
        "total_chunks": -(-episodes // EPISODES_OF_A_CHUNK),
        "chunks_size": EPISODES_OF_A_CHUNK,
        "fps": SCHEMA.fps_hz,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if videos else None,
        "features": of_episode.described(convention, extras),
    }
    write_json(root / "meta" / "info.json", info)
