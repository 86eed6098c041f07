"""What became of each planned episode, and what has to be replayed next to know it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

from pipeline.grouping import grouped
from pipeline.planning.plan import Row
from pipeline.types import Verdict

NOT_NEEDED = "reserve_not_needed"
"""The reason of a reserve for whose quota others were kept."""

NOT_USED = Verdict(False, NOT_NEEDED)

NOT_REPLAYED = "not_replayed"
"""The reason of what is needed, as far as is known, and has no trajectory yet."""


def pending(
    rows: Sequence[Row], verdicts: Mapping[str, Verdict], rejected: Mapping[str, str] | None = None
) -> list[str]:
    """The trajectories that have to be replayed next, in plan order, given what ``select`` is given.

    Reserves come in only where a candidate before them failed, so this is asked again until it is empty.
    """
    found = _verdicts(rows, verdicts, rejected)
    return list(dict.fromkeys(row.trajectory_id for row, verdict in found if verdict is None))


def select(
    rows: Sequence[Row], verdicts: Mapping[str, Verdict], rejected: Mapping[str, str] | None = None
) -> dict[str, Verdict]:
    """What became of every row: kept, dropped with a reason, or a reserve that was not needed.

    Args:
        verdicts: trajectory id to its verdict.
        rejected: episode id to the reason why its frames were rejected.
    """
    unknown = Verdict(False, NOT_REPLAYED)
    return {row.episode_id: verdict or unknown for row, verdict in _verdicts(rows, verdicts, rejected)}


def _verdicts(
    rows: Iterable[Row], verdicts: Mapping[str, Verdict], rejected: Mapping[str, str] | None
) -> Iterator[tuple[Row, Verdict | None]]:
    """Every row with what became of it: None for one that is needed, as far as is known, and not replayed.

    The twins, and each axis or combination, have a quota for each task. A wanted candidate that fails is replaced by
    the reserve that is most like it, so that what fails more often does not become rarer among kept episodes.
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
        for wanted in (row for row in group if row.wanted):
            results[wanted.episode_id] = verdict = judged(wanted)
            # Count undecided candidates as kept until they are replayed.
            while verdict and not verdict.kept and reserves:
                replacement = min(reserves, key=partial(_unlike, wanted))
                reserves.remove(replacement)
                results[replacement.episode_id] = verdict = judged(replacement)
        for row in group:
            yield row, results.get(row.episode_id, NOT_USED)


def _unlike(failed: Row, reserve: Row) -> tuple[int, bool, int]:
    """How far a reserve's levels and components are from those of the candidate that it replaces; then its rank."""
    levels = zip(failed.level.split("+"), reserve.level.split("+"), strict=True)
    apart = sum(abs(int(one) - int(other)) for one, other in levels)
    return apart, failed.component != reserve.component, reserve.rank
