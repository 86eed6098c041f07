"""LeRobot v2.1 datasets read back by PyArrow and PyAV; the installed lerobot reads v3.0 alone."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA
from pipeline.formats.base import Row
from pipeline.formats.lerobot_columns import EPISODE_ID, Convention
from pipeline.formats.lerobot_read import (
    MARKS,
    QUANTILES,
    decoded,
    episode,
    readable,
    refuse_others,
    vectors,
    wrong_statistics,
)
from pipeline.formats.lerobot_v21_write import data_path, video_path
from pipeline.formats.read_back import Copy, Fault
from pipeline.types import Extra

NAME, VERSION = "lerobot_v21", "v2.1"


def open_all(folder: Path) -> None:
    """Read what every set says of itself.

    Raises:
        PipelineError: when that cannot be read.
    """
    for root in _sets(folder):
        with readable(root, VERSION):
            _opened(root, _modified_ns(root))


def check(
    folder: Path, kept: Mapping[str, Row], convention: Convention, extras: tuple[Extra, ...]
) -> Iterator[tuple[str, Fault]]:
    """Version, frame rate, robot, the columns' names and shapes, all totals, the files and statistics of every episode
    and of no other, as many episodes as were kept, and what actions and states of each and of all come to.

    Raises:
        PipelineError: when a set cannot be opened.
    """
    episodes: list[str] = []
    for root in _sets(folder):
        with readable(root, VERSION):
            info, rows, tasks = _opened(root, _modified_ns(root))
            stats = {line["episode_index"]: line["stats"] for line in _lines(root / "meta" / "episodes_stats.jsonl")}
            wrong = list(_wrong_statistics(root, stats, convention))
        videos = [key for key, of in info["features"].items() if of["dtype"] == "video"]
        indices = [row["episode_index"] for row in rows.values()]
        files = [*map(data_path, indices), *(video_path(index, key) for index in indices for key in videos)]
        wanted = {
            "codebase_version": VERSION,
            "fps": SCHEMA.fps_hz,
            "robot_type": convention.robot_type,
            "total_episodes": len(rows),
            "total_frames": sum(row["length"] for row in rows.values()),
            "total_tasks": len(tasks),
            "total_videos": len(rows) * len(videos),
        }
        read = {name: info.get(name) for name in wanted}
        read["columns"] = {name: _described(of) for name, of in info["features"].items()}
        wanted["columns"] = {name: _described(of) for name, of in convention.columns(extras).items()}
        read["files"] = sorted(str(file.relative_to(root)) for file in root.glob("*/chunk-*/**/*") if file.is_file())
        wanted["files"] = sorted(files)
        read["episodes with statistics"], wanted["episodes with statistics"] = [*stats], indices
        for name, expected in wanted.items():
            if read[name] != expected:
                yield "format", Fault(NAME, None, f"{root.name}: {name} {_short(read[name])}", _short(expected))
        for what, expected in wrong:
            yield "format", Fault(NAME, None, f"{root.name}: {what}", expected)
        episodes += rows
    if len(episodes) != len(kept):
        yield "ids", Fault(NAME, None, f"{len(episodes)} episodes", f"{len(kept)}")
    # One that is missing is told where it is looked for.
    for episode_id in set(episodes) - kept.keys():
        yield "ids", Fault(NAME, episode_id, "is in the dataset", "kept episodes alone")


def _wrong_statistics(
    root: Path, of_episodes: Mapping[int, Mapping[str, Any]], convention: Convention
) -> Iterator[tuple[str, str]]:
    """Of the whole set, and of each episode whose file is there."""
    measured = [convention.name(spec.lerobot_key) for spec in (SCHEMA.action, SCHEMA.state)]
    of_all = json.loads((root / "meta" / "stats.json").read_text())
    steps = {file: vectors(file, measured) for file in sorted(root.glob("data/**/*.parquet"))}
    yield from wrong_statistics(of_all, [*steps.values()], QUANTILES)
    for index, stored in of_episodes.items():
        if (of_episode := steps.get(root / data_path(index))) is not None:
            for what, expected in wrong_statistics(stored, [of_episode]):
                yield f"{what} of episode {index}", expected


def read(folder: Path, episode_id: str, convention: Convention, extras: tuple[Extra, ...]) -> Copy | None:
    """An episode with these extras, under v3.0's names and with LIBERO's gripper; None when no set has it.

    Raises:
        PipelineError: when it cannot be read.
    """
    for root in _sets(folder):
        with readable(root, VERSION):
            _, rows, tasks = _opened(root, _modified_ns(root))
            if episode_id in rows:
                return _copy(root, rows[episode_id], tasks, convention, extras)
    return None


def _copy(
    root: Path, row: Mapping[str, Any], tasks: Mapping[int, str], convention: Convention, extras: tuple[Extra, ...]
) -> Copy:
    index = row["episode_index"]
    table = pq.read_table(root / data_path(index))
    refuse_others(table, row, row["first_step"])
    instructions = [tasks[task] for task in table["task_index"].to_pylist()]
    if row["tasks"] != [instructions[0]]:
        raise ValueError(f"episode {index} has the tasks {row['tasks']}, its steps {instructions[0]!r}")
    before = {name: ours for ours, name in convention.names.items()}
    table = table.rename_columns([before.get(name, name) for name in table.column_names])
    made = episode(table, row, instructions[0], extras)
    if convention.open_is_one:
        made = replace(made, action=np.hstack([made.action[:, :-1], 1 - 2 * made.action[:, -1:]]))
    keys = {view: convention.name(spec.lerobot_key) for view, spec in SCHEMA.views.items()}
    videos = {view: (root / video_path(index, key), 0.0) for view, key in keys.items() if convention.frames == "video"}
    marks = {name: table[name].to_numpy() for name in MARKS}
    return Copy(NAME, made, instructions, decoded(table["timestamp"].to_pylist(), videos), marks, {})


def _sets(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir())


def _modified_ns(root: Path) -> int:
    return max(file.stat().st_mtime_ns for file in (root / "meta").iterdir())


@lru_cache(maxsize=8)
def _opened(root: Path, modified_ns: int) -> tuple[dict[str, Any], dict[str, dict[str, Any]], dict[int, str]]:
    """``meta/info.json``, episode id to its line and its provenance, and number to task."""
    info: dict[str, Any] = json.loads((root / "meta" / "info.json").read_text())
    rows = _lines(root / "meta" / "episodes.jsonl")
    first_step = 0
    for row in rows:
        row["first_step"], first_step = first_step, first_step + row["length"]
    provenance = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    tasks = {row["task_index"]: row["task"] for row in _lines(root / "meta" / "tasks.jsonl")}
    return info, {also[EPISODE_ID]: also | row for row, also in zip(rows, provenance, strict=True)}, tasks


def _lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def _described(column: Mapping[str, Any]) -> tuple[Any, ...]:
    return column["dtype"], tuple(column["shape"]), tuple(column["names"] or ())


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 200 else f"{text[:200]}…"
