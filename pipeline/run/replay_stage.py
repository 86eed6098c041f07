"""Work of the stage ``replay``: workers replay the trajectories that a plan needs and the store lacks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.compute.pool import Workers, run_job
from pipeline.config import DemosConfig, FilterConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.planning.plan import Row
from pipeline.planning.selection import pending
from pipeline.run.verdicts import verdicts_of
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Verdict

NO_LIMITS = FilterConfig()


@dataclass(frozen=True)
class Replays:
    """Replays of a run: demonstrations, settings, store and workers.

    Attributes:
        demos: the section ``demos``.
        replay_config: the section ``replay``.
        store: store of the trajectories.
        limits: the section ``filter``.
    """

    demos: DemosConfig
    replay_config: ReplayConfig
    store: TrajectoryStore
    workers: Workers
    limits: FilterConfig = NO_LIMITS

    def complete(self, rows: Sequence[Row], rejected: Mapping[str, str] | None = None) -> dict[str, Verdict]:
        """Replay the trajectories that a plan needs and the store lacks; replay reserves only if a candidate failed.

        The clean twins come first, because tracking follows them.

        Args:
            rejected: episode id to the reason why its frames were rejected, as far as frames were rendered.

        Returns:
            Trajectory id to verdict, for every trajectory that was needed.

        Raises:
            PipelineError: when workers leave work undone.
        """
        stored = verdicts_of(self.store.refresh(), rows, self.limits)
        twins = [row for row in rows if row.role == "twin"]
        verdicts: dict[str, Verdict] = {}
        for group in (twins, rows):
            while needed := pending(group, verdicts, rejected):
                missing = [trajectory_id for trajectory_id in needed if trajectory_id not in stored]
                if missing:
                    self._replay(missing, rows)
                    stored = verdicts_of(self.store.refresh(), rows, self.limits)
                    undone = [trajectory_id for trajectory_id in missing if trajectory_id not in stored]
                    _reject_undone([self.store.path(trajectory_id) for trajectory_id in undone])
                verdicts |= {trajectory_id: stored[trajectory_id] for trajectory_id in needed}
        return verdicts

    def _replay(self, missing: Sequence[str], rows: Sequence[Row]) -> None:
        # A stage that has nothing to do loads no simulator.
        from pipeline.run.replay_job import ReplayJob

        row_of = {row.trajectory_id: row for row in rows}
        twin_of = {row.demo_id: row.trajectory_id for row in rows if row.role == "twin"}
        # Ordered by demonstration: a worker builds a task's environment and reads a twin once.
        in_turn = sorted(map(row_of.__getitem__, missing), key=lambda row: row.demo_id)
        where = self.demos, self.replay_config, self.store.root
        jobs = [ReplayJob(row, twin_of[row.demo_id], *where) for row in in_turn]
        self.workers(run_job, jobs, "replay")


def _reject_undone(files: Sequence[Path]) -> None:
    if files:
        raise PipelineError(
            f"{len(files)} trajectories were replayed and are still missing, such as this one",
            where=files[0],
            expected="files that workers write to this folder",
            remedy="check that all workers see this folder and have the same versions",
        )
