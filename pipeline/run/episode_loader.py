"""Loader that joins the plan and the rendered streams to an ``Episode``, which a writer puts into a dataset."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

from pipeline.catalogue.scene_files import portable
from pipeline.config import RenderConfig
from pipeline.episode_schema import Content
from pipeline.files import Edition, edition
from pipeline.identity import version_column, versions
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run.layout import FRAMES, PLAN, TRAJECTORIES
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Episode, Replay


@dataclass(frozen=True)
class EpisodeLoader:
    """Loader of rendered episodes by id, small enough to send to a worker, which reads the plan once itself.

    Attributes:
        failures: True for failures, which have further columns.
        rewrites: episode id to other wordings of its task; without them, the episode has none.
        replays: True if episodes get the states and the scene of their replay.
    """

    data: Path
    render_config: RenderConfig
    failures: bool = False
    rewrites: Mapping[str, Sequence[str]] = field(default_factory=dict)
    replays: bool = False

    @cached_property
    def content(self) -> Content:
        """Content of the episodes."""
        content = self.render_config.content
        return content.including("outcome") if self.failures else content

    @cached_property
    def _frames(self) -> FrameStore:
        return FrameStore(self.data / FRAMES, self.render_config)

    def __call__(self, episode_id: str) -> Episode:
        row = _rows_by_id(edition(self.data / PLAN))[episode_id]
        streams = streams_of(row.perturbations, self.content.views)
        stream_ids = [stream.stream_id for stream in streams.values()]
        geometry = {view: stream.geometry.stream_id for view, stream in streams.items()}
        rendered = self._frames.load(row.trajectory_id, stream_ids, set(geometry.values()))
        values = asdict(row) | {"replay_mode": rendered.replay_mode}
        values |= asdict(rendered.quality) if rendered.quality else {}
        values |= {version_column(name): version for name, version in versions().items()}
        if self.failures:
            verdict = TrajectoryStore(self.data / TRAJECTORIES).load(row.trajectory_id).verdict
            values |= {"success": verdict.kept, "reason": verdict.reason}
        return Episode(
            episode_id=episode_id,
            frames={view: rendered.streams[stream.stream_id] for view, stream in streams.items()},
            state=rendered.state,
            joint_state=rendered.joint_state,
            action=rendered.action,
            action_absolute=rendered.action_absolute,
            instruction=row.instruction,
            provenance={name: values[name] for name in self.content.provenance},
            geometry={view: rendered.geometry[name] for view, name in geometry.items()},
            object_poses=rendered.object_poses,
            instances=rendered.instances,
            rewrites=self.rewrites.get(episode_id, ()),
            subtasks=rendered.subtasks,
            replay=self._replay(row) if self.replays else None,
        )

    def _replay(self, row: plan.Row) -> Replay:
        trajectory = TrajectoryStore(self.data / TRAJECTORIES).load(row.trajectory_id)
        scene = replace(trajectory.scene, model_xml=portable(trajectory.model_xml))
        return Replay(trajectory.actions, trajectory.states[:-1], scene, row.demo_origin_sha256)


@lru_cache(maxsize=1)
def _rows_by_id(plan_file: Edition) -> dict[str, plan.Row]:
    return {row.episode_id: row for row in plan.read(plan_file.path)}
