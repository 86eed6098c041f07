"""Real demonstrations, cut short to the last second of three human ones, in LIBERO's HDF5."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pipeline.config import ReplayConfig
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Demo, Task, Trajectory

STOVE = find_task("libero_goal", "turn_on_the_stove")


PLATE = find_task("libero_goal", "push_the_plate_to_the_front_of_the_stove")


BOWL = find_task("libero_goal", "put_the_bowl_on_the_plate")


MILK = find_task("libero_object", "pick_up_the_milk_and_place_it_in_the_basket")


SHORT = {STOVE: 12, BOWL: 11, MILK: 18}
"""Number of last actions that are kept; the goal is reached within them."""


def starter_demo(task: Task) -> Demo:
    return StarterSource().demonstration(task)


def loaded_whole(folder: Path) -> dict[Task, Trajectory]:
    store = TrajectoryStore(folder)
    return {task: store.load(task.name) for task in SHORT}


def replay_whole(folder: Path) -> None:
    for task in SHORT:
        environment = Environment(task)
        trajectory = replay(environment, starter_demo(task), task.name, ReplayConfig())
        assert trajectory.verdict.kept, f"{task.name}: {trajectory.verdict.reason}"
        TrajectoryStore(folder).save(trajectory)
        environment.close()


def write_short_demos(whole: Mapping[Task, Trajectory], root: Path) -> None:
    for task, steps in SHORT.items():
        trajectory = whole[task]
        states = trajectory.states[-steps - 1 : -1]
        good = hdf5.Recording(
            actions=trajectory.actions[-steps:],
            states=states,
            robot_states=states[:, :9],
            model_file=trajectory.model_xml,
            obs={},
        )
        recordings = [good]
        if task == MILK:
            waiting = good.actions.copy()
            waiting[:, :6], waiting[:, 6] = 0.05, 1.0
            recordings.append(replace(good, actions=waiting))
        hdf5.write(root / task.suite / f"{task.name}_demo.hdf5", task, recordings)
