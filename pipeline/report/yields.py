"""Tables of a run's planned episodes: the number of kept episodes, and the reasons for dropping the others."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple

from pipeline.axes import from_json
from pipeline.axes.base import LEVELS
from pipeline.grouping import grouped
from pipeline.run.counts import Counts, Diversity, Rows, Target, diversity, named, tally


class Cell(NamedTuple):
    """An entry of a table, and the share that a bar below it shows; `None` for no bar."""

    text: str
    share: float | None = None


class Table(NamedTuple):
    """A table whose first column has the names of the rows."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[Cell, ...]]


def tables(tried: Rows) -> list[Table]:
    """Tabulate yields by suite and by level, drop reasons, and replay modes.

    Args:
        tried: the planned episodes, without reserves that were not needed.
    """
    return [
        by_suite(tried),
        by_level("Kept/planned episodes, by level", tried),
        by_demonstration(tried),
        _by_axis("Dropped episodes, by reason", [row for row in tried if not row["kept"]], "reason"),
        _by_axis("Kept episodes, by replay mode", [row for row in tried if row["kept"]], "replay_mode"),
    ]


def by_task(kept: Rows) -> Table:
    """Tabulate the kept episodes and their action sequences by task, with totals."""
    body: list[tuple[Cell, ...]] = []
    for task, figures in {**diversity(kept), "all": Diversity.of(kept)}.items():
        share = figures.sequences / figures.episodes if figures.episodes else None
        numbers = (Cell(f"{figures.episodes:,}"), Cell(f"{figures.sequences:,}", share), Cell(f"{figures.original:,}"))
        body.append((Cell(task), *numbers))
    head = ("task", "episodes", "distinct sequences", "as recorded")
    return Table("Action sequences of kept episodes, by task", head, body)


def wanted_and_kept(targets: Mapping[str, Target]) -> Table:
    """Tabulate the wanted and the kept episodes of each axis."""
    body: list[tuple[Cell, ...]] = []
    for axis, target in targets.items():
        share = min(1.0, target.kept / target.wanted) if target.wanted else None
        body.append((Cell(axis), Cell(f"{target.wanted:,}"), Cell(f"{target.kept:,}", share)))
    return Table("Wanted and kept episodes", ("axis", "wanted", "kept"), body)


def by_suite(tried: Rows) -> Table:
    """Tabulate yields by axis and suite, with totals."""
    suites = named(tried, "suite")
    head = ("axis", *suites, "all")
    lines: list[tuple[str, dict[str, str]]] = [(axis, {"axis": axis}) for axis in named(tried, "axis")]
    body: list[tuple[Cell, ...]] = []
    for name, of in (*lines, ("all", {})):
        by_suites = [_kept(Counts.of(tried, suite=suite, **of)) for suite in suites]
        body.append((Cell(name), *by_suites, _kept(Counts.of(tried, **of))))
    return Table("Kept/planned episodes, by suite", head, body)


def by_level(title: str, tried: Rows, axis: str | None = None) -> Table:
    """Tabulate yields by level, for each axis, or for each component of one axis.

    An episode that several axes perturb counts for each of them.
    """
    cells: dict[str, dict[int, list[Mapping[str, Any]]]] = {}
    for row in tried:
        for perturbation in from_json(row["perturbations"]):
            if axis in (None, perturbation.axis):
                name = perturbation.axis if axis is None else perturbation.component.replace("_", " ")
                cells.setdefault(name, defaultdict(list))[perturbation.level].append(row)
    body: list[tuple[Cell, ...]] = []
    for name, rows_of_level in cells.items():
        by_levels = [_kept(Counts.of(rows_of_level[level])) for level in LEVELS]
        body.append((Cell(name), *by_levels))
    return Table(title, ("level", *map(str, LEVELS)), body)


def by_demonstration(tried: Rows) -> Table:
    """Tabulate the demonstrations of perturbed episodes by task: their numbers, and the largest share of one of them.

    A reserve that replaces a failed episode may be of another demonstration. Demonstrations whose replays often fail
    therefore have fewer kept episodes than planned ones.
    """
    body: list[tuple[Cell, ...]] = []
    perturbed = [row for row in tried if row["role"] == "perturbed"]
    for task, rows in grouped((f"{row['suite']}/{row['task']}", row) for row in perturbed).items():
        planned = Counter(row["demo_id"] for row in rows)
        wanted = Counter(row["demo_id"] for row in rows if row["wanted"])
        kept = Counter(row["demo_id"] for row in rows if row["kept"])
        number = Cell(f"{len(kept):,}/{len(planned):,}", len(kept) / len(planned))
        body.append((Cell(task), number, _largest_share(wanted), _largest_share(kept)))
    head = ("task", "kept/planned", "share planned", "share kept")
    return Table("Demonstrations of perturbed episodes, and the largest share of one, by task", head, body)


def _largest_share(counts: Counter[str]) -> Cell:
    return Cell(f"{100 * max(counts.values()) / counts.total():.0f} %" if counts else "-")


def _kept(counts: Counts) -> Cell:
    if not counts.planned:
        return Cell("-")
    return Cell(f"{counts.kept:,}/{counts.planned:,}", counts.kept / counts.planned)


def _by_axis(title: str, rows: Rows, column: str) -> Table:
    counts = tally(rows, column)
    values = sorted(set().union(*counts.values()))
    body: list[tuple[Cell, ...]] = []
    for axis, of_axis in counts.items():
        numbers = [Cell(f"{of_axis[value]:,}" if of_axis[value] else "-") for value in values]
        body.append((Cell(axis), *numbers))
    return Table(title, ("axis", *values), body)
