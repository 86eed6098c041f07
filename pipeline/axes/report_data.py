"""Data that an axis gives to a run's report: descriptions of plots, and the interface to an episode that it measures.

``pipeline/report/figures.py`` plots the descriptions, and ``pipeline/report/seen.py`` implements the interface.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

from numpy.typing import NDArray

from pipeline.types import Floats, Task

if TYPE_CHECKING:
    import mujoco

    from pipeline.scenes.look import Look

Kind = TypeVar("Kind")
Values = NDArray[Any]
Groups = Mapping[str, Values]
"""Values plotted in one colour, by name; groups in ``REFERENCES`` are plotted behind the others, in grey.

The name of an axis has the colour of the axis."""

CLEAN, BENCHMARK = "clean", "benchmark"
REFERENCES = (CLEAN, BENCHMARK)


class KeptPerturbation(NamedTuple, Generic[Kind]):
    """One perturbation of a kept episode.

    Attributes:
        resolved: its recorded effect in the scene, `None` without a record.
    """

    task: Task
    perturbation: Kind
    resolved: Any


@dataclass(frozen=True, eq=False)
class Scatter:
    """Points (N, 2) in a plane; ``equal`` keeps both scales equal."""

    title: str
    groups: Groups
    x_label: str
    y_label: str
    equal: bool = False


@dataclass(frozen=True, eq=False)
class Histogram:
    """Share of each group's values (N,) in each of the bins, which are given by their edges."""

    title: str
    groups: Groups
    bins: Values
    label: str


@dataclass(frozen=True, eq=False)
class Strips:
    """A line for each row, with its groups' values (N,) along it."""

    title: str
    rows: Mapping[str, Groups]
    label: str


@dataclass(frozen=True, eq=False)
class Bars:
    """A bar for each name, in the colour of ``group``."""

    title: str
    counts: Mapping[str, int]
    group: str
    label: str


Plot = Scatter | Histogram | Strips | Bars


def groups_of(plot: Plot) -> list[str]:
    """List the names of the groups that a plot shows, each once."""
    if isinstance(plot, Bars):
        return [plot.group]
    if isinstance(plot, Strips):
        return list(dict.fromkeys(chain.from_iterable(plot.rows.values())))
    return list(plot.groups)


class CoveragePlots(NamedTuple):
    """A note on the test set, and plots of an axis."""

    note: str
    plots: Sequence[Plot]


Measures = Iterable[tuple[str, float]]
"""Names of visible effects, with their units, and one value each. The report has percentiles of numbers and shares of
truth values."""


class ObservedEpisode(Protocol):
    """Kept episode that a single perturbation changes, and its clean twin; both are read on request."""

    @property
    def task(self) -> Task:
        """LIBERO task of the episode."""

    @property
    def instruction(self) -> str:
        """Text that the policy gets."""

    @property
    def model(self) -> mujoco.MjModel:
        """Scene, with plain colours instead of images; it must not be changed."""

    @property
    def resolved(self) -> Mapping[str, Any]:
        """Axis to the recorded effect of its perturbation in the scene."""

    def look(self, step: int = 0) -> Look:
        """Return the state after ``step`` executed actions."""

    def twin_look(self, step: int = 0) -> Look | None:
        """Return the clean twin's state after ``step`` executed actions, or ``None`` without a clean twin."""

    def changes(self) -> Mapping[str, Floats]:
        """Return absolute differences of the first frame from the clean twin's, (H, W, 3), by view.

        The result is empty without a clean twin.
        """
