"""All that a report of evaluations says, as JSON: rates, the paper's table, comparisons, failures."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.evaluation import libero_plus
from pipeline.evaluation.results import Evaluated, Row
from pipeline.evaluation.statistics import compare, paired, success_rate, summary, wilson
from pipeline.testset.benchmark import TestTask

SOURCES = ("libero_plus", "own", "libero")
"""Of tasks, in a report's order; others follow."""


FAILURES = 3
"""So many are shown of each policy, source and axis."""


_FACTS = ("episode", "source", "suite", "name", "axis", "component", "level", "prompt", "reason", "steps", "looks")


def findings(policies: Sequence[Evaluated]) -> dict[str, Any]:
    """The findings, JSON-serialisable.

    Returns:
        ``policies``: name to settings, versions, number of refused episodes, ``overall``: the ``success_rate`` of all
        its episodes, and ``results``: ``summary`` by source.
        ``paper_table``: see ``PaperTable``; None where no test task was run.
        ``comparisons``: each two policies on the episodes of a source that both ran, see ``compare``.
        ``common``: source to the number of episodes that all policies ran which ran any of it.
        ``failures``: episodes to show, and whether there is a video.
    """
    present = {row["source"] for policy in policies for row in policy.rows}
    sources = [*(source for source in SOURCES if source in present), *sorted(present.difference(SOURCES))]
    tested = {policy.name: rows for policy in policies if (rows := policy.of("libero_plus"))}
    return {
        "policies": {
            policy.name: {
                "settings": policy.settings,
                "versions": _versions(policy.rows),
                "refused": policy.refused,
                "overall": success_rate(policy.rows),
                "results": {source: summary(rows) for source in sources if (rows := policy.of(source))},
            }
            for policy in policies
        },
        "common": {source: _common([rows for policy in policies if (rows := policy.of(source))]) for source in sources},
        "paper_table": _plain(paper_table(tested)) if tested else None,
        "comparisons": [
            {"source": source, "first": one.name, "second": other.name, **compare(pairs)}
            for source in sources
            for one, other in combinations(policies, 2)
            if (pairs := paired(one.of(source), other.of(source)))
        ],
        "failures": [
            {"policy": policy.name, "video": row["episode"] in policy.videos, **{name: row[name] for name in _FACTS}}
            for policy in policies
            for row in _shown_failures(policy)
        ],
    }


def _common(rows: Sequence[Sequence[Row]]) -> int:
    return len(set.intersection(*({(row["suite"], row["name"], row["seed"]) for row in group} for group in rows)))


def _shown_failures(policy: Evaluated) -> list[Row]:
    """Of each source and axis those with a video first, then the weakest perturbations, then by name."""
    failed = [row for row in policy.rows if not row["success"]]
    failed.sort(key=lambda row: (row["axis"], row["episode"] not in policy.videos, row["level"], row["episode"]))
    taken: Counter[tuple[str, str]] = Counter()
    shown = []
    for row in failed:
        taken[row["source"], row["axis"]] += 1
        if taken[row["source"], row["axis"]] <= FAILURES:
            shown.append(row)
    return shown


def _versions(rows: Sequence[Row]) -> dict[str, list[str]]:
    """Package, and what rendered, to its versions; several where machines differ."""
    names = dict.fromkeys(name for row in rows for name in row["versions"])
    return {name: sorted({row["versions"][name] for row in rows if name in row["versions"]}) for name in names}


def _plain(value: Any) -> Any:
    """Named tuples as objects, by the names of their fields."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: _plain(field) for name, field in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


PUBLISHED = Path(__file__).with_name("published.yaml")


COLUMNS = {
    "camera": ("camera",),
    "robot": ("robot",),
    "language": ("language",),
    "light": ("light",),
    "background": ("background",),
    "noise": ("noise",),
    "layout": ("layout", "pose"),
}
"""The paper's dimensions to this project's axes."""


NAMES = {("layout", "objects"): "confounding objects", ("pose", "pose"): "displaced targets"}
"""What the paper calls the two components of its layout."""


class Estimate(NamedTuple):
    """A success rate over the benchmark's tasks, from some of them.

    Attributes:
        episodes: it rests on.
        rate: in [0, 1].
        effective: the number of equally weighted episodes that would be as informative (Kish, 1965).
        low, high: Wilson's 95 % interval for that number (Korn and Graubard, 1998).
        absent: what of the benchmark no episode stands for.
    """

    episodes: int
    rate: float
    effective: float
    low: float
    high: float
    absent: str = ""


class Line(NamedTuple):
    """A row of the table.

    Attributes:
        name: of the model.
        cells: column to its estimate, for those that were measured.
        total: over all columns, weighted by their numbers of tasks; None where one was not measured.
        shared: the same over the columns that every evaluated policy was measured on.
    """

    name: str
    cells: Mapping[str, Estimate]
    total: Estimate | None
    shared: Estimate | None


class Published(NamedTuple):
    """A row of the paper's table, in percent; ``shared`` is as in ``Line``, and not in the paper."""

    name: str
    rates: Mapping[str, float]
    total: float
    shared: float | None


