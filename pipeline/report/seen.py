"""What a policy sees: a run's kept episodes beside the benchmark's test tasks, axis by axis.

Other measures compare parameters. Here it is centimetres of the hand, shares of a view, grey levels and words. What
test tasks show is in ``pipeline/testset/seen.json``, which ``benchmarks/test_tasks_seen.py`` makes by running them, and
in what the benchmark's files say of them.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

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
from pipeline.libero.tasks import find_task
from pipeline.planning.plan import Row
from pipeline.run import outcome
from pipeline.run.finished import SEEN
from pipeline.run.run import Run
from pipeline.scenes.compiled import physics_to_read
from pipeline.scenes.swept_path import SURFACES
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Floats

CAMERA_SIDE_M = 0.19
"""From where on, along x in the frame of the working surface, an object stands on the side of the agent camera."""

CAMERA_M: dict[str, tuple[float, float]] = {
    "tabletop": (0.66, 0.71),
    "kitchen": (0.66, 0.71),
    "study": (0.66, 0.74),
    "floor": (0.90, 0.65),
    "living_room": (0.61, 0.55),
}
"""Where LIBERO's agent camera is, by arena: along x in the frame of the working surface, and above it."""

SAMPLE = 200
"""Kept episodes of each axis that are looked at, at most: a new scene takes a third of a second."""

CHANGED_LEVELS = 8
"""A pixel has changed where a channel differs by so many grey levels."""

Places = dict[tuple[str, str], list[tuple[str, Shifts]]]
"""Suite and task to the names and displacements of its tests, or of a run's episodes."""


class Spread(NamedTuple):
    """Of ``number`` values: the tenth, fiftieth and ninetieth percentile."""

    number: int
    low: float
    middle: float
    high: float

    def __str__(self) -> str:
        return f"{self.middle:.3g} ({self.low:.3g} to {self.high:.3g})"


def spread(values: ArrayLike) -> Spread:
    """Of one value at least."""
    measured = np.asarray(values, float)
    return Spread(measured.size, *(round(float(q), 4) for q in np.percentile(measured, [10, 50, 90])))


class Share(NamedTuple):
    """Of ``number`` things, such as scenes, the share of which something is true."""

    number: int
    share: float

    def __str__(self) -> str:
        return f"{100 * self.share:.0f} %"


class Measure(NamedTuple):
    """One thing that is seen; None where there is nothing to measure."""

    axis: str
    what: str
    tested: Spread | Share | None
    ours: Spread | Share | None


class Look(NamedTuple):
    """One state: the hand in the world's frame, the gap of its fingers, its speed, and that of the fastest object."""

    position_m: Floats
    rotation: Rotation
    gripper_mm: float
    hand_cm_s: float
    object_cm_s: float

    @classmethod
    def of(cls, model: mujoco.MjModel, state: Floats) -> Look:
        """Args: state: (S,) flattened MuJoCo state of the model."""
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
        """Of an episode that changes nothing."""
        return {
            "clean: gripper at the first look (mm)": self.gripper_mm,
            "clean: hand's speed at the first look (cm/s)": self.hand_cm_s,
            "clean: fastest object at the first look (cm/s)": self.object_cm_s,
        }

    def away_from(self, other: Look, component: str, level: int) -> dict[str, float]:
        """How far the hand is from where it is without a change of the robot."""
        turned_deg = float(np.degrees((self.rotation * other.rotation.inv()).magnitude()))
        return {
            f"robot: hand moved by {component}, level {level} (cm)": 100 * math.dist(self.position_m, other.position_m),
            f"robot: hand turned by {component}, level {level} (degrees)": turned_deg,
        }


def measure(run: Run, test: TestSet) -> list[Measure]:
    """Every measure of a finished run and of the test tasks, axis by axis.

    Raises:
        PipelineError: when the run lacks a trajectory or frames.
    """
    result = run.outcome
    # In the order in which they are written: shuffled, so that the first of each axis are of many tasks.
    kept = [result.row_of[episode_id] for episode_id in result.kept]
    # Trajectories and frames of those that ``export.where`` leaves out are there too.
    made = [row for row in result.rows if result.verdicts[row.episode_id].reason in outcome.MADE]
    twins = {row.episode_id: row for row in made if row.role == "twin"}
    seen = _Seen(run, twins)
    by_axis = [[row for row in kept if row.axis == axis][:SAMPLE] for axis in dict.fromkeys(row.axis for row in kept)]
    ours = _summaries(chain(*map(seen.of, chain(*by_axis)), to_nearest_draw(test, kept)))
    run_once = {name: Spread(*values) for name, values in json.loads(SEEN.read_text()).items()}
    tested = run_once | _summaries(chain(*map(_of_test, test.tasks), to_nearest_test(test)))
    named = ((name.partition(": "), name) for name in sorted({*tested, *ours}))
    return [Measure(axis, what, tested.get(name), ours.get(name)) for (axis, _, what), name in named]


