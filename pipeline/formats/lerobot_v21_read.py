"""Reader and checks of LeRobot v2.1 datasets by PyArrow and PyAV; the installed lerobot reads v3.0 alone."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA
from pipeline.files import Edition, edition
from pipeline.formats.base import Row
from pipeline.formats.lerobot_columns import EPISODE_ID, Convention
from pipeline.formats.lerobot_meta import as_json, described, wrong_modality, wrong_tasks, wrong_video
from pipeline.formats.lerobot_read import MARKS, NUMBERS, decoded, episode, readable, refuse_others
from pipeline.formats.lerobot_statistics import FIGURES, matrix, wrong_frames, wrong_in_dataset
from pipeline.formats.lerobot_v21_write import DATA_PATH, EPISODES_OF_A_CHUNK, VIDEO_PATH, data_path, video_path
from pipeline.formats.read_back import Copy, Fault, Statistics, in_both_splits, unlike
from pipeline.types import Extra

NAME, VERSION = "lerobot_v21", "v2.1"


def open_all(folder: Path) -> None:
    """Read the metadata of every set.

    Raises:
        PipelineError: when the metadata cannot be read.
    """
    for root in _sets(folder):
        with readable(root, VERSION):
            _opened(root, _modified_ns(root))


def check(
    folder: Path, kept: Mapping[str, Row], convention: Convention, extras: tuple[Extra, ...], validation: float = 0.0
) -> Iterator[tuple[str, Fault]]:
    """Compare the metadata of the sets with the content of their files.

    The check covers every field of ``meta/info.json``, the tasks, the splits, the files of every episode, and the
    videos' own properties. It computes the statistics of all columns again.

    Raises:
        PipelineError: when a set cannot be opened.
    """
    split_of: dict[str, str] = {}
    for root in _sets(folder):
        with readable(root, VERSION):
            _, rows, _ = _opened(root, _modified_ns(root))
            faults = list(_format(root, convention, extras))
            wrong = list(_wrong_statistics(root, convention, extras))
        yield from (("format", fault) for fault in faults)
        for what, expected in wrong:
            yield "format", Fault(NAME, None, f"{root.name}: {what}", expected)
        for episode_id in rows.keys() & split_of.keys():
            yield "ids", Fault(NAME, episode_id, f"is in {root.name} and in another set", "one set")
        split_of |= dict.fromkeys(rows, "val" if root.name.endswith("_val") else "train")
    if len(split_of) != len(kept):
        yield "ids", Fault(NAME, None, f"{len(split_of)} episodes", f"{len(kept)}")
    # Reading the episodes reports missing ones.
    for episode_id in split_of.keys() - kept.keys():
        yield "ids", Fault(NAME, episode_id, "is in the dataset", "kept episodes alone")
    splits, wanted = set(split_of.values()), {"train", "val"} if validation else {"train"}
    if splits != wanted:
        yield "format", Fault(NAME, None, f"the sets are for {sorted(splits)}", f"{sorted(wanted)}")
    yield from in_both_splits(NAME, split_of, kept)


def _format(root: Path, convention: Convention, extras: tuple[Extra, ...]) -> Iterator[Fault]:
    """Compare the statements of a set's ``meta/`` with its files and its episodes."""
    info, rows, _ = _opened(root, _modified_ns(root))
    tasks = _lines(root / "meta" / "tasks.jsonl")
    columns = as_json(described(convention, extras))
    videos = [key for key, description in columns.items() if description["dtype"] == "video"]
    indices = [row["episode_index"] for row in rows.values()]
    files = [*map(data_path, indices), *(video_path(index, key) for index in indices for key in videos)]
    wanted = {
        "codebase_version": VERSION,
        "robot_type": convention.robot_type,
        "total_episodes": len(rows),
        "total_frames": sum(row["length"] for row in rows.values()),
        "total_tasks": len(tasks),
        "total_videos": len(rows) * len(videos),
        "total_chunks": len({file.split("/")[1] for file in files}),
        "chunks_size": EPISODES_OF_A_CHUNK,
        "fps": SCHEMA.fps_hz,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if videos else None,
        "features": columns,
    }
    within = f"{root.name}: "
    yield from unlike(NAME, info, wanted, within)
    existing = [file.relative_to(root).as_posix() for file in root.glob("*/chunk-*/**/*") if file.is_file()]
    stated = [line["episode_index"] for line in _lines(root / "meta" / "episodes_stats.jsonl")]
    read = {"fields of info.json": sorted(info), "files": sorted(existing), "episodes with statistics": stated}
    expected = {"fields of info.json": sorted(wanted), "files": sorted(files), "episodes with statistics": indices}
    yield from unlike(NAME, read, expected, within)
    lines = _lines(root / "meta" / "episodes.jsonl")
    read = {"episode_index": [line.get("episode_index") for line in lines]}
    read["fields of episodes.jsonl"] = sorted({tuple(sorted(line)) for line in lines})
    expected = {"episode_index": [*range(len(rows))]}
    expected["fields of episodes.jsonl"] = [("episode_id", "episode_index", "length", "tasks")]
    yield from unlike(NAME, read, expected, within)
    yield from wrong_tasks(NAME, tasks, [row["tasks"][0] for row in rows.values()])
    if convention.open_is_one:
        yield from wrong_modality(NAME, root, columns, convention)
    # The videos of a set are alike: only the first of each view is opened here. Reading episodes decodes frames of all.
    for key in videos:
        yield from wrong_video(NAME, root / video_path(indices[0], key), info["features"][key]["info"])


