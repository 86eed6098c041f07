"""Starts at resets: the yield of each task's replays, and the spread of the starts compared with LIBERO's own.

    nice -n 10 python benchmarks/reset_starts.py FOLDER [--starts 3] [--tasks 'libero_goal/*']

Each start is tried once, as in ``demos expand --starts reset``. The trajectories stay in FOLDER; a stopped run resumes
from them. LIBERO's own starts are the 50 initial states of each task. The last line is the result as JSON.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig
from pipeline.evaluation.tasks import libero_states
from pipeline.libero.starts import HOME_RAD
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.quality import smoothness
from pipeline.planning import plan
from pipeline.run.expand import REPLAY, ROUGH
from pipeline.run.replay_stage import Replays
from pipeline.scenes.compiled import compile_for_physics
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Floats, Task, Trajectory

SEED = 39


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--starts", type=int, default=3, help="starts of each demonstration; at least 2")
    parser.add_argument("--tasks", nargs="+", default=list(DemosConfig().tasks))
    parser.add_argument("--workers", type=int, help="number of workers; one for each core by default")
    arguments = parser.parse_args()
    demos = DemosConfig(tasks=tuple(arguments.tasks))
    planned = {entry.task: plan.resets([entry], arguments.starts, 0.0, SEED, REPLAY) for entry in demos.index().entries}
    store = TrajectoryStore(arguments.folder)
    with runner(ComputeConfig(workers=arguments.workers), Path("data")) as run:
        Replays(demos, REPLAY, store, run).complete([*chain.from_iterable(planned.values())])
    yields, ours, libero = {}, [], []
    for task, rows in planned.items():
        human, *replays = [store.load(row.trajectory_id) for row in rows]
        yields[f"{task.suite}/{task.name}"] = _yield(human, replays, task)
        starts = np.stack([replay.states[0] for replay in replays])
        ours.append(_Starts.of(starts, human.model_xml))
        libero.append(_Starts.of(libero_states(task), human.model_xml))
    lengths: list[float] = []
    for task_yield in yields.values():
        lengths += [steps / task_yield["human_steps"] for steps in task_yield["steps"]]
    percentiles = {f"{share}%": round(float(np.percentile(lengths, share)), 2) for share in (0, 10, 50, 90, 100)}
    result = {
        "kept": sum(task_yield["kept"] for task_yield in yields.values()),
        "tried": sum(task_yield["tried"] for task_yield in yields.values()),
        "starts": {"reset": _spread(ours), "libero": _spread(libero)},
        "length_of_human": percentiles,
        "tasks": yields,
    }
    print(json.dumps(result))


def _yield(human: Trajectory, replays: list[Trajectory], task: Task) -> dict[str, Any]:
    """Count the outcomes of a task's replays.

    A replay is kept if it reaches the goal and moves about as smoothly as the human.
    """
    reasons: Counter[str] = Counter()
    steps = []
    for replay in replays:
        reason = replay.verdict.reason
        if replay.verdict.kept:
            measured, reference = smoothness(replay, task), smoothness(human, task)
            rough = any(measured[name] > limit * reference[name] for name, limit in ROUGH.items())
            reason = "not_smooth" if rough else reason
        reasons[reason] += 1
        if reason == "kept":
            steps.append(len(replay.actions))
    counts = {"tried": len(replays), "kept": reasons.pop("kept", 0), "steps": steps, "human_steps": len(human.actions)}
    return counts | {"human": human.verdict.reason, "dropped": dict(reasons)}


class _Starts(NamedTuple):
    """Starts of a task: arm's joints from home (N, 7) in rad, objects' places (N, objects, 2) in m."""

    joints_rad: Floats
    objects_m: Floats

    @classmethod
    def of(cls, states: Floats, model_xml: str) -> _Starts:
        model = compile_for_physics(model_xml)
        free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        # A flattened state begins with the time, and its positions with the arm's seven joints.
        return cls(states[:, 1:8] - HOME_RAD, states[:, 1 + free[:, None] + [0, 1]])


def _spread(of_tasks: list[_Starts]) -> dict[str, float]:
    """Return standard deviations of the joints about home, and of an object's x and y about their mean in its task."""
    joints = np.concatenate([starts.joints_rad for starts in of_tasks])
    norms = np.linalg.norm(joints, axis=1)
    variances = np.concatenate([starts.objects_m.var(axis=0, ddof=1).ravel() for starts in of_tasks])
    return {
        "starts": len(joints),
        "joint_std_rad": round(float(np.sqrt((joints**2).mean())), 4),
        "joints_from_home_least_rad": round(float(norms.min()), 3),
        "joints_from_home_median_rad": round(float(np.median(norms)), 3),
        "joints_from_home_most_rad": round(float(norms.max()), 3),
        "object_std_m": round(float(np.sqrt(variances.mean())), 4),
    }


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
