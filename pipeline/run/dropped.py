"""Finished work that a changed configuration no longer needs: measured, and reported before a stage deletes it.

The stages ``plan``, ``replay`` and ``render`` call ``reject_deletion`` before they replace or delete anything.
``status`` and ``doctor`` report the result of ``measure``.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from pipeline.errors import PipelineError
from pipeline.identity import ALLOW, remake_allowed
from pipeline.planning import plan
from pipeline.planning.selection import NOT_NEEDED, NOT_REPLAYED
from pipeline.planning.streams import streams_of
from pipeline.run import machine
from pipeline.run.progress import Progress
from pipeline.run.run import Run
from pipeline.run.work_time import REFERENCE, frame_s, replay_s
from pipeline.stores.frame_store import settings_of
from pipeline.types import Verdict

LARGEST_SHARE = 0.1
"""Share of the finished work that stages delete without permission."""


@dataclass(frozen=True)
class Dropped:
    """Finished work that a plan does not need.

    Attributes:
        trajectories: number of trajectories.
        streams: number of streams of frames.
        work_s: time that one core needed for them, in s.
        share: their share of the time for all trajectories and frames, in [0, 1].
        episodes: number of episodes of the datasets; their trajectories and frames may have been deleted before.
        episode_share: share of all episodes of the datasets, in [0, 1].
    """

    trajectories: int = 0
    streams: int = 0
    work_s: float = 0.0
    share: float = 0.0
    episodes: int = 0
    episode_share: float = 0.0

    @property
    def asks(self) -> bool:
        """Return whether a person must allow the deletion."""
        return max(self.share, self.episode_share) > LARGEST_SHARE

    def __bool__(self) -> bool:
        return bool(self.trajectories or self.streams or self.episodes)

    def __str__(self) -> str:
        parts = []
        if self.trajectories or self.streams:
            parts.append(
                f"{self.trajectories} trajectories and {self.streams} streams of frames, {self.share:.0%} of the "
                f"finished work, about {_hours(self.work_s)} of one core"
            )
        if self.episodes:
            parts.append(f"{self.episodes} episodes of the datasets, {self.episode_share:.0%} of them")
        return "; ".join(parts)


def measure(rows: Sequence[plan.Row], run: Run) -> Dropped:
    """Measure the finished work that the stages ``replay``, ``render`` and ``export`` would delete under a plan.

    An undecided episode counts as needed: it, or a candidate before it, is not replayed or not rendered yet.
    """
    trajectories, streams = _needed(rows, run)
    speed = machine.known_speed(run) or REFERENCE
    encoded = settings_of(run.config.render)
    all_s = dropped_s = 0.0
    unneeded_streams = 0
    replayed = run.trajectories.rows_of_all_settings()
    unneeded = replayed.keys() - trajectories
    for name, row in replayed.items():
        took_s = replay_s(row["steps"], speed)
        all_s += took_s
        dropped_s += took_s * (name in unneeded)
    settings = run.frames.settings_by_fingerprint()
    for name, row in run.frames.rows_of_all_settings().items():
        encoded_otherwise = settings.get(row["made_by"], encoded) != encoded
        trajectory_id = name.split("/")[0]
        stored = {(trajectory_id, stream) for stream in row["streams"]}
        unneeded_of_file = stored if encoded_otherwise else stored - streams
        stream_s = row["steps"] * frame_s(speed)
        all_s += len(stored) * stream_s
        dropped_s += len(unneeded_of_file) * stream_s
        unneeded_streams += len(unneeded_of_file)
    exported = _exported(run)
    gone_episodes = len(exported - {row.episode_id for row in rows})
    return Dropped(
        trajectories=len(unneeded),
        streams=unneeded_streams,
        work_s=dropped_s,
        share=dropped_s / all_s if all_s else 0.0,
        episodes=gone_episodes,
        episode_share=gone_episodes / len(exported) if exported else 0.0,
    )


def reject_deletion(rows: Sequence[plan.Row], run: Run) -> None:
    """Print the amount of finished work that a plan drops, and stop if it is large and the deletion is not allowed.

    Raises:
        PipelineError: when the share is above ``LARGEST_SHARE`` and ``REMAKE=1`` is not set. Nothing was changed.
    """
    dropped = measure(rows, run)
    if dropped.asks and not remake_allowed():
        raise PipelineError(
            f"the run would delete finished work that the configuration no longer needs: {dropped}",
            where=run.folder,
            expected=f"a configuration that needs all but {LARGEST_SHARE:.0%} of the finished work",
            remedy="restore the former configuration; or copy the new one to a file with another `name:`, which gets "
            f"its own folder; or allow the deletion: {ALLOW}",
        )
    if dropped:
        print(f"later stages delete finished work that is no longer needed: {dropped}")


def _needed(rows: Sequence[plan.Row], run: Run) -> tuple[set[str], set[tuple[str, str]]]:
    """Return the ids of the trajectories that a plan may need, and pairs of trajectory id and id of a needed stream."""
    progress = Progress.of(rows, run.trajectories.rows(), run.frames.rows(), run.config)
    # A reserve is needed unless the candidates before it are replayed, rendered and kept. Rows without a replay or
    # without frames therefore count as dropped, with the reason of undecided rows.
    not_replayed = {row.trajectory_id: Verdict(False, NOT_REPLAYED) for row in rows}
    not_rendered = {row.episode_id: NOT_REPLAYED for row in rows if not progress.has_frames(row)}
    cautious = replace(
        progress,
        replay_verdicts={**not_replayed, **progress.replay_verdicts},
        rejected={**not_rendered, **progress.rejected},
    )
    trajectories = {row.trajectory_id for row in rows if cautious.verdict(row).reason != NOT_NEEDED}
    streams: set[tuple[str, str]] = set()
    for row in (*cautious.to_render(), *cautious.undecided()):
        streams_of_row = streams_of(row.perturbations, progress.views).values()
        streams |= {(row.trajectory_id, stream.stream_id) for stream in streams_of_row}
    return trajectories, streams


def _exported(run: Run) -> set[str]:
    """Return the ids of the episodes in the finished datasets that the run would replace."""
    exported: set[str] = set()
    for dataset in (*run.datasets, *run.failure_datasets):
        with suppress(PipelineError):  # The dataset has no record.
            exported |= dataset.record().places.keys()
    return exported


def _hours(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 360 else f"{seconds / 3600:.3f} h"
