"""Visible effects of perturbations: a run's kept episodes next to the benchmark's test tasks, axis by axis.

Other measures compare parameters. The measures here are centimetres of the hand, shares of a view, grey levels and
words. The values of the test tasks come from ``pipeline/testset/seen.json``, which ``benchmarks/test_tasks_seen.py``
generates by running them, and from the benchmark's files.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import NamedTuple, cast

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from pipeline.axes import from_json
from pipeline.axes.background import BackgroundPerturbation
from pipeline.axes.disturbance import DisturbancePerturbation
from pipeline.axes.language import LanguagePerturbation
from pipeline.axes.layout import LayoutPerturbation
from pipeline.axes.noise import NoisePerturbation
from pipeline.axes.pose import PosePerturbation, ScenePerturbation, Shifts, displacements
from pipeline.axes.robot import RobotPerturbation
from pipeline.episode_schema import SCHEMA
from pipeline.grouping import grouped
from pipeline.images.jpeg import decode
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS, SURFACES, Arena
from pipeline.libero.tasks import find_task
from pipeline.planning.plan import Row
from pipeline.run import outcome
from pipeline.run.finished import SEEN
from pipeline.run.run import Run
from pipeline.scenes.compiled import physics_to_read
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Floats

CAMERA_SIDE_M = 0.19
"""Least x, in the frame of the working surface, at which an object stands on the side of the agent camera."""

SAMPLE = 200
"""Largest number of kept episodes of each axis that are measured: a new scene takes a third of a second."""

CHANGED_LEVELS = 8
"""Least difference of a channel, in grey levels, at which a pixel counts as changed."""

Places = dict[tuple[str, str], list[tuple[str, Shifts]]]
"""Suite and task to the names and displacements of its tests, or of a run's episodes."""


class Spread(NamedTuple):
    """The tenth, fiftieth and ninetieth percentile of ``number`` values."""

    number: int
    low: float
    middle: float
    high: float

    def __str__(self) -> str:
        return f"{self.middle:.3g} ({self.low:.3g} to {self.high:.3g})"


def spread(values: ArrayLike) -> Spread:
    """Compute the percentiles of at least one value."""
    measured = np.asarray(values, float)
    return Spread(measured.size, *(round(float(q), 4) for q in np.percentile(measured, [10, 50, 90])))


class Share(NamedTuple):
    """The share of ``number`` things, such as scenes, for which a statement is true."""

    number: int
    share: float

    def __str__(self) -> str:
        return f"{100 * self.share:.0f} %"


class Measure(NamedTuple):
    """A visible effect of an axis, for the test tasks and the run; `None` without anything to measure."""

    axis: str
    what: str
    tested: Spread | Share | None
    ours: Spread | Share | None


class Look(NamedTuple):
    """A state: the hand in the world's frame, the gap of its fingers, its speed, and the fastest object's speed."""

    position_m: Floats
    rotation: Rotation
    gripper_mm: float
    hand_cm_s: float
    object_cm_s: float

    @classmethod
    def of(cls, model: mujoco.MjModel, state: Floats) -> Look:
        """Compute the position and speed of the hand, and the speeds of the objects.

        Args:
            model: the scene.
            state: (S,) flattened MuJoCo state of the model.
        """
        data, moving = mujoco.MjData(model), np.empty(6)
        data.qpos[:], data.qvel[:] = state[1 : 1 + model.nq], state[1 + model.nq :]
        mujoco.mj_forward(model, data)
        hand = data.site("gripper0_grip_site")
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, hand.id, moving, 0)
        left, right = (data.joint(f"gripper0_finger_joint{n}").qpos[0] for n in (1, 2))
        free = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        speeds = [float(np.linalg.norm(data.qvel[first : first + 3])) for first in free]
        return cls(
            hand.xpos.copy(),
            Rotation.from_matrix(hand.xmat.reshape(3, 3)),
            1000 * float(left - right),
            100 * float(np.linalg.norm(moving[3:])),
            100 * max(speeds, default=0.0),
        )

    def measures(self) -> dict[str, float]:
        """Return the measures of an unperturbed episode."""
        return {
            "clean: gripper at the first look (mm)": self.gripper_mm,
            "clean: hand's speed at the first look (cm/s)": self.hand_cm_s,
            "clean: fastest object at the first look (cm/s)": self.object_cm_s,
        }

    def away_from(self, other: Look, component: str, level: int) -> dict[str, float]:
        """Measure how far a perturbation of the robot moves and turns the hand; ``other`` is the twin's state."""
        turned_deg = float(np.degrees((self.rotation * other.rotation.inv()).magnitude()))
        return {
            f"robot: hand moved by {component}, level {level} (cm)": 100 * math.dist(self.position_m, other.position_m),
            f"robot: hand turned by {component}, level {level} (degrees)": turned_deg,
        }


