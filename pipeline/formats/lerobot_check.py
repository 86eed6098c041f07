"""A LeRobot dataset as a whole, and samples of it, as lerobot reads them."""

import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import av
import datasets
import huggingface_hub
import huggingface_hub.constants
import numpy as np
from datasets.exceptions import DatasetsError
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from pipeline.episode_schema import MOTION, SCHEMA
from pipeline.formats.base import Row
from pipeline.formats.lerobot_columns import EPISODE_ID
from pipeline.formats.lerobot_read import QUANTILES, copy_of, readable, rows, vectors, wrong_statistics
from pipeline.formats.read_back import Fault, sampled

BY_LEROBOT = 8
"""So many episodes are read by lerobot too, spread over the dataset."""

SAME_LEVELS = 1
"""Largest difference of a decoded frame between PyAV and what lerobot decodes with."""


def check(root: Path, cache: Path, kept: Mapping[str, Row], columns: Mapping[str, Any]) -> Iterator[tuple[str, Fault]]:
    """What lerobot finds: frame rate, robot, the columns' names and shapes, as many episodes as were kept, and in
    samples the very numbers and frames that ``lerobot_read.read`` finds; the videos' own frame rate; and the statistics
    of actions and states, computed again.

    Raises:
        PipelineError: when the dataset cannot be opened.
    """
    # lerobot decodes through it, and each worker would print that it will go.
    warnings.filterwarnings("ignore", message="The video decoding", category=UserWarning)
    with readable(root, also=(DatasetsError,)):
        with local_only(cache):
            data = LeRobotDataset(root.name, root=root, video_backend="pyav")
        meta = data.meta
        read: dict[str, Any] = {"fps": meta.fps, "robot_type": meta.robot_type}
        wanted: dict[str, Any] = {"fps": SCHEMA.fps_hz, "robot_type": SCHEMA.robot_type}
        for key, spec in columns.items():
            has = meta.features.get(key, {})
            read[key] = (has.get("dtype"), tuple(has.get("shape", ())), tuple(has.get("names") or ()))
            wanted[key] = (spec["dtype"], tuple(spec["shape"]), tuple(spec["names"] or ()))
        for file in sorted(root.glob("videos/**/*.mp4")):
            name = str(file.relative_to(root))
            with av.open(str(file)) as video:
                read[name], wanted[name] = float(video.streams.video[0].average_rate or 0), SCHEMA.fps_hz
        statistics = json.loads((root / "meta" / "stats.json").read_text())
        files = sorted(root.glob("data/**/*.parquet"))
        wrong: list[tuple[str, str]] = []
        for name in MOTION:  # One after another, as each takes memory.
            key = getattr(SCHEMA, name).lerobot_key
            wrong += wrong_statistics(statistics, [vectors(file, [key]) for file in files], QUANTILES)
        stored = (meta.total_episodes, data.num_frames)
        strangers = sorted(rows(root).keys() - kept.keys())
        samples = list(_samples(root, data))
    for key, expected in wanted.items():
        if read[key] != expected:
            yield "format", Fault("lerobot", None, f"{key} is {read[key]}", f"{expected}")
    for what, expected in wrong:
        yield "format", Fault("lerobot", None, what, expected)
    for episode_id, key in samples:
        yield "format", Fault("lerobot", episode_id, f"lerobot reads another {key}", "what its files hold")
    wanted_steps = sum(row["steps"] for row in kept.values())
    if stored != (len(kept), wanted_steps):
        found = f"{stored[0]} episodes of {stored[1]} steps"
        yield "ids", Fault("lerobot", None, found, f"{len(kept)} of {wanted_steps}")
    # One that is missing is told where it is looked for.
    for episode_id in strangers:
        yield "ids", Fault("lerobot", episode_id, "is in the dataset", "kept episodes alone")


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
