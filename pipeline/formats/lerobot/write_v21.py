"""Writer of LeRobot v2.1 as published, without lerobot.

A worker writes a piece: consecutive episodes. Every episode is one file of data and one of each video, all of them
final. The files about all episodes come at the end. ``meta/stats.json`` is no part of v2.1, but
``gr00t/data/dataset/lerobot_episode_loader.py`` of NVIDIA/Isaac-GR00T at 23ace64 requires it.
"""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from math import ceil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA, labels_of
from pipeline.formats.episodes import Load, Piece
from pipeline.formats.exact_statistics import Counts, listed
from pipeline.formats.lerobot.columns import (
    DATA_PATH_V21,
    FILES_OF_A_CHUNK,
    STARVLA_FIGURES,
    STARVLA_STATISTICS,
    VIDEO_PATH_V21,
    Layout,
    data_path_v21,
    video_path_v21,
)
from pipeline.formats.lerobot.video import Video
from pipeline.formats.lerobot.write_shared import (
    NumberedEpisode,
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

LINES = ("episodes.jsonl", "episodes_stats.jsonl")
"""Further files in a piece's folder, in addition to the files of its episodes."""

STATISTICS = ("min", "max", "mean", "std", "count")
"""Statistics of each episode."""


def write_piece(path: Path, piece: Piece, load: Load, layout: Layout) -> None:
    """Write the files of a piece's episodes into a new folder, under the paths of their set.

    The bytes, including those of videos, depend only on the episodes, their order and the encoder's version.

    Raises:
        PipelineError: when an episode breaks the schema.
    """
    path.mkdir()
    provenance, levels_of_episodes = [], []
    with ExitStack() as opened:
        episodes, stats = (opened.enter_context((path / name).open("w")) for name in LINES)
        for numbered in load_each(piece, load, layout):
            index, episode = numbered.episode_index, numbered.episode
            levels = _write_episode(path, numbered, layout)
            figures = {}
            for name, all_figures in episode_statistics(numbered.numbers, levels, layout).items():
                figures[name] = listed({figure: all_figures[figure] for figure in STATISTICS})
            row = {"episode_index": index, "tasks": [episode.instruction], "length": len(episode)}
            row |= {"episode_id": episode.episode_id, **labels_of(episode)}
            episodes.write(json.dumps(row) + "\n")
            stats.write(json.dumps({"episode_index": index, "stats": figures}) + "\n")
            provenance.append(provenance_row(numbered))
            levels_of_episodes.append(levels)
    write_summary(path, provenance, levels_of_episodes, layout.content)


def _write_episode(path: Path, numbered: NumberedEpisode, layout: Layout) -> dict[str, Counts]:
    """Write the files of one episode and return the counts of levels of its views."""
    index, episode = numbered.episode_index, numbered.episode
    levels = {}
    for view, column in layout.views.items():
        if layout.frames == "video":
            file = path / video_path_v21(index, column)
            file.parent.mkdir(parents=True, exist_ok=True)
            with Video(file, layout.content) as video:
                levels[view] = append_frames(episode, view, video)
        else:
            levels[view] = append_frames(episode, view, None)
    columns = step_columns(numbered, layout)
    schema = _schema(layout)
    file = path / data_path_v21(index)
    file.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({name: columns[name] for name in schema.names})
    pq.write_table(table.cast(schema), file)
    return levels


def _schema(layout: Layout) -> pa.Schema:
    schema = data_schema(layout.columns)
    # datasets 4 names a list differently from the clients' versions 2 and 3, but also reads their name.
    metadata = schema.metadata or {}
    return schema.with_metadata({name: value.replace(b'"List"', b'"Sequence"') for name, value in metadata.items()})


def finish(work: Path, root: Path, pieces: Sequence[Piece], layout: Layout) -> None:
    """Link the files of a set's pieces to their places below ``root``, and write the files about all episodes."""
    (root / "meta").mkdir(parents=True)
    for piece in pieces:
        for source in sorted((work / piece.path).glob("*/**/episode_*")):
            link(source, root / source.relative_to(work / piece.path))
    for name in LINES:
        texts = [(work / piece.path / name).read_text() for piece in pieces]
        (root / "meta" / name).write_text("".join(texts))
    tasks = write_common(work, root, pieces, layout)
    rows = [{"task_index": number, "task": task} for task, number in tasks.items()]
    (root / "meta" / "tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if layout.convention.open_is_one:
        _write_modality(root, layout)
        _write_starvla_statistics(root, layout)
    numbers = totals("v2.1", pieces[-1], len(tasks), layout)
    episodes, videos = numbers["total_episodes"], layout.frames == "video"
    info = {
        **numbers,
        "total_videos": episodes * len(layout.content.views) if videos else 0,
        "total_chunks": ceil(episodes / FILES_OF_A_CHUNK),
        "chunks_size": FILES_OF_A_CHUNK,
        "fps": SCHEMA.fps_hz,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH_V21,
        "video_path": VIDEO_PATH_V21 if videos else None,
        "features": layout.described,
    }
    write_json(root / "meta" / "info.json", info)


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
    write_json(root / "meta" / "modality.json", modality)


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
    write_json(root / "meta" / STARVLA_STATISTICS, content)
