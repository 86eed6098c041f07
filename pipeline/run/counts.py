"""Numbers of a run: how many of its episodes were planned, replayed and kept.

This module counts every number of ``counts.json``, the stage ``summary``, the report and the card, from the manifest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from pipeline.compute.pool import LOST
from pipeline.export_config import CLEAN
from pipeline.grouping import grouped
from pipeline.libero.demonstrations import HUMAN
from pipeline.libero.tasks import STEP_LIMITS
from pipeline.planning.selection import NOT_NEEDED
from pipeline.run.outcome import SUCCESS_REASONS

if TYPE_CHECKING:
    from rich.table import Table

Rows = Sequence[Mapping[str, Any]]
"""Rows of the manifest."""

LONGEST_LINE = 40
"""Largest width of the counts of all suites in one line of the table, which leaves room for the other columns."""


@dataclass(frozen=True)
class Counts:
    """Numbers of the ``tried`` rows; ``planned - kept`` is the number of dropped episodes."""

    planned: int
    replayed: int
    kept: int

    @classmethod
    def of(cls, rows: Rows, **values: str) -> Counts:
        """Count the rows that have these values, such as ``axis="camera"``."""
        matching = tried(rows)
        for column, value in values.items():
            matching = [row for row in matching if row[column] == value]
        replayed = sum(bool(row["steps"]) for row in matching)
        kept = sum(row["kept"] for row in matching)
        return cls(len(matching), replayed, kept)

    def __str__(self) -> str:
        return f"{self.planned}/{self.replayed}/{self.kept}" if self.planned else "-"


@dataclass(frozen=True)
class Target:
    """Numbers of episodes of an axis or combination.

    Attributes:
        wanted: the number in ``plan.episodes``; for ``clean``, the number of demonstrations. If ``export.where`` leaves
            episodes out, the number of wanted episodes that it selects.
        planned: number of wanted episodes for which the plan has perturbations.
        kept: number of episodes that reached their goal and whose frames show enough.
    """

    wanted: int
    planned: int
    kept: int


@dataclass(frozen=True)
class Diversity:
    """Numbers of kept episodes and of their action sequences.

    Attributes:
        sequences: number of distinct sequences; two differ if the stored actions of any step differ.
        original: number of episodes that repeat the recorded actions of their demonstration exactly, without no-ops.
    """

    episodes: int
    sequences: int
    original: int

    @classmethod
    def of(cls, rows: Rows) -> Diversity:
        kept = [row for row in rows if row["kept"]]
        sequences = {row["actions_sha256"] for row in kept}
        # An open-loop replay sends the recorded actions, and is kept only if it executed all of them.
        original = sum(row["replay_mode"] == "open_loop" for row in kept)
        return cls(len(kept), len(sequences), original)

    def __str__(self) -> str:
        return (
            f"{self.episodes:,} kept episodes have {self.sequences:,} distinct action sequences; {self.original:,} "
            "repeat the actions of their demonstration exactly"
        )


def diversity(rows: Rows) -> dict[str, Diversity]:
    """Map each task with kept episodes, ``<suite>/<task>``, to the numbers of its action sequences."""
    by_task = grouped((f"{row['suite']}/{row['task']}", row) for row in rows if row["kept"])
    return {task: Diversity.of(rows_of_task) for task, rows_of_task in sorted(by_task.items())}


def targets(rows: Rows, episodes: Mapping[str, int]) -> dict[str, Target]:
    """Map each axis or combination of the selected rows to its target, ``clean`` first.

    Args:
        rows: rows of the manifest, or their columns ``axis``, ``wanted``, ``chosen`` and ``reason``.
        episodes: ``plan.episodes``. For an axis that it lacks, the planned number counts as wanted.
    """
    selected = [row for row in rows if row["chosen"]]
    planned = Counter(row["axis"] for row in selected if row["wanted"])
    kept = Counter(row["axis"] for row in selected if row["reason"] in SUCCESS_REASONS)
    wanted = {axis: planned[axis] for axis in named(selected, "axis")}
    if len(selected) == len(rows):
        wanted |= episodes
    return {axis: Target(number, planned[axis], kept[axis]) for axis, number in wanted.items()}


def shortfalls(found: Mapping[str, Target]) -> list[str]:
    """Write a sentence for each axis with fewer kept episodes than wanted, with the setting that adds episodes."""
    sentences = []
    for axis, target in found.items():
        if axis == CLEAN or target.kept >= target.wanted:
            continue
        if target.planned < target.wanted:
            remedy = f"only {target.planned} could be planned: use more demonstrations or wider ranges"
        else:
            remedy = "raise plan.reserve, which adds candidates; more similar ones may replace some kept episodes"
        sentences.append(f"{axis}: {target.kept} of {target.wanted} wanted episodes are kept; {remedy}")
    return sentences


def lost_to_workers(rows: Rows) -> list[str]:
    """Report the episodes that were dropped because workers ended over them; empty without such episodes."""
    lost = [row for row in rows if row["reason"] == LOST]
    if not lost:
        return []
    trajectories = named(lost, "trajectory_id")
    return [
        f"{len(lost)} episodes are dropped, because workers ended over them or they took too long ({LOST}); to try "
        f"them again, move the files of {len(trajectories)} trajectories, such as {trajectories[0]}, out of "
        "trajectories/ and frames/, and run the command again; for a clean twin, move all files of its demonstration"
    ]


def beyond_step_limit(rows: Rows) -> list[str]:
    """Report the kept episodes with more steps than an evaluation allows; empty without such episodes."""
    beyond = [row for row in rows if row["kept"] and row["exceeds_step_limit"]]
    if not beyond:
        return []
    longest = max(beyond, key=lambda row: row["steps"] / STEP_LIMITS[row["suite"]])
    return [
        f"{len(beyond)} kept episodes take more control steps than an evaluation allows: at most {longest['steps']} of "
        f"{STEP_LIMITS[longest['suite']]}, in {longest['suite']}/{longest['task']}; `filter: {{exceeds_step_limit: "
        "drop}` drops them"
    ]


def tried(rows: Rows) -> list[Mapping[str, Any]]:
    """Return all rows except unneeded reserves and rows that ``export.where`` leaves out.

    Rows that ``export.where`` leaves out are never kept. Counting only their losses would make the yield wrong.
    """
    return [row for row in rows if row["reason"] != NOT_NEEDED and row["chosen"]]


def twins(rows: Rows) -> dict[str, Mapping[str, Any]]:
    """Map the episode ids of the clean twins of kept episodes to their rows.

    A clean twin is returned if it was kept, or if only ``export.where`` excludes it. Its trajectory and frames are then
    stored.
    """
    wanted = {row["twin_id"] for row in rows if row["kept"]}
    stored = [row for row in rows if row["reason"] in SUCCESS_REASONS]
    return {row["episode_id"]: row for row in stored if row["episode_id"] in wanted}


def named(rows: Rows, column: str) -> list[str]:
    """List the values of a column, each once, in the order of their first rows."""
    return list(dict.fromkeys(row[column] for row in rows))


def origins(rows: Rows, source: str) -> Counter[str]:
    """Count the demonstrations of some rows by origin: ``human``, ``recorded`` or ``expanded``.

    Args:
        source: source of the run's demonstrations. An HDF5 file does not state if a person or a policy recorded it.
    """
    origin_of = {row["demo_id"]: row["demo_origin"] for row in rows}
    numbers = Counter(origin_of.values())
    if source == "hdf5" and HUMAN in numbers:
        numbers["recorded"] = numbers.pop(HUMAN)
    return numbers


def tally(rows: Rows, column: str) -> dict[str, Counter[str]]:
    """Map each axis to the number of its rows with each value of a column."""
    counters: dict[str, Counter[str]] = {}
    for axis, rows_of_axis in by_axis(rows).items():
        counters[axis] = Counter(row[column] for row in rows_of_axis)
    return counters


def by_axis(rows: Rows) -> dict[str, list[Mapping[str, Any]]]:
    """Map each axis to its rows."""
    return grouped((row["axis"], row) for row in rows)


def by_axis_and_suite(rows: Rows) -> dict[str, dict[str, dict[str, int]]]:
    """Return the content of ``counts.json``: axis to suite to the numbers of episodes planned, replayed and kept."""
    table: dict[str, dict[str, dict[str, int]]] = {}
    for axis, suite in dict.fromkeys((row["axis"], row["suite"]) for row in tried(rows)):
        table.setdefault(axis, {})[suite] = asdict(Counts.of(rows, axis=axis, suite=suite))
    return table


def shown(rows: Rows, episodes: Mapping[str, int]) -> Table:
    """Return the counts by axis and suite as a table for the terminal, with totals and wanted episodes.

    Args:
        episodes: ``plan.episodes``.
    """
    from rich import box
    from rich.table import Table

    suites, axes = named(rows, "suite"), named(tried(rows), "axis")
    heads = [suite.replace("_", "_\n", 1) for suite in suites]
    target_of = targets(rows, episodes)
    wanted = sum(target.wanted for target in target_of.values())
    totals = [Counts.of(rows, suite=suite) for suite in suites]
    # A cell with large numbers has three lines, and the name of a combination has a line for each axis. All columns
    # then fit into 80 columns.
    in_lines = len(suites) * (max(map(len, map(str, totals)), default=0) + 2) > LONGEST_LINE
    table = Table("axis", title="planned/replayed/kept episodes", box=box.SIMPLE, pad_edge=False)
    for head in (*heads, "all", "wanted"):
        table.add_column(head, justify="right", no_wrap=True)
    for axis in axes:
        cells = [Counts.of(rows, axis=axis, suite=suite) for suite in suites]
        in_all = Counts.of(rows, axis=axis)
        table.add_row(axis.replace("+", "+\n"), *_cells([*cells, in_all], in_lines), str(target_of[axis].wanted))
    table.add_section()
    table.add_row("all", *_cells([*totals, Counts.of(rows)], in_lines), str(wanted))
    return table


def _cells(counts: Sequence[Counts], in_lines: bool) -> list[str]:
    """Format counts for a table, in one line or in three lines."""
    return [str(count).replace("/", "/\n") if in_lines else str(count) for count in counts]
