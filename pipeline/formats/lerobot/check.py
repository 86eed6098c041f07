"""Checks of LeRobot datasets as a whole, v3.0 and v2.1, and of samples as lerobot reads v3.0."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import av
import datasets
import huggingface_hub
import huggingface_hub.constants
import numpy as np
import pyarrow.parquet as pq
from datasets.exceptions import DatasetsError
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.formats.base import Row
from pipeline.formats.lerobot.columns import (
    DATA_PATH,
    DATA_PATH_V21,
    ENTRIES,
    EPISODE_ID,
    FILE_MB,
    FILES_OF_A_CHUNK,
    PLACE,
    STARVLA_FIGURES,
    STARVLA_STATISTICS,
    VIDEO_PATH,
    VIDEO_PATH_V21,
    Layout,
    data_path_v21,
    read_matrix,
    video_path_v21,
)
from pipeline.formats.lerobot.read import (
    VERSION_V21,
    copy_of,
    episode_files,
    libero_gripper,
    opened_v21,
    read_lines,
    readable,
    rows,
    sets_v21,
)
from pipeline.formats.read_back import Fault, in_both_splits, sampled, unlike
from pipeline.formats.stated_statistics import (
    FIGURES,
    QUANTILE_NAMES,
    SAME,
    Stored,
    Wrong,
    complete,
    disordered,
    unlike_figures,
    wrong_numbers,
)
from pipeline.types import Extra

BY_LEROBOT = 8
"""Number of episodes that lerobot reads too, spread over the dataset."""

SAME_LEVELS = 1
"""Largest difference in grey levels of a frame between PyAV and lerobot's decoder."""


SAME_DEPTH_M = 1e-5
"""Largest difference of depth between lerobot's decoding, in single precision, and ours."""


def check(
    root: Path,
    cache: Path,
    kept: Mapping[str, Row],
    layout: Layout,
    validation: float = 0.0,
) -> Iterator[tuple[str, Fault]]:
    """Compare a dataset's metadata with the content of its files.

    The check covers every field of ``meta/info.json``, the tasks, the splits, the files, and the
    videos' own properties. It computes the statistics of all columns again. lerobot opens the dataset; its numbers and
    frames of samples must equal those of ``read.read``.

    Args:
        validation: share of the demonstrations in the split ``val``.

    Raises:
        PipelineError: when the dataset cannot be opened.
    """
    # lerobot imports torch, which the checks of v2.1 do not need.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    # lerobot decodes by torchvision, which prints in each worker that its video decoding is deprecated.
    warnings.filterwarnings("ignore", message="The video decoding", category=UserWarning)
    with readable(root):
        episodes = rows(root)
        faults = list(_format(root, episodes, layout, validation))
    # These faults come first, because lerobot may stop at them with a less specific message.
    yield from (("format", fault) for fault in faults)
    with readable(root, also=(DatasetsError,)):
        # The option exists from lerobot 0.6 on, as such depth does.
        in_metres: dict[str, Any] = {"depth_output_unit": "m"} if layout.depth_videos else {}
        with local_only(cache):
            data = LeRobotDataset(root.name, root=root, video_backend="pyav", **in_metres)
        stored = (data.meta.total_episodes, data.num_frames)
        wrong = list(_wrong_statistics(root, layout))
        split_of = _split_of(root, episodes)
        samples = list(_samples(root, data, layout))
    for what, expected in wrong:
        yield "format", Fault("lerobot", None, what, expected)
    for episode_id, key in samples:
        yield "format", Fault("lerobot", episode_id, f"lerobot reads another {key}", "the content of its files")
    wanted_steps = sum(row["steps"] for row in kept.values())
    if stored != (len(kept), wanted_steps):
        size = f"{stored[0]} episodes of {stored[1]} steps"
        yield "ids", Fault("lerobot", None, size, f"{len(kept)} of {wanted_steps}")
    # Reading the episodes reports missing ones.
    for episode_id in sorted(episodes.keys() - kept.keys()):
        yield "ids", Fault("lerobot", episode_id, "is in the dataset", "only kept episodes")
    yield from in_both_splits("lerobot", split_of, kept)


