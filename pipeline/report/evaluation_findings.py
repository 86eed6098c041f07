"""All that a report of evaluations says, as JSON: rates, the paper's table, comparisons, failures."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import yaml

from pipeline.axes import level_of_test
from pipeline.evaluation.results import PER_TASK, EpisodeResult, Evaluated
from pipeline.evaluation.statistics import compare, paired, success_rate, summary, wilson
from pipeline.grouping import grouped
from pipeline.testset import benchmark

SOURCES = ("libero_plus", "own", "libero")
"""Of tasks, in a report's order; others follow."""

FAILURES = 3
"""So many are shown of each policy, source and axis."""

_FACTS = ("episode", "source", "suite", "name", "axis", "component", "level", "instruction", "reason", "steps", "looks")


def findings(policies: Sequence[Evaluated]) -> dict[str, Any]:
    """The findings, JSON-serialisable.

    Returns:
        ``policies``: name to settings, versions, number of refused episodes, ``overall``: the ``success_rate`` of all
        its episodes, and ``results``: ``summary`` by source.
        ``paper_table``: see there; None where no test task was run.
        ``comparisons``: each two policies on the episodes of a source that both ran, see ``compare``.
        ``common``: source to the number of episodes that all policies ran which ran any of it.
        ``failures``: episodes to show, and whether there is a video.
    """
    present = {row.source for policy in policies for row in policy.rows}
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
        "common": {
            source: len(
                set.intersection(*({row.trial for row in rows} for one in policies if (rows := one.of(source))))
            )
            for source in sources
        },
        "paper_table": paper_table(tested) if tested else None,
        "comparisons": [
            {"source": source, "first": one.name, "second": other.name, **compare(pairs)}
            for source in sources
            for one, other in combinations(policies, 2)
            if (pairs := paired(one.of(source), other.of(source)))
        ],
        "failures": [
            {
                "policy": policy.name,
                "video": row.episode in policy.videos,
                **{name: getattr(row, name) for name in _FACTS},
            }
            for policy in policies
            for row in _shown_failures(policy)
        ],
    }


def _shown_failures(policy: Evaluated) -> list[EpisodeResult]:
    """Of each source and axis those with a video first, then the weakest perturbations, then by name."""
    failed = [row for row in policy.rows if not row.success]
    failed.sort(key=lambda row: (row.axis, row.episode not in policy.videos, row.level, row.episode))
    groups = grouped(((row.axis, row.source), row) for row in failed)
    return [row for group in groups.values() for row in group[:FAILURES]]


def _versions(rows: Sequence[EpisodeResult]) -> dict[str, list[str]]:
    names = dict.fromkeys(name for row in rows for name in row.versions if name not in PER_TASK)
    return {name: sorted({row.versions[name] for row in rows if name in row.versions}) for name in names}


PUBLISHED = Path(__file__).with_name("published.yaml")

_SAME = ("camera", "robot", "language", "light", "background", "noise")
COLUMNS: dict[str, tuple[str, ...]] = {**{axis: (axis,) for axis in _SAME}, "layout": ("layout", "pose")}
"""The paper's dimensions to this project's axes."""

NAMES = {("layout", "objects"): "confounding objects", ("pose", "pose"): "displaced targets"}
"""What the paper calls the two components of its layout."""


