"""Job of a worker that computes one replay: read the demonstration, replay and judge it, store the trajectory."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from pipeline.axes import PhysicsPerturbation, from_json, of_layer, task_of
from pipeline.compute.pool import LOST, Job
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.errors import RUN_AGAIN, PipelineError
from pipeline.files import Edition, edition
from pipeline.libero.carried import all_counterparts
from pipeline.libero.starts import kept_actions
from pipeline.physics.environment import environment_of
from pipeline.physics.quality import measure
from pipeline.physics.reference import Reference
from pipeline.physics.replay import at_reset, needs_tracking, replay
from pipeline.planning.plan import Row
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Demo, Scene, Task, Trajectory, Verdict


@dataclass(frozen=True)
class ReplayJob(Job[Verdict]):
    """One trajectory's replay, as it is sent to a worker.

    Attributes:
        row: a row of the plan that has this trajectory.
        twin: id of the clean twin's trajectory, which tracking follows.
    """

    row: Row
    twin: str
    demos: DemosConfig
    replay_config: ReplayConfig
    folder: Path

    def __call__(self) -> Verdict:
        """Replay, judge and store; returns the verdict.

        Raises:
            PipelineError: when the demonstration is missing, or has changed since the plan.
        """
        demo = self.demos.open().load(self.row.demo_id)
        if demo.sha256 != self.row.demo_sha256:
            raise PipelineError(
                "the demonstration has changed since the plan",
                where=(self.demos.root or Path()) / demo.source,
                expected=f"content with the hash {self.row.demo_sha256}",
                remedy=f"restore the file, or {RUN_AGAIN}, which plans again from the present content",
            )
        physics = of_layer(from_json(self.row.perturbations), PhysicsPerturbation)
        task = task_of(self.row.suite, self.row.task, self.row.perturbations)
        environment = environment_of(task)
        reference = partial(self._reference, demo, task)
        start, replay_config = replace(demo, task=task), self.replay_config
        seed = self.row.reset_seed
        if seed is not None:
            # Open-loop actions would succeed by luck, and teach that object positions do not matter.
            start = at_reset(environment, start, seed)
            replay_config = replay_config.model_copy(update={"mode": "tracked"})
        trajectory = replay(environment, start, self.row.trajectory_id, replay_config, physics, reference)
        must_track = seed is not None or needs_tracking(trajectory.scene)
        if must_track and trajectory.verdict.kept and trajectory.mode != "tracked":
            trajectory = replace(trajectory, verdict=Verdict(False, "no_reference"))
        if trajectory.verdict.kept:
            trajectory = replace(trajectory, quality=measure(trajectory, task))
        TrajectoryStore(self.folder).save(trajectory)
        return trajectory.verdict

    def _reference(self, demo: Demo, task: Task) -> Reference | None:
        """Return the reference that tracking follows in the scene of ``task``."""
        reference = self._reference_in_own_scene(demo)
        if reference is None or task.goal_file is None:
            return reference
        return reference.in_scene(all_counterparts(task))

    def _reference_in_own_scene(self, demo: Demo) -> Reference | None:
        """Return the reference of the clean twin if it reached its goal, else of the recording."""
        if self.twin != self.row.trajectory_id:
            twin = TrajectoryStore(self.folder).path(self.twin)
            reference = _reference_of_file(edition(twin))
            if reference is not None:
                return reference
        if demo.states is None:
            # Replay the recorded hand motion, which began before anything settled.
            unsettled = self.replay_config.model_copy(update={"mode": "open_loop", "settle_steps": 0})
            return _reference_of(replay(environment_of(demo.task), demo, self.row.trajectory_id, unsettled))
        mask = kept_actions(demo.actions, self.replay_config.noops)
        # The state after the last action is not recorded: assume that the hand rests.
        states = np.vstack([demo.states[mask], demo.states[-1:]])
        model_xml = demo.model_xml or environment_of(demo.task).place_fixtures(self.replay_config.fixture_seed)
        return Reference.of(model_xml, states, demo.actions[mask])

    def limit_s(self) -> float:
        """Return the time after which the replay counts as hanging, in s; the longest replays take about a minute."""
        return 1800.0

    def lost(self) -> Verdict:
        """Store that no worker survived or finished this replay; it is not tried again while the file exists."""
        trajectory = Trajectory(
            trajectory_id=self.row.trajectory_id,
            mode="open_loop",
            scene=Scene("", np.zeros(1), {"fault": "workers ended during the replay, or it took too long"}),
            states=np.zeros((1, 1)),
            actions=np.empty((0, 7)),
            site_alpha=np.empty((1, 0), np.float32),
            verdict=Verdict(False, LOST),
        )
        TrajectoryStore(self.folder).save(trajectory)
        return trajectory.verdict


@lru_cache(maxsize=1)
def _reference_of_file(file: Edition) -> Reference | None:
    """Read the reference of a clean twin from its trajectory's file, `None` if it did not reach its goal."""
    return _reference_of(TrajectoryStore(file.path.parent).load(file.path.stem))


def _reference_of(trajectory: Trajectory) -> Reference | None:
    """Return the reference of a replay, `None` if it did not reach its goal."""
    if not trajectory.verdict.kept:
        return None
    return Reference.of(trajectory.model_xml, trajectory.states, trajectory.actions)
