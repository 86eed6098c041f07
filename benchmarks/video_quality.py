"""Difference of the videos from stored and from rendered frames: of demonstrations, or of a finished run.

    nice -n 10 python benchmarks/video_quality.py [--tasks SUITE/TASK ...]
    nice -n 10 python benchmarks/video_quality.py --run configs/starter.yaml

The script measures both views without noise, and the agent view with each noise at its strongest. With ``--run``, it
compares all videos of a finished run with the stored frames, by axis. The last line is the result as JSON.
"""

import argparse
import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
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
from pipeline.config import DemosConfig, PlanConfig, RenderConfig, ReplayConfig, load
from pipeline.episode_schema import SCHEMA
from pipeline.formats.lerobot.video import Video
from pipeline.images.jpeg import decode, encode, to_policy
from pipeline.libero.demonstrations import DemoEntry
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.rendering.renderer import Renderer
from pipeline.run.replay_job import ReplayJob
from pipeline.run.run import Run
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
    parser.add_argument("--run", type=Path, metavar="CONFIG", help="configuration of a finished run with LeRobot v3.0")
    arguments = parser.parse_args()
    if arguments.run:
        print(json.dumps(_of_run(Run(load(arguments.run)))))
        return
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


def _of_run(run: Run) -> dict[str, Any]:
    """Return the decibels of a run's videos to its stored frames: mean, worst and the share below 37, by axis."""
    rows = [row for row in run.manifest if row["kept"]]
    rows.sort(key=lambda row: row["lerobot_episode_index"])
    root, episodes = run.dataset("lerobot").root, run.episode_loader()
    played = {view: _played(root / "videos" / SCHEMA.views[view].lerobot_key) for view in SCHEMA.views}
    measured: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        episode = episodes(row["episode_id"])
        for view, video_frames in played.items():
            for stored, video_frame in zip(episode.frames[view], video_frames, strict=False):
                measured[row["axis"]].append(cv2.PSNR(decode(stored), video_frame))
    measured["all"] = list(chain.from_iterable(measured.values()))
    result = {}
    for axis, decibels in measured.items():
        below = round(float(np.mean(np.array(decibels) < 37.0)), 4)
        mean, worst = round(float(np.mean(decibels)), 2), round(min(decibels), 2)
        result[axis] = {"frames": len(decibels), "mean": mean, "worst": worst, "below 37 dB": below}
    return result


def _played(folder: Path) -> Iterator[Frame]:
    """Yield the frames of all videos of a view, in the order of the episodes."""
    for path in sorted(folder.rglob("*.mp4")):
        with av.open(str(path)) as video:
            for frame in video.decode(video=0):
                yield frame.to_ndarray(format="rgb24")


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
