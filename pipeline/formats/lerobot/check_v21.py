"""Checks of LeRobot v2.1 as a whole."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA
from pipeline.formats.base import ManifestRow
from pipeline.formats.lerobot.check_shared import as_json, wrong_frames, wrong_in_dataset, wrong_tasks, wrong_video
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
from pipeline.formats.lerobot.read import readable
from pipeline.formats.lerobot.read_v21 import VERSION, opened, read_lines, sets
from pipeline.formats.read_back import Fault, in_both_splits, unlike, wrong_splits
from pipeline.formats.stated_statistics import FIGURES


def check(
    folder: Path, kept: Mapping[str, ManifestRow], layout: Layout, validation: float = 0.0
) -> Iterator[tuple[str, Fault]]:
    """Compare the metadata of the sets with the content of their files.

    The check covers every field of ``meta/info.json``, ``modality.json`` and ``stats_gr00t.json``, the tasks, the
    splits, the files of every episode, and the videos' own properties. It computes the statistics of all columns again.

    Raises:
        PipelineError: when a set cannot be opened.
    """
    dataset, split_of = folder.name, dict[str, str]()
    for root in sets(folder):
        with readable(root, VERSION):
            _, rows, _ = opened(root)
            faults = list(_format(root, layout))
            wrong = list(_wrong_statistics(root, layout))
        yield from (("format", fault) for fault in faults)
        for what, expected in wrong:
            yield "format", Fault(dataset, None, f"{root.name}: {what}", expected)
        for episode_id in rows.keys() & split_of.keys():
            yield "ids", Fault(dataset, episode_id, f"is in {root.name} and in another set", "one set")
        split_of |= dict.fromkeys(rows, "val" if root.name.endswith("_val") else "train")
    if len(split_of) != len(kept):
        yield "ids", Fault(dataset, None, f"{len(split_of)} episodes", f"{len(kept)}")
    # Reading the episodes reports missing ones.
    for episode_id in split_of.keys() - kept.keys():
        yield "ids", Fault(dataset, episode_id, "is in the dataset", "only kept episodes")
    yield from wrong_splits(dataset, {*split_of.values()}, validation, "the sets have the splits")
    yield from in_both_splits(dataset, split_of, kept)


def _format(root: Path, layout: Layout) -> Iterator[Fault]:
    """Compare the statements of a set's ``meta/`` with its files and its episodes."""
    info, rows, _ = opened(root)
    tasks = read_lines(root / "meta" / "tasks.jsonl")
    columns = as_json(layout.described)
    videos = [key for key, description in columns.items() if description["dtype"] == "video"]
    indices = [row["episode_index"] for row in rows.values()]
    files = [*map(data_path_v21, indices), *(video_path_v21(index, key) for index in indices for key in videos)]
    wanted = {
        "codebase_version": VERSION,
        "robot_type": layout.convention.robot_type,
        "total_episodes": len(rows),
        "total_frames": sum(row["length"] for row in rows.values()),
        "total_tasks": len(tasks),
        "total_videos": len(rows) * len(videos),
        "total_chunks": len({file.split("/")[1] for file in files}),
        "chunks_size": FILES_OF_A_CHUNK,
        "fps": SCHEMA.fps_hz,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": DATA_PATH_V21,
        "video_path": VIDEO_PATH_V21 if videos else None,
        "features": columns,
    }
    dataset, within = root.parent.name, f"{root.name}: "
    yield from unlike(dataset, info, wanted, within)
    existing = [file.relative_to(root).as_posix() for file in root.glob("*/chunk-*/**/*") if file.is_file()]
    stated = [line["episode_index"] for line in read_lines(root / "meta" / "episodes_stats.jsonl")]
    read = {"fields of info.json": sorted(info), "files": sorted(existing), "episodes with statistics": stated}
    expected = {"fields of info.json": sorted(wanted), "files": sorted(files), "episodes with statistics": indices}
    yield from unlike(dataset, read, expected, within)
    table = pq.read_table(root / "meta" / "provenance.parquet", columns=["episode_index"])
    name = "episode_index of provenance.parquet"
    yield from unlike(dataset, {name: table["episode_index"].to_pylist()}, {name: [*range(len(rows))]}, within)
    lines = read_lines(root / "meta" / "episodes.jsonl")
    read = {"episode_index": [line.get("episode_index") for line in lines]}
    read["fields of episodes.jsonl"] = sorted({tuple(sorted(line)) for line in lines})
    expected = {"episode_index": [*range(len(rows))]}
    fields = ("episode_id", "episode_index", "length", "tasks", *SCHEMA.labels)
    expected["fields of episodes.jsonl"] = [tuple(sorted(fields))]
    yield from unlike(dataset, read, expected, within)
    yield from wrong_tasks(dataset, tasks, [row["tasks"][0] for row in rows.values()])
    if layout.convention.open_is_one:
        yield from _wrong_modality(dataset, root, columns, layout)
        yield from _wrong_starvla_statistics(dataset, root, layout)
    # The videos of a set are alike: only the first of each view is opened here. Reading episodes decodes frames of all.
    for key in videos:
        yield from wrong_video(dataset, root / video_path_v21(indices[0], key), info["features"][key]["info"])


