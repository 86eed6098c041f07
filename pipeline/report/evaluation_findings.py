"""Content of a report of evaluations, as JSON: rates, the paper's table, comparisons, failures."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import yaml

from pipeline.axes import AXES, level_of_test
from pipeline.evaluation.results import PER_TASK, EpisodeResult, Evaluated
from pipeline.evaluation.statistics import compare, paired, success_rate, summary, wilson
from pipeline.grouping import grouped
from pipeline.testset import benchmark

SOURCES = ("libero_plus", "own", "libero")
"""Sources of tasks, in a report's order; other sources follow."""

FAILURES = 3
"""Number of failures shown of each policy, source and axis."""

_FACTS = ("episode", "source", "suite", "name", "axis", "component", "level", "instruction", "reason", "steps", "looks")


def findings(policies: Sequence[Evaluated]) -> dict[str, Any]:
    """Compute the findings of evaluations, JSON-serialisable.

    Returns:
        ``policies``: name to settings, versions, number of rejected episodes, ``overall``: the ``success_rate`` of all
        its episodes, and ``results``: ``summary`` by source.
        ``paper_table``: see ``paper_table``; `None` if no test task was run.
        ``comparisons``: each pair of policies on the episodes of a source that both ran, see ``compare``.
        ``common``: source to the number of episodes that all policies with results of the source ran.
        ``failures``: episodes to show, and whether there is a video.
    """
    present: set[str] = set()
    for policy in policies:
        present |= {row.source for row in policy.rows}
    sources = [*(source for source in SOURCES if source in present), *sorted(present.difference(SOURCES))]
    tested = {
        policy.name: policy.from_source("libero_plus") for policy in policies if policy.from_source("libero_plus")
    }
    return {
        "policies": {policy.name: _policy_findings(policy, sources) for policy in policies},
        "common": {source: _common_trials(policies, source) for source in sources},
        "paper_table": paper_table(tested) if tested else None,
        "comparisons": _comparisons(policies, sources),
        "failures": _failures(policies),
    }


def _policy_findings(policy: Evaluated, sources: Sequence[str]) -> dict[str, Any]:
    results = {}
    overall = success_rate(policy.rows)
    for source in sources:
        rows = policy.from_source(source)
        if rows:
            results[source] = summary(rows)
    return {
        "settings": policy.settings,
        "versions": _versions(policy.rows),
        "refused": policy.refused,
        "overall": overall,
        "results": results,
    }


def _common_trials(policies: Sequence[Evaluated], source: str) -> int:
    """Count the trials of a source that are common to all policies with results of the source."""
    trials = []
    for policy in policies:
        rows = policy.from_source(source)
        if rows:
            trials.append({row.trial for row in rows})
    return len(set.intersection(*trials))


def _comparisons(policies: Sequence[Evaluated], sources: Sequence[str]) -> list[dict[str, Any]]:
    comparisons = []
    for source in sources:
        for first, second in combinations(policies, 2):
            pairs = paired(first.from_source(source), second.from_source(source))
            if pairs:
                comparisons.append({"source": source, "first": first.name, "second": second.name, **compare(pairs)})
    return comparisons


def _failures(policies: Sequence[Evaluated]) -> list[dict[str, Any]]:
    failures = []
    for policy in policies:
        for row in _shown_failures(policy):
            facts = {name: getattr(row, name) for name in _FACTS}
            failures.append({"policy": policy.name, "video": row.episode in policy.videos, **facts})
    return failures


def _shown_failures(policy: Evaluated) -> list[EpisodeResult]:
    """Choose failures of each source and axis: with a video first, then by level from the weakest, then by name."""
    failed = [row for row in policy.rows if not row.success]
    failed.sort(key=lambda row: (row.axis, row.episode not in policy.videos, row.level, row.episode))
    groups = grouped(((row.axis, row.source), row) for row in failed)
    return list(chain.from_iterable(group[:FAILURES] for group in groups.values()))


def _versions(rows: Sequence[EpisodeResult]) -> dict[str, list[str]]:
    versions: dict[str, set[str]] = {}
    for row in rows:
        for name, version in row.versions.items():
            if name not in PER_TASK:
                versions.setdefault(name, set()).add(version)
    return {name: sorted(found) for name, found in versions.items()}


PUBLISHED = Path(__file__).with_name("published.yaml")

DIMENSIONS = ("camera", "robot", "language", "light", "background", "noise", "layout")
"""The paper's dimensions, in the order of its tables."""

COLUMNS = {
    dimension: tuple(name for name, axis in AXES.items() if axis.dimension == dimension) for dimension in DIMENSIONS
}
"""The paper's dimensions to this project's axes."""


