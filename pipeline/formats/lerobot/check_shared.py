"""Checks that LeRobot v3.0 and v2.1 share: tasks, videos and statistics."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from pipeline.formats.lerobot.columns import ENTRIES, read_matrix
from pipeline.formats.read_back import Fault, unlike
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


def as_json(value: Any) -> Any:
    """Convert a value to the value that a JSON file returns for it."""
    return json.loads(json.dumps(value))


def wrong_tasks(dataset: str, tasks: Sequence[Mapping[str, Any]], used: Sequence[str]) -> Iterator[Fault]:
    """Compare the numbered tasks with the instructions of the episodes."""
    numbers, texts = [row["task_index"] for row in tasks], [row["task"] for row in tasks]
    yield from unlike(dataset, {"tasks": sorted(texts)}, {"tasks": sorted(set(used))})
    yield from unlike(dataset, {"task_index": numbers}, {"task_index": [*range(len(tasks))]})


def wrong_video(dataset: str, file: Path, stated: Mapping[str, Any]) -> Iterator[Fault]:
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


def wrong_in_dataset(stored: Mapping[str, Stored], files: Sequence[Path], columns: Mapping[str, Any]) -> Wrong:
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


def wrong_frames(column: str, stored: Stored, episodes: Mapping[str, NDArray[Any]]) -> Wrong:
    """Compare a camera's statistics over all frames with the statistics of the episodes.

    Mean, deviation and range follow from the episodes. A quantile must be between the least and the largest quantile of
    the episodes. If the episodes state none, as in version 2.1, it must be within the bounds of Cantelli's
    inequality. Nothing is compared if statistics are missing; ``wrong_in_dataset`` reports that.

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
