"""Rates of both writers on synthetic episodes; the last line printed is JSON."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import seeding
from pipeline.episode_schema import SCHEMA
from pipeline.types import Episode
from pipeline.writers import lerobot, rlds


def synthetic_episode(episode_id: str, steps: int) -> Episode:
    """Frames of a camera gliding over a smooth texture, about 20 kB a frame as LIBERO's are."""
    rng = seeding.rng("benchmark", episode_id)
    height, width, _ = SCHEMA.frame.shape
    noise = rng.integers(0, 256, (height + 64, width + 64, 3), np.uint8)
    texture = cv2.addWeighted(cv2.GaussianBlur(noise, (0, 0), 16), 8, cv2.GaussianBlur(noise, (0, 0), 1.5), 0.6, -980)

    def frame(t: int) -> bytes:
        dy, dx = (32 + 30 * np.array([np.sin(t / 40), np.cos(t / 40)])).astype(int)
        return cv2.imencode(".jpg", texture[dy:, dx:][:height, :width], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    frames = [frame(t) for t in range(steps)]
    return Episode(
        episode_id=episode_id,
        frames=dict.fromkeys(SCHEMA.views, frames),
        state=rng.normal(size=(steps, *SCHEMA.state.shape)).astype(np.float32),
        joint_state=rng.normal(size=(steps, *SCHEMA.joint_state.shape)).astype(np.float32),
        action=rng.uniform(-1, 1, (steps, *SCHEMA.action.shape)).astype(np.float32),
        instruction="put the black bowl on the plate",
        provenance={column: episode_id if column == "episode_id" else column for column in SCHEMA.provenance},
    )


def replay(episode_id: str, source: Episode) -> Episode:
    """The same content under another id, so that making episodes costs the writers nothing."""
    return Episode(
        **{**vars(source), "episode_id": episode_id, "provenance": {**source.provenance, "episode_id": episode_id}}
    )


def pool_map(pool: ProcessPoolExecutor, fn: Callable[[Any], Any], items: Sequence[Any], description: str) -> list[Any]:
    """The pipeline's parallel map on a process pool."""
    return list(pool.map(fn, items))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    ids = [f"synthetic-{k:05d}" for k in range(arguments.episodes)]
    load = partial(replay, source=synthetic_episode(ids[0], arguments.steps))
    result: dict[str, Any] = {**vars(arguments), "frame_bytes": len(load(ids[0]).frames["image"][0])}
    with tempfile.TemporaryDirectory() as out, ProcessPoolExecutor(arguments.workers, get_context("spawn")) as pool:
        run = partial(pool_map, pool)
        writers: dict[str, Callable[[list[str]], Any]] = {
            "rlds": lambda ids: rlds.write(ids, load, Path(out), name="benchmark", shards=arguments.workers, run=run),
            "lerobot": lambda ids: lerobot.write(
                ids, load, Path(out) / "lerobot", repo_id="local/benchmark", parts=arguments.workers, run=run
            ),
        }
        for name, write in writers.items():
            write(ids[: arguments.workers])  # imports, in every worker
            start = time.perf_counter()
            report = write(ids)
            seconds = time.perf_counter() - start
            result[name] = {
                "episodes_per_s": round(len(ids) / seconds, 2),
                "mb_per_s": round(report.bytes / 1e6 / seconds, 2),
                "mb_per_episode": round(report.bytes / 1e6 / len(ids), 3),
            }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
