"""The numbers of a run: how many of its episodes were planned, replayed and kept.

Every number of ``counts.json``, of the stage ``summary``, the report and the card is counted here, from the manifest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from pipeline.export_config import CLEAN
from pipeline.grouping import grouped
from pipeline.libero.demonstrations import HUMAN
from pipeline.libero.tasks import STEP_LIMITS
from pipeline.planning.selection import NOT_NEEDED
from pipeline.run.outcome import MADE

if TYPE_CHECKING:
    from rich.table import Table

Rows = Sequence[Mapping[str, Any]]
"""Rows of the manifest."""


@dataclass(frozen=True)
class Counts:
    """Of the rows among some that were ``tried``, so that ``planned - kept`` is what was lost on the way."""

    planned: int
    replayed: int
    kept: int

    @classmethod
    def of(cls, rows: Rows, **values: str) -> Counts:
        """Of the rows that have these values, such as ``axis="camera"``."""
        found = [row for row in tried(rows) if all(row[name] == value for name, value in values.items())]
        return cls(len(found), sum(bool(row["steps"]) for row in found), sum(row["kept"] for row in found))

    def __str__(self) -> str:
        return f"{self.planned}/{self.replayed}/{self.kept}" if self.planned else "-"


@dataclass(frozen=True)
class Target:
    """Episodes of an axis or combination, those that ``export.where`` leaves out included.

    Attributes:
        wanted: as ``plan.episodes`` has it; of ``clean``, the demonstrations.
        planned: of these, how many the plan has perturbations for.
        kept: how many reached their goal with frames that show enough.
    """

    wanted: int
    planned: int
    kept: int


def targets(rows: Rows, episodes: Mapping[str, int]) -> dict[str, Target]:
    """Axis or combination to its target, ``clean`` first.

    Args:
        episodes: ``plan.episodes``; where it lacks an axis, what is planned counts as wanted.
    """
    planned = Counter(row["axis"] for row in rows if row["wanted"])
    kept = Counter(row["axis"] for row in rows if row["reason"] in MADE)
    wanted = {axis: planned[axis] for axis in named(rows, "axis")} | dict(episodes)
    return {axis: Target(number, planned[axis], kept[axis]) for axis, number in wanted.items()}


def shortfalls(found: Mapping[str, Target]) -> list[str]:
    """A sentence for each axis that has fewer kept episodes than wanted, with the setting that helps."""
    sentences = []
    for axis, target in found.items():
        if axis == CLEAN or target.kept >= target.wanted:
            continue
        if target.planned < target.wanted:
            remedy = f"only {target.planned} could be planned: use more demonstrations, or wider ranges"
        else:
            remedy = "raise plan.reserve, which adds candidates and keeps what is finished"
        sentences.append(f"{axis}: {target.kept} of {target.wanted} wanted episodes are kept; {remedy}")
    return sentences


def beyond_step_limit(rows: Rows) -> list[str]:
    """Say which kept episodes take longer than an evaluation allows; empty where none does."""
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
    """All rows but the reserves that were not needed, and those that ``export.where`` leaves out, whatever became of
    them: without what they gave, their losses are no yield."""
    return [row for row in rows if row["reason"] != NOT_NEEDED and row["chosen"]]


def twins(rows: Rows) -> dict[str, Mapping[str, Any]]:
    """Episode id to row of the clean twins of kept episodes, as far as they were kept or ``export.where`` alone leaves
    them out: their trajectories and frames are there."""
    wanted = {row["twin_id"] for row in rows if row["kept"]}
    made = (row for row in rows if row["reason"] in MADE)
    return {row["episode_id"]: row for row in made if row["episode_id"] in wanted}


def named(rows: Rows, column: str) -> list[str]:
    """The values of a column, each once, in the order in which they come."""
    return list(dict.fromkeys(row[column] for row in rows))


def origins(rows: Rows, source: str) -> Counter[str]:
    """Who made the demonstrations of some rows, to how many: ``human``, ``recorded`` or ``expanded``.

    Args:
        source: of the run's demonstrations. Who recorded an HDF5 file, a person or a policy, is not known.
    """
    made = Counter({row["demo_id"]: row["demo_origin"] for row in rows}.values())
    if source == "hdf5" and HUMAN in made:
        made["recorded"] = made.pop(HUMAN)
    return made


def tally(rows: Rows, column: str) -> dict[str, Counter[str]]:
    """Axis to how often each value of a column occurs on it."""
    return {axis: Counter(row[column] for row in of_axis) for axis, of_axis in by_axis(rows).items()}


def by_axis(rows: Rows) -> dict[str, list[Mapping[str, Any]]]:
    """Axis to its rows."""
    return grouped((row["axis"], row) for row in rows)


def by_axis_and_suite(rows: Rows) -> dict[str, dict[str, dict[str, int]]]:
    """``counts.json``: axis to suite to the number of episodes planned, replayed and kept."""
    table: dict[str, dict[str, dict[str, int]]] = {}
    for axis, suite in dict.fromkeys((row["axis"], row["suite"]) for row in tried(rows)):
        table.setdefault(axis, {})[suite] = asdict(Counts.of(rows, axis=axis, suite=suite))
    return table


def shown(rows: Rows, episodes: Mapping[str, int]) -> Table:
    """The same as a table for people, with totals and the episodes that are wanted.

    Args:
        episodes: ``plan.episodes``.
    """
    from rich.table import Table

    suites, axes = named(rows, "suite"), named(tried(rows), "axis")
    heads = [suite.removeprefix("libero_") for suite in suites]
    found = targets(rows, episodes)
    table = Table("axis", *heads, "all", "wanted", title="planned/replayed/kept episodes")
    for column in table.columns[1:]:
        column.justify, column.no_wrap = "right", True
    for axis in axes:
        cells = [Counts.of(rows, axis=axis, suite=suite) for suite in suites]
        # A combination's name may break behind a +.
        of_axis = Counts.of(rows, axis=axis), found[axis].wanted
        table.add_row(axis.replace("+", "+ "), *map(str, (*cells, *of_axis)))
    wanted = sum(target.wanted for target in found.values())
    table.add_section()
    table.add_row("all", *(str(Counts.of(rows, suite=suite)) for suite in suites), str(Counts.of(rows)), str(wanted))
    return table
