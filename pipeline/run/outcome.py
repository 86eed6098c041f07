"""Outcome of every planned episode: kept, or dropped for a reason."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.config import Config, FilterConfig
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.export_config import ExportConfig
from pipeline.planning import plan, selection
from pipeline.planning.streams import streams_of
from pipeline.run.verdicts import verdicts_of
from pipeline.seeding import digest
from pipeline.stores.frame_store import FrameStore, StoredFrames, frames_by_trajectory
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Verdict

LEFT_OUT = "left_out"
"""Reason of an episode that reached its goal and is in no dataset because ``export.where`` does not name it."""

SUCCESS_REASONS = ("kept", LEFT_OUT)
"""Reasons of episodes whose trajectory and frames are stored."""


FAILURE_REASONS = ("goal_not_reached", "goal_lost")
"""Reasons of failures: replays that were simulated to the end and missed their goal.

Good demonstrations fail too: see the yields in docs/axes.md.
"""


@dataclass(frozen=True)
class Outcome:
    """Plan of a run with the results of replay and rendering.

    Attributes:
        rows: rows of the plan.
        trajectories: trajectory id to its row in the table of replays.
        frames: trajectory id to the record of its stored frames.
        views: names of the views of every episode.
        verdicts: episode id to verdict.
        failures: ids of the failures to write, in the order of the plan; empty unless ``export.failures`` is set.
    """

    rows: Sequence[plan.Row]
    trajectories: Mapping[str, Mapping[str, Any]]
    frames: Mapping[str, StoredFrames]
    views: tuple[str, ...]
    verdicts: Mapping[str, Verdict]
    failures: Sequence[str] = ()

    @cached_property
    def kept(self) -> list[str]:
        """Ids of the kept episodes, in the order they are written."""
        return shuffled(row.episode_id for row in self.rows if self.verdicts[row.episode_id].kept)

    @cached_property
    def row_of(self) -> dict[str, plan.Row]:
        """Episode id to its row of the plan."""
        return {row.episode_id: row for row in self.rows}

    def content(self, episode_id: str) -> str:
        """Return a short name of a rendered episode's content: equal names mean equal bytes in a dataset."""
        row = self.row_of[episode_id]
        frames = self.frames[row.trajectory_id]
        return digest(asdict(row), frames.made_by, frames.device, frames.replay_mode)[:16]


def shuffled(episode_ids: Iterable[str]) -> list[str]:
    """Sort episode ids into the order in which they are written: shuffled, because readers walk shards in order."""
    return sorted(episode_ids, key=lambda episode_id: digest("order", episode_id))


def read_replays(
    rows: Sequence[plan.Row], store: TrajectoryStore, rejected: Mapping[str, str], limits: FilterConfig
) -> dict[str, dict[str, Any]]:
    """Map trajectory ids to their rows in the table of replays.

    Args:
        rejected: episode id to the reason why its frames were rejected.
        limits: ``filter`` of the configuration.

    Raises:
        PipelineError: when a trajectory that the plan needs is missing, or can no longer be read.
    """
    trajectories = store.rows()
    needed = selection.pending(rows, verdicts_of(trajectories, rows, limits), rejected)
    # Only the stage `render` replays reserves that replace episodes with rejected frames.
    _reject_missing([store.path(name) for name in needed], "render" if rejected else "replay")
    return trajectories


def rejections(rows: Sequence[plan.Row], frames: Mapping[str, StoredFrames], views: tuple[str, ...]) -> dict[str, str]:
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


