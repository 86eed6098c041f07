"""Report on a plan's distances to the benchmark's test tasks: check of the clearance, and coverage of each component.

Clearance and coverage conflict: a plan far from all test tasks overlaps with no test task, and prepares for none. The
report therefore states the least distance of any pair. For each component, it also states the distances from the test
tasks to the wanted episodes.

Every perturbation is read back from the plan and compared again, independently of the planner. A row with several
perturbations counts for each of its axes: the benchmark perturbs one axis at a time, but each part must keep its
clearance.
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

from pipeline.axes import Perturbation, from_json, task_of
from pipeline.axes.base import Nearest
from pipeline.errors import RUN_AGAIN, PipelineError
from pipeline.files import write_json
from pipeline.planning.plan import Row
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Task


@dataclass(frozen=True)
class Compared:
    """Fields of an episode that are compared with the test tasks, named as in a row of the plan."""

    episode_id: str
    suite: str
    task: str
    perturbations: str
    wanted: bool = True


@dataclass(frozen=True)
class Coverage:
    """Distances from the test tasks of one component to the nearest episode, in the axis's measure.

    Attributes:
        test_tasks: number of the benchmark's tasks of this component.
        compared: number of test tasks that some episode could be compared with; 0 if the measure has no unit.
        smallest, median, p90, largest: quantiles of their distances; ``None`` if no test task was compared.
    """

    test_tasks: int
    compared: int
    smallest: float | None
    median: float | None
    p90: float | None
    largest: float | None


@dataclass(frozen=True)
class AxisDistance:
    """Distances between a plan and the test tasks of one axis.

    Attributes:
        rows: number of planned episodes that the axis perturbs, including reserves.
        test_tasks: number of the benchmark's tasks of this axis.
        comparisons: number of compared pairs of an episode and a test task.
        not_compared: number of episodes without a comparable test task, such as episodes in a scene of no test task.
            It counts all episodes if the changes of the test tasks cannot be read offline.
        smallest: least distance of all pairs, or of the overlaps if there are any; ``None`` if nothing was compared or
            nothing was similar.
        closest: episode with this distance.
        clearance: least allowed distance, for this episode's kind of perturbation if the axis has several.
        measure: definition and unit of the distance, for each kind of perturbation.
        overlaps: number of episodes that are closer than their clearance.
        verdict: ``overlap``, ``disjoint``, ``disjoint where compared`` if some episodes were not compared,
            ``unknown`` if no episode was compared, or ``no test tasks`` if the test set has none on the axis.
        coverage: component of the test tasks to their distances from the wanted episodes, without reserves; the report
            has the distances from the kept episodes (``covered_by``).
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
    """Compare every perturbation of a plan with the test tasks.

    Returns:
        Axis to its finding, in the order of the plan.
    """
    compared: dict[str, list[tuple[Nearest, str, Perturbation]]] = defaultdict(list)
    wanted: dict[str, list[tuple[Perturbation, Task]]] = defaultdict(list)
    for row in rows:
        task = task_of(row.suite, row.task, row.perturbations)
        for perturbation in from_json(row.perturbations):
            compared[perturbation.axis].append((perturbation.nearest(test, task), row.episode_id, perturbation))
            if row.wanted:
                wanted[perturbation.axis].append((perturbation, task))
    findings = {}
    for axis, comparisons in compared.items():
        least = distances(axis, wanted[axis], test)
        findings[axis] = _finding(comparisons, len(test.on_axis(axis)), coverage(axis, least, test))
    return findings


def distances(axis: str, perturbed: Iterable[tuple[Perturbation, Task]], test: TestSet) -> Floats:
    """Return the distance (N,) from each of an axis's test tasks to the nearest of some perturbations on the axis.

    It is NaN if the test task cannot be compared with any of them, or if the axis's measure has no unit.
    """
    least = np.full(len(test.on_axis(axis)), np.nan)
    for perturbation, task in perturbed:
        if perturbation.unit is not None:
            np.fmin(least, perturbation.distances(test, task), out=least)
    return least


def coverage(axis: str, least: Floats, test: TestSet) -> dict[str, Coverage]:
    """Summarize the result of :func:`distances` for each component of the axis's test tasks."""
    components = np.array([tested.component for tested in test.on_axis(axis)])
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
    """Replace the planned episodes' coverage in the findings of ``leakage.json`` by the kept episodes' coverage.

    Args:
        kept: rows of the manifest.
        findings: content of ``leakage.json``.
    """
    perturbed: dict[str, list[tuple[Perturbation, Task]]] = defaultdict(list)
    for row in kept:
        for perturbation in from_json(row["perturbations"]):
            task = task_of(row["suite"], row["task"], row["perturbations"])
            perturbed[perturbation.axis].append((perturbation, task))
    covered = {}
    for axis, finding in findings.items():
        components = coverage(axis, distances(axis, perturbed[axis], test), test)
        figures = {name: asdict(figures_of_component) for name, figures_of_component in components.items()}
        covered[axis] = {**finding, "coverage": figures}
    return covered


