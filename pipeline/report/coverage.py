"""Panels for each axis: the parameters of a run next to those of the test tasks, and the distances between them."""

from collections.abc import Sequence
from itertools import chain
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np

from pipeline.axes import AXES
from pipeline.axes.report_data import KeptPerturbation, groups_of
from pipeline.planning import leakage
from pipeline.report import figures
from pipeline.report.figures import Panel
from pipeline.testset.benchmark import TestSet

LABEL_WIDTH = 28
"""Longest line of a label, in characters; a longer line would not fit below a plot with long names of rows."""


class AxisPlots(NamedTuple):
    """A note on the test set, and the plots of one axis with the names of their groups."""

    note: str
    groups: list[str]
    panels: list[Panel]


def plot_axis(axis: str, kept: Sequence[KeptPerturbation[Any]], test: TestSet) -> AxisPlots:
    """Plot the coverage of one axis by its perturbations of kept episodes."""
    note, plots = AXES[axis].describe_coverage(kept, test)
    panels = [figures.plot(plot) for plot in plots]
    unit = AXES[axis].kinds[0].unit
    if unit is not None and test.on_axis(axis):
        panels.append(_distances(axis, kept, test, unit))
    groups = dict.fromkeys([axis, *chain.from_iterable(map(groups_of, plots))])
    return AxisPlots(note, [*groups], panels)


def _distances(axis: str, kept: Sequence[KeptPerturbation[Any]], test: TestSet, unit: str) -> Panel:
    """Plot the distance from each test task to the nearest perturbation of a kept episode.

    Test tasks that cannot be compared with any perturbation are left out.
    """
    least = leakage.distances(axis, [(item.perturbation, item.task) for item in kept], test)
    components = np.array([task.component for task in test.on_axis(axis)])
    rows = {}
    for component in dict.fromkeys(components.tolist()):
        comparable = (components == component) & np.isfinite(least)
        rows[component.replace("_", " ")] = {axis: least[comparable]}
    return figures.strips("Distance from each test task to the nearest kept episode", rows, fill(unit, LABEL_WIDTH))
