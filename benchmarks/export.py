"""Rates and peak memory of the exports on synthetic episodes; the last printed line is JSON."""

import argparse
import json
import math
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from pipeline import seeding
from pipeline.episode_schema import SCHEMA
from pipeline.formats.base import Format
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.lerobot import LeRobot, LeRobotConfig
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.run.export import export
from pipeline.types import Episode, Geometry, Jpeg

PER_PART = 150
"""Episodes in a part of the large configurations."""

WRITERS = ("rlds", "lerobot_video", "lerobot_images")


def synthetic_episode(episode_id: str, steps: int) -> Episode:
    """Generate an episode of a camera gliding over a smooth texture; a frame has about 20 kB, as LIBERO's frames."""
    rng = seeding.rng("benchmark", episode_id)
    height, width, _ = SCHEMA.frame.shape
    noise = rng.integers(0, 256, (height + 64, width + 64, 3), np.uint8)
    texture = cv2.addWeighted(cv2.GaussianBlur(noise, (0, 0), 16), 8, cv2.GaussianBlur(noise, (0, 0), 1.5), 0.6, -980)

    def frame(t: int) -> Jpeg:
        dy, dx = (32 + 30 * np.array([np.sin(t / 40), np.cos(t / 40)])).astype(int)
        shown = texture[dy:, dx:][:height, :width]
        return Jpeg(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())

    frames = [frame(t) for t in range(steps)]
    defaults = dict[str, Any](string="", int64=0, float32=0.0)
    provenance = {column: defaults[dtype] for column, dtype in SCHEMA.provenance.items()}
    return Episode(
        episode_id=episode_id,
        frames=dict.fromkeys(SCHEMA.views, frames),
        state=rng.normal(size=(steps, *SCHEMA.state.shape)).astype(np.float32),
        joint_state=rng.normal(size=(steps, *SCHEMA.joint_state.shape)).astype(np.float32),
        action=rng.uniform(-1, 1, (steps, *SCHEMA.action.shape)).astype(np.float32),
        action_absolute=rng.normal(size=(steps, *SCHEMA.action_absolute.shape)).astype(np.float32),
        instruction="put the black bowl on the plate",
        provenance=provenance | {"episode_id": episode_id},
        geometry=dict.fromkeys(SCHEMA.views, Geometry(np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32))),
    )


def replay(episode_id: str, source: Episode) -> Episode:
    """Copy an episode under another id; generating episodes must not slow the exports."""
    provenance = {**source.provenance, "episode_id": episode_id}
    return Episode(**{**vars(source), "episode_id": episode_id, "provenance": provenance})


def pool_map(pool: ProcessPoolExecutor, fn: Callable[[Any], Any], items: Sequence[Any], description: str) -> list[Any]:
    """Apply ``fn`` to all items on a process pool, as the pipeline's parallel map."""
    return list(pool.map(fn, items))


def dataset(writer: str, out: Path, parts: int) -> Format[Any]:
    if writer == "rlds":
        return Rlds(out, RldsConfig(name="benchmark", shards=parts))
    frames: Literal["video", "images"] = "video" if writer == "lerobot_video" else "images"
    return LeRobot(out, LeRobotConfig(name="benchmark", shards=parts, frames=frames))


def measure(writer: str, episodes: int, steps: int, workers: int) -> dict[str, float]:
    """Measure rates and memory of one writer.

    Peaks cover a process's whole life; therefore each writer runs in a new process.
    """
    ids = [f"synthetic-{k:05d}" for k in range(episodes)]
    load = partial(replay, source=synthetic_episode(ids[0], steps))
    parts = max(workers, math.ceil(episodes / PER_PART))
    with tempfile.TemporaryDirectory() as out:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            run = partial(pool_map, pool)
            target = dataset(writer, Path(out), parts)

            def write(ids: Sequence[str]) -> int:
                """Write the dataset; return its bytes."""
                facts = EpisodeFacts("libero_spatial", "synthetic", "", load(ids[0]).instruction, steps)
                export(target, Episodes(dict.fromkeys(ids, facts), load), run)
                return sum((target.folder / file).stat().st_size for file in target.record().files)

            write(ids[:workers])  # imports, in every worker
            start = time.perf_counter()
            size = write(ids)
            seconds = time.perf_counter() - start
        # The peak of the largest child that has ended, and of this process, in KiB.
        worker = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        parent = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return {
            "episodes_per_s": round(episodes / seconds, 2),
            "steps_per_s": round(steps * episodes / seconds, 1),
            "mb_per_s": round(size / 1e6 / seconds, 2),
            "mb_per_episode": round(size / 1e6 / episodes, 3),
            "peak_worker_mb": round(worker * 1024 / 1e6),
            "peak_parent_mb": round(parent * 1024 / 1e6),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    result: dict[str, Any] = {
        **vars(arguments),
        "frame_bytes": len(synthetic_episode("synthetic-00000", 1).frames["image"][0]),
    }
    for writer in WRITERS:
        with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
            result[writer] = fresh.submit(measure, writer, *vars(arguments).values()).result()
    print(json.dumps(result))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
