"""Tables of what became of a run's planned episodes: how many were kept, why the others were dropped."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, get_args

from pipeline.axes import from_json
from pipeline.axes.base import Level
from pipeline.run import manifest

LEVELS: tuple[Level, ...] = get_args(Level)

Rows = Sequence[Mapping[str, Any]]
"""Rows of the manifest."""


class Cell(NamedTuple):
    """A table's entry, and the share of a whole that a bar behind it shows, None for no bar."""

    text: str
    share: float | None = None


class Table(NamedTuple):
    """A table; the first column names the rows."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[Cell, ...]]


def tables(asked: Rows) -> list[Table]:
    """Yields by suite and by level, drop reasons, and replay modes.

    Args:
        asked: the episodes that were tried, reserves only where they were needed.
    """
    return [
        by_suite(asked),
        by_level("kept of planned, by level", asked),
        _by_axis("dropped, by reason", [row for row in asked if not row["kept"]], "reason"),
        _by_axis("kept, by how it was replayed", [row for row in asked if row["kept"]], "replay_mode"),
    ]


def by_suite(asked: Rows) -> Table:
    """Yields by axis and suite, with totals."""
    suites = list(dict.fromkeys(row["suite"] for row in asked))
    lines = {axis: where(asked, axis=axis) for axis in dict.fromkeys(row["axis"] for row in asked)} | {"all": asked}
    return Table(
        "kept of planned, by suite",
        ("axis", *(suite.removeprefix("libero_") for suite in suites), "all"),
        [
            (Cell(name), *(_kept_of(where(line, suite=suite)) for suite in suites), _kept_of(line))
            for name, line in lines.items()
        ],
    )


def by_level(title: str, asked: Rows, axis: str | None = None) -> Table:
    """Yields by level, of each axis, or of each component of one; what several axes perturb counts with each."""
    cells: dict[str, dict[int, list[Mapping[str, Any]]]] = {}
    for row in asked:
        for made in from_json(row["perturbations"]):
            if axis in (None, made.axis):
                name = made.axis if axis is None else made.component.replace("_", " ")
                cells.setdefault(name, defaultdict(list))[made.level].append(row)
    body = [(Cell(key), *(_kept_of(found[level]) for level in LEVELS)) for key, found in cells.items()]
    return Table(title, ("level", *map(str, LEVELS)), body)


def where(rows: Rows, **wanted: str) -> Rows:
    """The rows that have these values."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def _kept_of(rows: Rows) -> Cell:
    kept = sum(row["kept"] for row in rows)
    return Cell(f"{kept:,}/{len(rows):,}", kept / len(rows)) if rows else Cell("-")


def _by_axis(title: str, rows: Rows, column: str) -> Table:
    """How often each value of a column occurs on each axis."""
    counts = manifest.tally(rows, column)
    values = sorted({value for of_axis in counts.values() for value in of_axis})
    body = [
        (Cell(axis), *(Cell(f"{of_axis[value]:,}" if of_axis[value] else "-") for value in values))
        for axis, of_axis in counts.items()
    ]
    return Table(title, ("axis", *values), body)