def _finding(
    comparisons: Sequence[tuple[Nearest, str, Perturbation]], test_tasks: int, coverage: dict[str, Coverage]
) -> AxisDistance:
    """Summarize the comparisons of one axis.

    Args:
        comparisons: nearest test task, episode id and perturbation of each episode that the axis perturbs.
    """

    def overlap_first(comparison: tuple[Nearest, str, Perturbation]) -> tuple[bool, float]:
        nearest, _, perturbation = comparison
        return nearest.distance >= perturbation.clearance, nearest.distance

    closest, closest_id, closest_perturbation = min(comparisons, key=overlap_first)
    overlaps = sum(nearest.distance < perturbation.clearance for nearest, _, perturbation in comparisons)
    not_compared = sum(not nearest.compared for nearest, _, _ in comparisons) if test_tasks else 0
    alike = math.isfinite(closest.distance)
    if overlaps:
        verdict = "overlap"
    elif not test_tasks:
        verdict = "no test tasks"
    elif not_compared == len(comparisons):
        verdict = "unknown"
    else:
        verdict = "disjoint where compared" if not_compared else "disjoint"
    measures = dict.fromkeys(_measure(perturbation) for _, _, perturbation in comparisons)
    return AxisDistance(
        rows=len(comparisons),
        test_tasks=test_tasks,
        comparisons=sum(nearest.compared for nearest, _, _ in comparisons),
        not_compared=not_compared,
        smallest=closest.distance if alike else None,
        closest=closest_id if alike else None,
        clearance=closest_perturbation.clearance,
        measure="; ".join(measures),
        overlaps=overlaps,
        verdict=verdict,
        coverage=coverage,
    )


def _measure(perturbation: Perturbation) -> str:
    """Return the unit, if there is one, and the definition of a perturbation's distance."""
    if perturbation.unit:
        return f"{perturbation.unit}: {perturbation.measure}"
    return perturbation.measure


def write(findings: dict[str, AxisDistance], path: Path) -> None:
    """Write the findings as JSON."""
    write_json(path, {axis: asdict(finding) for axis, finding in findings.items()})


def report(findings: dict[str, AxisDistance]) -> Group:
    """Format the findings for people: two tables that fit 80 columns, and the definition of each distance."""
    table = Table(title="distance to the LIBERO-Plus test set", box=box.SIMPLE, pad_edge=False)
    table.add_column("axis", no_wrap=True)
    for column in ("episodes", "tests", "overlaps", "smallest", "clearance"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("verdict", min_width=len("compared"))
    for axis, finding in findings.items():
        smallest = "-" if finding.smallest is None else f"{finding.smallest:.3g}"
        counts = [f"{count:,}" for count in (finding.rows, finding.test_tasks, finding.overlaps)]
        table.add_row(axis, *counts, smallest, f"{finding.clearance:g}", finding.verdict)
    covered = Table(
        "axis", "component", title="distance from each test task to the nearest wanted episode", box=box.SIMPLE
    )
    covered.caption = "-: the measure only distinguishes equal from different changes"
    for column in ("tests", "smallest", "median", "90 %", "largest"):
        covered.add_column(column, justify="right")
    for axis, finding in findings.items():
        for component, summary in finding.coverage.items():
            figures = (summary.smallest, summary.median, summary.p90, summary.largest)
            cells = ["-" if figure is None else f"{figure:.3g}" for figure in figures]
            covered.add_row(axis, component, f"{summary.test_tasks:,}", *cells)
    lines = [f"{axis}: {finding.measure}" for axis, finding in findings.items()]
    for axis, finding in findings.items():
        if finding.not_compared:
            counts_of_rows = f"{finding.not_compared:,} of {finding.rows:,}"
            lines.append(f"{axis}: {counts_of_rows} episodes have no comparable test task")
    return Group(table, covered, *map(Text, lines))


def reject_overlap(findings: dict[str, AxisDistance]) -> None:
    """Stop a run that would train on test tasks.

    Raises:
        PipelineError: when any episode overlaps, naming for each axis the number of overlaps and the closest one.
    """
    faults = []
    for axis, finding in findings.items():
        if finding.overlaps:
            faults.append(
                f"{finding.overlaps} of {finding.rows} on the {axis} axis (such as {finding.closest}, distance "
                f"{finding.smallest:.3g}, clearance {finding.clearance:g})"
            )
    if faults:
        raise PipelineError(
            f"planned episodes overlap with the benchmark's test tasks: {'; '.join(faults)}",
            expected="no overlap on any axis",
            remedy=f"move the run's plan.parquet to another place, and {RUN_AGAIN}, which plans without overlaps",
        )
