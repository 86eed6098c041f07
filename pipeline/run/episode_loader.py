"""From the plan and the rendered streams to the Episode that a writer puts into a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.config import RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.files import Edition, edition
from pipeline.run import plan
from pipeline.run.stores import FrameStore, TrajectoryStore
from pipeline.run.streams import streams_of
from pipeline.seeding import digest
from pipeline.types import Episode, Verdict
from pipeline.versions import versions


@dataclass(frozen=True)
class EpisodeLoader:
    """Loads kept episodes by id; small enough to send to a worker, which reads the plan once for itself.

    Attributes:
        plan_file: the plan's table.
        frames: folder of the frame store.
        config: how its frames are encoded.
    """

    plan_file: Path
    frames: Path
    config: RenderConfig

    def __call__(self, episode_id: str) -> Episode:
        row = _rows_by_id(edition(self.plan_file))[episode_id]
        shown = streams_of(row.perturbations)
        rendered = FrameStore(self.frames, self.config).load(row.trajectory_id, [s.stream_id for s in shown.values()])
        known = asdict(row) | {"replay_mode": rendered.replay_mode}
        known |= {f"{name}_version": versions()[name] for name in ("mujoco", "robosuite", "pipeline")}
        return Episode(
            episode_id=episode_id,
            frames={view: rendered.streams[stream.stream_id] for view, stream in shown.items()},
            state=rendered.state,
            joint_state=rendered.joint_state,
            action=rendered.action,
            instruction=row.instruction,
            provenance={name: str(known[name]) for name in SCHEMA.provenance},
        )

    def motion(self, episode_id: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Action (T, 7) and state (T, 8) of an episode, without its frames."""
        row = _rows_by_id(edition(self.plan_file))[episode_id]
        rendered = FrameStore(self.frames, self.config).load(row.trajectory_id, [])
        return rendered.action, rendered.state


@lru_cache(maxsize=1)
def _rows_by_id(plan_file: Edition) -> dict[str, plan.Row]:
    return {row.episode_id: row for row in plan.read(plan_file.path)}


def verdicts(rows: Sequence[plan.Row], trajectories: Path) -> dict[str, Verdict]:
    """What is known of the plan's trajectories."""
    store = TrajectoryStore(trajectories)
    known = {row.trajectory_id: store.verdict(row.trajectory_id) for row in rows}
    return {trajectory_id: verdict for trajectory_id, verdict in known.items() if verdict is not None}


def rejected(rows: Sequence[plan.Row], frames: FrameStore) -> dict[str, str]:
    """Episode id to the reason why one of its streams was not rendered, where that is so."""
    streams = {trajectory_id: frames.rejected(trajectory_id) for trajectory_id in {row.trajectory_id for row in rows}}
    reasons: dict[str, str] = {}
    for row in rows:
        if of_trajectory := streams[row.trajectory_id]:
            for stream in streams_of(row.perturbations).values():
                if stream.stream_id in of_trajectory:
                    reasons[row.episode_id] = of_trajectory[stream.stream_id]
    return reasons


def outcome(rows: Sequence[plan.Row], data: Path, config: RenderConfig) -> dict[str, Verdict]:
    """What became of every row of a run whose data lie in ``data``."""
    frames = FrameStore(data / "frames", config)
    return plan.select(rows, verdicts(rows, data / "trajectories"), rejected(rows, frames))


def kept(rows: Sequence[plan.Row], data: Path, config: RenderConfig) -> list[str]:
    """Ids of the kept episodes, in the order they are written: shuffled, because readers walk shards in order."""
    known = outcome(rows, data, config)
    ids = [row.episode_id for row in rows if known[row.episode_id].kept]
    return sorted(ids, key=lambda episode_id: digest("order", episode_id))