def _format(root: Path, episodes: Mapping[str, Mapping[str, Any]], layout: Layout, val: float) -> Iterator[Fault]:
    """Compare the statements of ``meta/`` with the files and with the episodes."""
    info = json.loads((root / "meta" / "info.json").read_text())
    tasks = pq.read_table(root / "meta" / "tasks.parquet").to_pylist()
    steps = sum(row["length"] for row in episodes.values())
    wanted: dict[str, Any] = {
        "codebase_version": "v3.0",
        "robot_type": layout.convention.robot_type,
        "total_episodes": len(episodes),
        "total_frames": steps,
        "total_tasks": len(tasks),
        "chunks_size": FILES_OF_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": FILE_MB,
        "fps": SCHEMA.fps_hz,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if layout.videos else None,
    }
    yield from unlike("lerobot", info, wanted)
    yield from unlike("lerobot", {"fields of info.json": sorted(info)}, {"fields of info.json": _fields(wanted)})
    yield from unlike("lerobot", info["features"], _as_json(layout.described))
    unexpected = sorted(info["features"].keys() - layout.columns.keys())
    if unexpected:
        yield Fault("lerobot", None, f"info.json describes the columns {unexpected}", "only columns of the data files")
    yield from _wrong_tasks("lerobot", tasks, [row["tasks"][0] for row in episodes.values()])
    yield from _wrong_splits(info["splits"], len(episodes), val)
    yield from _wrong_files(root, episodes, layout)
    for file in sorted(root.glob("videos/**/*.mp4")):
        yield from _wrong_video("lerobot", file, info["features"][file.parent.parent.name]["info"])


def _fields(wanted: Mapping[str, Any]) -> list[str]:
    return sorted([*wanted, "splits", "features"])


def _wrong_splits(splits: Mapping[str, str], episodes: int, validation: float) -> Iterator[Fault]:
    """Compare the ranges of the splits with the episodes: ``train`` first, and each episode in one split."""
    names = ["train", "val"] if validation else ["train"]
    firsts, ends = [], []
    for text in splits.values():
        first, end = map(int, text.split(":"))
        firsts.append(first)
        ends.append(end)
    bounds = [0, *ends]
    is_complete = firsts == bounds[:-1] and bounds[-1] == episodes
    is_filled = all(first < end for first, end in zip(firsts, ends, strict=True))
    if [*splits] != names or not (is_complete and is_filled):
        yield Fault("lerobot", None, f"splits is {dict(splits)}", f"{' and '.join(names)}, of 0 to {episodes} in all")