@dataclass(frozen=True)
class Estimate:
    """A success rate over the benchmark's tasks, estimated from some of them.

    Attributes:
        rate: in [0, 1].
        effective: the number of equally weighted episodes that would be as informative (Kish, 1965).
        low, high: Wilson's 95 % interval for that number (Korn and Graubard, 1998).
        absent: the parts of the benchmark without any episode.
    """

    episodes: int
    rate: float
    effective: float
    low: float
    high: float
    absent: str = ""


def paper_table(policies: Mapping[str, Sequence[EpisodeResult]]) -> dict[str, Any]:
    """Compute the paper's table, with policies next to the published models; JSON-serialisable.

    A balanced subset has as many easy tasks as hard tasks, unlike the benchmark. An episode is therefore weighted
    by the number of test tasks of its axis, component and level, divided by the number of its episodes. Parts of the
    benchmark without an episode are left out of a column, and reported.

    Args:
        policies: name to episodes on test tasks.

    Returns:
        ``source``: reference of the published rows.
        ``tasks``: column to the number of test tasks in it.
        ``shared``: the columns that every evaluated policy was measured on.
        ``evaluated``: rows with ``name``, ``cells``, ``total`` and ``shared``. ``cells`` map each measured column to an
        ``Estimate``. ``total`` is over all columns, weighted by their numbers of tasks; it is `None` if a column was
        not measured. ``shared`` is the total over the shared columns.
        ``published``: rows with ``name``, ``rates`` by column in percent, ``total``, and ``shared``, which is not in
        the paper.
    """
    tasks = {column: _sizes(axes, 1).total() for column, axes in COLUMNS.items()}
    measured = {name: _cells(rows) for name, rows in policies.items()}
    shared = set(COLUMNS).intersection(*measured.values())
    shared_columns = [column for column in COLUMNS if column in shared]
    evaluated = [_evaluated_row(name, cells, shared_columns, tasks) for name, cells in measured.items()]
    packed = yaml.safe_load(PUBLISHED.read_text())
    published = []
    for name, row in packed["models"].items():
        rates = dict(zip(packed["columns"], row["rates"], strict=True))
        mean = _mean({column: rates[column] for column in shared_columns}, tasks) if shared_columns else None
        published.append({"name": name, "rates": rates, "total": row["total"], "shared": mean})
    return {
        "source": packed["source"],
        "tasks": tasks,
        "shared": shared_columns,
        "published": published,
        "evaluated": evaluated,
    }


def _evaluated_row(
    name: str, cells: Mapping[str, Estimate], shared: Sequence[str], tasks: Mapping[str, int]
) -> dict[str, Any]:
    total = _joined(cells, tasks) if len(cells) == len(COLUMNS) else None
    over_shared = _joined({column: cells[column] for column in shared}, tasks) if shared else None
    return {
        "name": name,
        "cells": {column: asdict(cell) for column, cell in cells.items()},
        "total": None if total is None else asdict(total),
        "shared": None if over_shared is None else asdict(over_shared),
    }


def _cells(rows: Sequence[EpisodeResult]) -> dict[str, Estimate]:
    """Estimate the success rate in each column that has episodes."""
    cells = {}
    for column, axes in COLUMNS.items():
        cell = _cell(rows, axes)
        if cell is not None:
            cells[column] = cell
    return cells


def _cell(rows: Sequence[EpisodeResult], axes: Sequence[str]) -> Estimate | None:
    chosen = [row for row in rows if row.axis in axes]
    outcomes = grouped((_stratum(row), row.success) for row in chosen)
    if not outcomes:
        return None
    strata = {}
    for stratum, successes in outcomes.items():
        number = len(successes)
        strata[stratum] = Estimate(number, sum(successes) / number, number, 0, 1)
    return replace(_joined(strata, _sizes(axes, 3)), absent=_absent(chosen, axes))


def _stratum(row: EpisodeResult) -> tuple[str, str, int]:
    """Return axis, component and level from the benchmark: a result of an earlier version may have another level."""
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
    descriptions = []
    for kind, levels in missing.items():
        partly = any(stratum[:2] == kind for stratum in run)
        which = f" level {' and '.join(map(str, levels))}" if partly else ""
        count = sum(sizes[(*kind, level)] for level in levels)
        axis, component = kind
        descriptions.append(f"{AXES[axis].test_name or component}{which} ({count:,} tasks)")
    axes_run = {axis for axis, *_ in run}
    suites = {suite for axis, _, _, suite in _tests() if axis in axes_run}
    return ", ".join([*descriptions, *sorted(suites - {row.suite for row in rows})])


def _sizes(axes: Sequence[str], columns: int) -> Counter[Any]:
    """Count the test tasks of some axes by the first columns of ``_tests``."""
    sizes: Counter[Any] = Counter()
    for kind, count in _tests().items():
        if kind[0] in axes:
            sizes[kind[:columns]] += count
    return sizes


@cache
def _tests() -> Counter[tuple[str, str, int, str]]:
    return Counter((test.axis, test.component, level_of_test(test), test.suite) for test in benchmark.load().tasks)
