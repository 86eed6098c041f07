"""Loader that joins the plan and the rendered streams to an ``Episode``, which a writer puts into a dataset."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

from pipeline.catalogue.scene_files import portable
from pipeline.config import RenderConfig
from pipeline.episode_schema import provenance_of
from pipeline.files import Edition, edition
from pipeline.identity import versions
from pipeline.libero.tasks import find_task
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run.layout import FRAMES, PLAN, TRAJECTORIES
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Episode, Extra, Replay, Subtask


@dataclass(frozen=True)
class EpisodeLoader:
    """Loader of rendered episodes by id, small enough to send to a worker, which reads the plan once itself.

    Attributes:
        extras: ``outcome`` for failures.
        rewrites: episode id to other wordings of its task. Episodes get rewrites and subtasks only if it is set.
        replays: True if episodes get the states and the scene of their replay.
    """

    data: Path
    render_config: RenderConfig
    extras: tuple[Extra, ...] = ()
    rewrites: Mapping[str, Sequence[str]] | None = None
    replays: bool = False

    @cached_property
    def _frames(self) -> FrameStore:
        return FrameStore(self.data / FRAMES, self.render_config)

    def __call__(self, episode_id: str) -> Episode:
        row = _rows_by_id(edition(self.data / PLAN))[episode_id]
        streams = streams_of(row.perturbations)
        stream_ids = [stream.stream_id for stream in streams.values()]
        geometry = {view: stream.geometry.stream_id for view, stream in streams.items()}
        rendered = self._frames.load(row.trajectory_id, stream_ids, set(geometry.values()))
        values = asdict(row) | {"replay_mode": rendered.replay_mode}
        values |= asdict(rendered.quality) if rendered.quality else {}
        values |= {f"{name}_version": version for name, version in versions().items()}
        if "outcome" in self.extras:
            verdict = TrajectoryStore(self.data / TRAJECTORIES).load(row.trajectory_id).verdict
            values |= {"success": verdict.kept, "reason": verdict.reason}
        episode = Episode(
            episode_id=episode_id,
            frames={view: rendered.streams[stream.stream_id] for view, stream in streams.items()},
            state=rendered.state,
            joint_state=rendered.joint_state,
            action=rendered.action,
            action_absolute=rendered.action_absolute,
            instruction=row.instruction,
            provenance={name: values[name] for name in provenance_of(self.extras)},
            geometry={view: rendered.geometry[name] for view, name in geometry.items()},
            object_poses=rendered.object_poses,
            instances=rendered.instances,
            replay=self._replay(row) if self.replays else None,
        )
        if self.rewrites is None:
            return episode
        subtasks = _subtasks(self.data / TRAJECTORIES, row.trajectory_id, row.suite, row.task)
        return replace(episode, rewrites=self.rewrites[episode_id], subtasks=subtasks)

    def _replay(self, row: plan.Row) -> Replay:
        trajectory = TrajectoryStore(self.data / TRAJECTORIES).load(row.trajectory_id)
        scene = replace(trajectory.scene, model_xml=portable(trajectory.model_xml))
        return Replay(trajectory.actions, trajectory.states[:-1], scene, row.demo_origin_sha256)


@lru_cache(maxsize=1)
def _rows_by_id(plan_file: Edition) -> dict[str, plan.Row]:
    return {row.episode_id: row for row in plan.read(plan_file.path)}


@lru_cache(maxsize=10_000)
def _subtasks(trajectories: Path, trajectory_id: str, suite: str, task: str) -> tuple[Subtask, ...]:
    """Return the subtasks of a trajectory; cached, because episodes share trajectories and are loaded in any order."""
    from pipeline.physics.subtasks import subtasks  # Only episodes with subtasks need the simulator.

    return subtasks(TrajectoryStore(trajectories).load(trajectory_id), find_task(suite, task))
