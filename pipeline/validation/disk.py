"""Disk that a run takes: from the lengths of its demonstrations, and from what a step was measured to take.

The sizes are rounded up from four runs of one demonstration of 90 steps (``benchmarks/disk.py``, see
``docs/cost.md``). Episodes are counted as long as their demonstrations.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.axes import AXES, PhysicsPerturbation, RenderPerturbation, axes_of
from pipeline.config import Config, DemosConfig, PlanConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import HDF5Source, StarterSource
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.types import Extra, Task

JPEG_KB = {50: 6.0, 80: 10.0, 90: 15.0, 95: 20.0, 100: 35.0}
"""A frame, by quality."""
MAP_KB: dict[Extra, float] = {"depth": 31.0, "segmentation": 3.0}
"""A view of one step."""
POSES_KB, MOTION_KB = 0.7, 0.5
"""One step: object poses; state, action and what else is beside the frames."""
VIDEO_KB = 15.0
"""One step in LeRobot, both views as video."""
IN_TEXT = 1.2
"""How much larger LeRobot's columns of base64 are than the PNG files in them."""
TRAJECTORY_KB, STATE_KB = 100.0, 1.2
"""A trajectory, and each step of it."""
EPISODE_KB = 50.0
"""An episode in a dataset, however short."""
RUN_MB = 100.0
"""A run's sheets, report and tables."""

PUBLISHED = 50
"""Demonstrations of a task in LIBERO's files."""


def needed_mb(config: Config) -> dict[str, float]:
    """Folder of a run to the megabytes that it takes.

    Every planned episode counts as kept, and so does the clean twin of every demonstration.
    """
    amounts, views, extras = Amounts.of(lengths(config.demos), config.plan), len(SCHEMA.views), config.render.extras
    twins, planned, twin_steps, mean_steps = amounts
    steps, episodes = amounts.steps, twins + planned
    own = _own(config.plan)
    frame_kb = float(np.interp(config.render.jpeg_quality, list(JPEG_KB), list(JPEG_KB.values())))
    map_kb = sum(MAP_KB[extra] for extra in extras if extra in MAP_KB)
    poses_kb = POSES_KB if "object_poses" in extras else 0.0
    lerobot = config.export.lerobot
    shown_kb = VIDEO_KB if lerobot and lerobot.frames == "video" else views * frame_kb + MOTION_KB
    needed_kb = {
        "trajectories": (twins + own.trajectories) * (TRAJECTORY_KB + STATE_KB * mean_steps),
        "frames": (views * twin_steps + own.frames * mean_steps) * frame_kb
        + (views * twin_steps + own.maps * mean_steps) * map_kb
        + steps * (poses_kb + MOTION_KB),
        "rlds": steps * (views * (frame_kb + map_kb) + poses_kb + MOTION_KB) + episodes * EPISODE_KB,
        "lerobot": steps * (shown_kb + IN_TEXT * views * map_kb + poses_kb) + episodes * EPISODE_KB,
    }
    if (older := config.export.lerobot_v21) is not None:
        shown_kb = VIDEO_KB if older.convention == "ipec" else views * frame_kb + MOTION_KB
        needed_kb["lerobot_v21"] = steps * (shown_kb + IN_TEXT * views * map_kb + poses_kb) + episodes * EPISODE_KB
    left_out = {"rlds", "lerobot"} - set(config.export.formats)
    return {folder: kb / 1e3 for folder, kb in needed_kb.items() if folder not in left_out} | {"sheets": RUN_MB}


def free_gb(folder: Path) -> float:
    """What is free where a folder is, or would be made."""
    there = next(one for one in (folder.absolute(), *folder.absolute().parents) if one.exists())
    return shutil.disk_usage(there).free / 1e9


class Amounts(NamedTuple):
    """How many twins and planned episodes a run has, the steps of all twins, and those of a planned episode: the mean,
    as episodes are spread evenly over the tasks."""

    twins: int
    planned: int
    twin_steps: int
    mean_steps: float

    @classmethod
    def of(cls, tasks: Mapping[Task, list[int]], plan: PlanConfig) -> Amounts:
        """By the steps of each demonstration of each task (see ``lengths``)."""
        found = list(tasks.values())
        mean_steps = float(np.mean([np.mean(task) for task in found]))
        return cls(sum(map(len, found)), sum(plan.episodes.values()), sum(map(sum, found)), mean_steps)

    @property
    def steps(self) -> float:
        return self.twin_steps + self.planned * self.mean_steps


class _Own(NamedTuple):
    """What planned episodes have that their twins do not: trajectories, and views of frames and of maps."""

    trajectories: float
    frames: float
    maps: float


def _own(plan: PlanConfig) -> _Own:
    trajectories = frames = maps = 0.0
    for name, episodes in plan.episodes.items():
        kinds = [AXES[axis].draws[0] for axis in axes_of(name)]
        physics = [kind for kind in kinds if issubclass(kind, PhysicsPerturbation)]
        cameras = [kind for kind in kinds if issubclass(kind, RenderPerturbation) and kind.sees_otherwise]
        trajectories += episodes * (1 + plan.reserve) * bool(physics)
        frames += episodes * len({view for kind in kinds for view in kind.views})
        maps += episodes * len({view for kind in (*physics, *cameras) for view in kind.views})
    return _Own(trajectories, frames, maps)


def lengths(demos: DemosConfig) -> dict[Task, list[int]]:
    """Steps of each demonstration, by task; where no file is there yet, those of LIBERO's as long as the starter's.

    Raises:
        PipelineError: when only own tasks are asked for, and none has a demonstration.
    """
    starter = StarterSource()
    if demos.root is None:
        return {entry.task: [entry.steps] for entry in starter.index(select_tasks(demos.tasks)).entries}
    source = HDF5Source(demos.root)
    found = {task: source.lengths(task)[: demos.per_task] for task in select_tasks(demos.tasks)}
    if not any(found.values()):
        of_libero = [task for task in found if task.suite in SUITES]
        found = {task: [len(starter.of(task).actions)] * (demos.per_task or PUBLISHED) for task in of_libero}
    if not any(found.values()):
        raise PipelineError(
            "none of your own tasks has a demonstration",
            where=demos.root,
            expected="<suite>/<task>_demo.hdf5 there",
            remedy="see `python -m pipeline demos check`",
        )
    return {task: steps for task, steps in found.items() if steps}
