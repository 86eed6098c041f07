"""Single replay of a demonstration, for benchmarks that render it repeatedly."""

from pathlib import Path

from pipeline.compute.pool import loop
from pipeline.config import Config
from pipeline.planning import plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Trajectory


def replayed_twin(config: Config, task: str, folder: Path) -> Trajectory:
    """Replay a task's first demonstration unperturbed; ``folder`` stores it under its trajectory's id."""
    demos = config.demos.model_copy(update={"tasks": (task,)})
    twin = plan.twins(demos.index().entries, config.plan.seed, config.replay)[0]
    Replays(demos, config.replay, TrajectoryStore(folder), loop).complete([twin])
    return TrajectoryStore(folder).load(twin.trajectory_id)
