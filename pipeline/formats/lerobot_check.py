"""A LeRobot dataset as a whole, and samples of it, as lerobot reads them."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import datasets
import huggingface_hub
import huggingface_hub.constants
import numpy as np
import pyarrow.parquet as pq
from datasets.exceptions import DatasetsError
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from pipeline.episode_schema import MOTION, SCHEMA
from pipeline.formats.base import Row
from pipeline.formats.lerobot_columns import EPISODE_ID, FILE_MB, Convention
from pipeline.formats.lerobot_meta import as_json, described, wrong_modality, wrong_tasks, wrong_video
from pipeline.formats.lerobot_read import copy_of, episode_files, readable, rows
from pipeline.formats.lerobot_statistics import FIGURES, QUANTILES, wrong_frames, wrong_in_dataset
from pipeline.formats.read_back import Fault, in_both_splits, sampled, unlike
from pipeline.types import Extra

BY_LEROBOT = 8
"""So many episodes are read by lerobot too, spread over the dataset."""

SAME_LEVELS = 1
"""Largest difference of a decoded frame between PyAV and what lerobot decodes with."""

FILES_OF_A_CHUNK, PLACE = 1000, "chunk-{chunk_index:03d}/file-{file_index:03d}"
"""lerobot's own, which its tools for editing go on with."""


def check(
    root: Path,
    cache: Path,
    kept: Mapping[str, Row],
    convention: Convention,
    extras: Sequence[Extra] = (),
    validation: float = 0.0,
) -> Iterator[tuple[str, Fault]]:
    """Compare a dataset as a whole with what its files hold: every field of ``meta/info.json`` and ``modality.json``,
    the tasks, the splits, the files, the videos' own properties, and the statistics of all columns, computed again.
    lerobot opens it, and samples are the very numbers and frames that ``lerobot_read.read`` finds.

    Args:
        validation: share of the demonstrations in the split ``val``.

    Raises:
        PipelineError: when the dataset cannot be opened.
    """
    # lerobot decodes through it, and each worker would print that it will go.
    warnings.filterwarnings("ignore", message="The video decoding", category=UserWarning)
    with readable(root):
        episodes = rows(root)
        faults = list(_format(root, episodes, convention, extras, validation))
    # First, as lerobot may stop at them with less to say.
    yield from (("format", fault) for fault in faults)
    with readable(root, also=(DatasetsError,)):
        with local_only(cache):
            data = LeRobotDataset(root.name, root=root, video_backend="pyav")
        stored = (data.meta.total_episodes, data.num_frames)
        wrong = list(_wrong_statistics(root, convention, extras))
        split_of = _split_of(root, episodes)
        samples = list(_samples(root, data))
    for what, expected in wrong:
        yield "format", Fault("lerobot", None, what, expected)
    for episode_id, key in samples:
        yield "format", Fault("lerobot", episode_id, f"lerobot reads another {key}", "what its files hold")
    wanted_steps = sum(row["steps"] for row in kept.values())
    if stored != (len(kept), wanted_steps):
        found = f"{stored[0]} episodes of {stored[1]} steps"
        yield "ids", Fault("lerobot", None, found, f"{len(kept)} of {wanted_steps}")
    # One that is missing is told where it is looked for.
    for episode_id in sorted(episodes.keys() - kept.keys()):
        yield "ids", Fault("lerobot", episode_id, "is in the dataset", "kept episodes alone")
    yield from in_both_splits("lerobot", split_of, kept)


def _format(
    root: Path, episodes: Mapping[str, Mapping[str, Any]], convention: Convention, extras: Sequence[Extra], val: float
) -> Iterator[Fault]:
    """Compare what ``meta/`` states with the files and with the episodes."""
    info = json.loads((root / "meta" / "info.json").read_text())
    tasks = pq.read_table(root / "meta" / "tasks.parquet").to_pylist()
    steps = sum(row["length"] for row in episodes.values())
    wanted: dict[str, Any] = {
        "codebase_version": "v3.0",
        "robot_type": convention.robot_type,
        "total_episodes": len(episodes),
        "total_frames": steps,
        "total_tasks": len(tasks),
        "chunks_size": FILES_OF_A_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": FILE_MB,
        "fps": SCHEMA.fps_hz,
        "data_path": f"data/{PLACE}.parquet",
        "video_path": f"videos/{{video_key}}/{PLACE}.mp4" if convention.frames == "video" else None,
    }
    yield from unlike("lerobot", info, wanted)
    yield from unlike("lerobot", {"fields of info.json": sorted(info)}, {"fields of info.json": _fields(wanted)})
    yield from unlike("lerobot", info["features"], as_json(described(convention, extras)))
    if strange := sorted(info["features"].keys() - convention.columns(extras).keys()):
        yield Fault("lerobot", None, f"columns {strange} are described", "those of the data files")
    yield from wrong_tasks("lerobot", tasks, [row["tasks"][0] for row in episodes.values()])
    yield from _wrong_splits(info["splits"], len(episodes), val)
    yield from wrong_modality("lerobot", root, info["features"], convention)
    yield from _wrong_files(root, episodes, convention)
    for file in sorted(root.glob("videos/**/*.mp4")):
        yield from wrong_video("lerobot", file, info["features"][file.parent.parent.name]["info"])


