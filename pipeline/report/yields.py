"""Tables of what became of a run's planned episodes: how many were kept, why the others were dropped."""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple

from pipeline.axes import from_json
from pipeline.axes.base import LEVELS
from pipeline.run.counts import Counts, Rows, Target, named, tally


class Cell(NamedTuple):
    """A table's entry, and the share of a whole that a bar behind it shows, None for no bar."""

    text: str
    share: float | None = None


class Table(NamedTuple):
    """A table; the first column names the rows."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[Cell, ...]]


def tables(tried: Rows) -> list[Table]:
    """Yields by suite and by level, drop reasons, and replay modes.

    Args:
        tried: the episodes that were tried, reserves only where they were needed.
    """
    return [
        by_suite(tried),
        by_level("kept of planned, by level", tried),
        _by_axis("dropped, by reason", [row for row in tried if not row["kept"]], "reason"),
        _by_axis("kept, by how it was replayed", [row for row in tried if row["kept"]], "replay_mode"),
    ]


def wanted_and_kept(targets: Mapping[str, Target]) -> Table:
    """Kept episodes of each axis beside those that the configuration wants."""
    body: list[tuple[Cell, ...]] = []
    for axis, target in targets.items():
        share = min(1.0, target.kept / target.wanted) if target.wanted else None
        body.append((Cell(axis), Cell(f"{target.wanted:,}"), Cell(f"{target.kept:,}", share)))
    return Table("wanted and kept", ("axis", "wanted", "kept"), body)


def by_suite(tried: Rows) -> Table:
    """Yields by axis and suite, with totals."""
    suites = named(tried, "suite")
    lines: list[tuple[str, dict[str, str]]] = [(axis, {"axis": axis}) for axis in named(tried, "axis")]
    return Table(
        "kept of planned, by suite",
        ("axis", *(suite.removeprefix("libero_") for suite in suites), "all"),
        [
            (
                Cell(name),
                *(_kept(Counts.of(tried, suite=suite, **of)) for suite in suites),
                _kept(Counts.of(tried, **of)),
            )
            for name, of in (*lines, ("all", {}))
        ],
    )


def by_level(title: str, tried: Rows, axis: str | None = None) -> Table:
    """Yields by level, of each axis, or of each component of one; what several axes perturb counts with each."""
    cells: dict[str, dict[int, list[Mapping[str, Any]]]] = {}
    for row in tried:
        for made in from_json(row["perturbations"]):
            if axis in (None, made.axis):
                name = made.axis if axis is None else made.component.replace("_", " ")
                cells.setdefault(name, defaultdict(list))[made.level].append(row)
    body = [(Cell(key), *(_kept(Counts.of(found[level])) for level in LEVELS)) for key, found in cells.items()]
    return Table(title, ("level", *map(str, LEVELS)), body)


def _kept(counts: Counts) -> Cell:
    if not counts.planned:
        return Cell("-")
    return Cell(f"{counts.kept:,}/{counts.planned:,}", counts.kept / counts.planned)


def _by_axis(title: str, rows: Rows, column: str) -> Table:
    counts = tally(rows, column)
    values = sorted({value for of_axis in counts.values() for value in of_axis})
    body = [
        (Cell(axis), *(Cell(f"{of_axis[value]:,}" if of_axis[value] else "-") for value in values))
        for axis, of_axis in counts.items()
    ]
    return Table(title, ("axis", *values), body)
