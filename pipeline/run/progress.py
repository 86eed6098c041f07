"""Progress of a plan: the verdicts and frames so far, and the trajectories and frames that are still missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pipeline.config import Config
from pipeline.export_config import ExportConfig
from pipeline.planning import selection
from pipeline.planning.plan import Row
from pipeline.planning.streams import streams_of
from pipeline.run.verdicts import FAILURE_REASONS, verdicts_of
from pipeline.stores.frame_store import StoredFrames, frames_by_trajectory
from pipeline.types import Verdict


@dataclass(frozen=True)
class Progress:
    """Plan of a run with its replays and frames so far.

    Attributes:
        rows: rows of the plan.
        replay_verdicts: trajectory id to the verdict on its replay, for every stored trajectory.
        frames: trajectory id to the record of its stored frames.
        rejected: episode id to the reason why its frames were rejected.
        views: names of the views of every episode.
        export: the section ``export``.
    """

    rows: Sequence[Row]
    replay_verdicts: Mapping[str, Verdict]
    frames: Mapping[str, StoredFrames]
    rejected: Mapping[str, str]
    views: tuple[str, ...]
    export: ExportConfig

    @classmethod
    def of(
        cls,
        rows: Sequence[Row],
        replays: Mapping[str, Mapping[str, Any]],
        files_of_frames: Mapping[str, Mapping[str, Any]],
        config: Config,
    ) -> Progress:
        """Return the progress of a plan under a configuration.

        Args:
            replays: rows of the table of trajectories.
            files_of_frames: rows of the table of frames. Frames of files that are left out count as not rendered.
        """
        frames, views = frames_by_trajectory(files_of_frames), config.render.content.views
        return cls(
            rows=rows,
            replay_verdicts=verdicts_of(replays, rows, config.filter),
            frames=frames,
            rejected=rejections(rows, frames, views),
            views=views,
            export=config.export,
        )

    @cached_property
    def verdicts(self) -> dict[str, Verdict]:
        """Episode id to verdict; an undecided episode has the reason ``NOT_REPLAYED``."""
        return selection.select(self.rows, self.replay_verdicts, self.rejected)

    def verdict(self, row: Row) -> Verdict:
        """Return the verdict on an episode."""
        return self.verdicts[row.episode_id]

    def is_rejected(self, row: Row) -> bool:
        """Return whether frames of an episode were rejected."""
        return row.episode_id in self.rejected

    def has_frames(self, row: Row) -> bool:
        """Return whether the frames of an episode's views are stored."""
        return has_frames(row, self.frames, self.views)

    def pending(self) -> list[str]:
        """List the trajectories that must be replayed next, in the order of the plan."""
        return selection.pending(self.rows, self.replay_verdicts, self.rejected)

    def undecided(self) -> list[Row]:
        """List the episodes that are needed, as far as is known, and have no trajectory yet."""
        return [row for row in self.rows if self.verdict(row).reason == selection.NOT_REPLAYED]

    def to_render(self) -> list[Row]:
        """List the episodes whose frames the stage ``render`` stores, so far.

        These are kept episodes, failures if ``export.failures`` requests them, and episodes with rejected frames, which
        would else be tried again. ``export.where`` selects among rendered episodes.
        """
        listed = []
        for row in self.rows:
            verdict = self.verdict(row)
            has_rejected_frames = verdict.reason == self.rejected.get(row.episode_id)
            is_requested_failure = self.export.failures and verdict.reason in FAILURE_REASONS
            if verdict.kept or has_rejected_frames or is_requested_failure:
                listed.append(row)
        return listed


def rejections(rows: Sequence[Row], frames: Mapping[str, StoredFrames], views: tuple[str, ...]) -> dict[str, str]:
    """Map the ids of episodes with a rejected stream to the reason of the rejection.

    Args:
        frames: trajectory id to the record of its stored frames.
        views: names of the views of every episode.
    """
    reasons: dict[str, str] = {}
    for row in rows:
        stored = frames.get(row.trajectory_id)
        if stored is None or not stored.rejected:
            continue
        for stream in streams_of(row.perturbations, views).values():
            if stream.stream_id in stored.rejected:
                reasons[row.episode_id] = stored.rejected[stream.stream_id]
    return reasons


def has_frames(row: Row, frames: Mapping[str, StoredFrames], views: tuple[str, ...]) -> bool:
    """Return whether the frames of an episode's views are stored."""
    needed = {stream.stream_id for stream in streams_of(row.perturbations, views).values()}
    return row.trajectory_id in frames and needed <= frames[row.trajectory_id].streams
