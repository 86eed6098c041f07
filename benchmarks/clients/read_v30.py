"""Comparison of a LeRobot v3.0 dataset, as the installed lerobot reads it, with its files.

The script runs in lerobot's environment, which has neither this project nor its packages. ROOT is a dataset:

    ENV/bin/python benchmarks/clients/read_v30.py ROOT

Every number of every step is compared, and the labels of every episode. All views, texts (such as maps) and language
columns are compared at the first, the middle and the last step of each episode. ``read_depth.py`` compares depth as
video. The last printed line is JSON: the steps, the columns and the largest differences.
"""

import io
import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

LABELS = ("subtask_starts", "subtask_texts", "rewrites")


def frames_of(root: Path, episode: dict[str, Any], view: str) -> list[Any]:
    """Decode all frames (H, W, 3) of an episode's view from its video."""
    place = {"video_key": view, "chunk_index": episode[f"videos/{view}/chunk_index"]}
    place["file_index"] = episode[f"videos/{view}/file_index"]
    info = json.loads((root / "meta" / "info.json").read_text())
    first = round(episode[f"videos/{view}/from_timestamp"] * info["fps"])
    frames = []
    with av.open(str(root / info["video_path"].format(**place))) as video:
        for number, frame in enumerate(video.decode(video=0)):
            if first <= number < first + episode["length"]:
                frames.append(frame.to_ndarray(format="rgb24"))
    return frames


def main(root: Path) -> None:
    dataset = LeRobotDataset(root.name, root=root, video_backend="pyav")
    info = json.loads((root / "meta" / "info.json").read_text())
    rows: list[dict[str, Any]] = []
    for file in sorted(root.glob("data/*/*.parquet")):
        rows += pq.read_table(file).to_pylist()
    tasks = {row["task_index"]: row["task"] for row in tables(root / "meta" / "tasks.parquet")}
    specs = info["features"]
    columns = [name for name, spec in specs.items() if spec["dtype"] == "float32" and name != "timestamp"]
    texts = [name for name, spec in specs.items() if spec["dtype"] in ("string", "language")]
    views = [name for name in specs if name.startswith("observation.images.") and not name.endswith("_depth")]
    furthest = dict.fromkeys((*columns, *views), 0.0)

    numbers = dataset.hf_dataset.with_format("numpy")
    for name in columns:
        read = np.stack([np.asarray(row[name]) for row in numbers.select_columns([name])])
        written = np.array([row[name] for row in rows], np.float32)
        furthest[name] = float(np.abs(read - written).max())

    for episode in tables(root / "meta" / "episodes"):
        length, first = episode["length"], episode["dataset_from_index"]
        labels = dataset.meta.episodes[episode["episode_index"]]
        assert all(list(labels[name]) == list(episode[name]) for name in LABELS)
        written_frames = {}
        if specs[views[0]]["dtype"] == "video":
            written_frames = {view: frames_of(root, episode, view) for view in views}
        for step in (0, length // 2, length - 1):
            item, row = dataset[first + step], rows[first + step]
            assert item["task"] == tasks[row["task_index"]]
            assert all(item[name] == row[name] for name in texts)
            for view in views:
                if written_frames:
                    frame = written_frames[view][step]
                else:
                    frame = np.array(Image.open(io.BytesIO(row[view]["bytes"])))
                apart = np.abs(item[view].numpy().transpose(1, 2, 0) * 255 - frame)
                furthest[view] = max(furthest[view], float(apart.max()))
    figures = {"lerobot": version("lerobot"), "root": root.name, "steps": len(rows), "equal": [*texts, *LABELS]}
    print(json.dumps({**figures, "largest_difference": furthest}))


def tables(path: Path) -> list[dict[str, Any]]:
    """Read a Parquet file, or all files of a folder in order."""
    rows: list[dict[str, Any]] = []
    for file in [path] if path.is_file() else sorted(path.glob("*/*.parquet")):
        rows += pq.read_table(file).to_pylist()
    return rows


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