def measure(run: Run, test: TestSet) -> list[Measure]:
    """Compute every measure of a finished run and of the test tasks, axis by axis.

    Raises:
        PipelineError: when the run lacks a trajectory or frames.
    """
    result = run.outcome
    # Episodes are kept in a shuffled order, so that the first episodes of each axis are from many tasks.
    kept = [result.row_of[episode_id] for episode_id in result.kept]
    # Episodes that ``export.where`` leaves out have trajectories and frames, too.
    made = [row for row in result.rows if result.verdicts[row.episode_id].reason in outcome.MADE]
    twins = {row.episode_id: row for row in made if row.role == "twin"}
    seen = _Seen(run, twins)
    sampled: list[Row] = []
    for axis in dict.fromkeys(row.axis for row in kept):
        sampled += [row for row in kept if row.axis == axis][:SAMPLE]
    ours = _summaries(chain(*map(seen.measure, sampled), to_nearest_draw(test, kept)))
    run_once = {name: Spread(*values) for name, values in json.loads(SEEN.read_text()).items()}
    tested = run_once | _summaries(chain(*map(_of_test, test.tasks), to_nearest_test(test)))
    measures = []
    for name in sorted({*tested, *ours}):
        axis, _, what = name.partition(": ")
        measures.append(Measure(axis, what, tested.get(name), ours.get(name)))
    return measures


def _summaries(pairs: Iterable[tuple[str, float]]) -> dict[str, Spread | Share]:
    """Summarize the values of each name: truth values as a share, numbers as percentiles."""
    summaries: dict[str, Spread | Share] = {}
    for name, values in grouped(pairs).items():
        if isinstance(values[0], bool):
            summaries[name] = Share(len(values), round(float(np.mean(values)), 4))
        else:
            summaries[name] = spread(values)
    return summaries


class _Seen:
    """Measures of a run's episodes; each state is read once."""

    def __init__(self, run: Run, twins: Mapping[str, Row]):
        self._store = run.trajectories
        self._load = run.episodes()
        self._twins = twins
        self._looks: dict[tuple[str, int], Look] = {}

    def measure(self, row: Row) -> Iterator[tuple[str, float]]:
        """Yield the measures of an episode that is unperturbed or perturbed on one axis."""
        twin = self._twins.get(row.twin_id)
        match from_json(row.perturbations):
            case ():
                yield from self._look(row).measures().items()
            case (RobotPerturbation() as change,) if twin:
                yield from self._look(row).away_from(self._look(twin), change.component, change.level).items()
            case (DisturbancePerturbation() as change,) if twin:
                end = change.first_step + change.steps
                away_cm = 100 * math.dist(self._look(row, end).position_m, self._look(twin, end).position_m)
                yield f"disturbance: hand off its path after a push of level {change.level} (cm)", away_cm
            case (ScenePerturbation() as change,):
                yield from _targets_moved(row.suite, row.task, change.shifts_in_all, change.level)
            case (LayoutPerturbation() as change,):
                trajectory = self._store.load(row.trajectory_id)
                model, placed = physics_to_read(trajectory.model_xml), trajectory.scene.resolved["layout"]["objects"]
                bodies = [model.body(body).name for body in range(model.nbody)]
                surface_m = model.body(next(name for name in SURFACES if name in bodies)).pos
                xy_m = np.array([thing["position_m"][:2] for thing in placed]) - surface_m[:2]
                arena = bddl.read(find_task(row.suite, row.task).bddl_file).arena
                yield from _added([added.name for added in change.objects], xy_m, arena)
            case (BackgroundPerturbation() as change,) if twin:
                for view, changed in self._changed(row, twin).items():
                    share = float((changed.max(axis=2) >= CHANGED_LEVELS).mean())
                    yield f"background: share of {view} that {change.component} changes", share
            case (NoisePerturbation() as change,) if twin:
                yield f"noise: {change.component} (mean grey levels)", float(self._changed(row, twin)["image"].mean())
            case (LanguagePerturbation(),):
                yield "language: words", len(row.instruction.split())

    def _look(self, row: Row, step: int = 0) -> Look:
        if (row.trajectory_id, step) not in self._looks:
            trajectory = self._store.load(row.trajectory_id)
            look = Look.of(physics_to_read(trajectory.model_xml), trajectory.states[step])
            self._looks[row.trajectory_id, step] = look
        return self._looks[row.trajectory_id, step]

    def _changed(self, row: Row, twin: Row) -> dict[str, Floats]:
        """Return the absolute differences of the first frame from the twin's, (H, W, 3), by view."""
        frames, twin_frames = self._load(row.episode_id).frames, self._load(twin.episode_id).frames
        differences = {}
        for view in SCHEMA.views:
            differences[view] = np.abs(decode(frames[view][0]).astype(float) - decode(twin_frames[view][0]))
        return differences


