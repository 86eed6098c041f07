"""The report on a plan and the benchmark's test tasks: that it keeps clear of them, and how near it comes to each.

The two pull against each other: a plan far from all test tasks overlaps with none, and prepares for none. So beside the
least distance of any pair stands, for each component, how far the test tasks are from what is planned.

Every perturbation is read back from the plan as it was recorded and compared anew, whatever the planner thought. A row
with several counts for each of its axes: the benchmark perturbs one at a time, but each part must keep its clearance.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from pipeline.axes import Perturbation, from_json
from pipeline.axes.base import Nearest
from pipeline.errors import PipelineError
from pipeline.files import write_json
from pipeline.libero.tasks import find_task
from pipeline.planning.plan import Row
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Task


@dataclass(frozen=True)
class Compared:
    """What of an episode is compared with the test tasks, named as in a row of the plan."""

    episode_id: str
    suite: str
    task: str
    perturbations: str
    wanted: bool = True


@dataclass(frozen=True)
class Coverage:
    """How far the test tasks of one component are from the nearest episode, in the axis's measure.

    Attributes:
        test_tasks: the benchmark's tasks of this component.
        compared: those that some episode could be compared with; 0 where the measure does not tell near from far.
        smallest, median, p90, largest: of their distances, 90 % are at most ``p90``; None when none was compared.
    """

    test_tasks: int
    compared: int
    smallest: float | None
    median: float | None
    p90: float | None
    largest: float | None


@dataclass(frozen=True)
class AxisDistance:
    """How close a plan comes to the test tasks of one axis.

    Attributes:
        rows: planned episodes that the axis perturbs, reserves among them.
        test_tasks: the benchmark's tasks of this axis.
        comparisons: pairs of an episode and a test task that were compared.
        not_compared: episodes that could be compared with none of the test tasks, such as those in a scene that none
            has, or all where what the test tasks change cannot be read offline.
        smallest: the least distance of all, or of the overlaps where there are any; None when there was nothing to
            compare with, or nothing similar.
        closest: the episode it belongs to.
        clearance: the least distance that is allowed, of this episode's kind where the axis has several.
        measure: what the distance is and its unit; of each kind.
        overlaps: episodes that are closer than that.
        verdict: ``overlap``, ``disjoint``, ``disjoint where compared`` when some episodes were not compared, or
            ``unknown`` when none was.
        coverage: component of the test tasks to how far these are from the wanted episodes, reserves left out; the
            report has it of the kept ones (``covered_by``).
    """

    rows: int
    test_tasks: int
    comparisons: int
    not_compared: int
    smallest: float | None
    closest: str | None
    clearance: float
    measure: str
    overlaps: int
    verdict: str
    coverage: dict[str, Coverage]


def check(rows: Sequence[Row | Compared], test: TestSet) -> dict[str, AxisDistance]:
    """Axis to finding, in the order of the plan."""
    found: dict[str, list[tuple[Nearest, str, Perturbation]]] = defaultdict(list)
    wanted: dict[str, list[tuple[Perturbation, Task]]] = defaultdict(list)
    tasks = {key: find_task(*key) for key in {(row.suite, row.task) for row in rows}}
    for row in rows:
        task = tasks[row.suite, row.task]
        for perturbation in from_json(row.perturbations):
            found[perturbation.axis].append((perturbation.nearest(test, task), row.episode_id, perturbation))
            if row.wanted:
                wanted[perturbation.axis].append((perturbation, task))
    return {
        axis: _finding(of_axis, len(test.of(axis)), coverage(axis, distances(axis, wanted[axis], test), test))
        for axis, of_axis in found.items()
    }


def distances(axis: str, draws: Iterable[tuple[Perturbation, Task]], test: TestSet) -> Floats:
    """(N,) how far each of an axis's test tasks is from the nearest of some draws on the axis, NaN where it cannot be
    compared with any, or the axis's measure does not tell near from far."""
    least = np.full(len(test.of(axis)), np.nan)
    for perturbation, task in draws:
        if perturbation.unit is not None:
            np.fmin(least, perturbation.distances(test, task), out=least)
    return least


def coverage(axis: str, least: Floats, test: TestSet) -> dict[str, Coverage]:
    """What :func:`distances` come to for each component of the axis's test tasks."""
    components = np.array([tested.component for tested in test.of(axis)])
    summaries = {}
    for component in dict.fromkeys(components.tolist()):
        of_component = least[components == component]
        compared = of_component[np.isfinite(of_component)]
        figures = np.quantile(compared, (0.0, 0.5, 0.9, 1.0)).tolist() if len(compared) else (None,) * 4
        summaries[component] = Coverage(len(of_component), len(compared), *figures)
    return summaries


