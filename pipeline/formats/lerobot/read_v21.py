"""Reader of single episodes of LeRobot v2.1."""

import json
from collections.abc import Mapping
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from pipeline.files import Edition, edition
from pipeline.formats.lerobot.columns import (
    EPISODE_ID,
    Layout,
    data_path_v21,
    matrix,
    video_path_v21,
)
from pipeline.formats.lerobot.read import (
    NUMBERS,
    decoded,
    episode,
    read_step_marks,
    readable,
    reject_others,
    v30_columns,
)
from pipeline.formats.read_back import Copy, Statistics

VERSION = "v2.1"


def open_all(folder: Path) -> None:
    """Read the metadata of every set.

    Raises:
        PipelineError: when the metadata cannot be read.
    """
    for root in sets(folder):
        with readable(root, VERSION):
            opened(root)


def read(folder: Path, episode_id: str, layout: Layout) -> Copy | None:
    """Read an episode of this layout, under v3.0's names and with LIBERO's gripper; ``None`` when no set has it.

    Raises:
        PipelineError: when the episode cannot be read.
    """
    for root in sets(folder):
        with readable(root, VERSION):
            info, rows, tasks = opened(root)
            if episode_id in rows:
                return _copy_of(root, info, rows[episode_id], tasks, layout)
    return None


def _copy_of(
    root: Path,
    info: Mapping[str, Any],
    row: Mapping[str, Any],
    tasks: Mapping[int, str],
    layout: Layout,
) -> Copy:
    index = row["episode_index"]
    stored = pq.read_table(root / data_path_v21(index))
    reject_others(stored, row, row["first_step"])
    instructions = [tasks[task] for task in stored["task_index"].to_pylist()]
    if row["tasks"] != [instructions[0]]:
        raise ValueError(f"episode {index} has the tasks {row['tasks']}, its steps {instructions[0]!r}")
    table = v30_columns(stored, layout)
    copied_episode = episode(table, row, instructions[0], layout)
    keys = layout.views
    videos = {view: (root / video_path_v21(index, key), 0.0) for view, key in keys.items() if layout.frames == "video"}
    numbers = {name: matrix(stored, name) for name, of in info["features"].items() if of["dtype"] in NUMBERS}
    statistics = Statistics(_statistics(root, index), numbers, keys)
    frames = decoded(table["timestamp"].to_pylist(), videos)
    return Copy(
        dataset=root.parent.name,
        episode=copied_episode,
        instructions=instructions,
        decoded=frames,
        step_marks=read_step_marks(table),
        place={},
        statistics=statistics,
    )


def _statistics(root: Path, index: int) -> dict[str, Any]:
    """Read the statistics of an episode's columns in ``meta/episodes_stats.jsonl``."""
    file = root / "meta" / "episodes_stats.jsonl"
    with file.open("rb") as lines:
        lines.seek(_begins(edition(file))[index])
        line = json.loads(lines.readline())
    if line["episode_index"] != index:
        raise ValueError(f"line {index} of {file.name} is of episode {line['episode_index']}")
    stats: dict[str, Any] = line["stats"]
    return stats


@lru_cache(maxsize=8)
def _begins(file: Edition) -> list[int]:
    """Return the offset of each line of a file, in bytes."""
    with file.path.open("rb") as lines:
        lengths = [len(line) for line in lines]
    return [0, *accumulate(lengths)]


def sets(folder: Path) -> list[Path]:
    """List the folders of the sets."""
    return sorted(path for path in folder.iterdir() if path.is_dir())


def opened(root: Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]], dict[int, str]]:
    """Read ``meta/info.json``, each episode's line and provenance by its id, and the tasks by their number."""
    return _opened(root, max(file.stat().st_mtime_ns for file in (root / "meta").iterdir()))


@lru_cache(maxsize=8)
def _opened(root: Path, modified_ns: int) -> tuple[dict[str, Any], dict[str, dict[str, Any]], dict[int, str]]:
    """Read the result of ``opened``, at a time of the last change."""
    info: dict[str, Any] = json.loads((root / "meta" / "info.json").read_text())
    rows = read_lines(root / "meta" / "episodes.jsonl")
    first_step = 0
    for row in rows:
        row["first_step"] = first_step
        first_step += row["length"]
    provenance = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    tasks = {row["task_index"]: row["task"] for row in read_lines(root / "meta" / "tasks.jsonl")}
    by_id = {}
    for row, labels in zip(rows, provenance, strict=True):
        by_id[labels[EPISODE_ID]] = labels | row
    return info, by_id, tasks


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Read a file with a JSON object on each line."""
    return [json.loads(line) for line in file.read_text().splitlines()]
