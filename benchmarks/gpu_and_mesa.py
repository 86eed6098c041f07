"""Comparison of a GPU's frames with those of Mesa's software, and of this pipeline with a naive one on a GPU.

    python benchmarks/gpu_and_mesa.py

The script replays one demonstration. A process with Mesa's software renders some of its states again.
`against_naive.py` follows with one task. The last line is JSON: the device, the differences from Mesa's frames, and the
ratio naive : ours.
"""

import json
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from replayed_twin import replayed_twin

from pipeline import gl
from pipeline.config import load
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.savings import PLAIN
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Frame

CAMERAS = ("agentview", "robot0_eye_in_hand")
TASK = "libero_goal/put_the_bowl_on_the_plate"
COMPARED = 20
"""States whose frames are compared with Mesa's."""

SOFTWARE = {"LIBGL_ALWAYS_SOFTWARE": "1", "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
"""Environment variables of a process that renders with Mesa."""


def main() -> None:
    choice = gl.choose()
    print(choice, flush=True)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        name = replayed_twin(load(Path("configs/starter.yaml")), TASK, folder).trajectory_id
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
        "compared_frames": len(away),
        "same_frames": int((away.reshape(len(away), -1) == 0).all(axis=1).sum()),
        "mean_levels": round(float(away.mean()), 4),
        "pixels_off_by_more_than_8": round(float((away.max(axis=-1) > 8).mean()), 5),
        "against_naive": json.loads(naive.stdout.splitlines()[-1]),
    }
    print(json.dumps(figures))


def _in_new_process(folder: Path, name: str, **environment: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Render ``COMPARED`` states plainly in a new process; return the frames (N, H, W, 3)."""
    file = folder / "frames.npy"
    code = f"from gpu_and_mesa import _save; _save({str(folder)!r}, {name!r})"
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
