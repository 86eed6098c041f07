"""Disk and time that a run takes: from the lengths of its demonstrations, and from what a step was measured to take.

Every planned episode counts as kept, and so does the clean twin of every demonstration; each is as long as its
demonstration.

Sizes are rounded up from four runs of one demonstration of 90 steps (``benchmarks/disk.py``, see ``docs/cost.md``).
Times of frames and replays are those of ``run/work_time.py``; the others are CPU times of one core of the same machine,
of the stages of ``configs/starter.yaml`` and of a run of 1,004 episodes, which took 19 % less time than they say.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.axes import AXES, Perturbation, PhysicsPerturbation, RenderPerturbation, axes_of
from pipeline.compute_config import ComputeConfig
from pipeline.config import Config, DemosConfig, PlanConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.export_config import CLEAN
from pipeline.libero import bddl
from pipeline.libero.demonstrations import HDF5Source, StarterSource
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.run.machine import Speed
from pipeline.run.work_time import ENCODE_S, FRAME_S, REFERENCE, replay_s
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

SHADOWS_S, SHADOWS = 0.13, 0.4
"""What shadows add to a frame, and the share of the light episodes that have them."""
MAPS_S = 0.045
"""Depth or segmentation, or both, of a view of one step: rendered once more, and PNG files."""
RLDS_S, LEROBOT_S, VALIDATE_S = 0.0004, 0.0015, 0.0006
"""A step of an episode in the exports and in ``validate``."""
FIXED_S = 100.0
"""Starting the stages, previews, sheets and report: on the clock, however many workers there are."""
IN_TURN = ("rest", "GPU")
"""What takes as long with more workers. A GPU renders for one process at a time: an H200 gave 770 frames a second to 4
as to 16 of them, and 600 to one (`benchmarks/gpu.py`)."""


def needed_mb(config: Config) -> dict[str, float]:
    """Folder of a run to the megabytes that it takes."""
    amounts, views, extras = Amounts.of(lengths(config.demos), config.plan), len(SCHEMA.views), config.render.extras
    twins, _, twin_steps, mean_steps = amounts
    export, (episodes, steps) = config.export, _exported(config, amounts)
    # What planned episodes have that their twins do not: trajectories, and views of frames and of maps.
    trajectories = frames = maps = 0.0
    for _, number, kinds in _planned(config.plan):
        physics = any(issubclass(kind, PhysicsPerturbation) for kind in kinds)
        trajectories += number * (1 + config.plan.reserve) * physics
        frames += number * len({view for kind in kinds for view in kind.views})
        maps += number * len({view for kind in kinds if _seen_otherwise(kind) for view in kind.views})
    frame_kb = float(np.interp(config.render.jpeg_quality, list(JPEG_KB), list(JPEG_KB.values())))
    map_kb = sum(MAP_KB[extra] for extra in extras if extra in MAP_KB)
    poses_kb = POSES_KB if "object_poses" in extras else 0.0

    def lerobot_kb(video: bool) -> float:
        shown_kb = VIDEO_KB if video else views * frame_kb + MOTION_KB
        return steps * (shown_kb + IN_TEXT * views * map_kb + poses_kb) + episodes * EPISODE_KB

    needed_kb = {
        "trajectories": (twins + trajectories) * (TRAJECTORY_KB + STATE_KB * mean_steps),
        "frames": (views * twin_steps + frames * mean_steps) * frame_kb
        + (views * twin_steps + maps * mean_steps) * map_kb
        + amounts.steps * (poses_kb + MOTION_KB),
    }
    if export.rlds is not None:
        needed_kb["rlds"] = steps * (views * (frame_kb + map_kb) + poses_kb + MOTION_KB) + episodes * EPISODE_KB
    if export.lerobot is not None:
        needed_kb["lerobot"] = lerobot_kb(export.lerobot.frames == "video")
    if export.lerobot_v21 is not None:
        needed_kb["lerobot_v21"] = lerobot_kb(export.lerobot_v21.convention == "ipec")
    return {folder: kb / 1e3 for folder, kb in needed_kb.items()} | {"sheets": RUN_MB}


def needed_s(config: Config, speed: Speed) -> dict[str, float]:
    """Stage to the seconds that one core takes for it; under ``IN_TURN``, seconds that more cores do not make fewer.

    Savings are taken to gain as much as on the reference machine. A GPU renders plainly and takes as long in every
    arena.

    Args:
        config: of the run.
        speed: of the machine.
    """
    tasks = lengths(config.demos)
    amounts = Amounts.of(tasks, config.plan)
    # To render a frame of each view: the mean over all demonstrations.
    arenas, weights = [bddl.read(task.bddl_file).arena for task in tasks], [sum(steps) for steps in tasks.values()]
    drawn_s = np.average([FRAME_S[arena] for arena in arenas], axis=0, weights=weights)
    slower = speed.frame_s / REFERENCE.frame_s
    frame_s = [speed.frame_s] * len(drawn_s) if speed.gpus else [float(s) * slower for s in drawn_s]
    maps_s = MAPS_S * slower * any(extra in MAP_KB for extra in config.render.extras)
    trajectories, rendered_s = amounts.twins, amounts.twin_steps * sum(view_s + maps_s for view_s in frame_s)
    encoded_s = amounts.twin_steps * len(frame_s) * ENCODE_S
    for axes, episodes, kinds in _planned(config.plan):
        trajectories += episodes * any(issubclass(kind, PhysicsPerturbation) for kind in kinds)
        for view, view_s in zip(SCHEMA.views, frame_s, strict=True):
            here = [kind for kind in kinds if view in kind.views]
            rendered = any(issubclass(kind, PhysicsPerturbation | RenderPerturbation) for kind in here)
            mapped = any(_seen_otherwise(kind) for kind in here)
            shadows_s = SHADOWS_S * SHADOWS * ("light" in axes) * slower
            rendered_s += episodes * amounts.mean_steps * (rendered * (view_s + shadows_s) + maps_s * mapped)
            encoded_s += episodes * amounts.mean_steps * ENCODE_S * bool(here)
    processor = speed.step_s / REFERENCE.step_s
    formats = {"rlds": RLDS_S, "lerobot": LEROBOT_S, "lerobot_v21": LEROBOT_S}
    _, exported_steps = _exported(config, amounts)
    return {
        "replay": trajectories * replay_s(amounts.mean_steps, speed),
        "render": encoded_s + rendered_s * (not speed.gpus),
        "export": processor * exported_steps * sum(formats[name] for name in config.export.formats),
        "validate": processor * exported_steps * VALIDATE_S * len(config.export.formats),
        "rest": processor * FIXED_S,
    } | ({"GPU": rendered_s / speed.gpus} if speed.gpus else {})


def in_words(stages_s: Mapping[str, float], workers: int) -> str:
    """Some stages' time on the clock, with so many cores."""
    times_s = {stage: s if stage in IN_TURN else s / workers for stage, s in stages_s.items()}
    parts = ", ".join(f"{stage} {_time(s)}" for stage, s in times_s.items())
    return f"about {_time(sum(times_s.values()))} with {workers} worker{'s' * (workers > 1)}: {parts}"


