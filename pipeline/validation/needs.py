"""Disk and time that a run takes, from the lengths of its demonstrations and from measured costs of a step.

Every planned episode counts as kept, and so does the clean twin of every demonstration. Each has as many steps as its
demonstration.

Sizes are rounded up from four runs of one demonstration of 90 steps (``benchmarks/disk.py``, see ``docs/cost.md``).
Times of frames and replays come from ``run/work_time.py``. The other times are CPU times of one core of the same
machine. They were measured with the stages of ``configs/starter.yaml``, and of a run of 1,004 episodes, which took 19 %
less time than estimated.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.axes import AXES, Perturbation, PhysicsPerturbation, RenderPerturbation, axes_of
from pipeline.compute_config import ComputeConfig
from pipeline.config import Config, DemosConfig, PlanConfig
from pipeline.errors import PipelineError
from pipeline.export_config import CLEAN
from pipeline.formats.base import StepSizes
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS
from pipeline.libero.demonstrations import HDF5Source, StarterSource
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.run.machine import Speed
from pipeline.run.work_time import ENCODE_S, REFERENCE, replay_s
from pipeline.types import Extra, Task

JPEG_KB = {50: 6.0, 80: 10.0, 90: 15.0, 95: 20.0, 100: 35.0}
"""A frame, by quality."""
MAP_KB: dict[Extra, float] = {"depth": 31.0, "segmentation": 3.0}
"""A view of one step."""
POSES_KB, BOXES_KB, MOTION_KB = 0.7, 0.8, 0.5
"""One step: object poses; boxes of both views; state, action and all other columns except the frames."""
TRAJECTORY_KB, STATE_KB = 100.0, 1.2
"""A trajectory, and each step of it."""
EPISODE_KB = 50.0
"""An episode in a dataset, however short."""
RUN_MB = 100.0
"""A run's sheets, report and tables."""

PUBLISHED = 50
"""Demonstrations of a task in LIBERO's files."""

SHADOWS_S, SHADOWS = 0.13, 0.4
"""Time that shadows add to a frame, and the share of the light episodes that have them."""
MAPS_S = 0.045
"""Depth, segmentation, boxes, or all of them, of a view of one step: a second rendering, and PNG files."""
FIXED_S = 100.0
"""Wall-clock time of starting the stages, previews, sheets and report, with any number of workers."""
IN_TURN = ("rest", "GPU")
"""Work whose time is not that of one core. A GPU renders for one process at a time."""

H200_FRAME_S = 0.0015
"""Time for a plain frame by one process that waits for it, as ``Speed.frame_s``: 2.16 ms with JPEG and state
(``benchmarks/gpu.py``), which take 0.66 ms."""
SHARING, H200_FRAMES_PER_S = (2, 4, 8), (853, 1228, 2118)
"""Processes that share an H200, and its frames per second: in flight for up to 2, in layers for more. 16 get as many
as 8."""


def needed_mb(config: Config) -> dict[str, float]:
    """Estimate the megabytes that each folder of a run takes."""
    amounts, content = Amounts.of(lengths(config.demos), config.plan), config.render.content
    views = len(content.views)
    twins, _, twin_steps, mean_steps = amounts
    episodes, steps = _exported(config, amounts)
    # Trajectories, and views of frames and of maps, that planned episodes do not share with their clean twins.
    trajectories = frames = maps = 0.0
    for number, kinds in _planned(config.plan):
        physics = any(issubclass(kind, PhysicsPerturbation) for kind in kinds)
        trajectories += number * (1 + config.plan.reserve) * physics
        frames += number * _changed_views(kinds, content.views)
        maps += number * _changed_views([kind for kind in kinds if _seen_otherwise(kind)], content.views)
    frame_kb = content.area * float(np.interp(config.render.jpeg_quality, list(JPEG_KB), list(JPEG_KB.values())))
    map_kb = content.area * sum(MAP_KB[extra] for extra in content.extras if extra in MAP_KB)
    poses_kb = POSES_KB * ("object_poses" in content.extras) + BOXES_KB * ("boxes" in content.extras)

    needed_kb = {
        "trajectories": (twins + trajectories) * (TRAJECTORY_KB + STATE_KB * mean_steps),
        "frames": (views * twin_steps + frames * mean_steps) * frame_kb
        + (views * twin_steps + maps * mean_steps) * map_kb
        + amounts.steps * (poses_kb + MOTION_KB),
    }
    sizes = StepSizes(frame_kb, map_kb, poses_kb, MOTION_KB)
    for dataset in config.export.datasets(config.run_folder, content):
        needed_kb[dataset.name] = steps * dataset.step_kb(sizes) + episodes * EPISODE_KB
    return {folder: kb / 1e3 for folder, kb in needed_kb.items()} | {"sheets": RUN_MB}


