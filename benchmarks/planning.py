"""How long a plan of the paper's size takes: 22,400 perturbed episodes drawn on the starter demonstrations."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

from pipeline import plan, testset
from pipeline.axes import Axes
from pipeline.axes.camera import CameraAxis
from pipeline.axes.language import LanguageAxis
from pipeline.axes.noise import NoiseAxis
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig


def main() -> None:
    axes = Axes(camera=CameraAxis(), noise=NoiseAxis(), language=LanguageAxis())
    config = PlanConfig(seed=1, axes=axes, episodes={"camera": 11_200, "noise": 9_600, "language": 1_600})
    start = time.perf_counter()
    index = DemosConfig().index()
    test = testset.load()
    indexed = time.perf_counter()
    rows = plan.make(index.entries, config, ReplayConfig(), test)
    drawn = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        plan.write(rows, Path(folder) / "plan.parquet")
        size = (Path(folder) / "plan.parquet").stat().st_size
    written = time.perf_counter()
    perturbed = sum(row.role == "perturbed" for row in rows)
    figures = {
        "rows": len(rows),
        "perturbed": perturbed,
        "index_s": round(indexed - start, 2),
        "draw_s": round(drawn - indexed, 2),
        "write_s": round(written - drawn, 2),
        "rows_per_s": round(len(rows) / (written - start)),
        "file_mb": round(size / 1e6, 2),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