class PaperTable(NamedTuple):
    """The table.

    Attributes:
        source: of the published rows.
        tasks: column to the number of test tasks in it.
        shared: the columns that every evaluated policy was measured on.
        published, evaluated: rows.
    """

    source: str
    tasks: Mapping[str, int]
    shared: tuple[str, ...]
    published: list[Published]
    evaluated: list[Line]


def paper_table(policies: Mapping[str, Sequence[Row]]) -> PaperTable:
    """Set policies beside the published models.

    Args:
        policies: name to episodes on test tasks.
    """
    tasks = {column: sum(_tests(axis).total() for axis in axes) for column, axes in COLUMNS.items()}
    cells = {
        name: {column: cell for column, axes in COLUMNS.items() if (cell := _cell(rows, axes))}
        for name, rows in policies.items()
    }
    shared = tuple(column for column in COLUMNS if all(column in measured for measured in cells.values()))
    lines = [
        Line(
            name,
            measured,
            _joined(measured, tasks) if len(measured) == len(COLUMNS) else None,
            _joined({column: measured[column] for column in shared}, tasks) if shared else None,
        )
        for name, measured in cells.items()
    ]
    packed = yaml.safe_load(PUBLISHED.read_text())
    published = []
    for name, row in packed["models"].items():
        rates = dict(zip(packed["columns"], row["rates"], strict=True))
        common = {column: rates[column] for column in shared}
        published.append(Published(name, rates, row["total"], _mean(common, tasks) if shared else None))
    return PaperTable(packed["source"], tasks, shared, published, lines)


def _cell(rows: Sequence[Row], axes: Sequence[str]) -> Estimate | None:
    """A column's rate; None where it has no episode."""
    outcomes: dict[tuple[Any, ...], list[bool]] = defaultdict(list)
    chosen = [row for row in rows if row["axis"] in axes]
    for row in chosen:
        outcomes[row["axis"], row["component"], row["level"]].append(bool(row["success"]))
    if not outcomes:
        return None
    sizes: Counter[Any] = Counter()
    for axis in axes:
        for (component, level, _), count in _tests(axis).items():
            sizes[axis, component, level] += count
    strata = {
        stratum: Estimate(len(listed), sum(listed) / len(listed), len(listed), 0, 1)
        for stratum, listed in outcomes.items()
    }
    return _joined(strata, sizes)._replace(absent=_absent(chosen, axes))


def _joined(parts: Mapping[Any, Estimate], sizes: Mapping[Any, int]) -> Estimate:
    """The rate over several parts of the benchmark, each weighted by its number of tasks."""
    rate = _mean({name: part.rate for name, part in parts.items()}, sizes)
    whole = sum(sizes[name] for name in parts)
    effective = whole**2 / sum(sizes[name] ** 2 / part.effective for name, part in parts.items())
    low, high = wilson(rate * effective, effective)
    return Estimate(sum(part.episodes for part in parts.values()), rate, effective, low, high)


def _mean(rates: Mapping[Any, float], sizes: Mapping[Any, int]) -> float:
    """The mean, weighted by the numbers of tasks."""
    return sum(sizes[name] * rate for name, rate in rates.items()) / sum(sizes[name] for name in rates)


def _absent(rows: Sequence[Row], axes: Sequence[str]) -> str:
    """Which components, suites and levels of a column have no episode."""
    said = []
    for axis in axes:
        run = {row["component"] for row in rows if row["axis"] == axis}
        sizes: Counter[str] = Counter()
        for (component, _, _), count in _tests(axis).items():
            sizes[component] += count if component not in run else 0
        said += [f"{NAMES.get((axis, name), name)} ({count:,} tasks)" for name, count in sorted((+sizes).items())]
    tests = [key for axis in axes if axis in {row["axis"] for row in rows} for key in _tests(axis)]
    for at, column in ((2, "suite"), (1, "level")):
        missing = {key[at] for key in tests} - {row[column] for row in rows}
        said += [f"{column} {value}" if column == "level" else str(value) for value in sorted(missing)]
    return ", ".join(said)


@cache
def _tests(axis: str) -> Counter[tuple[str, int, str]]:
    """How many test tasks of an axis there are of each component, level and suite."""
    tests: Iterable[TestTask] = libero_plus.by_name().values()
    return Counter((test.component, libero_plus.level_of(test), test.suite) for test in tests if test.axis == axis)
