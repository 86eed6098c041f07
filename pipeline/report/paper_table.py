"""The paper's table: success rates by LIBERO-Plus's seven dimensions, next to published models."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import yaml

from pipeline.axes import AXES, level_of_test
from pipeline.evaluation.analyses.tested import TestedPolicy
from pipeline.evaluation.statistics import wilson
from pipeline.grouping import grouped
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestTask

PUBLISHED = Path(__file__).with_name("published.yaml")

DIMENSIONS = ("camera", "robot", "language", "light", "background", "noise", "layout")
"""The paper's dimensions, in the order of its tables."""

AXES_OF_DIMENSION = {
    dimension: tuple(name for name, axis in AXES.items() if axis.dimension == dimension) for dimension in DIMENSIONS
}
"""The paper's dimensions to this project's axes."""


class Scored(Protocol):
    """Outcome of an episode on a test task, such as an ``EpisodeResult`` or an ``Outcome``."""

    @property
    def suite(self) -> str:
        """Return the suite of the test task."""

    @property
    def name(self) -> str:
        """Return the name of the test task."""

    @property
    def success(self) -> bool:
        """Return whether the episode reached its goal."""


@dataclass(frozen=True)
class Estimate:
    """A success rate over the benchmark's tasks, estimated from some of them.

    Attributes:
        episodes: number of episodes.
        tasks: number of test tasks with an episode.
        rate: in [0, 1].
        effective: the number of equally weighted tasks that would be as informative (Kish, 1965).
        low, high: Wilson's 95 % interval for that number (Korn and Graubard, 1998).
        absent: the parts of the benchmark without any episode.
    """

    episodes: int
    tasks: int
    rate: float
    effective: float
    low: float
    high: float
    absent: str = ""


def table_of(policies: Sequence[TestedPolicy]) -> dict[str, Any]:
    """Compute the paper's table, and the protocol of each evaluated policy; JSON-serialisable.

    Args:
        policies: outcomes of policies with different names.

    Returns:
        The content of ``paper_table``. Each evaluated row also has its ``protocol``:
        ``program``, ``prompt``, ``black``, ``step_limits``, ``left_out``, ``mixed_versions``, ``tasks_run`` and
        ``trials``, the smallest and the largest number of episodes of a task.
    """
    table = paper_table({policy.name: policy.outcomes for policy in policies})
    for row, policy in zip(table["evaluated"], policies, strict=True):
        episodes = Counter((outcome.suite, outcome.name) for outcome in policy.outcomes)
        row["protocol"] = {
            "program": policy.program,
            "prompt": policy.prompt,
            "black": policy.black,
            "step_limits": {suite: list(limits) for suite, limits in policy.step_limits.items()},
            "left_out": policy.left_out,
            "mixed_versions": policy.mixed_versions,
            "tasks_run": len(episodes),
            "trials": [min(episodes.values()), max(episodes.values())],
        }
    return table


def paper_table(policies: Mapping[str, Sequence[Scored]]) -> dict[str, Any]:
    """Compute the paper's table, with policies next to the published models; JSON-serialisable.

    A balanced subset has as many easy tasks as hard tasks, and equally many of each suite, unlike the benchmark. A task
    is therefore weighted by the number of test tasks of its axis, component, level and suite, divided by the number of
    these tasks with an episode. Suites without an episode at a level are represented by the other suites. Other parts
    of the benchmark without an episode are left out of a column, and reported. The rate of a task with several episodes
    is their mean.

    Args:
        policies: name to episodes on test tasks.

    Returns:
        ``source``: reference of the published rows. ``protocol``: how they were measured, as far as it is known.
        ``tasks``: column to the number of test tasks in it.
        ``shared``: the columns that every evaluated policy was measured on.
        ``evaluated``: rows with ``name``, ``cells``, ``total``, ``mean`` and ``shared``. ``cells`` map each measured
        column to an ``Estimate``. ``total`` is over all columns, weighted by their numbers of tasks. ``mean`` is the
        mean of the seven columns. Both are `None` if a column was not measured. ``shared`` is the total over the shared
        columns.
        ``published``: rows with ``name``, ``rates`` by column in percent, ``total``, and ``mean`` and ``shared``, which
        are not in the paper.
    """
    tasks = {column: _sizes(axes, 1).total() for column, axes in AXES_OF_DIMENSION.items()}
    measured = {name: _cells(rows) for name, rows in policies.items()}
    shared = set(AXES_OF_DIMENSION).intersection(*measured.values())
    shared_columns = [column for column in AXES_OF_DIMENSION if column in shared]
    evaluated = [_evaluated_row(name, cells, shared_columns, tasks) for name, cells in measured.items()]
    packed = yaml.safe_load(PUBLISHED.read_text())
    equal = dict.fromkeys(AXES_OF_DIMENSION, 1)
    published = []
    for name, row in packed["models"].items():
        rates = dict(zip(packed["columns"], row["rates"], strict=True))
        over_shared = _mean({column: rates[column] for column in shared_columns}, tasks) if shared_columns else None
        mean = _mean(rates, equal)
        published.append({"name": name, "rates": rates, "total": row["total"], "mean": mean, "shared": over_shared})
    return {
        "source": packed["source"],
        "protocol": packed["protocol"],
        "tasks": tasks,
        "shared": shared_columns,
        "published": published,
        "evaluated": evaluated,
    }