def _split_of(root: Path, episodes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the name of each episode's split, by episode id."""
    splits = json.loads((root / "meta" / "info.json").read_text())["splits"]
    split_of: dict[str, str] = {}
    for name, text in splits.items():
        first, end = map(int, text.split(":"))
        for episode_id, row in episodes.items():
            if first <= row["episode_index"] < end:
                split_of[episode_id] = name
    return split_of


def _wrong_files(root: Path, episodes: Mapping[str, Mapping[str, Any]], layout: Layout) -> Iterator[Fault]:
    """Compare the existing files with the files that the episodes name."""
    kinds = {"data": ".parquet", "meta/episodes": ".parquet"}
    kinds |= {f"videos/{column}": ".mp4" for column in layout.videos.values()}
    wanted = set()
    for row in episodes.values():
        for kind, suffix in kinds.items():
            place = PLACE.format(chunk_index=row[f"{kind}/chunk_index"], file_index=row[f"{kind}/file_index"])
            wanted.add(f"{kind}/{place}{suffix}")
    existing = set()
    for folder in ("data", "videos", "meta/episodes"):
        for file in (root / folder).rglob("*"):
            if file.is_file():
                existing.add(file.relative_to(root).as_posix())
    yield from unlike("lerobot", {"files": sorted(existing)}, {"files": sorted(wanted)})


def _wrong_statistics(root: Path, layout: Layout) -> Iterator[tuple[str, str]]:
    """Compare ``meta/stats.json`` with all steps; for frames, compare it with the statistics of the episodes."""
    stored = json.loads((root / "meta" / "stats.json").read_text())
    yield from _wrong_in_dataset(stored, sorted(root.glob("data/**/*.parquet")), layout.columns)
    for column in layout.pictures.values():
        names = [f"stats/{column}/{figure}" for figure in (*FIGURES, *QUANTILE_NAMES)]
        tables = [pq.read_table(file, columns=names) for file in episode_files(root)]
        of_episodes = {}
        for name in names:
            values = np.array([value for table in tables for value in table[name].to_pylist()])
            figure = name.rpartition("/")[2]
            of_episodes[figure] = values.reshape(len(values), -1)
        yield from _wrong_frames(column, stored[column], of_episodes)


def _samples(root: Path, data: Any, layout: Layout) -> Iterator[tuple[str, str]]:
    """List each episode and column in which lerobot and ``copy_of`` differ at the sampled steps."""
    depth_videos = layout.depth_videos
    extras: tuple[Extra, ...] = ("depth",) if depth_videos else ()
    episodes = sorted(rows(root).values(), key=lambda row: row["episode_index"])
    places = {round(place) for place in np.linspace(0, len(episodes) - 1, BY_LEROBOT)}
    for place in sorted(places):
        row = episodes[place]
        copy = copy_of(root, row, replace(layout, content=replace(layout.content, extras=extras)))
        for step in sampled(row["length"]):
            item = data[row["dataset_from_index"] + step]
            for name, v30_key in layout.motion_keys.items():
                key = layout.name(v30_key)
                values = item[key].numpy()[None]
                if layout.convention.open_is_one and name in ("action", "action_absolute"):
                    values = libero_gripper(values)
                if not np.array_equal(values[0], getattr(copy.episode, name)[step]):
                    yield row[EPISODE_ID], key
            for view, column in layout.views.items():
                # lerobot returns floats in [0, 1], channels first.
                frame = item[column].numpy().transpose(1, 2, 0) * 255
                if np.abs(frame - copy.frame(view, step)).max() > SAME_LEVELS:
                    yield row[EPISODE_ID], column
            for view, column in depth_videos.items():
                depth_m = item[column].numpy()[0]
                if np.abs(depth_m - copy.depth_m[view, step]).max() > SAME_DEPTH_M:
                    yield row[EPISODE_ID], column
            if item["task"] != copy.instructions[step]:
                yield row[EPISODE_ID], "task"


@contextmanager
def local_only(cache: Path) -> Iterator[None]:
    """Keep lerobot off the hub, and keep the copies of ``datasets`` out of the home folder."""
    with (
        mock.patch.object(datasets.config, "HF_DATASETS_CACHE", cache),
        mock.patch.object(huggingface_hub.constants, "HF_HUB_OFFLINE", True),
    ):
        datasets.disable_progress_bars()
        forget_sessions()
        try:
            yield
        finally:
            forget_sessions()


def forget_sessions() -> None:
    """Discard the session of huggingface-hub before version 1.

    A thread keeps its session, which stays online or offline as it was created.
    """
    getattr(huggingface_hub, "configure_http_backend", lambda: None)()


# Version 2.1.


def check_v21(
    folder: Path, kept: Mapping[str, Row], layout: Layout, validation: float = 0.0
) -> Iterator[tuple[str, Fault]]:
    """Compare the metadata of the sets with the content of their files.

    The check covers every field of ``meta/info.json``, ``modality.json`` and ``stats_gr00t.json``, the tasks, the
    splits, the files of every episode, and the videos' own properties. It computes the statistics of all columns again.

    Raises:
        PipelineError: when a set cannot be opened.
    """
    dataset, split_of = folder.name, dict[str, str]()
    for root in sets_v21(folder):
        with readable(root, VERSION_V21):
            _, rows, _ = opened_v21(root)
            faults = list(_format_v21(root, layout))
            wrong = list(_wrong_statistics_v21(root, layout))
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
    splits, wanted = set(split_of.values()), {"train", "val"} if validation else {"train"}
    if splits != wanted:
        yield "format", Fault(dataset, None, f"the sets have the splits {sorted(splits)}", f"{sorted(wanted)}")
    yield from in_both_splits(dataset, split_of, kept)


def _format_v21(root: Path, layout: Layout) -> Iterator[Fault]:
    """Compare the statements of a set's ``meta/`` with its files and its episodes."""
    info, rows, _ = opened_v21(root)
    tasks = read_lines(root / "meta" / "tasks.jsonl")
    columns = _as_json(layout.described)
    videos = [key for key, description in columns.items() if description["dtype"] == "video"]
    indices = [row["episode_index"] for row in rows.values()]
    files = [*map(data_path_v21, indices), *(video_path_v21(index, key) for index in indices for key in videos)]
    wanted = {
        "codebase_version": VERSION_V21,
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
    lines = read_lines(root / "meta" / "episodes.jsonl")
    read = {"episode_index": [line.get("episode_index") for line in lines]}
    read["fields of episodes.jsonl"] = sorted({tuple(sorted(line)) for line in lines})
    expected = {"episode_index": [*range(len(rows))]}
    fields = ("episode_id", "episode_index", "length", "tasks", *SCHEMA.labels)
    expected["fields of episodes.jsonl"] = [tuple(sorted(fields))]
    yield from unlike(dataset, read, expected, within)
    yield from _wrong_tasks(dataset, tasks, [row["tasks"][0] for row in rows.values()])
    if layout.convention.open_is_one:
        yield from _wrong_modality(dataset, root, columns, layout)
        yield from _wrong_starvla_statistics(dataset, root, layout)
    # The videos of a set are alike: only the first of each view is opened here. Reading episodes decodes frames of all.
    for key in videos:
        yield from _wrong_video(dataset, root / video_path_v21(indices[0], key), info["features"][key]["info"])


def _wrong_statistics_v21(root: Path, layout: Layout) -> Iterator[tuple[str, str]]:
    """Compare ``meta/stats.json`` with all steps; for frames, compare it with the statistics of the episodes."""
    stored = json.loads((root / "meta" / "stats.json").read_text())
    yield from _wrong_in_dataset(stored, sorted(root.glob("data/**/*.parquet")), layout.columns)
    views = layout.views.values()
    figures: dict[tuple[str, str], list[Any]] = {(view, name): [] for view in views for name in FIGURES}
    with (root / "meta" / "episodes_stats.jsonl").open() as lines:
        for line in lines:
            stats = json.loads(line)["stats"]
            for view, name in figures:
                figures[view, name].append(np.ravel(stats[view][name]))
    for view in views:
        of_episodes = {name: np.array(figures[view, name]) for name in FIGURES}
        yield from _wrong_frames(view, stored[view], of_episodes)


# Files of ``meta/`` that both versions have.


def _as_json(value: Any) -> Any:
    """Convert a value to the value that a JSON file returns for it."""
    return json.loads(json.dumps(value))


def _wrong_tasks(dataset: str, tasks: Sequence[Mapping[str, Any]], used: Sequence[str]) -> Iterator[Fault]:
    """Compare the numbered tasks with the instructions of the episodes."""
    numbers, texts = [row["task_index"] for row in tasks], [row["task"] for row in tasks]
    yield from unlike(dataset, {"tasks": sorted(texts)}, {"tasks": sorted(set(used))})
    yield from unlike(dataset, {"task_index": numbers}, {"task_index": [*range(len(tasks))]})


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


def _wrong_video(dataset: str, file: Path, stated: Mapping[str, Any]) -> Iterator[Fault]:
    """Compare a video with the properties that ``meta/info.json`` states."""
    with av.open(str(file)) as video:
        stream = video.streams.video[0]
        read = {
            "video.height": stream.height,
            "video.width": stream.width,
            "video.codec": stream.codec_context.name,
            "video.pix_fmt": stream.codec_context.pix_fmt,
            "video.fps": float(stream.average_rate or 0),
            "has_audio": bool(video.streams.audio),
        }
    yield from unlike(dataset, read, {name: stated[name] for name in read}, f"{file.parent.name}/{file.name}: ")


def _wrong_in_dataset(stored: Mapping[str, Stored], files: Sequence[Path], columns: Mapping[str, Any]) -> Wrong:
    """Compare the statistics of all steps with the data files, for every column of numbers.

    Args:
        stored: column to its stored statistics.
        files: the data files.
        columns: the columns as ``meta/info.json`` should describe them.
    """
    numbers = {name: of["shape"][0] for name, of in columns.items() if of["dtype"] in ("float32", "int64")}
    frames = {name: of["shape"][2] for name, of in columns.items() if of["dtype"] in ("image", "video")}
    widths = numbers | frames
    if stored.keys() != widths.keys():
        yield f"the statistics have the columns {sorted(stored)}", f"{sorted(widths)}"
    for column, width in widths.items():
        yield from complete(column, stored.get(column, {}), (*FIGURES, *QUANTILE_NAMES), width)
    for column, width in numbers.items():
        if any(complete(column, stored.get(column, {}), (*FIGURES, *QUANTILE_NAMES), width)):
            continue
        for first in range(0, width, ENTRIES):
            entries = slice(first, first + ENTRIES)
            values = np.concatenate([read_matrix(file, column)[:, entries] for file in files])
            part = {name: value if name == "count" else value[entries] for name, value in stored[column].items()}
            yield from wrong_numbers(column, part, values, QUANTILE_NAMES)


def _wrong_frames(column: str, stored: Stored, episodes: Mapping[str, NDArray[Any]]) -> Wrong:
    """Compare a camera's statistics over all frames with the statistics of the episodes.

    Mean, deviation and range follow from the episodes. A quantile must be between the least and the largest quantile of
    the episodes. If the episodes state none, as in version 2.1, it must be within the bounds of Cantelli's
    inequality. Nothing is compared if statistics are missing; ``_wrong_in_dataset`` reports that.

    Args:
        column: the camera's column.
        stored: its statistics over all frames.
        episodes: name to the statistics of all episodes, (episodes, channels), of the count (episodes, 1).
    """
    if any(complete(column, stored, (*FIGURES, *QUANTILE_NAMES), episodes["mean"].shape[1])):
        return
    frames = episodes["count"]
    mean = (frames * episodes["mean"]).sum(axis=0) / frames.sum()
    spread = episodes["std"] ** 2 + (episodes["mean"] - mean) ** 2
    wanted = {
        "count": frames.sum(axis=0),
        "mean": mean,
        "std": np.sqrt((frames * spread).sum(axis=0) / frames.sum()),
        "min": episodes["min"].min(axis=0),
        "max": episodes["max"].max(axis=0),
    }
    for name, expected in wanted.items():
        yield from unlike_figures(f"{name} of {column}", np.ravel(stored[name]), expected)
    mean, std = wanted["mean"], wanted["std"]
    for name in QUANTILE_NAMES:
        levels, share = np.ravel(stored[name]), int(name[1:]) / 100
        least, most = mean - std * np.sqrt((1 - share) / share), mean + std * np.sqrt(share / (1 - share))
        if name in episodes:
            least, most = episodes[name].min(axis=0), episodes[name].max(axis=0)
        if not ((levels >= least - SAME) & (levels <= most + SAME)).all():
            statement = f"{name} of {column} is {levels.tolist()} in the statistics"
            yield statement, f"from {least.tolist()} to {most.tolist()}, by the statistics of the episodes"
    yield from disordered(column, stored)
