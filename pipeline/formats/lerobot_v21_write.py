"""LeRobot v2.1 as its files are published, without lerobot, which no longer writes it.

Every episode is a file of data and one of each video, final at once. ``meta/stats.json`` is no part of v2.1;
``gr00t/data/dataset/lerobot_episode_loader.py`` of NVIDIA/Isaac-GR00T at 23ace64 asks for it.
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
"""In a piece's folder, beside the files of its episodes."""

STATISTICS = ("min", "max", "mean", "std", "count")
"""Of v2.1, for each episode."""


def data_path(index: int) -> str:
    """Path of an episode's data below its set's root."""
    return DATA_PATH.format(episode_chunk=index // EPISODES_OF_A_CHUNK, episode_index=index)


def video_path(index: int, key: str) -> str:
    """Path of an episode's video."""
    return VIDEO_PATH.format(episode_chunk=index // EPISODES_OF_A_CHUNK, episode_index=index, video_key=key)


def write_piece(path: Path, piece: Piece, load: Load, convention: Convention, extras: tuple[Extra, ...]) -> None:
    """Write the files of some episodes into a new folder, where they lie as in their set.

    The bytes, videos included, depend on the episodes, their order and the encoder's version alone.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    made = []
    with ExitStack() as opened:
        episodes, stats = (opened.enter_context((path / name).open("w")) for name in LINES)
        for index, _, episode, numbers in of_episode.each(piece, load, convention, extras):
            shown = _write_episode(path, index, episode, numbers, convention, extras)
            figures = {
                convention.name(name): listed({of: found[of] for of in STATISTICS})
                for name, found in of_episode.figures(numbers, shown).items()
            }
            row = {"episode_index": index, "tasks": [episode.instruction], "length": len(episode)}
            episodes.write(json.dumps(row | {"episode_id": episode.episode_id}) + "\n")
            stats.write(json.dumps({"episode_index": index, "stats": figures}) + "\n")
            made.append((of_episode.provenance(episode, index), shown))
    of_episode.summarise(path, made, extras)


def _write_episode(
    path: Path,
    index: int,
    episode: Episode,
    numbers: of_episode.Numbers,
    convention: Convention,
    extras: tuple[Extra, ...],
) -> dict[str, Counts]:
    """Write the files of one episode; returns the levels of its views."""
    shown = {}
    for view, of in SCHEMA.views.items():
        if convention.frames == "video":
            file = path / video_path(index, convention.name(of.lerobot_key))
            file.parent.mkdir(parents=True, exist_ok=True)
            with Video(file) as video:
                shown[view] = of_episode.show(episode, view, video)
        else:
            shown[view] = of_episode.show(episode, view, None)
    made = of_episode.columns(episode, numbers, convention.frames)
    columns = {convention.name(name): of for name, of in made.items()}
    schema = _schema(convention, extras)
    file = path / data_path(index)
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table({name: columns[name] for name in schema.names}).cast(schema), file)
    return shown


def _schema(convention: Convention, extras: tuple[Extra, ...]) -> pa.Schema:
    schema = of_episode.schema(convention.columns(extras))
    # datasets 4 calls a list another name than versions 2 and 3, which the clients have, and reads theirs too.
    described = {name: value.replace(b'"List"', b'"Sequence"') for name, value in (schema.metadata or {}).items()}
    return schema.with_metadata(described)


def finish(work: Path, root: Path, pieces: Sequence[Piece], convention: Convention, extras: tuple[Extra, ...]) -> None:
    """Put the files of a set's pieces in their places below ``root``, and write what is about all of them."""
    (root / "meta").mkdir(parents=True)
    for piece in pieces:
        for made in sorted((work / piece.path).glob("*/**/episode_*")):
            link(made, root / made.relative_to(work / piece.path))
    for name in LINES:
        (root / "meta" / name).write_text("".join((work / piece.path / name).read_text() for piece in pieces))
    tasks = of_episode.finish(work, root, pieces, convention, extras)
    rows = [{"task_index": number, "task": task} for task, number in tasks.items()]
    (root / "meta" / "tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if convention.open_is_one:  # As its readers take the gripper.
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
