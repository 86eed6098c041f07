"""File of demonstrations as LIBERO publishes it, with a scene that was recorded on another machine."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from conftest import Once

from pipeline.libero import assets, hdf5
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.types import Task

TASK = find_task("libero_goal", "turn_on_the_stove")
NAME = f"{TASK.suite}/{TASK.name}"

# Asset folders in the scenes of the published dataset, without the author's name.
LIBERO = "/home/author/workspace/libero-dev/chiliocosm/assets"
ROBOSUITE = "/Users/author/workspace/robosuite-master/robosuite/models/assets"

# robosuite picks its GL back end on import, once for a process: leave the choice to the tests that render.
MAKE_SCENE = """
import sys
from pipeline.physics.environment import Environment
from pipeline.libero.tasks import find_task
print(Environment(find_task(*sys.argv[1:])).place_fixtures(seed=0))
"""


def run(code: str, *arguments: object, **environment: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", code, *map(str, arguments)]
    env = os.environ | {"MUJOCO_GL": "disable"} | environment
    done = subprocess.run(command, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_scene(folder: Path) -> None:
    (folder / "scene.xml").write_text(run(MAKE_SCENE, TASK.suite, TASK.name))


def scene_here(once: Once) -> str:
    """Return a real scene of LIBERO, with the asset paths of this machine."""
    return (once("stove_scene", write_scene) / "scene.xml").read_text()


def as_published(scene: str) -> str:
    """Convert a scene to that of the published files: asset paths of another machine, one of them with ``..``."""
    libero, robosuite = assets._roots()["/libero/assets/"], assets._roots()["/robosuite/models/assets/"]
    foreign = scene.replace(str(libero), LIBERO).replace(str(robosuite), ROBOSUITE)
    return foreign.replace(f"{LIBERO}/textures/", f"{LIBERO}/scenes/../textures/", 1)


def recording(model_file: str, steps: int = 12, seed: int = 0) -> hdf5.Recording:
    demo = StarterSource().index([TASK]).entries[0]
    start = StarterSource().load(demo.demo_id)
    rng = np.random.default_rng(seed)
    states = start.init_state + np.cumsum(rng.normal(scale=0.01, size=(steps, len(start.init_state))), axis=0)
    states[:, 0] = start.init_state[0] + 0.05 * np.arange(steps)
    pose = np.zeros((steps, 9))
    images = rng.integers(0, 256, (steps, 8, 8, 3), dtype=np.uint8)
    return hdf5.Recording(
        start.actions[:steps], states, pose, model_file, {"agentview_rgb": images, "ee_pos": pose[:, 2:5]}
    )


def write_eleven(root: Path, model_file: str) -> Path:
    """Write 11 demonstrations of one task in a published file's layout."""
    hdf5.write(file_in(root), TASK, (recording(model_file, seed=seed) for seed in range(11)))
    return root


def file_in(root: Path, task: Task = TASK) -> Path:
    return root / task.suite / f"{task.name}_demo.hdf5"