def needed_s(config: Config, speed: Speed) -> dict[str, float]:
    """Estimate the seconds that one core takes for each stage; more cores do not reduce the entries in ``IN_TURN``.

    Rendering optimizations count as gaining as much as on the reference machine, and on a GPU as much as on an H200. A
    GPU takes equally long in every arena. Shadows and maps count as gaining nothing there.

    Args:
        config: configuration of the run.
        speed: measured speed of the machine.
    """
    tasks = lengths(config.demos)
    amounts = Amounts.of(tasks, config.plan)
    # Time to render a frame of each view: the mean over all demonstrations.
    arenas, weights = [bddl.read(task.bddl_file).arena for task in tasks], [sum(steps) for steps in tasks.values()]
    mean_frame_s = np.average([ARENAS[arena].frame_s for arena in arenas], axis=0, weights=weights)
    slower = speed.frame_s / REFERENCE.frame_s
    content = config.render.content
    agent_s, wrist_s = (float(s) * slower for s in mean_frame_s)
    # A further view takes about as long as the agent view.
    frame_s = [agent_s, wrist_s, *[agent_s] * (len(content.views) - 2)]
    if speed.gpus:
        frame_s = [_gpu_frame_s(config.compute, speed)] * len(content.views)
    maps_s = MAPS_S * slower * bool({*MAP_KB, "boxes"} & {*content.extras})
    trajectories, rendered_s = amounts.twins, amounts.twin_steps * sum(view_s + maps_s for view_s in frame_s)
    encoded_s = amounts.twin_steps * len(frame_s) * ENCODE_S
    for episodes, kinds in _planned(config.plan):
        trajectories += episodes * any(issubclass(kind, PhysicsPerturbation) for kind in kinds)
        for view, view_s in zip(content.views, frame_s, strict=True):
            here = [kind for kind in kinds if view in kind.views]
            rendered = any(issubclass(kind, PhysicsPerturbation | RenderPerturbation) for kind in here)
            mapped = any(_seen_otherwise(kind) for kind in here)
            shadows_s = SHADOWS_S * SHADOWS * any(_casts_shadows(kind) for kind in kinds) * slower
            rendered_s += episodes * amounts.mean_steps * (rendered * (view_s + shadows_s) + maps_s * mapped)
            encoded_s += episodes * amounts.mean_steps * ENCODE_S * bool(here)
    processor = speed.step_s / REFERENCE.step_s
    datasets = config.export.datasets(config.run_folder, content)
    _, exported_steps = _exported(config, amounts)
    return {
        "replay": trajectories * replay_s(amounts.mean_steps, speed),
        "render": encoded_s + rendered_s * (not speed.gpus),
        "export": processor * exported_steps * sum(dataset.step_s for dataset in datasets),
        "validate": processor * exported_steps * sum(dataset.validate_s for dataset in datasets),
        "rest": processor * FIXED_S,
    } | ({"GPU": rendered_s / speed.gpus} if speed.gpus else {})


def _gpu_frame_s(compute: ComputeConfig, speed: Speed) -> float:
    """Estimate the time that a GPU takes for a frame when all workers render.

    Only workers of this machine know how many of them share a GPU (``GlChoice.sharing``).
    """
    sharing = workers_of(compute) / speed.gpus if compute.cluster == "local" else 1
    return speed.frame_s / (H200_FRAME_S * float(np.interp(sharing, SHARING, H200_FRAMES_PER_S)))


def in_words(stages_s: Mapping[str, float], workers: int) -> str:
    """Format the wall-clock time of stages for a number of workers."""
    times_s = {stage: s if stage in IN_TURN else s / workers for stage, s in stages_s.items()}
    parts = ", ".join(f"{stage} {_time(s)}" for stage, s in times_s.items())
    return f"about {_time(sum(times_s.values()))} with {workers} worker{'s' * (workers > 1)}: {parts}"


