"""Checks of LeRobot v3.0 as a whole, and of samples as lerobot reads them."""

import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import datasets
import huggingface_hub
import huggingface_hub.constants
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from datasets.exceptions import DatasetsError

from pipeline.episode_schema import SCHEMA
from pipeline.formats.base import ManifestRow
from pipeline.formats.lerobot.check_shared import as_json, wrong_frames, wrong_in_dataset, wrong_tasks, wrong_video
from pipeline.formats.lerobot.columns import (
    DATA_PATH,
    EPISODE_ID,
    FILE_MB,
    FILES_OF_A_CHUNK,
    PLACE,
    SELECTED_BY,
    VIDEO_PATH,
    Layout,
)
from pipeline.formats.lerobot.read import (
    copy_of,
    episode_files,
    libero_gripper,
    readable,
    rows,
)
from pipeline.formats.read_back import Fault, in_both_splits, sampled, unlike
from pipeline.formats.stated_statistics import FIGURES, QUANTILE_NAMES
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
    kept: Mapping[str, ManifestRow],
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
    yield from unlike("lerobot", info["features"], as_json(layout.described))
    unexpected = sorted(info["features"].keys() - layout.columns.keys())
    if unexpected:
        yield Fault("lerobot", None, f"info.json describes the columns {unexpected}", "only columns of the data files")
    yield from wrong_tasks("lerobot", tasks, [row["tasks"][0] for row in episodes.values()])
    yield from _wrong_splits(info["splits"], len(episodes), val)
    yield from _wrong_files(root, episodes, layout)
    yield from _wrong_selection(root)
    for file in sorted(root.glob("videos/**/*.mp4")):
        yield from wrong_video("lerobot", file, info["features"][file.parent.parent.name]["info"])


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


def _wrong_selection(root: Path) -> Iterator[Fault]:
    """Compare the columns of ``meta/episodes`` by which users select with ``meta/provenance.parquet``."""
    provenance = pq.read_table(root / "meta" / "provenance.parquet", columns=list(SELECTED_BY)).to_pylist()
    tables = [pq.read_table(file, columns=list(SELECTED_BY)) for file in episode_files(root)]
    for row, wanted in zip(pa.concat_tables(tables).to_pylist(), provenance, strict=True):
        yield from unlike("lerobot", row, wanted, f"meta/episodes, {wanted[EPISODE_ID]}: ")


def _wrong_statistics(root: Path, layout: Layout) -> Iterator[tuple[str, str]]:
    """Compare ``meta/stats.json`` with all steps; for frames, compare it with the statistics of the episodes."""
    stored = json.loads((root / "meta" / "stats.json").read_text())
    yield from wrong_in_dataset(stored, sorted(root.glob("data/**/*.parquet")), layout.columns)
    for column in layout.pictures.values():
        names = [f"stats/{column}/{figure}" for figure in (*FIGURES, *QUANTILE_NAMES)]
        tables = [pq.read_table(file, columns=names) for file in episode_files(root)]
        of_episodes = {}
        for name in names:
            values = np.array([value for table in tables for value in table[name].to_pylist()])
            figure = name.rpartition("/")[2]
            of_episodes[figure] = values.reshape(len(values), -1)
        yield from wrong_frames(column, stored[column], of_episodes)


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
