"""Camera: pose of the agent view. Render layer; the wrist view moves with the arm and never changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from pipeline import seeding
from pipeline.axes.base import (
    Axis,
    ByLevel,
    Degrees,
    Intervals,
    Level,
    RenderPerturbation,
    level_from,
    pick,
    sample_number,
    sample_point,
)
from pipeline.axes.report_data import BENCHMARK, CoveragePlots, KeptPerturbation, Scatter, Strips
from pipeline.errors import PipelineError
from pipeline.rotations import about, product, rotate
from pipeline.testset.benchmark import TestSet, TestTask, is_in_tested_scene
from pipeline.types import Floats, Frozen, Task

if TYPE_CHECKING:
    import mujoco

Component = Literal["distance", "spherical", "orientation"]

ORBIT_CENTRE_M = np.array([0.0, 0.0, 0.8])
"""World point about which LIBERO-Plus turns the camera and scales its distance, identical for every arena
(`Problem._setup_camera` of LIBERO-Plus)."""

STEEPEST_DEG = 60.5
"""Elevation of the study's agent view, the steepest of the five arenas, above the orbit centre's horizon.

There a degree of azimuth spans the smallest arc of the sphere. A camera at its clearance from the test cameras there is
at its clearance in every arena."""

PARAMETERS = ("azimuth_deg", "elevation_deg", "distance_scale", "yaw_deg", "pitch_deg")
"""Parameters that place a camera, in perturbations and in test tasks."""

NEAREST = 0.01
"""Least multiple of the distance that a configuration can ask for; perturbations are recorded with four decimals."""


class CameraPerturbation(RenderPerturbation):
    """A new pose for the agent view, relative to the scene's own.

    The order is LIBERO-Plus's: elevate about the orbit centre, turn about the world's z axis, move along the ray
    to the orbit centre, then yaw and pitch in place. Unlike LIBERO-Plus, no step is rounded.

    Attributes:
        azimuth_deg: counter-clockwise turn about the world's z axis.
        elevation_deg: rise about the world's y axis through the orbit centre; positive lifts the camera.
        distance_scale: multiple of the distance to the orbit centre.
        yaw_deg: turn in place about the world's z axis.
        pitch_deg: turn in place about the world's y axis; positive looks further down.

    The paper keeps training cameras 5 degrees from test cameras on the sphere. Two cameras can also stand on one ray
    from the orbit centre: the test set's changes of distance and turns in place all do. The distance between two
    cameras is therefore the largest of three angles, and is zero only for equal pictures:

    * the angle between their rays,
    * the angle between their turns in place,
    * the logarithm of the ratio of their distances in radians. Along the ray it moves a camera by as much as an equal
      angle does across the ray; 5 degrees are a ratio of 1.091.
    """

    axis: Literal["camera"] = "camera"
    component: Component
    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    distance_scale: float = Field(default=1.0, gt=0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0

    views: ClassVar[frozenset[str]] = frozenset({"image"})
    fields: ClassVar[tuple[str, ...]] = ("cam_pos", "cam_quat")
    clearance: ClassVar[float] = 5.0
    unit: ClassVar[str | None] = "degrees"
    measure: ClassVar[str] = (
        "the largest of the angle on the sphere about the orbit centre, the angle between the turns in place, "
        "and the logarithm of the distance ratio (5 degrees: 1.091)"
    )

    def pose(self, pos_m: Floats, quat_wxyz: Floats) -> tuple[Floats, Floats]:
        """Return the perturbed pose of a camera whose nominal world pose is ``pos_m`` (3,), ``quat_wxyz`` (4,)."""
        lift = about("y", -self.elevation_deg)
        turn = about("z", self.azimuth_deg)
        pos = rotate(lift, pos_m - ORBIT_CENTRE_M) + ORBIT_CENTRE_M
        pos = rotate(turn, pos)
        pos = ORBIT_CENTRE_M + self.distance_scale * (pos - ORBIT_CENTRE_M)
        quat = quat_wxyz
        for step in (lift, turn, about("z", self.yaw_deg), about("y", -self.pitch_deg)):
            quat = product(step, quat)
        return pos, quat

    def apply(self, model: mujoco.MjModel) -> None:
        """Move the model's agent view and change nothing else."""
        camera = model.camera("agentview")
        camera.pos[:], camera.quat[:] = self.pose(camera.pos.copy(), camera.quat.copy())

    def distances(self, test: TestSet, task: Task) -> Floats:
        """Return the distances (N,) to the test cameras of all tasks, because many tasks share one nominal view.

        They are NaN for a task in a scene without test tasks, as some of LIBERO-90's and of the user's own are.
        """
        if not is_in_tested_scene(task):
            return np.full(len(test.on_axis(self.axis)), np.nan)
        cameras, places = _test_cameras(test)
        return self._angles_deg(cameras)[places]

    def distances_to(self, others: Sequence[CameraPerturbation]) -> Floats:
        """Return the distances (N,) to other cameras, for any tasks."""
        parameters = [perturbation.parameters() for perturbation in others]
        return self._angles_deg(_embed(np.array(parameters)))

    def _angles_deg(self, cameras: _Cameras) -> Floats:
        """Return the distances (N,) to N cameras in degrees."""
        camera = _embed(np.array([self.parameters()]))
        sphere = _angle_deg(cameras.rays @ camera.rays[0])
        turn = 2 * _angle_deg(np.abs(cameras.turns @ camera.turns[0]))
        dolly = np.rad2deg(np.abs(cameras.log_scales - camera.log_scales[0]))
        return np.asarray(np.maximum(np.maximum(sphere, turn), dolly))

    def parameters(self) -> tuple[float, ...]:
        """Return the values of ``PARAMETERS``."""
        return tuple(getattr(self, name) for name in PARAMETERS)


