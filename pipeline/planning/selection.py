"""Verdict on each planned episode, and the trajectories that must be replayed next to reach it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

from pipeline.grouping import grouped
from pipeline.planning.plan import Row
from pipeline.types import Verdict

NOT_NEEDED = "reserve_not_needed"
"""Reason of a reserve whose quota was met by other episodes."""

NOT_USED = Verdict(False, NOT_NEEDED)

NOT_REPLAYED = "not_replayed"
"""Reason of an episode that, by the verdicts so far, is needed and has no trajectory yet."""


def pending(
    rows: Sequence[Row], verdicts: Mapping[str, Verdict], rejected: Mapping[str, str] | None = None
) -> list[str]:
    """List the trajectories that must be replayed next, in plan order, for the arguments of ``select``.

    A reserve is used only after a candidate failed. Callers therefore ask again until the list is empty.
    """
    judged = _verdicts(rows, verdicts, rejected)
    return list(dict.fromkeys(row.trajectory_id for row, verdict in judged if verdict is None))


def select(
    rows: Sequence[Row], verdicts: Mapping[str, Verdict], rejected: Mapping[str, str] | None = None
) -> dict[str, Verdict]:
    """Return the verdict on every row: kept, dropped with a reason, or a reserve that was not needed.

    Args:
        verdicts: trajectory id to its verdict.
        rejected: episode id to the reason why its frames were rejected.
    """
    unknown = Verdict(False, NOT_REPLAYED)
    return {row.episode_id: verdict or unknown for row, verdict in _verdicts(rows, verdicts, rejected)}


def _verdicts(
    rows: Iterable[Row], verdicts: Mapping[str, Verdict], rejected: Mapping[str, str] | None
) -> Iterator[tuple[Row, Verdict | None]]:
    """Judge every row.

    The clean twins, and each axis or combination, have a quota for each task. The most similar reserve replaces a
    wanted candidate that fails. Perturbations that fail more often thus do not become rarer among kept episodes.

    Yields:
        Every row with its verdict; ``None`` for a row that, by the verdicts so far, is needed and is not replayed.
    """

    def judged(row: Row) -> Verdict | None:
        verdict = verdicts.get(row.trajectory_id)
        if rejected and verdict and verdict.kept and row.episode_id in rejected:
            return Verdict(False, rejected[row.episode_id])
        return verdict

    for quota in grouped(((row.axis, row.suite, row.task), row) for row in rows).values():
        group = sorted(quota, key=lambda row: row.rank)
        reserves = [row for row in group if not row.wanted]
        results: dict[str, Verdict | None] = {}
        for candidate in group:
            if not candidate.wanted:
                continue
            results[candidate.episode_id] = verdict = judged(candidate)
            # Count undecided candidates as kept until they are replayed.
            while verdict and not verdict.kept and reserves:
                replacement = min(reserves, key=partial(_unlike, candidate))
                reserves.remove(replacement)
                results[replacement.episode_id] = verdict = judged(replacement)
        for row in group:
            yield row, results.get(row.episode_id, NOT_USED)


def _unlike(failed: Row, reserve: Row) -> tuple[int, bool, int]:
    """Return the dissimilarity of a reserve to the failed candidate: by levels, then by component, then by rank."""
    levels = zip(failed.level.split("+"), reserve.level.split("+"), strict=True)
    level_difference = sum(abs(int(failed_level) - int(level)) for failed_level, level in levels)
    return level_difference, failed.component != reserve.component, reserve.rank