@dataclass(frozen=True)
class Estimate:
    """A success rate over the benchmark's tasks, from some of them.

    Attributes:
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


def paper_table(policies: Mapping[str, Sequence[EpisodeResult]]) -> dict[str, Any]:
    """The paper's table, policies beside the published models; JSON-serialisable.

    An evaluation on a balanced subset has as many easy tasks as hard ones, and the benchmark has not. So an episode
    stands for as many test tasks as there are of its axis, component and level for each one that was run. What no
    episode was run of is left out of a column, and said.

    Args:
        policies: name to episodes on test tasks.

    Returns:
        ``source``: of the published rows.
        ``tasks``: column to the number of test tasks in it.
        ``shared``: the columns that every evaluated policy was measured on.
        ``evaluated``: rows with ``name``, ``cells``, which are column to an ``Estimate`` where it was measured,
        ``total`` over all columns, weighted by their numbers of tasks, None where one was not measured, and ``shared``,
        the same over the shared columns.
        ``published``: rows with ``name``, ``rates`` by column in percent, ``total``, and ``shared``, which is not in
        the paper.
    """
    tasks = {column: _sizes(axes, 1).total() for column, axes in COLUMNS.items()}
    cells = {
        name: {column: cell for column, axes in COLUMNS.items() if (cell := _cell(rows, axes))}
        for name, rows in policies.items()
    }
    shared = [column for column in COLUMNS if all(column in measured for measured in cells.values())]
    evaluated = [
        {
            "name": name,
            "cells": {column: asdict(cell) for column, cell in measured.items()},
            "total": asdict(_joined(measured, tasks)) if len(measured) == len(COLUMNS) else None,
            "shared": asdict(_joined({column: measured[column] for column in shared}, tasks)) if shared else None,
        }
        for name, measured in cells.items()
    ]
    packed = yaml.safe_load(PUBLISHED.read_text())
    published = []
    for name, row in packed["models"].items():
        rates = dict(zip(packed["columns"], row["rates"], strict=True))
        mean = _mean({column: rates[column] for column in shared}, tasks) if shared else None
        published.append({"name": name, "rates": rates, "total": row["total"], "shared": mean})
    found = {"source": packed["source"], "tasks": tasks, "shared": shared}
    return {**found, "published": published, "evaluated": evaluated}


def _cell(rows: Sequence[EpisodeResult], axes: Sequence[str]) -> Estimate | None:
    chosen = [row for row in rows if row.axis in axes]
    outcomes = grouped((_stratum(row), row.success) for row in chosen)
    if not outcomes:
        return None
    strata = {
        stratum: Estimate(len(listed), sum(listed) / len(listed), len(listed), 0, 1)
        for stratum, listed in outcomes.items()
    }
    return replace(_joined(strata, _sizes(axes, 3)), absent=_absent(chosen, axes))


def _stratum(row: EpisodeResult) -> tuple[str, str, int]:
    """Axis, component and level; a result of an earlier version may state another level."""
    return row.axis, row.component, level_of_test(benchmark.load().find(row.suite, row.name))


def _joined(parts: Mapping[Any, Estimate], sizes: Mapping[Any, int]) -> Estimate:
    rate = _mean({name: part.rate for name, part in parts.items()}, sizes)
    whole = sum(sizes[name] for name in parts)
    effective = whole**2 / sum(sizes[name] ** 2 / part.effective for name, part in parts.items())
    low, high = wilson(rate * effective, effective)
    return Estimate(sum(part.episodes for part in parts.values()), rate, effective, low, high)


def _mean(rates: Mapping[Any, float], sizes: Mapping[Any, int]) -> float:
    return sum(sizes[name] * rate for name, rate in rates.items()) / sum(sizes[name] for name in rates)


def _absent(rows: Sequence[EpisodeResult], axes: Sequence[str]) -> str:
    run, sizes = {_stratum(row) for row in rows}, _sizes(axes, 3)
    missing = grouped((stratum[:2], stratum[2]) for stratum in sorted(sizes.keys() - run))
    told = []
    for kind, levels in missing.items():
        partly = any(stratum[:2] == kind for stratum in run)
        which = f" level {' and '.join(map(str, levels))}" if partly else ""
        count = sum(sizes[(*kind, level)] for level in levels)
        told.append(f"{NAMES.get(kind, kind[1])}{which} ({count:,} tasks)")
    suites = {suite for axis, _, _, suite in _tests() if axis in {axis for axis, *_ in run}}
    return ", ".join([*told, *sorted(suites - {row.suite for row in rows})])


def _sizes(axes: Sequence[str], columns: int) -> Counter[Any]:
    """How many test tasks of some axes there are, by the first columns of ``_tests``."""
    sizes: Counter[Any] = Counter()
    for kind, count in _tests().items():
        if kind[0] in axes:
            sizes[kind[:columns]] += count
    return sizes


@cache
def _tests() -> Counter[tuple[str, str, int, str]]:
    return Counter((test.axis, test.component, level_of_test(test), test.suite) for test in benchmark.load().tasks)