def _summaries(pairs: Iterable[tuple[str, float]]) -> dict[str, Spread | Share]:
    return {
        name: Share(len(found), round(float(np.mean(found)), 4)) if isinstance(found[0], bool) else spread(found)
        for name, found in grouped(pairs).items()
    }


class _Seen:
    """What a run has of its episodes; each first look is read once."""

    def __init__(self, run: Run, twins: Mapping[str, Row]):
        self._store = run.trajectories
        self._load = run.episodes()
        self._twins = twins
        self._looks: dict[tuple[str, int], Look] = {}

    def of(self, row: Row) -> Iterator[tuple[str, float]]:
        """What an episode shows that changes nothing, or one axis."""
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
        """View to the (H, W, 3) differences of the first frame from the twin's."""
        own, others = (self._load(one.episode_id).frames for one in (row, twin))
        return {view: np.abs(decode(own[view][0]).astype(float) - decode(others[view][0])) for view in SCHEMA.views}


def _of_test(tested: TestTask) -> Iterator[tuple[str, float]]:
    known = tested.parameters
    match tested.axis:
        case "pose":
            yield from _targets_moved(tested.suite, tested.base, displacements(known), int(known["level"]))
        case "layout":
            xy_m = np.array([pair.split(",") for pair in str(known["positions"]).split(";")], float)
            yield from _added(str(known["category"]).split(","), xy_m, str(known["arena"]))
        case "language":
            yield "language: words", len(str(known["text"]).split())


def _targets_moved(suite: str, task: str, moves: Shifts, level: int) -> Iterator[tuple[str, float]]:
    for target in bddl.read(find_task(suite, task).bddl_file).targets:
        if target in moves:
            yield f"pose: target of {suite} moved, level {level} (cm)", 100 * float(np.hypot(*moves[target]))


def to_nearest_draw(test: TestSet, rows: Iterable[Row]) -> Iterator[tuple[str, float]]:
    """How far the things that a pose test is about are from the nearest place that some rows put them at.

    Tests of tasks for which no row moves a thing are left out.
    """
    drawn: Places = defaultdict(list)
    for row in rows:
        for change in from_json(row.perturbations):
            match change:
                case ScenePerturbation() | PosePerturbation():
                    drawn[row.suite, row.task].append((row.episode_id, change.shifts_in_all))
    return _to_nearest(test, drawn)


def to_nearest_test(test: TestSet) -> Iterator[tuple[str, float]]:
    """The same to the nearest place in another test of the same task: how close tests are to each other."""
    moved = (((one.suite, one.base), (one.name, displacements(one.parameters))) for one in test.of("pose"))
    return _to_nearest(test, grouped(moved))


def _to_nearest(test: TestSet, places: Places) -> Iterator[tuple[str, float]]:
    for tested in test.of("pose"):
        own = displacements(tested.parameters)
        others = [shifts for name, shifts in places[tested.suite, tested.base] if name != tested.name]
        for thing in bddl.read(find_task(tested.suite, tested.base).bddl_file).things_of_interest:
            apart_m = [math.dist(own[thing], other[thing]) for other in others if thing in other and thing in own]
            if apart_m:
                yield f"pose: test's thing of interest in {tested.suite} to the nearest other (cm)", 100 * min(apart_m)


def _added(models: Sequence[str], xy_m: Floats, arena: str) -> Iterator[tuple[str, float]]:
    """Of one scene with objects added: their models, and where they stand (N, 2) in the frame of the surface."""
    for number in range(1, 6):
        yield f"layout: scenes with {number} added", len(models) == number
    if len(models) > 1:
        yield f"layout: scenes with {len(models)} added that repeat a model", len(set(models)) < len(models)
    x_m, z_m = CAMERA_M[arena]
    for place in xy_m:
        yield "layout: object on the camera's side", bool(place[0] > CAMERA_SIDE_M)
        yield "layout: object to camera (m)", float(np.hypot(np.linalg.norm(place - [x_m, 0.0]), z_m))
