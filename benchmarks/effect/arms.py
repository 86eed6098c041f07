"""Which of a run's episodes an arm is trained on, and those as a LeRobot dataset of small frames."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import pyarrow.parquet as pq

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import replaced, scratch
from pipeline.images.jpeg import decode, resized
from pipeline.seeding import digest

EpisodeRow = Mapping[str, Any]
"""An episode of ``meta/provenance.parquet``."""


def provenance(root: Path) -> list[dict[str, Any]]:
    """The episodes of a LeRobot dataset that a run made."""
    rows: list[dict[str, Any]] = pq.read_table(root / "meta" / "provenance.parquet").to_pylist()
    return rows


def chosen(rows: Iterable[EpisodeRow], perturbed_by: Sequence[str]) -> list[EpisodeRow]:
    """An arm's episodes: of each task as many as it has clean twins.

    These are the perturbed episodes of the arm, and clean twins in place of those that are missing: first twins of
    demonstrations that no perturbed episode was made from.

    Args:
        perturbed_by: axes or combinations, as in ``plan.episodes``.

    Raises:
        PipelineError: when a task has more perturbed episodes than twins.
    """
    by_task: dict[tuple[str, str], list[EpisodeRow]] = defaultdict(list)
    for row in rows:
        by_task[row["suite"], row["task"]].append(row)
    arm: list[EpisodeRow] = []
    for (suite, task), episodes in sorted(by_task.items()):
        twins = [row for row in episodes if row["axis"] == "clean"]
        perturbed = [row for row in episodes if row["axis"] in perturbed_by]
        if len(perturbed) > len(twins):
            raise PipelineError(
                f"{len(perturbed)} perturbed episodes and {len(twins)} clean ones; all arms have as many as there are "
                "clean ones",
                where=f"{suite}/{task}",
                remedy="lower plan.episodes in the run's configuration, or give it more demonstrations",
            )
        used = {row["demo_id"] for row in perturbed}
        twins.sort(key=lambda row: (row["demo_id"] in used, digest("twin", row["episode_id"])))
        arm += perturbed + twins[: len(twins) - len(perturbed)]
    return sorted(arm, key=lambda row: int(row["episode_index"]))


def write_small(source: Path, rows: Sequence[EpisodeRow], out: Path, frame_px: int) -> None:
    """Write episodes of a dataset as a LeRobot dataset with square frames of ``frame_px``, stored as images.

    Decoding a small image costs a training step next to nothing; decoding video costs more than the step.

    Args:
        source: root of the run's LeRobot dataset, frames stored as images.
        rows: the episodes, of ``meta/provenance.parquet``.
        out: root of the new dataset; complete once it is there. ``meta/provenance.parquet`` has its episodes.
    """
    # lerobot takes seconds to import.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from pipeline.formats.lerobot_read import local_only

    views = [view.lerobot_key for view in SCHEMA.views.values()]
    vectors = [SCHEMA.state, SCHEMA.action]
    frame = {"dtype": "image", "shape": (frame_px, frame_px, 3), "names": list(SCHEMA.frame.names)}
    features = {key: dict(frame) for key in views} | {
        vector.lerobot_key: {"dtype": vector.dtype, "shape": vector.shape, "names": list(vector.names)}
        for vector in vectors
    }
    episodes = pq.read_table(source / "meta" / "episodes", columns=["episode_index", "tasks"]).to_pylist()
    instructions = {episode["episode_index"]: episode["tasks"][0] for episode in episodes}
    data = pyarrow.dataset.dataset(source / "data")
    with replaced(out) as unfinished, scratch(out.parent / f".cache_{out.name}") as cache, local_only(cache):
        small = LeRobotDataset.create(
            out.name, SCHEMA.fps_hz, features, root=unfinished, robot_type=SCHEMA.robot_type, use_videos=False
        )
        for row in rows:
            number = int(row["episode_index"])
            its_own = pyarrow.dataset.field("episode_index") == number
            for step in data.to_table(list(features), filter=its_own).to_pylist():
                small.add_frame(
                    {key: resized(decode(step[key]["bytes"]), frame_px, frame_px) for key in views}
                    | {vector.lerobot_key: np.array(step[vector.lerobot_key], vector.dtype) for vector in vectors}
                    | {"task": instructions[number]}
                )
            small.save_episode()
        small.finalize()
        renumbered = [{**row, "episode_index": number} for number, row in enumerate(rows)]
        pq.write_table(pyarrow.Table.from_pylist(renumbered), unfinished / "meta" / "provenance.parquet")