def _of_test(tested: TestTask) -> Iterator[tuple[str, float]]:
    parameters = tested.parameters
    match tested.axis:
        case "pose":
            moves = displacements(parameters)
            yield from _targets_moved(tested.suite, tested.base, moves, int(parameters["level"]))
        case "layout":
            xy_m = np.array([pair.split(",") for pair in str(parameters["positions"]).split(";")], float)
            yield from _added(str(parameters["category"]).split(","), xy_m, cast(Arena, parameters["arena"]))
        case "language":
            yield "language: words", len(str(parameters["text"]).split())


def _targets_moved(suite: str, task: str, moves: Shifts, level: int) -> Iterator[tuple[str, float]]:
    for target in bddl.read(find_task(suite, task).bddl_file).targets:
        if target in moves:
            yield f"pose: target of {suite} moved, level {level} (cm)", 100 * float(np.hypot(*moves[target]))


def to_nearest_draw(test: TestSet, rows: Iterable[Row]) -> Iterator[tuple[str, float]]:
    """Measure how far the objects of interest of a pose test are from the nearest places that the rows put them at.

    Tests of tasks for which no row moves an object of interest are left out.
    """
    drawn: Places = defaultdict(list)
    for row in rows:
        for change in from_json(row.perturbations):
            match change:
                case ScenePerturbation() | PosePerturbation():
                    drawn[row.suite, row.task].append((row.episode_id, change.shifts_in_all))
    return _to_nearest(test, drawn)


def to_nearest_test(test: TestSet) -> Iterator[tuple[str, float]]:
    """Measure the distances of pose tests to the nearest place in another test of the same task."""
    moved = (((task.suite, task.base), (task.name, displacements(task.parameters))) for task in test.on_axis("pose"))
    return _to_nearest(test, grouped(moved))


def _to_nearest(test: TestSet, places: Places) -> Iterator[tuple[str, float]]:
    for tested in test.on_axis("pose"):
        tested_shifts = displacements(tested.parameters)
        others = [shifts for name, shifts in places[tested.suite, tested.base] if name != tested.name]
        for thing in bddl.read(find_task(tested.suite, tested.base).bddl_file).things_of_interest:
            if thing not in tested_shifts:
                continue
            apart_m = [math.dist(tested_shifts[thing], shifts[thing]) for shifts in others if thing in shifts]
            if apart_m:
                yield f"pose: test's thing of interest in {tested.suite} to the nearest other (cm)", 100 * min(apart_m)


def _added(models: Sequence[str], xy_m: Floats, arena: Arena) -> Iterator[tuple[str, float]]:
    """Measure a scene with added objects, by their models and their positions (N, 2) in the frame of the surface."""
    for number in range(1, 6):
        yield f"layout: scenes with {number} added", len(models) == number
    if len(models) > 1:
        yield f"layout: scenes with {len(models)} added that repeat a model", len(set(models)) < len(models)
    x_m, z_m = ARENAS[arena].camera_xz_m
    for place in xy_m:
        yield "layout: object on the camera's side", bool(place[0] > CAMERA_SIDE_M)
        yield "layout: object to camera (m)", float(np.hypot(np.linalg.norm(place - [x_m, 0.0]), z_m))