def judge(rows: Sequence[plan.Row], trajectories: TrajectoryStore, frames: FrameStore, config: Config) -> Outcome:
    """Judge every row of a plan after the render stage, and apply ``export.where``.

    Raises:
        PipelineError: when a trajectory or a frame that the plan needs is missing, or can no longer be read.
    """
    stored_frames = frames_by_trajectory(frames.rows())
    views = config.render.content.views
    rejected = rejections(rows, stored_frames, views)
    replays = read_replays(rows, trajectories, rejected, config.filter)
    judged = selection.select(rows, verdicts_of(replays, rows, config.filter), rejected)
    where = config.export.where
    if where:
        for row in rows:
            if judged[row.episode_id].kept and not where.takes(row.axis, row.component, row.level, row.suite):
                judged[row.episode_id] = Verdict(False, LEFT_OUT)
    failures = [row for row in list_failures(rows, judged, config.export) if row.episode_id not in rejected]
    kept = [row for row in rows if judged[row.episode_id].kept]
    not_rendered = [row for row in (*kept, *failures) if not has_frames(row, stored_frames, views)]
    folders = dict.fromkeys(frames.folder(row.trajectory_id) for row in not_rendered)
    _reject_missing(list(folders), "render")
    return Outcome(rows, replays, stored_frames, views, judged, [row.episode_id for row in failures])


def to_render(
    rows: Sequence[plan.Row], judged: Mapping[str, Verdict], rejected: Mapping[str, str], export: ExportConfig
) -> list[plan.Row]:
    """List the episodes whose frames the stage ``render`` stores, so far.

    These are kept episodes, failures if ``export.failures`` requests them, and episodes with rejected frames, which
    would else be tried again. ``export.where`` selects among rendered episodes.

    Args:
        judged: verdicts of ``selection.select``.
        rejected: episode id to the reason why its frames were rejected.
    """
    failures = FAILURE_REASONS if export.failures else ()
    listed = []
    for row in rows:
        verdict = judged[row.episode_id]
        if verdict.kept or verdict.reason in (rejected.get(row.episode_id), *failures):
            listed.append(row)
    return listed


def list_failures(rows: Sequence[plan.Row], judged: Mapping[str, Verdict], export: ExportConfig) -> list[plan.Row]:
    """List the failures that ``export`` requests, by the verdicts of ``selection.select``."""
    if not export.failures:
        return []
    failures = [row for row in rows if judged[row.episode_id].reason in FAILURE_REASONS]
    where = export.where
    if where is None:
        return failures
    return [row for row in failures if where.takes(row.axis, row.component, row.level, row.suite)]


def has_frames(row: plan.Row, frames: Mapping[str, StoredFrames], views: tuple[str, ...]) -> bool:
    """Return whether the frames of an episode's views are stored."""
    needed = {stream.stream_id for stream in streams_of(row.perturbations, views).values()}
    return row.trajectory_id in frames and needed <= frames[row.trajectory_id].streams


def _reject_missing(missing: Sequence[Path], stage: str) -> None:
    if missing:
        raise PipelineError(
            f"{len(missing)} files or folders that the plan needs are missing, damaged or outdated, such as this one",
            where=missing[0],
            remedy=f"run `{MAKE_AGAIN}`, or `python stages/{stage}.py CONFIG` for this stage alone",
        )


def outdated(
    rows: Sequence[plan.Row], trajectories: TrajectoryStore, frames: FrameStore, device: str | None = None
) -> Counter[str]:
    """Count the stored files of a plan that this version, or this machine, would generate again, by reason.

    The count includes finished files of today's plan, with today's settings, that were generated with other recipes,
    packages, machine code or another OpenGL device: see ``identity.reject_unasked``. Files that a changed
    configuration or plan replaces are not counted: ``dropped.reject_deletion`` reports them.

    Args:
        device: OpenGL name of the device that renders here; without it, frames of any device count as finished.
    """
    planned = dict.fromkeys(row.trajectory_id for row in rows)
    by_kind = {
        "trajectories": trajectories.outdated(planned),
        "files of frames": frames.outdated_of(planned, device),
    }
    numbers: Counter[str] = Counter()
    for kind, reasons in by_kind.items():
        for reason, number in reasons.items():
            numbers[f"{kind}, generated with {reason}"] += number
    return numbers