def workers_of(compute: ComputeConfig) -> int:
    """Return the number of processes that work at the same time.

    A cluster elsewhere sets its own number; then the number of cores of this machine is returned.
    """
    from dask.system import CPU_COUNT

    return 1 if compute.cluster == "loop" else compute.workers or CPU_COUNT


def _time(seconds: float) -> str:
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


def free_gb(folder: Path) -> float:
    """Return the free space of the disk that has a folder, or would have it."""
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    return shutil.disk_usage(existing).free / 1e9


class Amounts(NamedTuple):
    """The size of a run.

    Attributes:
        twins: number of clean twins.
        planned: number of planned episodes.
        twin_steps: steps of all clean twins.
        mean_steps: mean steps of a planned episode; tasks count by their ``task_weights``.
    """

    twins: int
    planned: int
    twin_steps: int
    mean_steps: float

    @classmethod
    def of(cls, tasks: Mapping[Task, list[int]], plan: PlanConfig) -> Amounts:
        """Compute the size of a run from the steps of each demonstration of each task (see ``lengths``)."""
        steps = list(tasks.values())
        weights = [plan.task_weights.get(str(task), 1.0) for task in tasks]
        mean_steps = float(np.average([np.mean(task) for task in steps], weights=weights))
        return cls(sum(map(len, steps)), sum(plan.episodes.values()), sum(map(sum, steps)), mean_steps)

    @property
    def steps(self) -> float:
        return self.twin_steps + self.planned * self.mean_steps


def _planned(plan: PlanConfig) -> Iterator[tuple[int, list[type[Perturbation]]]]:
    """Yield, for each combination of axes, its wanted number of episodes, and the classes of its perturbations."""
    for name, episodes in plan.episodes.items():
        yield episodes, [AXES[axis].kinds[0] for axis in axes_of(name)]


def _changed_views(kinds: Iterable[type[Perturbation]], views: Iterable[str]) -> int:
    """Count the views that show at least one of the perturbations."""
    return len(set(views) & set(chain.from_iterable(kind.views for kind in kinds)))


def _casts_shadows(kind: type[Perturbation]) -> bool:
    return issubclass(kind, RenderPerturbation) and kind.casts_shadows


def _seen_otherwise(kind: type[Perturbation]) -> bool:
    """Return whether episodes have their own maps, because they show other surfaces or views than the clean twin."""
    return issubclass(kind, PhysicsPerturbation) or (issubclass(kind, RenderPerturbation) and kind.shows_other_surfaces)


def _exported(config: Config, amounts: Amounts) -> tuple[int, float]:
    """Estimate the episodes and steps of a dataset; only the axes of ``export.where`` are taken into account."""
    axes = config.export.where.axis if config.export.where else None
    planned = sum(number for name, number in config.plan.episodes.items() if axes is None or name in axes)
    twins, twin_steps = (amounts.twins, amounts.twin_steps) if axes is None or CLEAN in axes else (0, 0)
    return twins + planned, twin_steps + planned * amounts.mean_steps


def lengths(demos: DemosConfig) -> dict[Task, list[int]]:
    """Return the steps of each demonstration, by task.

    If no file exists yet, the demonstrations of LIBERO's tasks count as long as the starter set's.

    Raises:
        PipelineError: when only the user's own tasks are selected, and none has a demonstration.
    """
    starter = StarterSource()
    if demos.root is None:
        return {entry.task: [entry.steps] for entry in starter.index(select_tasks(demos.tasks)).entries}
    source = HDF5Source(demos.root)
    steps_of = {task: source.lengths(task)[: demos.per_task] for task in select_tasks(demos.tasks)}
    if not any(steps_of.values()):
        libero_tasks = [task for task in steps_of if task.suite in SUITES]
        steps_of = {
            task: [len(starter.demonstration(task).actions)] * (demos.per_task or PUBLISHED) for task in libero_tasks
        }
    if not any(steps_of.values()):
        raise PipelineError(
            "none of your own tasks has a demonstration",
            where=demos.root,
            expected="<suite>/<task>_demo.hdf5 there",
            remedy="see `python -m pipeline demos check`",
        )
    return {task: steps for task, steps in steps_of.items() if steps}