def _wrong_statistics(root: Path, convention: Convention, extras: tuple[Extra, ...]) -> Iterator[tuple[str, str]]:
    """Compare ``meta/stats.json`` with all steps; for frames, compare it with the statistics of the episodes."""
    stored = json.loads((root / "meta" / "stats.json").read_text())
    yield from wrong_in_dataset(stored, sorted(root.glob("data/**/*.parquet")), convention.columns(extras))
    views = [convention.name(view.lerobot_key) for view in SCHEMA.views.values()]
    figures: dict[tuple[str, str], list[Any]] = {(view, name): [] for view in views for name in FIGURES}
    with (root / "meta" / "episodes_stats.jsonl").open() as lines:
        for line in lines:
            stats = json.loads(line)["stats"]
            for view, name in figures:
                figures[view, name].append(np.ravel(stats[view][name]))
    for view in views:
        of_episodes = {name: np.array(figures[view, name]) for name in FIGURES}
        yield from wrong_frames(view, stored[view], of_episodes)


def read(folder: Path, episode_id: str, convention: Convention, extras: tuple[Extra, ...]) -> Copy | None:
    """Read an episode with these extras, under v3.0's names and with LIBERO's gripper; ``None`` when no set has it.

    Raises:
        PipelineError: when the episode cannot be read.
    """
    for root in _sets(folder):
        with readable(root, VERSION):
            info, rows, tasks = _opened(root, _modified_ns(root))
            if episode_id in rows:
                return _copy(root, info, rows[episode_id], tasks, convention, extras)
    return None


def _copy(
    root: Path,
    info: Mapping[str, Any],
    row: Mapping[str, Any],
    tasks: Mapping[int, str],
    convention: Convention,
    extras: tuple[Extra, ...],
) -> Copy:
    index = row["episode_index"]
    stored = pq.read_table(root / data_path(index))
    refuse_others(stored, row, row["first_step"])
    instructions = [tasks[task] for task in stored["task_index"].to_pylist()]
    if row["tasks"] != [instructions[0]]:
        raise ValueError(f"episode {index} has the tasks {row['tasks']}, its steps {instructions[0]!r}")
    v30_names = {name: v30_name for v30_name, name in convention.names.items()}
    table = stored.rename_columns([v30_names.get(name, name) for name in stored.column_names])
    made = episode(table, row, instructions[0], extras)
    if convention.open_is_one:
        libero_gripper = 1 - 2 * made.action[:, -1:]
        made = replace(made, action=np.hstack([made.action[:, :-1], libero_gripper]))
    keys = {view: convention.name(spec.lerobot_key) for view, spec in SCHEMA.views.items()}
    videos = {view: (root / video_path(index, key), 0.0) for view, key in keys.items() if convention.frames == "video"}
    marks = {name: table[name].to_numpy() for name in MARKS}
    numbers = {name: matrix(stored, name) for name, of in info["features"].items() if of["dtype"] in NUMBERS}
    statistics = Statistics(_statistics(root, index), numbers, keys)
    frames = decoded(table["timestamp"].to_pylist(), videos)
    return Copy(NAME, made, instructions, frames, marks, {}, statistics=statistics)


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


def _sets(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir())


def _modified_ns(root: Path) -> int:
    return max(file.stat().st_mtime_ns for file in (root / "meta").iterdir())


@lru_cache(maxsize=8)
def _opened(root: Path, modified_ns: int) -> tuple[dict[str, Any], dict[str, dict[str, Any]], dict[int, str]]:
    """Read ``meta/info.json``, each episode's line and provenance by its id, and the tasks by their number."""
    info: dict[str, Any] = json.loads((root / "meta" / "info.json").read_text())
    rows = _lines(root / "meta" / "episodes.jsonl")
    first_step = 0
    for row in rows:
        row["first_step"] = first_step
        first_step += row["length"]
    provenance = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    tasks = {row["task_index"]: row["task"] for row in _lines(root / "meta" / "tasks.jsonl")}
    by_id = {}
    for row, labels in zip(rows, provenance, strict=True):
        by_id[labels[EPISODE_ID]] = labels | row
    return info, by_id, tasks


def _lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]
