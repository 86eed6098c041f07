"""Measures of an OpenGL device: frames per second of 1 to 16 processes, frames compared with Mesa's, ours with naive.

    python benchmarks/gpu.py [--seconds 20] [--processes 1 2 4 8 16]

The script replays one demonstration. Then each number of processes renders its states with both cameras for some
seconds, JPEG included. It renders without savings, and with the savings that this device may use. Processes start
together. A process with Mesa's software renders some states again for the comparison. `against_naive.py` follows with
one task. The script takes about four minutes on a GPU.

The last line is JSON: the device, the differences from Mesa's frames, and the ratio naive : ours. For each number of
processes it has frames per second, and CPU time and memory of a process.
"""

import argparse
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from replayed_twin import replayed_twin

from pipeline import gl
from pipeline.config import RenderConfig, load
from pipeline.images.jpeg import encode, to_policy
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.savings import PLAIN, why_plain
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Frame

CAMERAS = ("agentview", "robot0_eye_in_hand")
TASK = "libero_goal/put_the_bowl_on_the_plate"
COMPARED = 20
"""States whose frames are compared with Mesa's."""

SOFTWARE = {"LIBGL_ALWAYS_SOFTWARE": "1", "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
"""Environment variables of a process that renders with Mesa."""

_ready: Barrier


@dataclass(frozen=True)
class Rendered:
    """Work of one process: frames in the seconds, CPU seconds, peak memory, and the reason for rendering plainly."""

    frames: int
    seconds: float
    cpu_s: float
    peak_gb: float
    plain: str | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    arguments = parser.parse_args()
    choice = gl.choose()
    print(choice, flush=True)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        name = replayed_twin(load(Path("configs/starter.yaml")), TASK, folder).trajectory_id
        ways: dict[str, dict[int, Any]] = {}
        for way, plain in (("plain", "1"), ("with savings", "")):
            os.environ[PLAIN] = plain
            ways[way] = {count: _by(count, folder, name, arguments.seconds) for count in arguments.processes}
            print(way, ways[way], flush=True)
        del os.environ[PLAIN]
        here, mesa = _in_new_process(folder, name), _in_new_process(folder, name, **SOFTWARE)
    away = np.abs(here.astype(int) - mesa)
    naive = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("against_naive.py")), "--tasks", TASK],
        check=True,
        capture_output=True,
        text=True,
    )
    figures = {
        "device": choice.device,
        "cores": os.cpu_count(),
        "frames_per_s": ways,
        "compared_frames": len(away),
        "same_frames": int((away.reshape(len(away), -1) == 0).all(axis=1).sum()),
        "mean_levels": round(float(away.mean()), 4),
        "pixels_off_by_more_than_8": round(float((away.max(axis=-1) > 8).mean()), 5),
        "against_naive": json.loads(naive.stdout.splitlines()[-1]),
    }
    print(json.dumps(figures))


def _by(count: int, folder: Path, name: str, seconds: float) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(count)
    with ProcessPoolExecutor(count, mp_context=context, initializer=_take, initargs=(barrier,)) as pool:
        done = list(pool.map(_render, [folder] * count, [name] * count, [seconds] * count))
    cpu_s, frames = sum(process.cpu_s for process in done), sum(process.frames for process in done)
    return {
        "frames_per_s": round(sum(process.frames / process.seconds for process in done), 1),
        "cpu_ms_per_frame": round(1000 * cpu_s / frames, 2),
        "peak_gb": round(max(process.peak_gb for process in done), 2),
        "plain_because": done[0].plain,
    }


def _take(barrier: Barrier) -> None:
    global _ready
    _ready = barrier


def _render(folder: Path, name: str, seconds: float) -> Rendered:
    trajectory = TrajectoryStore(folder).load(name)
    with closing(Renderer(trajectory.model_xml)) as renderer:
        for camera in CAMERAS:
            renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
            renderer.frame(camera)
        plain = why_plain()
        _ready.wait()
        start, start_cpu, frames = time.perf_counter(), time.process_time(), 0
        while (spent := time.perf_counter() - start) < seconds:
            step = frames // 2 % len(trajectory.actions)
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            for camera in CAMERAS:
                encode(to_policy(renderer.frame(camera)), RenderConfig().jpeg_quality)
                frames += 1
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return Rendered(frames, spent, time.process_time() - start_cpu, peak_gb, plain)


def _in_new_process(folder: Path, name: str, **environment: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Render ``COMPARED`` states plainly in a new process; return the frames (N, H, W, 3)."""
    file = folder / "frames.npy"
    code = f"from gpu import _save; _save({str(folder)!r}, {name!r})"
    folders = (str(Path(__file__).parent), os.environ.get("PYTHONPATH"))
    path = os.pathsep.join(filter(None, folders))
    environment |= {PLAIN: "1", "PYTHONPATH": path}
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | environment)
    frames: np.ndarray[Any, np.dtype[np.uint8]] = np.load(file)
    return frames


def _save(folder: str, name: str) -> None:
    trajectory = TrajectoryStore(Path(folder)).load(name)
    frames: list[Frame] = []
    with closing(Renderer(trajectory.model_xml)) as renderer:
        for step in np.linspace(0, len(trajectory.actions) - 1, COMPARED).round().astype(int):
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            frames += [renderer.frame(camera) for camera in CAMERAS]
    np.save(Path(folder) / "frames.npy", np.stack(frames))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