def workers_of(compute: ComputeConfig) -> int:
    """Processes that work at the same time; as many as this machine has cores, where a cluster elsewhere decides."""
    from dask.system import CPU_COUNT

    return 1 if compute.cluster == "loop" else compute.workers or CPU_COUNT


def _time(seconds: float) -> str:
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


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


def _planned(plan: PlanConfig) -> Iterator[tuple[list[str], int, list[type[Perturbation]]]]:
    """The axes that each wanted combination has, how many episodes are wanted of it, and the kinds of its draws."""
    for name, episodes in plan.episodes.items():
        axes = list(axes_of(name))
        yield axes, episodes, [AXES[axis].draws[0] for axis in axes]


def _seen_otherwise(kind: type[Perturbation]) -> bool:
    """Whether it has maps of its own: it shows other surfaces than the twin does, or from elsewhere."""
    return issubclass(kind, PhysicsPerturbation) or (issubclass(kind, RenderPerturbation) and kind.sees_otherwise)


def _exported(config: Config, amounts: Amounts) -> tuple[int, float]:
    """Episodes and steps of a dataset; of ``export.where`` the axes count alone."""
    axes = config.export.where.axis if config.export.where else None
    planned = sum(number for name, number in config.plan.episodes.items() if axes is None or name in axes)
    twins, twin_steps = (amounts.twins, amounts.twin_steps) if axes is None or CLEAN in axes else (0, 0)
    return twins + planned, twin_steps + planned * amounts.mean_steps


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