def _wrong_statistics(root: Path, layout: Layout) -> Iterator[tuple[str, str]]:
    """Compare ``meta/stats.json`` with all steps; for frames, compare it with the statistics of the episodes."""
    stored = json.loads((root / "meta" / "stats.json").read_text())
    yield from wrong_in_dataset(stored, sorted(root.glob("data/**/*.parquet")), layout.columns)
    views = layout.views.values()
    figures: dict[tuple[str, str], list[Any]] = {(view, name): [] for view in views for name in FIGURES}
    with (root / "meta" / "episodes_stats.jsonl").open() as lines:
        for line in lines:
            stats = json.loads(line)["stats"]
            for view, name in figures:
                figures[view, name].append(np.ravel(stats[view][name]))
    for view in views:
        of_episodes = {name: np.array(figures[view, name]) for name in FIGURES}
        yield from wrong_frames(view, stored[view], of_episodes)


def _wrong_modality(
    dataset: str, root: Path, features: Mapping[str, Mapping[str, Any]], layout: Layout
) -> Iterator[Fault]:
    """Compare ``meta/modality.json`` with the columns: parts cover a vector in order, and views are the cameras."""
    modality = json.loads((root / "meta" / "modality.json").read_text())
    pose = ["x", "y", "z", "roll", "pitch", "yaw"]
    for name, spec, parts in (
        ("state", SCHEMA.state, [*pose, "pad", "gripper"]),
        ("action", SCHEMA.action, [*pose, "gripper"]),
    ):
        column = layout.name(spec.lerobot_key)
        width = features[column]["shape"][0]
        wanted = [(part, k, k + 1, column) for k, part in zip(range(width), parts, strict=True)]
        entries = modality[name].items()
        read = [(part, entry["start"], entry["end"], entry["original_key"]) for part, entry in entries]
        yield from unlike(dataset, {f"{name} of modality.json": read}, {f"{name} of modality.json": wanted})
    views = layout.views
    columns = {
        "video": {"primary_image": views["image"], **views},
        "annotation": {"human.action.task_description": "task_index"},
    }
    for name, wanted_keys in columns.items():
        keys = {part: entry["original_key"] for part, entry in modality[name].items()}
        yield from unlike(dataset, {f"{name} of modality.json": keys}, {f"{name} of modality.json": wanted_keys})
    yield from unlike(dataset, {"parts of modality.json": [*modality]}, {"parts of modality.json": [*_PARTS]})


_PARTS = ("state", "action", "video", "annotation")


def _wrong_starvla_statistics(dataset: str, root: Path, layout: Layout) -> Iterator[Fault]:
    """Compare starVLA's statistics with ``meta/stats.json``, which is compared with the data files."""
    stats = json.loads((root / "meta" / "stats.json").read_text())
    stored = json.loads((root / "meta" / STARVLA_STATISTICS).read_text())
    wanted = {"__format_version": 2, "__cache_config": {"mode": "abs"}}
    yield from unlike(dataset, stored, wanted, f"{STARVLA_STATISTICS}: ")
    for spec in (SCHEMA.state, SCHEMA.action):
        column = layout.name(spec.lerobot_key)
        figures = {name: stats[column][name] for name in STARVLA_FIGURES}
        yield from unlike(dataset, stored["statistics"], {column: figures}, f"{STARVLA_STATISTICS}: ")
