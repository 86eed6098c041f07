"""Difference of the videos from stored and from rendered frames, on one demonstration of each given task.

    nice -n 10 python benchmarks/video_quality.py [--tasks SUITE/TASK ...]

The script measures both views without noise, and the agent view with each noise at its strongest. The last line is the
result as JSON.
"""

import argparse
import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from pipeline import seeding
from pipeline.axes import Axes
from pipeline.axes.noise import NoiseAxis
from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig, PlanConfig, RenderConfig, ReplayConfig
from pipeline.episode_schema import SCHEMA
from pipeline.formats.lerobot.video import Video
from pipeline.images.jpeg import decode, encode, to_policy
from pipeline.libero.demonstrations import DemoEntry
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.rendering.renderer import Renderer
from pipeline.run.replay_job import ReplayJob
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Frame

TASKS = (
    "libero_spatial/pick_up_the_black_bowl_on_the_cookie_box_and_place_it_on_the_plate",
    "libero_object/pick_up_the_orange_juice_and_place_it_in_the_basket",
    "libero_goal/put_the_bowl_on_the_plate",
    "libero_10/STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy",
)
COLUMNS = ("video to stored", "video to rendered", "stored to rendered")
STRONGEST = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    arguments = parser.parse_args()
    measured: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
    demos = DemosConfig(tasks=tuple(arguments.tasks), per_task=1)
    with runner(ComputeConfig(), Path("data")) as run:
        for rows in run(partial(_measured, demos=demos), demos.index().entries, "demonstrations"):
            for name, of_demo in rows.items():
                measured[name].append(of_demo)
    result = {name: _summary(np.vstack(rows)) for name, rows in measured.items()}
    headers = [f"{column} dB, mean (worst)" for column in COLUMNS]
    table = Table("frames", "", *headers, "video B", "stored B")
    for name, row in result.items():
        decibels = [f"{row[column]['mean']} ({row[column]['worst']})" for column in COLUMNS]
        table.add_row(name, str(row["frames"]), *decibels, str(row["video_bytes"]), str(row["stored_bytes"]))
    Console(width=150).print(table)
    print(json.dumps(result))


def _measured(entry: DemoEntry, demos: DemosConfig) -> dict[str, NDArray[np.float64]]:
    return {name: _measure(frames) for name, frames in _shown(entry, demos)}


def _shown(entry: DemoEntry, demos: DemosConfig) -> Iterator[tuple[str, list[Frame]]]:
    """Return name and frames of each measured view or noise, as a policy sees them and before they are encoded."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (twin,) = plan.make([entry], PlanConfig(seed=0, axes=Axes(), episodes={}), ReplayConfig(), TestSet(()))
        ReplayJob(twin, twin.trajectory_id, demos, ReplayConfig(), folder)()
        trajectory = TrajectoryStore(folder).load(twin.trajectory_id)
    raw: dict[str, list[Frame]] = {view: [] for view in SCHEMA.views}
    renderer = Renderer(trajectory.model_xml)
    for state, alpha in zip(trajectory.states[:-1], trajectory.site_alpha[:-1], strict=True):
        renderer.restore(state, alpha)
        for view, spec in SCHEMA.views.items():
            raw[view].append(renderer.frame(spec.camera))
    renderer.close()
    for view, frames in raw.items():
        yield f"{entry.task.suite} {view}", [to_policy(frame) for frame in frames]
    for component in ("motion", "gaussian_blur", "zoom", "fog", "glass"):
        effect = getattr(NoiseAxis(), component)[STRONGEST - 1]
        noisy: list[Frame] = []
        for step, frame in enumerate(raw["image"]):
            noisy.append(to_policy(effect.apply(frame, seeding.rng("video_quality", step))))
        yield f"image, {component} {STRONGEST}", noisy


def _measure(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Measure the decibels of ``COLUMNS`` and the bytes in video and store, for each frame: (T, 5)."""
    stored = [encode(frame, RenderConfig().jpeg_quality) for frame in frames]
    pixels = [decode(packed) for packed in stored]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "shown.mp4"
        with Video(path) as video_file:
            for step, frame in enumerate(pixels):
                video_file.add(frame, first=step == 0)
        with av.open(str(path)) as video:
            played = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        size = path.stat().st_size / len(frames)
    rows: list[tuple[float, ...]] = []
    for video_frame, kept, raw, packed in zip(played, pixels, frames, stored, strict=True):
        decibels = (cv2.PSNR(video_frame, kept), cv2.PSNR(video_frame, raw), cv2.PSNR(kept, raw))
        rows.append((*decibels, size, len(packed)))
    return np.array(rows)


def _summary(rows: NDArray[np.float64]) -> dict[str, Any]:
    decibels = {
        column: {"mean": round(float(values.mean()), 1), "worst": round(float(values.min()), 1)}
        for column, values in zip(COLUMNS, rows.T, strict=False)
    }
    video_bytes, stored_bytes = (round(float(mean)) for mean in rows[:, 3:].mean(axis=0))
    return {"frames": len(rows), **decibels, "video_bytes": video_bytes, "stored_bytes": stored_bytes}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