def covered_by(
    kept: Iterable[Mapping[str, Any]], findings: Mapping[str, Mapping[str, Any]], test: TestSet
) -> dict[str, dict[str, Any]]:
    """The findings of ``leakage.json`` with the coverage of kept episodes in place of the planned ones'.

    Args:
        kept: rows of the manifest.
    """
    draws: dict[str, list[tuple[Perturbation, Task]]] = {axis: [] for axis in findings}
    for row in kept:
        task = find_task(row["suite"], row["task"])
        for perturbation in from_json(row["perturbations"]):
            draws[perturbation.axis].append((perturbation, task))
    covered = {}
    for axis, finding in findings.items():
        components = coverage(axis, distances(axis, draws[axis], test), test)
        covered[axis] = {**finding, "coverage": {name: asdict(figures) for name, figures in components.items()}}
    return covered


def _finding(
    found: Sequence[tuple[Nearest, str, Perturbation]], test_tasks: int, coverage: dict[str, Coverage]
) -> AxisDistance:
    nearest, closest, kind = min(found, key=lambda one: (one[0].distance >= one[2].clearance, one[0].distance))
    not_compared = sum(not one.compared for one, _, _ in found) if test_tasks else 0
    overlaps = sum(one.distance < kind.clearance for one, _, kind in found)
    alike = math.isfinite(nearest.distance)
    if overlaps:
        verdict = "overlap"
    elif not_compared == len(found):
        verdict = "unknown"
    else:
        verdict = "disjoint where compared" if not_compared else "disjoint"
    return AxisDistance(
        rows=len(found),
        test_tasks=test_tasks,
        comparisons=sum(one.compared for one, _, _ in found),
        not_compared=not_compared,
        smallest=nearest.distance if alike else None,
        closest=closest if alike else None,
        clearance=kind.clearance,
        measure="; ".join(dict.fromkeys(f"{f'{k.unit}: ' if k.unit else ''}{k.measure}" for _, _, k in found)),
        overlaps=overlaps,
        verdict=verdict,
        coverage=coverage,
    )


def write(findings: dict[str, AxisDistance], path: Path) -> None:
    write_json(path, {axis: asdict(finding) for axis, finding in findings.items()})


def report(findings: dict[str, AxisDistance]) -> Group:
    """The findings as a person reads them: two tables that fit 80 columns, and what each distance is."""
    table = Table("axis", title="distance to the LIBERO-Plus test set", box=box.SIMPLE)
    for column in ("episodes", "tests", "overlaps", "smallest", "clearance"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for axis, finding in findings.items():
        smallest = "-" if finding.smallest is None else f"{finding.smallest:.3g}"
        counts = [f"{count:,}" for count in (finding.rows, finding.test_tasks, finding.overlaps)]
        table.add_row(axis, *counts, smallest, f"{finding.clearance:g}", finding.verdict)
    covered = Table("axis", "component", title="from each test task to the nearest wanted episode", box=box.SIMPLE)
    covered.caption = "-: the measure does not tell near from far"
    for column in ("tests", "smallest", "median", "90 %", "largest"):
        covered.add_column(column, justify="right")
    for axis, finding in findings.items():
        for component, one in finding.coverage.items():
            figures = (one.smallest, one.median, one.p90, one.largest)
            shown = ("-" if figure is None else f"{figure:.3g}" for figure in figures)
            covered.add_row(axis, component, f"{one.test_tasks:,}", *shown)
    lines = [f"{axis}: {finding.measure}" for axis, finding in findings.items()]
    lines += [
        f"{axis}: {finding.not_compared:,} of {finding.rows:,} episodes could be compared with no test task"
        for axis, finding in findings.items()
        if finding.not_compared
    ]
    return Group(table, covered, *map(Text, lines))


def refuse_overlap(findings: dict[str, AxisDistance]) -> None:
    """Stop a run that would train on test tasks.

    Raises:
        PipelineError: when any episode overlaps, naming for each axis how many and the closest.
    """
    faults = [
        f"{finding.overlaps} of {finding.rows} on the {axis} axis (such as {finding.closest}, distance "
        f"{finding.smallest:.3g}, clearance {finding.clearance:g})"
        for axis, finding in findings.items()
        if finding.overlaps
    ]
    if faults:
        raise PipelineError(
            f"planned episodes overlap with the benchmark's test tasks: {'; '.join(faults)}",
            expected="no overlap on any axis",
            remedy="run the plan stage again: it draws anew where a draw overlaps",
        )
