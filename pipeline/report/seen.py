"""Visible effects of perturbations: in a run's kept episodes and in the benchmark's test tasks, axis by axis.

Other measures compare parameters. The measures here are distances in cm, shares of a view, grey levels and numbers of
words; each axis defines its own. The values of the test tasks come from ``pipeline/testset/seen.json``, which
``benchmarks/test_tasks_seen.py`` generates by running them, and from the benchmark's files.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from pipeline.axes import AXES, from_json, task_of
from pipeline.axes.report_data import CLEAN, KeptPerturbation
from pipeline.grouping import grouped
from pipeline.images.jpeg import decode
from pipeline.planning.plan import Row
from pipeline.run import outcome
from pipeline.run.finished import SEEN
from pipeline.run.run import Run
from pipeline.scenes.compiled import compile_for_physics
from pipeline.scenes.look import Look
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Task, Trajectory

SAMPLE = 200
"""Largest number of kept episodes of each axis that are measured: a new scene takes a third of a second."""


class Spread(NamedTuple):
    """The tenth, fiftieth and ninetieth percentile of ``number`` values."""

    number: int
    low: float
    middle: float
    high: float

    def __str__(self) -> str:
        return f"{self.middle:.3g} ({self.low:.3g} to {self.high:.3g})"


def spread(values: ArrayLike) -> Spread:
    """Compute the percentiles of one or more values."""
    measured = np.asarray(values, float)
    return Spread(measured.size, *(round(float(q), 4) for q in np.percentile(measured, [10, 50, 90])))


class MeasuredShare(NamedTuple):
    """The share of ``number`` items, such as scenes, that have a property."""

    number: int
    share: float

    def __str__(self) -> str:
        return f"{100 * self.share:.0f} %"


class Measure(NamedTuple):
    """A visible effect of an axis in the test tasks and in the run; `None` without a measured value."""

    axis: str
    what: str
    tested: Spread | MeasuredShare | None
    ours: Spread | MeasuredShare | None


def measure(run: Run, test: TestSet) -> list[Measure]:
    """Compute every measure of a finished run and of the test tasks, axis by axis.

    Raises:
        PipelineError: when the run lacks a trajectory or frames.
    """
    result = run.outcome
    # Episodes are kept in a shuffled order, so that the first episodes of each axis are from many tasks.
    kept = [result.row_of[episode_id] for episode_id in result.kept]
    # Episodes that ``export.where`` leaves out have trajectories and frames, too.
    made = [row for row in result.rows if result.verdicts[row.episode_id].reason in outcome.SUCCESS_REASONS]
    twins = {row.episode_id: row for row in made if row.role == "twin"}
    seen = _Seen(run, twins)
    sampled: list[Row] = []
    for axis in dict.fromkeys(row.axis for row in kept):
        sampled += [row for row in kept if row.axis == axis][:SAMPLE]
    ours = _summaries(chain(*map(seen.measure, sampled), _together(test, kept)))
    run_once = {name: Spread(*values) for name, values in json.loads(SEEN.read_text()).items()}
    tested = run_once | _summaries(_of_tests(test))
    measures = []
    for name in sorted({*tested, *ours}):
        axis, _, what = name.partition(": ")
        measures.append(Measure(axis, what, tested.get(name), ours.get(name)))
    return measures


def clean_measures(look: Look) -> dict[str, float]:
    """Return the measures of an unperturbed episode, computed from its first observation."""
    return {
        f"{CLEAN}: width of the gripper in the first observation (mm)": look.gripper_mm,
        f"{CLEAN}: speed of the hand in the first observation (cm/s)": look.hand_cm_s,
        f"{CLEAN}: speed of the fastest object in the first observation (cm/s)": look.object_cm_s,
    }


def _summaries(pairs: Iterable[tuple[str, float]]) -> dict[str, Spread | MeasuredShare]:
    """Summarize the values of each name: truth values as a share, numbers as percentiles."""
    summaries: dict[str, Spread | MeasuredShare] = {}
    for name, values in grouped(pairs).items():
        if isinstance(values[0], bool):
            summaries[name] = MeasuredShare(len(values), round(float(np.mean(values)), 4))
        else:
            summaries[name] = spread(values)
    return summaries


def _of_tests(test: TestSet) -> Iterator[tuple[str, float]]:
    """Yield the measures of the test tasks that the benchmark's files state."""
    for name, axis in AXES.items():
        for what, value in axis.observe_tests(test):
            yield f"{name}: {what}", value


def _together(test: TestSet, rows: Iterable[Row]) -> Iterator[tuple[str, float]]:
    """Yield the measures of all kept episodes together."""
    changes: list[tuple[str, KeptPerturbation[Any]]] = []
    for row in rows:
        task = task_of(row.suite, row.task, row.perturbations)
        changes += [(change.axis, KeptPerturbation(task, change, None)) for change in from_json(row.perturbations)]
    for name, kept in grouped(changes).items():
        for what, value in AXES[name].observe_together(kept, test):
            yield f"{name}: {what}", value


class _Seen:
    """Measures of a run's episodes; each state is read once."""

    def __init__(self, run: Run, twins: Mapping[str, Row]):
        self.trajectories = run.trajectories
        self.load = run.episode_loader()
        self._twins = twins
        self._looks: dict[tuple[str, int], Look] = {}

    def measure(self, row: Row) -> Iterator[tuple[str, float]]:
        """Yield the measures of an episode that is unperturbed or perturbed on one axis."""
        match from_json(row.perturbations):
            case ():
                yield from clean_measures(self.look(row)).items()
            case (change,):
                for what, value in change.observe(_Observed(row, self._twins.get(row.twin_id), self)):
                    yield f"{change.axis}: {what}", value

    def look(self, row: Row, step: int = 0) -> Look:
        """Return the state of an episode after ``step`` executed actions."""
        if (row.trajectory_id, step) not in self._looks:
            trajectory = self.trajectories.load(row.trajectory_id)
            look = Look.of(compile_for_physics(trajectory.model_xml), trajectory.states[step])
            self._looks[row.trajectory_id, step] = look
        return self._looks[row.trajectory_id, step]


class _Observed:
    """An episode of a run, as ``ObservedEpisode`` defines it."""

    def __init__(self, row: Row, twin: Row | None, seen: _Seen):
        self._row, self._twin, self._seen = row, twin, seen

    @property
    def task(self) -> Task:
        return task_of(self._row.suite, self._row.task, self._row.perturbations)

    @property
    def instruction(self) -> str:
        return self._row.instruction

    @property
    def model(self) -> mujoco.MjModel:
        return compile_for_physics(self._trajectory.model_xml)

    @property
    def resolved(self) -> Mapping[str, Any]:
        return self._trajectory.scene.resolved

    def look(self, step: int = 0) -> Look:
        return self._seen.look(self._row, step)

    def twin_look(self, step: int = 0) -> Look | None:
        return None if self._twin is None else self._seen.look(self._twin, step)

    def changes(self) -> Mapping[str, Floats]:
        if self._twin is None:
            return {}
        frames = self._seen.load(self._row.episode_id).frames
        twin_frames = self._seen.load(self._twin.episode_id).frames
        differences = {}
        for view in frames:
            differences[view] = np.abs(decode(frames[view][0]).astype(float) - decode(twin_frames[view][0]))
        return differences

    @cached_property
    def _trajectory(self) -> Trajectory:
        return self._seen.trajectories.load(self._row.trajectory_id)
