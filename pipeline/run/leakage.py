"""The report that a plan keeps clear of the benchmark's test tasks.

Every perturbation is read back from the plan as it was recorded and compared anew, whatever the planner thought. A row
with several counts for each of its axes: the benchmark perturbs one at a time, but each part must keep its clearance.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from pipeline.axes import AnyPerturbation, from_json
from pipeline.axes.base import Nearest
from pipeline.errors import PipelineError
from pipeline.files import replaced
from pipeline.libero.tasks import find_task
from pipeline.run.plan import Row
from pipeline.testset.benchmark import TestSet


@dataclass(frozen=True)
class AxisDistance:
    """How close a plan comes to the test tasks of one axis.

    Attributes:
        rows: planned episodes that the axis perturbs, reserves among them.
        test_tasks: the benchmark's tasks of this axis.
        comparisons: pairs of an episode and a test task that were compared.
        smallest: the least distance of all; None when there was nothing to compare with, or nothing similar.
        closest: the episode it belongs to.
        clearance: the least distance that is allowed.
        measure: what the distance is and its unit.
        overlaps: episodes that are closer than that.
        verdict: ``disjoint``, ``overlap``, or ``unknown`` when what the test tasks change cannot be read offline.
    """

    rows: int
    test_tasks: int
    comparisons: int
    smallest: float | None
    closest: str | None
    clearance: float
    measure: str
    overlaps: int
    verdict: str


def check(rows: Sequence[Row], test: TestSet) -> dict[str, AxisDistance]:
    """Axis to finding, in the order of the plan."""
    found: dict[str, list[tuple[Nearest, str]]] = defaultdict(list)
    kinds: dict[str, AnyPerturbation] = {}
    known = {(row.suite, row.task) for row in rows}
    tasks = {key: find_task(*key) for key in known}
    for row in rows:
        for perturbation in from_json(row.perturbations):
            kinds[perturbation.axis] = perturbation
            nearest = perturbation.nearest(test, tasks[row.suite, row.task])
            found[perturbation.axis].append((nearest, row.episode_id))
    return {axis: _finding(found[axis], kind, len(test.of(axis))) for axis, kind in kinds.items()}


def _finding(found: Sequence[tuple[Nearest, str]], kind: AnyPerturbation, test_tasks: int) -> AxisDistance:
    nearest, closest = min(found, key=lambda pair: pair[0].distance)
    comparisons = sum(one.compared for one, _ in found)
    overlaps = sum(one.distance < kind.clearance for one, _ in found)
    alike = math.isfinite(nearest.distance)
    return AxisDistance(
        rows=len(found),
        test_tasks=test_tasks,
        comparisons=comparisons,
        smallest=nearest.distance if alike else None,
        closest=closest if alike else None,
        clearance=kind.clearance,
        measure=kind.measure,
        overlaps=overlaps,
        verdict="overlap" if overlaps else "unknown" if test_tasks and not comparisons else "disjoint",
    )


def write(findings: dict[str, AxisDistance], path: Path) -> None:
    with replaced(path) as temporary:
        temporary.write_text(json.dumps({axis: asdict(finding) for axis, finding in findings.items()}, indent=1) + "\n")


def report(findings: dict[str, AxisDistance]) -> Group:
    """The findings as a person reads them: a table that fits 80 columns, and what each distance is."""
    table = Table("axis", title="distance to the LIBERO-Plus test set", box=box.SIMPLE)
    for column in ("episodes", "tests", "overlaps", "smallest", "clearance"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for axis, finding in findings.items():
        smallest = "-" if finding.smallest is None else f"{finding.smallest:.3g}"
        counts = [f"{count:,}" for count in (finding.rows, finding.test_tasks, finding.overlaps)]
        table.add_row(axis, *counts, smallest, f"{finding.clearance:g}", finding.verdict)
    return Group(table, *(Text(f"{axis}: {finding.measure}") for axis, finding in findings.items()))


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
