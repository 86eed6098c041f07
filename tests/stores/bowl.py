"""Shortened demonstration of the bowl and a plan of it, which the tests of the stores replay and render."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from short_demonstrations import BOWL
from short_runs import tiny_config

from pipeline.compute.pool import loop
from pipeline.config import Config
from pipeline.planning import plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet


def bowl_config(demos: Path) -> Config:
    fields = tiny_config(demos)
    fields["demos"] = {"source": "hdf5", "root": str(demos), "tasks": [f"{BOWL.suite}/{BOWL.name}"]}
    fields["plan"] = {"seed": 7, "axes": {"light": {}}, "episodes": {"light": 1}, "reserve": 1.0}
    return Config.model_validate(fields)


def bowl_plan(config: Config) -> list[plan.Row]:
    """Plan a clean twin, a light episode and its reserve."""
    return plan.make(config.demos.index().entries, config.plan, config.replay, TestSet(()))


def replay_bowl(config: Config, folder: Path) -> None:
    judged = Replays(config.demos, config.replay, TrajectoryStore(folder), loop).complete(bowl_plan(config))
    TrajectoryStore(folder).keep(judged)
    assert all(verdict.kept for verdict in judged.values())


def given_up(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
    """Give up all items, as a cluster does with work that no worker survives.

    tests/compute/test_compute.py tests workers that die.
    """
    return [item.lost() for item in items]


def nothing_to_do(fn: Any, items: Sequence[Any], description: str) -> list[Any]:
    raise AssertionError(f"{description}: {len(items)} items are made again")
