"""Replay of demonstrations through LIBERO's environment at 20 Hz: a Demo in, a Trajectory out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import PhysicsPerturbation, RefusedError, from_json, of_layer
from pipeline.compute import Run
from pipeline.config import Config, DemosConfig, ReplayConfig
from pipeline.environment import Environment
from pipeline.judge import verdict
from pipeline.plan import Row, pending
from pipeline.store import TrajectoryStore
from pipeline.types import Demo, Floats, Scene, Task, Trajectory, Verdict

NOOP_NORM = 1e-4
"""Largest norm of the six pose deltas that still counts as no motion (OpenVLA's `regenerate_libero_dataset.py`)."""


def kept_actions(actions: Floats, noops: str) -> NDArray[np.bool_]:
    """Which actions are executed; the others are skipped without stepping the physics.

    A no-op moves the arm by less than ``NOOP_NORM`` and leaves the gripper as the last executed action had it
    (OpenVLA's rule; the very first action is a no-op by its motion alone).

    Args:
        actions: (T, 7).
        noops: ``drop``, ``trim_ends`` or ``keep``.

    Returns:
        (T,) mask.
    """
    if noops == "keep":
        return np.ones(len(actions), bool)
    still = np.linalg.norm(actions[:, :6], axis=1) < NOOP_NORM
    real = np.zeros(len(actions), bool)
    gripper: float | None = None
    for step, action in enumerate(actions):
        real[step] = not (still[step] and (gripper is None or action[6] == gripper))
        if real[step]:
            gripper = action[6]
    if noops == "trim_ends" and real.any():
        first, last = np.flatnonzero(real)[[0, -1]]
        real[first : last + 1] = True
    return real


def open_loop(
    environment: Environment,
    demo: Demo,
    trajectory_id: str,
    config: ReplayConfig,
    perturbations: Sequence[PhysicsPerturbation] = (),
) -> Trajectory:
    """Send the demonstration's actions as they were recorded, from its exact first state or a perturbed one."""
    mask = kept_actions(demo.actions, config.noops)
    actions = demo.actions[mask]
    scene = Scene(demo.model_xml or environment.place_fixtures(config.fixture_seed), demo.init_state)
    refusal: Verdict | None = None
    try:
        for perturbation in perturbations:
            scene = perturbation.apply(scene, demo)
    except RefusedError as refused:
        refusal, actions = Verdict(False, refused.reason), actions[:0]
    environment.restore(scene.model_xml, scene.state)
    states, alphas, succeeded = [environment.state], [environment.site_alpha], []
    for action in actions:
        environment.step(action)
        states.append(environment.state)
        alphas.append(environment.site_alpha)
        succeeded.append(environment.succeeded())
    return Trajectory(
        trajectory_id=trajectory_id,
        model_xml=scene.model_xml,
        states=np.stack(states),
        actions=actions,
        kept_mask=mask,
        site_alpha=np.stack(alphas),
        resolved=json.dumps(scene.resolved, sort_keys=True),
        verdict=refusal or verdict(np.stack(states), np.array(succeeded, bool)),
    )


@dataclass(frozen=True)
class ReplayJob:
    """One trajectory's replay, as it is sent to a worker."""

    trajectory_id: str
    demo_id: str
    perturbations: str
    demos: DemosConfig
    config: ReplayConfig
    folder: Path

    def __call__(self) -> Verdict:
        """Replay, judge and store; returns the verdict."""
        demo = self.demos.open().load(self.demo_id)
        physics = of_layer(from_json(self.perturbations), PhysicsPerturbation)
        trajectory = open_loop(_environment(demo.task), demo, self.trajectory_id, self.config, physics)
        TrajectoryStore(self.folder).save(trajectory)
        return trajectory.verdict


def replay_plan(rows: Sequence[Row], config: Config, folder: Path, run: Run) -> dict[str, Verdict]:
    """Replay what the plan needs and ``folder`` does not hold yet; reserves only where a candidate failed.

    Returns:
        Trajectory id to verdict, for every trajectory that was needed.
    """
    store = TrajectoryStore(folder)
    row_of = {row.trajectory_id: row for row in rows}
    verdicts: dict[str, Verdict] = {}
    while needed := pending(rows, verdicts):
        found = {trajectory_id: store.verdict(trajectory_id) for trajectory_id in needed}
        verdicts |= {trajectory_id: verdict for trajectory_id, verdict in found.items() if verdict is not None}
        # Ordered by task: a worker builds a task's environment once.
        jobs = [
            ReplayJob(
                trajectory_id,
                row_of[trajectory_id].demo_id,
                row_of[trajectory_id].perturbations,
                config.demos,
                config.replay,
                folder,
            )
            for trajectory_id in sorted(needed, key=lambda trajectory_id: row_of[trajectory_id].demo_id)
            if found[trajectory_id] is None
        ]
        if jobs:
            judged = run(ReplayJob.__call__, jobs, "replay")
            verdicts |= {job.trajectory_id: verdict for job, verdict in zip(jobs, judged, strict=True)}
    return verdicts


@lru_cache(maxsize=1)
def _environment(task: Task) -> Environment:
    """This process's environment for ``task``."""
    return Environment(task)
