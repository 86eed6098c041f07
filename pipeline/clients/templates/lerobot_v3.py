"""A LeRobot v3.0 dataset under the names of openpi's LIBERO policies, read with PyArrow and PyAV alone.

openpi pins a lerobot of early 2025, which cannot open version 3.0 (Physical-Intelligence/openpi#706).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, SupportsIndex

import av
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

VIEWS = {"image": "observation.images.image", "wrist_image": "observation.images.image2"}
VECTORS = {"state": "observation.state", "actions": "action"}


def trained_on(info: Mapping[str, Any]) -> list[tuple[str, str, int]]:
    """Which rows to train on, as PyArrow filters them: those of the split ``train`` of ``meta/info.json``."""
    first, end = info["splits"]["train"].split(":")
    return [("episode_index", ">=", int(first)), ("episode_index", "<", int(end))]


class LeRobotV3:
    """Random access to the steps that a dataset has to train on, with the actions that follow each.

    Args:
        root: the dataset's folder.
        horizon: actions to return with each step, its own first; past the episode's end the last is repeated.
    """

    def __init__(self, root: Path, horizon: int) -> None:
        info = json.loads((root / "meta" / "info.json").read_text())
        if info["features"][VIEWS["image"]]["dtype"] != "video":
            raise ValueError(f"{root} has images; export it with export.lerobot.frames: video")
        columns = ["episode_index", "frame_index", "task_index", *VECTORS.values()]
        table = pq.read_table(root / "data", columns=columns, filters=trained_on(info))
        tasks = pq.read_table(root / "meta" / "tasks.parquet")
        # pandas writes an index without a name, as lerobot 0.4 has it, and one with a name, as 0.6 has it.
        prompt = "task" if "task" in tasks.column_names else "__index_level_0__"
        episodes = pq.read_table(root / "meta" / "episodes").sort_by("episode_index")
        self._root, self._horizon, self._fps, self._video_path = root, horizon, info["fps"], info["video_path"]
        self._prompts = {row["task_index"]: row[prompt] for row in tasks.to_pylist()}
        self._vectors = {
            name: np.stack(table[column].to_numpy()).astype(np.float32) for name, column in VECTORS.items()
        }
        self._episode, self._frame, self._task = (table[name].to_numpy() for name in columns[:3])
        self._videos = {
            view: episodes.select(
                [f"videos/{key}/{field}" for field in ("chunk_index", "file_index", "from_timestamp")]
            ).to_pydict()
            for view, key in VIEWS.items()
        }

    def __len__(self) -> int:
        return len(self._episode)

    def __getitem__(self, index: SupportsIndex) -> dict[str, Any]:
        """``image`` and ``wrist_image`` (H, W, 3) uint8, ``state`` (8,), ``actions`` (horizon, 7), ``prompt``."""
        step = range(len(self))[index]
        episode = self._episode[step]
        end = np.searchsorted(self._episode, episode, side="right")
        ahead = np.minimum(np.arange(step, step + self._horizon), end - 1)
        return {
            **{view: self._pixels(view, episode, self._frame[step] / self._fps) for view in VIEWS},
            "state": self._vectors["state"][step],
            "actions": self._vectors["actions"][ahead],
            "prompt": self._prompts[self._task[step]],
        }

    def _pixels(self, view: str, episode: int, time_s: float) -> NDArray[np.uint8]:
        chunk, file, start_s = (column[episode] for column in self._videos[view].values())
        path = self._video_path.format(video_key=VIEWS[view], chunk_index=chunk, file_index=file)
        return _frame(self._root / path, start_s + time_s, 0.5 / self._fps)


@lru_cache(maxsize=16)
def _open(path: Path) -> Any:
    """An open video, once in each process."""
    return av.open(str(path))


def _frame(path: Path, time_s: float, tolerance_s: float) -> NDArray[np.uint8]:
    container = _open(path)
    stream = container.streams.video[0]
    container.seek(int(time_s / stream.time_base), stream=stream)
    for frame in container.decode(stream):
        if abs(frame.time - time_s) < tolerance_s:
            return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
        if frame.time > time_s:
            break
    raise ValueError(f"{path}: no frame at {time_s:.3f} s")