class _Cameras(NamedTuple):
    """Cameras relative to the nominal one: unit rays (N, 3), turns as unit quaternions (N, 4), log scales (N,)."""

    rays: Floats
    turns: Floats
    log_scales: Floats


def _embed(parameters: Floats) -> _Cameras:
    """Convert ``PARAMETERS`` (N, 5) into cameras of the steepest arena."""
    azimuth_deg, elevation_deg, scale, yaw_deg, pitch_deg = parameters.T
    h, v = np.deg2rad(azimuth_deg), np.deg2rad(STEEPEST_DEG + elevation_deg)
    rays = np.stack([np.cos(v) * np.cos(h), np.cos(v) * np.sin(h), np.sin(v)], axis=1)
    y, p = np.deg2rad(yaw_deg) / 2, -np.deg2rad(pitch_deg) / 2
    turns = np.stack(
        [np.cos(p) * np.cos(y), np.sin(p) * np.sin(y), np.sin(p) * np.cos(y), np.cos(p) * np.sin(y)], axis=1
    )
    return _Cameras(rays, turns, np.log(scale))


def _angle_deg(cosine: Floats) -> Floats:
    """Convert cosines into angles in degrees."""
    return np.asarray(np.rad2deg(np.arccos(cosine.clip(-1, 1))))


@lru_cache(maxsize=4)
def _test_cameras(test: TestSet) -> tuple[_Cameras, NDArray[np.intp]]:
    """Return the distinct cameras of the test set, and each test task's index among them."""
    listed = []
    for task in test.on_axis("camera"):
        listed.append([float(task.parameters[name]) for name in PARAMETERS])
    parameters = np.array(listed).reshape(-1, len(PARAMETERS))
    distinct, places = np.unique(parameters, axis=0, return_inverse=True)
    return _embed(distinct), places.reshape(-1)


