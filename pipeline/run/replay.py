"""Replay what a plan needs and a folder does not hold yet, spread over workers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.axes import PhysicsPerturbation, from_json, of_layer
from pipeline.compute.pool import LOST, Expendable, Run
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.files import Edition, edition
from pipeline.physics.environment import shared
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay
from pipeline.planning.plan import Row, pending
from pipeline.scenes.noops import kept_actions
from pipeline.stores.trajectory_store import TrajectoryStore, verdicts_of
from pipeline.types import Scene, Trajectory, Verdict


@dataclass(frozen=True)
class ReplayJob:
    """One trajectory's replay, as it is sent to a worker.

    Attributes:
        trajectory_id, demo_id, demo_sha256, perturbations: as in the plan's row.
        twin: trajectory of the same demonstration without perturbations, which tracking follows.
        demos, config: sections of the run's configuration.
        folder: of the trajectory store.
    """

    trajectory_id: str
    demo_id: str
    demo_sha256: str
    perturbations: str
    twin: str
    demos: DemosConfig
    config: ReplayConfig
    folder: Path

    def __call__(self) -> Verdict:
        """Replay, judge and store; returns the verdict.

        Raises:
            PipelineError: when the demonstration is not there, or another than the plan was drawn for.
        """
        demo = self.demos.open().load(self.demo_id)
        if demo.sha256 != self.demo_sha256:
            raise PipelineError(
                "the demonstration has changed since the plan",
                where=(self.demos.root or Path()) / demo.source,
                expected=f"content with the hash {self.demo_sha256}",
                remedy="put the file back, or run the plan stage again, which draws for what is there now",
            )
        physics = of_layer(from_json(self.perturbations), PhysicsPerturbation)
        environment = shared(demo.task)

        def reference() -> Reference | None:
            if self.twin != self.trajectory_id:
                twin = TrajectoryStore(self.folder).path(self.twin)
                if (followed := _twin(edition(twin))) is not None:
                    return followed
            if demo.states is None:
                # The way the hand went when it was recorded, before anything settled.
                unsettled = self.config.model_copy(update={"mode": "open_loop", "settle_steps": 0})
                recorded = replay(environment, demo, self.trajectory_id, unsettled)
                return _followed(recorded)
            mask = kept_actions(demo.actions, self.config.noops)
            # The state after the last action is not recorded: as if the hand rested.
            states = np.vstack([demo.states[mask], demo.states[-1:]])
            model_xml = demo.model_xml or environment.place_fixtures(self.config.fixture_seed)
            return Reference.of(model_xml, states, demo.actions[mask])

        trajectory = replay(environment, demo, self.trajectory_id, self.config, physics, reference)
        TrajectoryStore(self.folder).save(trajectory)
        return trajectory.verdict

    def limit_s(self) -> float:
        """So long it may take before it counts as hanging; the longest take about a minute."""
        return 1800.0

    def lost(self) -> Verdict:
        """Store that no worker survived this replay, or finished it; it is not tried again while the file is there."""
        trajectory = Trajectory(
            trajectory_id=self.trajectory_id,
            mode="open_loop",
            scene=Scene("", np.zeros(1), {"fault": "workers ended in it, or it took too long"}),
            states=np.zeros((1, 1)),
            actions=np.empty((0, 7)),
            site_alpha=np.empty((1, 0), np.float32),
            verdict=Verdict(False, LOST),
        )
        TrajectoryStore(self.folder).save(trajectory)
        return trajectory.verdict


def replay_plan(
    rows: Sequence[Row],
    demos: DemosConfig,
    config: ReplayConfig,
    folder: Path,
    run: Run,
    rejected: Mapping[str, str] | None = None,
) -> dict[str, Verdict]:
    """Replay what the plan needs and ``folder`` does not hold yet; reserves only where a candidate failed.

    The twins come first, because tracking follows them.

    Args:
        rows: the plan.
        demos, config: sections of the run's configuration.
        folder: of the trajectory store.
        run: where the work is done.
        rejected: episode id to the reason why its frames were rejected, as far as frames were made.

    Returns:
        Trajectory id to verdict, for every trajectory that was needed.
    """
    twins = [row for row in rows if row.role == "twin"]
    verdicts = _replay(twins, twins, {}, demos, config, folder, run, rejected)
    verdicts = _replay(rows, twins, verdicts, demos, config, folder, run, rejected)
    # The table tells of what was just replayed, so that whoever comes next opens no file for it.
    TrajectoryStore(folder).refresh()
    return verdicts


def _replay(
    rows: Sequence[Row],
    twins: Sequence[Row],
    verdicts: dict[str, Verdict],
    demos: DemosConfig,
    config: ReplayConfig,
    folder: Path,
    run: Run,
    rejected: Mapping[str, str] | None,
) -> dict[str, Verdict]:
    row_of = {row.trajectory_id: row for row in rows}
    twin_of = {row.demo_id: row.trajectory_id for row in twins}
    stored = verdicts_of(TrajectoryStore(folder).refresh())
    while needed := pending(rows, verdicts, rejected):
        verdicts |= {trajectory_id: stored[trajectory_id] for trajectory_id in needed if trajectory_id in stored}
        # Ordered by demonstration: a worker builds a task's environment and reads a twin once.
        jobs = [
            ReplayJob(
                trajectory_id,
                row_of[trajectory_id].demo_id,
                row_of[trajectory_id].demo_sha256,
                row_of[trajectory_id].perturbations,
                twin_of[row_of[trajectory_id].demo_id],
                demos,
                config,
                folder,
            )
            for trajectory_id in sorted(needed, key=lambda trajectory_id: row_of[trajectory_id].demo_id)
            if trajectory_id not in stored
        ]
        if jobs:
            judged = run(Expendable(ReplayJob.__call__, ReplayJob.limit_s, ReplayJob.lost), jobs, "replay")
            verdicts |= {job.trajectory_id: verdict for job, verdict in zip(jobs, judged, strict=True)}
    return verdicts


@lru_cache(maxsize=1)
def _twin(file: Edition) -> Reference | None:
    """What a twin did, if it reached its goal."""
    return _followed(TrajectoryStore(file.path.parent).load(file.path.stem))


def _followed(trajectory: Trajectory) -> Reference | None:
    """What a replay did, if it reached its goal."""
    if not trajectory.verdict.kept:
        return None
    return Reference.of(trajectory.model_xml, trajectory.states, trajectory.actions)