def _evaluated_row(
    name: str, cells: Mapping[str, Estimate], shared: Sequence[str], tasks: Mapping[str, int]
) -> dict[str, Any]:
    """Collect the cells of an evaluated policy, its total, its mean and its total over the shared columns."""
    whole = len(cells) == len(AXES_OF_DIMENSION)
    total = _joined(cells, tasks) if whole else None
    mean = _joined(cells, dict.fromkeys(AXES_OF_DIMENSION, 1)) if whole else None
    over_shared = _joined({column: cells[column] for column in shared}, tasks) if shared else None
    return {
        "name": name,
        "cells": {column: asdict(cell) for column, cell in cells.items()},
        "total": None if total is None else asdict(total),
        "mean": None if mean is None else asdict(mean),
        "shared": None if over_shared is None else asdict(over_shared),
    }


def _cells(rows: Iterable[Scored]) -> dict[str, Estimate]:
    """Estimate the success rate in each column that has episodes."""
    outcomes = grouped(((row.suite, row.name), row.success) for row in rows)
    by_axis = grouped((test.axis, (test, successes)) for test, successes in _of_tests(outcomes))
    cells = {}
    for column, axes in AXES_OF_DIMENSION.items():
        chosen = list(chain.from_iterable(by_axis.get(axis, ()) for axis in axes))
        if chosen:
            cells[column] = _cell(chosen, axes)
    return cells


TestOutcomes = tuple[TestTask, Sequence[bool]]
"""A test task, and the outcomes of its episodes."""


def _of_tests(outcomes: Mapping[tuple[str, str], Sequence[bool]]) -> Iterable[TestOutcomes]:
    """Yield the test task of each suite and name, and its outcomes."""
    for (suite, name), successes in outcomes.items():
        yield benchmark.load().find(suite, name), successes


def _cell(outcomes: Sequence[TestOutcomes], axes: Sequence[str]) -> Estimate:
    """Estimate the success rate of a column from the outcomes of its test tasks with an episode."""
    by_suite = grouped(((*_stratum(test), test.suite), successes) for test, successes in outcomes)
    suites_of: dict[tuple[str, str, int], dict[tuple[str, str, int, str], Estimate]] = {}
    for part, tasks in by_suite.items():
        rate = sum(sum(successes) / len(successes) for successes in tasks) / len(tasks)
        episodes = sum(map(len, tasks))
        suites_of.setdefault(part[:3], {})[part] = Estimate(episodes, len(tasks), rate, len(tasks), 0, 1)
    sizes = _sizes(axes, 4)
    strata = {stratum: _joined(suites, sizes) for stratum, suites in suites_of.items()}
    tests = [test for test, _ in outcomes]
    return replace(_joined(strata, _sizes(axes, 3)), absent=_absent(tests, axes))


def _stratum(test: TestTask) -> tuple[str, str, int]:
    """Return axis, component and level from the benchmark: a result of an earlier version may have another level."""
    return test.axis, test.component, level_of_test(test)


def _joined(parts: Mapping[Any, Estimate], sizes: Mapping[Any, int]) -> Estimate:
    """Estimate the success rate over several parts, weighted by their sizes."""
    rate = _mean({name: part.rate for name, part in parts.items()}, sizes)
    whole = sum(sizes[name] for name in parts)
    effective = whole**2 / sum(sizes[name] ** 2 / part.effective for name, part in parts.items())
    low, high = wilson(rate * effective, effective)
    episodes, tasks = sum(part.episodes for part in parts.values()), sum(part.tasks for part in parts.values())
    return Estimate(episodes, tasks, rate, effective, low, high)


def _mean(rates: Mapping[Any, float], sizes: Mapping[Any, int]) -> float:
    """Return the mean of rates, weighted by sizes."""
    return sum(sizes[name] * rate for name, rate in rates.items()) / sum(sizes[name] for name in rates)


def _absent(tests: Sequence[TestTask], axes: Sequence[str]) -> str:
    """Describe the parts of a column without an episode: kinds, levels and suites."""
    run, sizes = {_stratum(test) for test in tests}, _sizes(axes, 3)
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
    return ", ".join([*descriptions, *sorted(suites - {test.suite for test in tests})])


def _sizes(axes: Sequence[str], columns: int) -> Counter[Any]:
    """Count the test tasks of some axes by the first columns of ``_tests``."""
    sizes: Counter[Any] = Counter()
    for kind, count in _tests().items():
        if kind[0] in axes:
            sizes[kind[:columns]] += count
    return sizes


@cache
def _tests() -> Counter[tuple[str, str, int, str]]:
    """Count the test tasks by axis, component, level and suite."""
    return Counter((test.axis, test.component, level_of_test(test), test.suite) for test in benchmark.load().tasks)