def _positive(intervals: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """Check that all distances are at least ``NEAREST``."""
    if any(low < NEAREST for low, _ in intervals):
        raise ValueError(f"a distance is a positive multiple of the nominal one, {NEAREST} or more")
    return intervals


Scales = Annotated[Intervals[Annotated[float, Field(le=10.0)]], AfterValidator(_positive)]

Angles = Intervals[Degrees]


def _both_ways(low: float, high: float) -> Angles:
    """Return the intervals of angles with a size from ``low`` to ``high``, in both directions."""
    return ((-high, -low), (low, high))


class DistanceRange(Frozen):
    """The test set's scales are 1.15 and 1.19 to 2.00.

    Attributes:
        distance_scale: For each level, intervals of the multiple of the distance to the orbit centre.
    """

    distance_scale: ByLevel[Scales] = (((1.08, 1.2),), ((1.2, 1.4),), ((1.4, 1.6),), ((1.6, 1.8),), ((1.8, 2.0),))


class SphericalRange(Frozen):
    """The test set's azimuths are whole degrees in [-75, 75], its elevations 0 and 15. The azimuth sets the level.

    Attributes:
        azimuth_deg: For each level, intervals of the counter-clockwise turn about the world's z axis, in degrees.
        elevation_deg: Intervals of the rise about the orbit centre at every level, in degrees; positive values lift the
            camera.
    """

    azimuth_deg: ByLevel[Angles] = (
        ((-15.0, 15.0),),
        _both_ways(15.0, 30.0),
        _both_ways(30.0, 45.0),
        _both_ways(45.0, 60.0),
        _both_ways(60.0, 75.0),
    )
    elevation_deg: Angles = ((-2.0, 17.0),)


class OrientationRange(Frozen):
    """Ranges of the component ``orientation``.

    The test set turns cameras by 2, 4, 6, 8 or 10 degrees about both axes. Each level has one of these in its middle.

    Attributes:
        turn_deg: For each level, intervals of the larger turn in place, in degrees. It is yaw or pitch with equal
            probability, and the other turn has at most its size, in either direction.
    """

    turn_deg: ByLevel[Angles] = (
        _both_ways(1.0, 3.0),
        _both_ways(3.0, 5.0),
        _both_ways(5.0, 7.0),
        _both_ways(7.0, 9.0),
        _both_ways(9.0, 11.0),
    )


Aside = Literal["elevation", "distance", "turn", "yaw"]


class AsideRange(Frozen):
    """Second change of a camera, slightly larger than the clearance, that separates it from the test cameras.

    A test camera changes its distance, its place on the sphere or its turn in place, and leaves the other two alone.

    Attributes:
        elevation_deg: Intervals of the elevation in degrees; by default on both sides of the test set's elevations, 0
            and 15 degrees. Values outside of the component's own ranges are never used: by default, those below 0.
        distance_scale: Intervals of the multiple of the distance; by default on both sides of the nominal distance,
            which most test cameras keep. A camera that still comes too close to a test camera is sampled again. Values
            outside of the component's own ranges are never used: by default, those below 1.
        turn_deg: Intervals of the turn in place in degrees, in any direction. A camera that moved around the scene only
            turns by a yaw, as its pitch would roll it like no test camera.
    """

    elevation_deg: Angles = ((-8.0, -5.1), (5.1, 9.9))
    distance_scale: Scales = ((0.87, 0.914), (1.094, 1.18))
    turn_deg: Angles = ((5.1, 8.0),)

    def sample(self, rng: np.random.Generator, kind: Aside) -> dict[str, float]:
        """Sample the parameters of one kind of second change."""
        match kind:
            case "elevation":
                return {"elevation_deg": sample_number(rng, self.elevation_deg)}
            case "distance":
                return {"distance_scale": sample_number(rng, self.distance_scale)}
            case "turn":
                yaw_deg, pitch_deg = sample_point(rng, sample_number(rng, self.turn_deg))
                return {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg}
            case "yaw":
                return {"yaw_deg": sample_number(rng, self.turn_deg) * (1 if rng.random() < 0.5 else -1)}


ASIDES: dict[Component, tuple[Aside, ...]] = {
    "distance": ("elevation", "turn"),
    "spherical": ("elevation", "distance", "yaw"),
    "orientation": ("elevation", "distance"),
}
"""Kinds of second change of each component's perturbations, each with equal probability.

A second change that leaves the component's ranges, or a camera that is still too close to a test camera, is sampled
again. The kinds of the cameras that remain are therefore not equally frequent."""

COMPONENT_OF: dict[Aside, Component] = {
    "elevation": "spherical",
    "distance": "distance",
    "turn": "orientation",
    "yaw": "orientation",
}
"""Component whose configured ranges a kind of second change keeps."""

ClearBy = Literal["second_change", "resample", "off"]

SECOND_CHANGES = 20
"""Most attempts to sample a second change within the configured ranges."""

TRIED_CAMERAS = 300
"""Number of cameras of a component and level of which at least one has to keep its clearance."""


class CameraAxis(Axis):
    """Ranges to sample from: each component spans the values of LIBERO-Plus's test cameras of its kind.

    Test cameras use every value of these ranges. A perturbation therefore has a second change, which keeps it 5 degrees
    from all test cameras: a distance of 1.6 with 6 degrees of elevation has its clearance. Frames of the defaults were
    inspected in all five arenas.

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), each entry with equal probability; all five by default.
        components: Components to sample, each entry with equal probability: ``distance``, ``spherical`` (moves the
            camera around the scene) and ``orientation`` (turns it in place); all three by default.
        distance: Ranges of the component ``distance``.
        spherical: Ranges of the component ``spherical``.
        orientation: Ranges of the component ``orientation``.
        clear_by: Method that keeps cameras in scenes of the four tested suites at their clearance from test cameras.
            ``second_change``, the default, also changes a second one of ``components``, within its ranges. ``resample``
            only samples again, and needs ranges that no test camera occupies. ``off`` keeps no clearance:
            ``leakage.json`` counts the overlaps, and the run continues.
        aside: Ranges of the second change, limited to the ranges of its component.
    """

    kinds: ClassVar = (CameraPerturbation,)
    colour: ClassVar = "#4285f4"
    dimension: ClassVar = "camera"
    audited: ClassVar = "cameras"

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = get_args(Component)
    distance: DistanceRange = DistanceRange()
    spherical: SphericalRange = SphericalRange()
    orientation: OrientationRange = OrientationRange()
    clear_by: ClearBy = "second_change"
    aside: AsideRange = AsideRange()

    @model_validator(mode="before")
    @classmethod
    def _leave_out_null(cls, raw: Any) -> Any:
        """Leave out components whose ranges are null, as configurations did before ``components``."""
        if not isinstance(raw, Mapping):
            return raw
        null = [name for name in get_args(Component) if name in raw and raw[name] is None]
        if not null:
            return raw
        components = raw.get("components", get_args(Component))
        if not isinstance(components, list | tuple):
            return raw  # The field's own type reports this.
        left = [name for name in components if name not in null]
        if not left:
            raise ValueError("keep at least one of distance, spherical and orientation")
        return {name: ranges for name, ranges in raw.items() if name not in null} | {"components": left}

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the level by the distance, the azimuth, or the larger of yaw and pitch, in steps of the defaults."""
        value = {name: float(tested.parameters[name]) for name in PARAMETERS}
        match tested.component:
            case "distance":
                return level_from((value["distance_scale"] - 1) / 0.2)
            case "spherical":
                return level_from(abs(value["azimuth_deg"]) / 15)
            case _:
                return level_from(max(abs(value["yaw_deg"]), abs(value["pitch_deg"])) / 2)

    @property
    def keeps_clearance(self) -> bool:
        """Return whether cameras keep their clearance to the test cameras."""
        return self.clear_by != "off"

    def reject_levels_without_clearance(self, test: TestSet, task: Task) -> None:
        """Reject a component with a level at which the ranges have no camera at its clearance from the test cameras.

        Raises:
            PipelineError: naming component and levels.
        """
        if not self.keeps_clearance:
            return
        for component in dict.fromkeys(self.components):
            near = [level for level in sorted({*self.levels}) if not self._has_clear(component, level, test, task)]
            if near:
                raise PipelineError(
                    f"no {component} camera of level {', '.join(map(str, near))} within the ranges is at least "
                    f"{CameraPerturbation.clearance:g} degrees from all test cameras",
                    where=f"plan.axes.camera, task {task}",
                    expected="components that can change together with it, with ranges that reach 5 degrees",
                    remedy="add components or widen the ranges; or set clear_by: off, so that training cameras may "
                    "equal test cameras",
                )

    def _has_clear(self, component: Component, level: Level, test: TestSet, task: Task) -> bool:
        """Return whether one of ``TRIED_CAMERAS`` of a component and level keeps its clearance."""
        random = seeding.rng("clear cameras", component, level)
        for _ in range(TRIED_CAMERAS):
            perturbation = self._sample_at(random, component, level, task)
            if perturbation.nearest(test, task).distance >= perturbation.clearance:
                return True
        return False

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> CameraPerturbation:
        component = pick(rng, self.components)
        return self._sample_at(rng, component, self.sample_level(rng), task)

    def _sample_at(
        self, rng: np.random.Generator, component: Component, level: Level, task: Task
    ) -> CameraPerturbation:
        """Sample a perturbation of a component at a level."""
        parameters = self._sample_parameters(rng, component, level)
        if self.clear_by == "second_change" and is_in_tested_scene(task):
            parameters |= self._sample_second_change(rng, component)
        return CameraPerturbation.model_validate({"component": component, "level": level, **parameters})

    def _sample_second_change(self, rng: np.random.Generator, component: Component) -> dict[str, float]:
        """Sample a second change within the configured ranges; empty if none is found.

        A camera without a second change rarely keeps its clearance, and is then sampled again.
        """
        kinds = [kind for kind in ASIDES[component] if COMPONENT_OF[kind] in self.components]
        if not kinds:
            return {}
        kind = pick(rng, kinds)
        intervals = self._intervals(COMPONENT_OF[kind])
        for _ in range(SECOND_CHANGES):
            change = self.aside.sample(rng, kind)
            value = max(change.values(), key=abs)
            if any(low <= value <= high for low, high in intervals):
                return change
        return {}

    def _intervals(self, component: Component) -> tuple[tuple[float, float], ...]:
        """List the intervals of a component, of all levels, that a second change keeps."""
        match component:
            case "distance":
                return tuple(chain(*self.distance.distance_scale))
            case "spherical":
                return self.spherical.elevation_deg
            case "orientation":
                return tuple(chain(*self.orientation.turn_deg))

    def _sample_parameters(self, rng: np.random.Generator, component: Component, level: Level) -> dict[str, float]:
        """Sample the parameters that a component changes."""
        match component:
            case "distance":
                return {"distance_scale": sample_number(rng, self.distance.distance_scale[level - 1])}
            case "spherical":
                azimuth_deg = sample_number(rng, self.spherical.azimuth_deg[level - 1])
                return {"azimuth_deg": azimuth_deg, "elevation_deg": sample_number(rng, self.spherical.elevation_deg)}
            case "orientation":
                large, small = ("yaw_deg", "pitch_deg") if rng.random() < 0.5 else ("pitch_deg", "yaw_deg")
                turn_deg = sample_number(rng, self.orientation.turn_deg[level - 1])
                return {large: turn_deg, small: round(turn_deg * rng.uniform(-1.0, 1.0), 4)}

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[CameraPerturbation]], test: TestSet) -> CoveragePlots:
        """Describe plots of the positions, the distances and the rotations of the cameras."""
        tested = [task.parameters for task in test.on_axis("camera")]
        cameras = [item.perturbation for item in kept]

        def points(first: str, second: str) -> dict[str, Floats]:
            """Return the distinct points (N, 2) of the test tasks, and the points of the perturbations."""
            test_points = [(float(parameters[first]), float(parameters[second])) for parameters in tested]
            read = attrgetter(first, second)
            return {
                BENCHMARK: np.unique(np.array(test_points).reshape(-1, 2), axis=0),
                "camera": np.array([read(camera) for camera in cameras]).reshape(-1, 2),
            }

        scales = {
            BENCHMARK: np.unique([float(parameters["distance_scale"]) for parameters in tested]),
            "camera": np.array([camera.distance_scale for camera in cameras]),
        }
        return CoveragePlots(
            f"{len(tested):,} test cameras. A kept episode is one point in each plot; its unchanged parameters have "
            "LIBERO's values. A camera that keeps its clearance may equal a test camera in one plot, but not in all.",
            [
                Scatter("Position", points("azimuth_deg", "elevation_deg"), "azimuth (°)", "elevation (°)"),
                Strips("Distance", {"scale": scales}, "multiple of the distance"),
                Scatter("Rotation in place", points("yaw_deg", "pitch_deg"), "yaw (°)", "pitch (°)"),
            ],
        )