def _fields(wanted: Mapping[str, Any]) -> list[str]:
    return sorted([*wanted, "splits", "features"])


def _wrong_splits(splits: Mapping[str, str], episodes: int, validation: float) -> Iterator[Fault]:
    """Compare the ranges of the splits with the episodes, all of which are in one of them, ``train`` first."""
    names = ["train", "val"] if validation else ["train"]
    ends = [tuple(int(end) for end in text.split(":")) for text in splits.values()]
    begins = [0, *(end for _, end in ends)]
    whole = [begin for begin, _ in ends] == begins[:-1] and begins[-1] == episodes and all(a < b for a, b in ends)
    if [*splits] != names or not whole:
        yield Fault("lerobot", None, f"splits is {dict(splits)}", f"{' and '.join(names)}, of 0 to {episodes} in all")


def _split_of(root: Path, episodes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Episode id to the name of its split."""
    splits = json.loads((root / "meta" / "info.json").read_text())["splits"]
    found: dict[str, str] = {}
    for name, text in splits.items():
        first, end = (int(number) for number in text.split(":"))
        found |= {one: name for one, row in episodes.items() if first <= row["episode_index"] < end}
    return found


def _wrong_files(root: Path, episodes: Mapping[str, Mapping[str, Any]], convention: Convention) -> Iterator[Fault]:
    """Compare the files that are there with those that the episodes name."""
    kinds = {"data": ".parquet", "meta/episodes": ".parquet"}
    if convention.frames == "video":
        kinds |= {f"videos/{view.lerobot_key}": ".mp4" for view in SCHEMA.views.values()}
    wanted = set()
    for row in episodes.values():
        for kind, suffix in kinds.items():
            place = PLACE.format(chunk_index=row[f"{kind}/chunk_index"], file_index=row[f"{kind}/file_index"])
            wanted.add(f"{kind}/{place}{suffix}")
    found = [file for folder in ("data", "videos", "meta/episodes") for file in (root / folder).rglob("*")]
    there = {file.relative_to(root).as_posix() for file in found if file.is_file()}
    yield from unlike("lerobot", {"files": sorted(there)}, {"files": sorted(wanted)})


def _wrong_statistics(root: Path, convention: Convention, extras: Sequence[Extra]) -> Iterator[tuple[str, str]]:
    """Compare ``meta/stats.json`` with all steps, and for frames with the statistics of the episodes."""
    stored = json.loads((root / "meta" / "stats.json").read_text())
    yield from wrong_in_dataset(stored, sorted(root.glob("data/**/*.parquet")), convention.columns(extras))
    for view in SCHEMA.views.values():
        column = view.lerobot_key
        names = [f"stats/{column}/{name}" for name in (*FIGURES, *QUANTILES)]
        tables = [pq.read_table(file, columns=names) for file in episode_files(root)]
        read = {name: np.array([value for table in tables for value in table[name].to_pylist()]) for name in names}
        of_episodes = {name.rpartition("/")[2]: values.reshape(len(values), -1) for name, values in read.items()}
        yield from wrong_frames(column, stored[column], of_episodes)


def _samples(root: Path, data: LeRobotDataset) -> Iterator[tuple[str, str]]:
    """Episode and column where lerobot hands out something else than ``copy_of`` at the sampled steps."""
    episodes = sorted(rows(root).values(), key=lambda row: row["episode_index"])
    for place in sorted({round(k) for k in np.linspace(0, len(episodes) - 1, BY_LEROBOT)}):
        row = episodes[place]
        copy = copy_of(root, row, ())
        for step in sampled(row["length"]):
            item = data[row["dataset_from_index"] + step]
            for name in MOTION:
                key = getattr(SCHEMA, name).lerobot_key
                if not np.array_equal(item[key].numpy(), getattr(copy.episode, name)[step]):
                    yield row[EPISODE_ID], key
            for view, spec in SCHEMA.views.items():
                # lerobot hands out floats in [0, 1], channels first.
                shown = item[spec.lerobot_key].numpy().transpose(1, 2, 0) * 255
                if np.abs(shown - copy.frame(view, step)).max() > SAME_LEVELS:
                    yield row[EPISODE_ID], spec.lerobot_key
            if item["task"] != copy.instructions[step]:
                yield row[EPISODE_ID], "task"


@contextmanager
def local_only(cache: Path) -> Iterator[None]:
    """Keep the copies that ``datasets`` makes of what lerobot reads out of the home folder, and lerobot off the hub."""
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
    """Before huggingface-hub 1, a thread keeps a session, which stays on or off the hub as it was made."""
    getattr(huggingface_hub, "configure_http_backend", lambda: None)()
