"""Time that a run takes: from what it renders, and from how fast this machine simulates and renders.

The constants are CPU times of one core of the machine that ``REFERENCE`` describes: of frames 0.8 of what
``benchmarks/frame_cost.py`` gave beside other work, so that they sum up to the stage of ``configs/starter.yaml``; the
others are of the stages of that run and of one of 988 episodes. No larger run was compared yet.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.axes import AXES, PhysicsPerturbation, RenderPerturbation, axes_of
from pipeline.config import ComputeConfig, Config
from pipeline.episode_schema import SCHEMA
from pipeline.libero import bddl
from pipeline.libero.bddl import Arena
from pipeline.run.machine import Speed
from pipeline.types import Task
from pipeline.validation.disk import Amounts, lengths

REFERENCE = Speed(step_s=0.0033, frame_s=0.093)
"""Of the machine of the figures below, by ``machine.trial``: one step again and again, and a frame without savings."""

FRAME_S: dict[Arena, tuple[float, float]] = {
    "tabletop": (0.032, 0.041),
    "floor": (0.022, 0.034),
    "kitchen": (0.041, 0.033),
    "living_room": (0.024, 0.047),
    "study": (0.028, 0.035),
}
"""A frame of the agent view and of the wrist view, with savings."""
SHADOWS_S, SHADOWS = 0.13, 0.4
"""What shadows add to a frame, and the share of the light episodes that have them."""
ENCODE_S = 0.004
"""Of a frame: the JPEG, and the noise where there is some. A GPU does not make it quicker."""
SCENE_S, STEP_S, TRIES = 2.2, 0.007, 1.4
"""A trajectory besides its control steps; a step; how often steps are run, as tracking follows a replay that missed."""
RLDS_S, LEROBOT_S, VALIDATE_S = 0.0004, 0.003, 0.0013
"""A step of an episode in the exports and in ``validate``."""
FIXED_S = 100.0
"""Starting the stages, previews, sheets and report: on the clock, however many workers there are."""


def needed_s(config: Config, speed: Speed) -> dict[str, float]:
    """Stage to the seconds that one core takes for it; under ``rest``, seconds that more cores do not make fewer.

    Every planned episode counts as kept, and so does the clean twin of every demonstration. Savings are taken to gain
    as much as on the reference machine.

    Args:
        config: of the run.
        speed: of the machine.
    """
    tasks = lengths(config.demos)
    amounts, frame_s = Amounts.of(tasks, config.plan), _frame_s(tasks, speed)
    trajectories, frames_s = amounts.twins, amounts.twin_steps * sum(view_s + ENCODE_S for view_s in frame_s)
    for name, episodes in config.plan.episodes.items():
        kinds = [AXES[axis].draws[0] for axis in axes_of(name)]
        trajectories += episodes * any(issubclass(kind, PhysicsPerturbation) for kind in kinds)
        for view, view_s in zip(SCHEMA.views, frame_s, strict=True):
            here = [kind for kind in kinds if view in kind.views]
            rendered = any(issubclass(kind, PhysicsPerturbation | RenderPerturbation) for kind in here)
            shadows_s = SHADOWS_S * SHADOWS * ("light" in axes_of(name)) * speed.frame_s / REFERENCE.frame_s
            frames_s += episodes * amounts.mean_steps * (rendered * (view_s + shadows_s) + ENCODE_S * bool(here))
    processor = speed.step_s / REFERENCE.step_s
    formats = {"rlds": RLDS_S, "lerobot": LEROBOT_S, "lerobot_v21": LEROBOT_S}
    return {
        "replay": processor * trajectories * (SCENE_S + TRIES * amounts.mean_steps * STEP_S),
        "render": frames_s,
        "export": processor * amounts.steps * sum(formats[name] for name in config.export.formats),
        "validate": processor * amounts.steps * VALIDATE_S * len(config.export.formats),
        "rest": processor * FIXED_S,
    }


def in_words(stages_s: Mapping[str, float], workers: int) -> str:
    """Some stages' time on the clock, with so many cores."""
    times_s = {stage: s if stage == "rest" else s / workers for stage, s in stages_s.items()}
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


def _frame_s(tasks: Mapping[Task, list[int]], speed: Speed) -> list[float]:
    """To render a frame of each view: the mean over all demonstrations."""
    weights = [sum(steps) for steps in tasks.values()]
    drawn_s = np.average([FRAME_S[bddl.read(task.bddl_file).arena] for task in tasks], axis=0, weights=weights)
    return [float(s) * speed.frame_s / REFERENCE.frame_s for s in drawn_s]
