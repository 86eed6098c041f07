"""Outcome of every planned episode: kept, or dropped for a reason."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.config import Config
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.export_config import ExportConfig, Where
from pipeline.planning import plan
from pipeline.run.progress import Progress, has_frames
from pipeline.run.verdicts import FAILURE_REASONS
from pipeline.seeding import digest
from pipeline.stores.frame_store import FrameStore, StoredFrames
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Verdict

LEFT_OUT = "left_out"
"""Reason of an episode that reached its goal and is in no dataset because ``export.where`` does not name it."""

SUCCESS_REASONS = ("kept", LEFT_OUT)
"""Reasons of episodes whose trajectory and frames are stored."""

REPLAYS, RENDERINGS = "trajectories", "files of frames"
"""Kinds of stored files."""


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

    def has_frames(self, row: plan.Row) -> bool:
        """Return whether the frames of an episode's views are stored."""
        return has_frames(row, self.frames, self.views)

    def content(self, episode_id: str) -> str:
        """Return a short name of a rendered episode's content: equal names mean equal bytes in a dataset."""
        row = self.row_of[episode_id]
        frames = self.frames[row.trajectory_id]
        return digest(asdict(row), frames.fingerprint, frames.device, frames.replay_mode)[:16]


def shuffled(episode_ids: Iterable[str]) -> list[str]:
    """Sort episode ids into the order in which they are written: shuffled, because readers walk shards in order."""
    return sorted(episode_ids, key=lambda episode_id: digest("order", episode_id))


def judge(rows: Sequence[plan.Row], trajectories: TrajectoryStore, frames: FrameStore, config: Config) -> Outcome:
    """Judge every row of a plan after the render stage, and apply ``export.where``.

    Raises:
        PipelineError: when a trajectory or a frame that the plan needs is missing, or can no longer be read.
    """
    replays = trajectories.rows()
    progress = Progress.of(rows, replays, frames.rows(), config)
    reject_missing_replays(progress, trajectories)
    verdicts = dict(progress.verdicts)
    for row in rows:
        if verdicts[row.episode_id].kept and not is_selected(row, config.export.where):
            verdicts[row.episode_id] = Verdict(False, LEFT_OUT)
    failures = [row for row in list_failures(rows, verdicts, config.export) if not progress.is_rejected(row)]
    kept = [row for row in rows if verdicts[row.episode_id].kept]
    not_rendered = [row for row in (*kept, *failures) if not progress.has_frames(row)]
    folders = dict.fromkeys(frames.folder(row.trajectory_id) for row in not_rendered)
    _reject_missing(list(folders), "render")
    return Outcome(rows, replays, progress.frames, progress.views, verdicts, [row.episode_id for row in failures])


def reject_missing_replays(progress: Progress, store: TrajectoryStore) -> None:
    """Stop if a trajectory that the plan needs is not stored.

    Raises:
        PipelineError: naming the file of such a trajectory.
    """
    # Only the stage `render` replays reserves that replace episodes with rejected frames.
    stage = "render" if progress.rejected else "replay"
    _reject_missing([store.path(name) for name in progress.pending()], stage)


def is_selected(row: plan.Row, where: Where | None) -> bool:
    """Return whether ``export.where`` selects an episode; without it, every episode is selected."""
    return where is None or where.takes(row.axis, row.component, row.level, row.suite)


def list_failures(rows: Sequence[plan.Row], verdicts: Mapping[str, Verdict], export: ExportConfig) -> list[plan.Row]:
    """List the failures that ``export`` requests, by the verdicts on the episodes."""
    if not export.failures:
        return []
    failures = [row for row in rows if verdicts[row.episode_id].reason in FAILURE_REASONS]
    return [row for row in failures if is_selected(row, export.where)]


def _reject_missing(missing: Sequence[Path], stage: str) -> None:
    if missing:
        raise PipelineError(
            f"{len(missing)} files or folders that the plan needs are missing, damaged or outdated, such as this one",
            where=missing[0],
            remedy=f"run `{MAKE_AGAIN}`, or `python stages/{stage}.py CONFIG` for this stage alone",
        )


def outdated(
    rows: Sequence[plan.Row], trajectories: TrajectoryStore, frames: FrameStore, device: str | None = None
) -> dict[str, Counter[str]]:
    """Count the stored files of a plan that this version, or this machine, would generate again, by kind and reason.

    The count includes finished files of today's plan, with today's settings, that were generated with other recipes,
    packages, machine code or another OpenGL device: see ``identity.require_remake_permission``. Files that a changed
    configuration or plan replaces are not counted: ``dropped.reject_deletion`` reports them.

    Args:
        device: OpenGL name of the device that renders here; without it, frames of any device count as finished.

    Returns:
        ``REPLAYS`` and ``RENDERINGS``, if there are such files, to the number of files for each reason.
    """
    planned = dict.fromkeys(row.trajectory_id for row in rows)
    by_kind = {REPLAYS: trajectories.outdated(planned), RENDERINGS: frames.outdated_of(planned, device)}
    return {kind: reasons for kind, reasons in by_kind.items() if reasons}


def join_kinds(outdated_files: Mapping[str, Counter[str]]) -> Counter[str]:
    """Map descriptions of kind and reason to numbers of files.

    Args:
        outdated_files: as returned by ``outdated``.
    """
    numbers: Counter[str] = Counter()
    for kind, reasons in outdated_files.items():
        for reason, number in reasons.items():
            numbers[f"{kind}, generated with {reason}"] += number
    return numbers
