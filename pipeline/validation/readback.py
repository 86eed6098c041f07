"""Episodes as a reader gets them: from RLDS without TensorFlow, from LeRobot through lerobot itself."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow.parquet as pq
from datasets.exceptions import DatasetsError
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.rendering.jpeg import decode
from pipeline.types import Frame
from pipeline.validation.shards import METADATA
from pipeline.writers.lerobot import local_only

UNREADABLE = (
    AssertionError,
    AttributeError,
    DatasetsError,
    IndexError,
    KeyError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What lerobot raises on files that are damaged, missing or do not belong together."""

MARKS = ("frame_index", "timestamp")
"""LeRobot's columns that tell steps apart."""


@dataclass(frozen=True)
class Copy:
    """An episode as a dataset hands it out.

    Attributes:
        dataset: ``rlds`` or ``lerobot``.
        motion: ``action``, ``state`` and ``joint_state``, each (T, D).
        instructions: one for each step.
        provenance: the columns of ``schemas/episode.json``.
        frames: (view, step) to the decoded frame, for ``sampled`` steps.
        marks: what else stands at each step, by the dataset's own names, each (T,).
    """

    dataset: str
    motion: Mapping[str, NDArray[Any]]
    instructions: Sequence[str]
    provenance: Mapping[str, str]
    frames: Mapping[tuple[str, int], Frame]
    marks: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.motion["action"])


@dataclass(frozen=True)
class LeRobotSet:
    """A LeRobot dataset opened.

    Attributes:
        data: as lerobot opens it.
        provenance: episode id to its row of ``meta/provenance.parquet``, ``episode_index`` included.
    """

    data: LeRobotDataset
    provenance: Mapping[str, Mapping[str, Any]]


def sampled(steps: int) -> list[int]:
    """The steps whose frames are decoded: the first, the middle and the last."""
    return sorted({0, steps // 2, steps - 1})


def from_rlds(steps: Mapping[str, NDArray[Any]]) -> Copy:
    """An episode of RLDS, from its columns (``shards.columns``)."""
    return Copy(
        dataset="rlds",
        motion={"action": steps["action"]} | {name: steps[f"observation/{name}"] for name in ("state", "joint_state")},
        instructions=[text.decode() for text in steps["language_instruction"]],
        provenance={column: steps[METADATA + column][0].decode() for column in SCHEMA.provenance},
        frames={
            (view, step): decode(steps[f"observation/{view}"][step])
            for view in SCHEMA.views
            for step in sampled(len(steps["action"]))
        },
        marks={name: steps[name] for name in ("is_first", "is_last", "is_terminal", "reward", "discount")},
    )


@lru_cache(maxsize=1)
def open_lerobot(root: Path, cache: Path) -> LeRobotSet:
    """Open a LeRobot dataset, without the hub.

    Args:
        root: of the dataset.
        cache: folder for the copies that ``datasets`` makes of what lerobot reads.

    Raises:
        UNREADABLE: any of them.
    """
    datasets.disable_progress_bars()
    # lerobot decodes through it, and each worker would print that it will go.
    warnings.filterwarnings("ignore", message="The video decoding", category=UserWarning)
    with local_only(cache):
        data = LeRobotDataset(root.name, root=root, video_backend="pyav")
    told = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    return LeRobotSet(data, {row["episode_id"]: row for row in told})


def from_lerobot(opened: LeRobotSet, episode_id: str) -> Copy:
    """An episode of LeRobot.

    Raises:
        UNREADABLE: any of them.
    """
    data = opened.data
    provenance = opened.provenance[episode_id]
    index = provenance["episode_index"]
    found = data.meta.episodes[index]
    start, stop = found["dataset_from_index"], found["dataset_to_index"]
    vectors = {"action": SCHEMA.action, "state": SCHEMA.state, "joint_state": SCHEMA.joint_state}
    # Without the images of every step, where they are not videos.
    plain = [*(spec.lerobot_key for spec in vectors.values()), "episode_index", "task_index", *MARKS]
    table = data.hf_dataset.select_columns(plain).with_format("numpy")[start:stop]
    if set(table["episode_index"].tolist()) != {index} or len(table["action"]) != found["length"]:
        raise ValueError(f"rows {start} to {stop} are not the {found['length']} steps of episode {index}")
    frames = {}
    for step in sampled(stop - start):
        item = data[start + step]
        for view, spec in SCHEMA.views.items():
            # lerobot hands out floats in [0, 1], channels first.
            pixels = np.rint(item[spec.lerobot_key].numpy().transpose(1, 2, 0) * 255)
            frames[view, step] = np.ascontiguousarray(pixels, np.uint8)
    return Copy(
        dataset="lerobot",
        motion={name: table[spec.lerobot_key] for name, spec in vectors.items()},
        instructions=[str(data.meta.tasks.iloc[task].name) for task in table["task_index"].tolist()],
        provenance=provenance,
        frames=frames,
        marks={name: table[name] for name in MARKS},
    )
