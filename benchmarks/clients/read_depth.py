"""Error of the depth that lerobot's own unchanged reader returns in metres, by distance, as JSON.

The script needs lerobot 0.6 or later (``pip install 'lerobot[dataset]==0.6.1'``), and nothing of this project. Both
folders are LeRobot datasets of one plan with the extra ``depth``: VIDEO of ``export.lerobot.depth: video``, TEXT of
``text``, whose PNG files have units of 0.1 mm:

    python benchmarks/clients/read_depth.py VIDEO TEXT
"""

import base64
import json
import sys
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset

CAMERAS = {"image": "agent", "image2": "wrist"}
"""Name of a view to the camera in the columns of text; further views have the same name in both."""

BOUNDS_M = (0.0, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 6.5536)


def main(video: Path, text: Path) -> None:
    dataset = LeRobotDataset(video.name, root=video, video_backend="pyav", depth_output_unit="m")
    ids = pq.read_table(video / "meta" / "provenance.parquet")["episode_id"].to_pylist()
    columns: dict[str, str] = {}  # column of a video to the column of the same maps as text
    for key in dataset.meta.depth_keys:
        view = key.removeprefix("observation.images.").removesuffix("_depth")
        columns[key] = f"camera.{CAMERAS.get(view, view)}.depth"
    names = ["episode_id", "frame_index", *columns.values()]
    stored = {}
    for file in sorted((text / "data").rglob("*.parquet")):
        for row in pq.read_table(file, columns=names).to_pylist():
            stored[row["episode_id"], row["frame_index"]] = row
    pixels, sums_m, largest_m = (
        defaultdict[int, int](int),
        defaultdict[int, float](float),
        defaultdict[int, float](float),
    )
    for index in range(len(dataset)):
        item = dataset[index]
        row = stored[ids[int(item["episode_index"])], int(item["frame_index"])]
        for read_column, column in columns.items():
            packed = np.frombuffer(base64.b64decode(row[column]), np.uint8)
            expected_m = np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED)) / 10_000
            errors_m = np.abs(item[read_column].numpy()[0] - expected_m)
            places = np.digitize(expected_m, BOUNDS_M) - 1
            for place in np.unique(places).tolist():
                within = errors_m[places == place]
                pixels[place] += within.size
                sums_m[place] += float(within.sum())
                largest_m[place] = max(largest_m[place], float(within.max()))
    total = sum(pixels.values())
    ranges = []
    for place in sorted(pixels):
        ranges.append(
            {
                "from_m": BOUNDS_M[place],
                "to_m": BOUNDS_M[place + 1],
                "share": round(pixels[place] / total, 4),
                "mean_mm": round(1000 * sums_m[place] / pixels[place], 3),
                "max_mm": round(1000 * largest_m[place], 3),
            }
        )
    print(json.dumps({"columns": columns, "maps": len(columns) * len(dataset), "ranges": ranges}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
