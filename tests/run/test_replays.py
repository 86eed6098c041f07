"""Replays that share a clean twin: neither their order nor the workers change a stored trajectory."""

from pathlib import Path

import numpy as np
import pytest
from short_demonstrations import BOWL, STOVE

from pipeline.axes import Axes
from pipeline.axes.robot import RobotAxis
from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.planning import plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Trajectory

TRACKED = ReplayConfig(mode="tracked", settle_steps=0)


def replayed(folder: Path, demos: DemosConfig, rows: list[plan.Row], compute: ComputeConfig) -> dict[str, Trajectory]:
    store = TrajectoryStore(folder)
    with runner(compute, folder) as workers:
        verdicts = Replays(demos, TRACKED, store, workers).complete(rows)
    return {trajectory_id: store.load(trajectory_id) for trajectory_id in verdicts}


@pytest.mark.slow
def test_tracked_replays_do_not_depend_on_their_order_or_the_workers(short_demos: Path, tmp_path: Path) -> None:
    """Three robot starts of each of two demonstrations, which follow the two clean twins."""
    tasks = tuple(f"{task.suite}/{task.name}" for task in (STOVE, BOWL))
    demos = DemosConfig(source="hdf5", root=short_demos, tasks=tasks)
    settings = PlanConfig(seed=3, axes=Axes(robot=RobotAxis()), episodes={"robot": 6}, reserve=0)
    rows = plan.make(demos.index().entries, settings, TRACKED, TestSet(()))
    alone = replayed(tmp_path / "alone", demos, rows, ComputeConfig(cluster="loop"))
    together = replayed(tmp_path / "together", demos, rows[::-1], ComputeConfig(workers=2))
    assert alone.keys() == together.keys()
    assert [trajectory.mode for trajectory in alone.values()] == 8 * ["tracked"]
    for trajectory_id, trajectory in alone.items():
        other = together[trajectory_id]
        assert np.array_equal(trajectory.states, other.states)
        assert np.array_equal(trajectory.actions, other.actions)
        assert (trajectory.verdict, trajectory.resolved) == (other.verdict, other.resolved)
