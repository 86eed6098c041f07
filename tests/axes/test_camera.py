"""Camera: the benchmark's own formulas, by an independent implementation, and clear of its test cameras."""

import itertools
import re
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from short_demonstrations import MILK

from pipeline.axes import from_json, to_json
from pipeline.axes.camera import PARAMETERS, CameraAxis, CameraPerturbation
from pipeline.axes.noise import NoiseAxis
from pipeline.errors import PipelineError
from pipeline.libero.tasks import tasks
from pipeline.planning import leakage
from pipeline.seeding import rng
from pipeline.testset.benchmark import TESTED_SUITES, TestSet, TestTask
from pipeline.types import Task

OF_LIBERO_90 = tasks("libero_90")[0]
TABLETOP_POS_M = np.array([0.6586131746834771, 0.0, 1.6103500240372423])
TABLETOP_QUAT_WXYZ = np.array([0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349])
NOMINAL_RAYS_M = {
    "tabletop": (0.6586, 0.0, 0.8104),
    "study": (0.4586, 0.0, 0.8104),
    "floor": (0.8966, 0.0, -0.15),
    "living_room": (0.6066, 0.0, 0.16),
}
ANGLE = st.floats(-75, 75)
COMPONENTS = ("distance", "spherical", "orientation")


def camera(component: str, **parameters: float) -> CameraPerturbation:
    return CameraPerturbation.model_validate({"component": component, "level": 1, **parameters})


def benchmark_cameras() -> Iterator[tuple[str, dict[str, float]]]:
    """The whole grid that LIBERO-Plus chose its 1,599 test cameras from."""
    for azimuth, elevation in itertools.product(range(-75, 76), (0, 15)):
        yield "spherical", {"azimuth_deg": azimuth, "elevation_deg": elevation}
    for percent in (115, *range(119, 201)):
        yield "distance", {"distance_scale": percent / 100}
    turns = (-10, -8, -6, -4, -2, 2, 4, 6, 8, 10)
    for yaw, pitch in itertools.product(turns, turns):
        yield "orientation", {"yaw_deg": yaw, "pitch_deg": pitch}


def whole(parameters: Mapping[str, float]) -> dict[str, float]:
    return {"azimuth_deg": 0, "elevation_deg": 0, "distance_scale": 1.0, "yaw_deg": 0, "pitch_deg": 0, **parameters}


@pytest.fixture(scope="module")
def test_set() -> TestSet:
    test_tasks = [
        TestTask("libero_goal", "base", f"base_{n}", "camera", component, whole(parameters))
        for n, (component, parameters) in enumerate(benchmark_cameras())
        if parameters != {"azimuth_deg": 0, "elevation_deg": 0}  # H = 0 is in the grid at 15 degrees only
    ]
    return TestSet(tuple(test_tasks))


def benchmark_pose(
    azimuth: float, elevation: float, scale: float, yaw: float, pitch: float
) -> tuple[NDArray[np.float64], Rotation]:
    """`Problem._setup_camera` of LIBERO-Plus in SciPy, without its rounding to four decimals."""
    centre = np.array([0, 0, 0.8])
    pos = TABLETOP_POS_M
    rotation = Rotation.from_quat(TABLETOP_QUAT_WXYZ, scalar_first=True)
    lift = Rotation.from_euler("y", -elevation, degrees=True)
    pos, rotation = lift.apply(pos - centre) + centre, lift * rotation
    turn = Rotation.from_euler("z", azimuth, degrees=True)
    pos, rotation = turn.apply(pos), turn * rotation
    pos = centre + scale * (pos - centre)
    rotation = Rotation.from_euler("z", yaw, degrees=True) * rotation
    return pos, Rotation.from_euler("y", -pitch, degrees=True) * rotation


@given(ANGLE, st.floats(-10, 30), st.floats(0.5, 2), ANGLE, ANGLE)
def test_pose_is_the_benchmarks(azimuth: float, elevation: float, scale: float, yaw: float, pitch: float) -> None:
    perturbation = camera(
        "spherical", azimuth_deg=azimuth, elevation_deg=elevation, distance_scale=scale, yaw_deg=yaw, pitch_deg=pitch
    )
    pos, quat = perturbation.pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    expected_pos, expected = benchmark_pose(azimuth, elevation, scale, yaw, pitch)
    assert np.allclose(pos, expected_pos, atol=1e-9)
    assert (Rotation.from_quat(quat, scalar_first=True) * expected.inv()).magnitude() < 1e-6
    assert np.linalg.norm(quat) == pytest.approx(np.linalg.norm(TABLETOP_QUAT_WXYZ))


def test_nominal_is_exactly_nominal() -> None:
    pos, quat = camera("distance").pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert np.allclose(pos, TABLETOP_POS_M, rtol=0, atol=1e-15)
    assert np.array_equal(quat, TABLETOP_QUAT_WXYZ)


def test_directions_mean_what_the_docstrings_say() -> None:
    lifted, _ = camera("spherical", elevation_deg=10).pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert lifted[2] > TABLETOP_POS_M[2]
    turned, _ = camera("spherical", azimuth_deg=10).pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert turned[1] > 0, "counter-clockwise seen from above takes +x towards +y"

    def looks(quat: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(Rotation.from_quat(quat, scalar_first=True).apply([0, 0, -1]))

    _, pitched = camera("orientation", pitch_deg=5).pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert looks(pitched)[2] < looks(TABLETOP_QUAT_WXYZ)[2]


def sample_many(axis: CameraAxis, count: int = 1000, task: Task = MILK) -> list[CameraPerturbation]:
    return [axis.sample(rng(1, "camera", "demo", variant), task, variant) for variant in range(count)]


def test_perturbations_depend_on_their_key_and_cover_every_component_and_level() -> None:
    perturbations = sample_many(CameraAxis())
    assert perturbations == sample_many(CameraAxis())
    assert from_json(to_json(perturbations[:1])) == (perturbations[0],)
    assert {(p.component, p.level) for p in perturbations} == set(itertools.product(COMPONENTS, range(1, 6)))


def test_the_level_is_the_strength_of_what_the_component_is_about() -> None:
    axis = CameraAxis()
    for p in sample_many(axis):
        by_level, strength = {
            "distance": (axis.distance.distance_scale, p.distance_scale),
            "spherical": (axis.spherical.azimuth_deg, p.azimuth_deg),
            "orientation": (axis.orientation.turn_deg, max(p.yaw_deg, p.pitch_deg, key=abs)),
        }[p.component]
        assert any(low <= strength <= high for low, high in by_level[p.level - 1]), p


def test_a_perturbation_changes_one_thing_a_little_in_addition_to_its_component() -> None:
    for p in sample_many(CameraAxis()):
        aside = {
            "elevation": p.component != "spherical" and p.elevation_deg != 0,
            "distance": p.component != "distance" and p.distance_scale != 1,
            "turn": p.component != "orientation" and (p.yaw_deg, p.pitch_deg) != (0, 0),
        }
        # Of a spherical perturbation the elevation itself may be what is off the test set's.
        assert sum(aside.values()) == 1 or (p.component == "spherical" and not any(aside.values())), p
        assert p.component == "spherical" or p.azimuth_deg == 0
        assert p.component == "distance" or p.distance_scale == 1 or 1.094 <= p.distance_scale <= 1.18
        assert -2 <= p.elevation_deg <= 17
        assert p.component == "orientation" or np.hypot(p.yaw_deg, p.pitch_deg) <= 8.001


def test_no_side_is_preferred() -> None:
    perturbations = sample_many(CameraAxis())
    for component, name in itertools.product(COMPONENTS, ("azimuth_deg", "yaw_deg", "pitch_deg")):
        turns = [getattr(p, name) for p in perturbations if p.component == component and getattr(p, name)]
        assert abs(np.mean(np.sign(turns or [-1, 1]))) < 0.3, (component, name)
    diagonal = [np.sign(p.yaw_deg * p.pitch_deg) for p in perturbations if p.component == "orientation"]
    assert abs(np.mean(diagonal)) < 0.2


def test_levels_and_components_can_be_chosen() -> None:
    axis = CameraAxis(levels=(2, 5), components=("spherical",))
    assert {(p.component, p.level) for p in sample_many(axis, 50)} == {("spherical", 2), ("spherical", 5)}
    with pytest.raises(ValidationError, match="components"):
        CameraAxis(components=())


def test_a_component_that_is_null_is_left_out_as_before() -> None:
    """Configurations of earlier versions."""
    written = CameraAxis.model_validate({"distance": None, "orientation": None, "levels": [2]})
    assert written == CameraAxis(components=("spherical",), levels=(2,))
    with pytest.raises(ValidationError, match="at least one of distance"):
        CameraAxis.model_validate({"distance": None, "components": ["distance"]})


@pytest.mark.parametrize("clear_by", ["second_change", "resample", "off"])
@pytest.mark.parametrize("task", [MILK, OF_LIBERO_90], ids=["tested suite", "LIBERO-90"])
def test_no_configured_range_is_left(task: Task, clear_by: str) -> None:
    """A low camera near the front: the second change leaves distance and turn, which are not among the components."""
    spherical = {"elevation_deg": [[0, 5]], "azimuth_deg": [[[-10, 10]]] * 5}
    settings = {"components": ["spherical"], "spherical": spherical, "clear_by": clear_by}
    axis = CameraAxis.model_validate(settings)
    for p in sample_many(axis, task=task):
        assert 0 <= p.elevation_deg <= 5
        assert abs(p.azimuth_deg) <= 10
        assert (p.distance_scale, p.yaw_deg, p.pitch_deg) == (1, 0, 0)


def test_a_second_change_is_within_the_ranges_of_its_component() -> None:
    settings = {
        "distance": {"distance_scale": [[[1.0, 1.1]]] * 5},
        "spherical": {"elevation_deg": [[2, 6]]},
        "orientation": {"turn_deg": [[[0, 6]]] * 5},
    }
    perturbations = sample_many(CameraAxis.model_validate(settings))
    for p in perturbations:
        assert 1 <= p.distance_scale <= 1.1
        assert 2 <= p.elevation_deg <= 6 or (p.component != "spherical" and p.elevation_deg == 0)
        assert 0 <= max(p.yaw_deg, p.pitch_deg, key=abs) <= 6
    changed = Counter((p.component, p.distance_scale != 1, bool(p.yaw_deg)) for p in perturbations)
    assert changed["spherical", True, False] > 50
    assert changed["spherical", False, True] > 50


def test_only_tasks_of_tested_suites_get_a_second_change(test_set: TestSet) -> None:
    for p in sample_many(CameraAxis(), task=OF_LIBERO_90):
        parts = (p.azimuth_deg or p.elevation_deg, p.distance_scale - 1, p.yaw_deg or p.pitch_deg)
        assert sum(part != 0 for part in parts) == 1, p
        assert p.nearest(test_set, OF_LIBERO_90) == (np.inf, 0)


@pytest.mark.slow
def test_a_task_of_libero_90_in_a_tested_scene_keeps_its_clearance(test_set: TestSet) -> None:
    """Scenes are compared by the text of LIBERO's files: four sections that have no goal and no instruction."""

    def scene(task: Task) -> tuple[str, ...]:
        sections = re.split(r"\n  (?=\(:\w+)", task.bddl_file.read_text().replace("    (:", "  (:"))
        texts = [
            section for section in sections if section.startswith(("(:regions", "(:fixtures", "(:objects", "(:init"))
        ]
        return tuple(re.sub(r"\s+", " ", text) for text in texts)

    tested = {scene(task) for suite in TESTED_SUITES for task in tasks(suite)}
    alike = [task for task in tasks("libero_90") if scene(task) in tested]
    assert len(alike) == 35
    for task in alike:
        planted = test_set.tasks[0]
        parameters = {name: planted.parameters[name] for name in PARAMETERS}
        same = CameraPerturbation.model_validate({"component": planted.component, "level": 1, **parameters})
        assert same.nearest(test_set, task).distance == pytest.approx(0, abs=1e-5)
        found = [p.nearest(test_set, task).distance for p in sample_many(CameraAxis(), task=task)[:20]]
        assert np.mean(np.array(found) >= CameraPerturbation.clearance) > 0.7


def test_ranges_without_a_clear_camera_are_rejected(test_set: TestSet) -> None:
    CameraAxis().reject_levels_without_clearance(test_set, MILK)
    near = CameraAxis.model_validate({"components": ["orientation"], "levels": [2, 5]})
    with pytest.raises(PipelineError, match=r"no orientation camera of level 2, 5 .* 5 degrees(?s:.*)clear_by: off"):
        near.reject_levels_without_clearance(test_set, MILK)
    near.reject_levels_without_clearance(test_set, OF_LIBERO_90)
    near.model_copy(update={"clear_by": "off"}).reject_levels_without_clearance(test_set, MILK)
    low = {"components": ["spherical"], "spherical": {"elevation_deg": [[5.1, 9.9]]}, "clear_by": "resample"}
    CameraAxis.model_validate(low).reject_levels_without_clearance(test_set, MILK)


def test_default_cameras_mostly_keep_their_clearance_from_every_test_camera(test_set: TestSet) -> None:
    found = [p.nearest(test_set, MILK) for p in sample_many(CameraAxis())]
    assert {near.compared for near in found} == {len(test_set.tasks)}
    # The rest is sampled again.
    assert np.mean([near.distance >= CameraPerturbation.clearance for near in found]) > 0.9


@pytest.mark.parametrize("steepest_deg", [60.5, -9.5], ids=["steepest arena", "flattest arena"])
def test_cameras_with_clearance_cover_the_test_cameras(
    steepest_deg: float, test_set: TestSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the measure, which is that of the steepest arena, and where a degree of azimuth is farther."""
    clear = [p for p in sample_many(CameraAxis(), 4000) if p.nearest(test_set, MILK).distance >= p.clearance]
    monkeypatch.setattr("pipeline.axes.camera.STEEPEST_DEG", steepest_deg)
    same = TestSet(test_set.tasks)  # what is remembered of a test set is of another arena
    covered = leakage.coverage("camera", leakage.distances("camera", [(p, MILK) for p in clear], same), same)
    assert set(covered) == set(COMPONENTS)
    for component, found in covered.items():
        smallest, median, p90 = (getattr(found, name) for name in ("smallest", "median", "p90"))
        assert smallest >= CameraPerturbation.clearance, component
        assert median <= 7, component
        assert p90 <= 9, component
    azimuths_deg = [p.azimuth_deg for p in clear]
    assert min(azimuths_deg) < -74
    assert max(azimuths_deg) > 74


def test_every_test_camera_is_found(test_set: TestSet) -> None:
    for task in test_set.tasks:
        copied = camera(task.component, **{name: float(value) for name, value in task.parameters.items()})
        assert copied.nearest(test_set, MILK).distance == pytest.approx(0, abs=1e-4)


def test_distance_is_a_bound_on_the_angle_between_rays_in_every_arena() -> None:
    """Checked against the rays that the poses themselves give, arena by arena."""
    test = TestSet((TestTask("libero_10", "base", "one", "camera", "spherical", whole({"azimuth_deg": 40})),))
    for azimuth, elevation in ((0, 7), (33, -5), (47, 5), (60, 25)):
        moved = camera("spherical", azimuth_deg=azimuth, elevation_deg=elevation)
        claimed = moved.nearest(test, MILK).distance
        for arena, ray in NOMINAL_RAYS_M.items():
            own, other = (
                p.pose(np.array([0, 0, 0.8]) + ray, TABLETOP_QUAT_WXYZ)[0] - [0, 0, 0.8]
                for p in (moved, camera("spherical", azimuth_deg=40))
            )
            cosine = own @ other / np.linalg.norm(own) / np.linalg.norm(other)
            assert claimed <= np.rad2deg(np.arccos(cosine)) + 0.05, arena


@pytest.mark.parametrize(
    ("near", "clear"),
    [
        # From the turns in place by 2 degrees, which stand at the nominal distance.
        (camera("distance", distance_scale=0.92), camera("distance", distance_scale=0.915)),
        # From the farthest dolly.
        (camera("distance", distance_scale=2.18), camera("distance", distance_scale=2.19)),
        (camera("spherical", elevation_deg=4.9), camera("spherical", elevation_deg=5.1)),
        (
            camera("spherical", azimuth_deg=60, elevation_deg=19.9),
            camera("spherical", azimuth_deg=60, elevation_deg=20.1),
        ),
        (camera("orientation", yaw_deg=14, pitch_deg=1), camera("orientation", yaw_deg=15.1, pitch_deg=2)),
        (camera("orientation", yaw_deg=6.5, pitch_deg=-9), camera("orientation", pitch_deg=-15.2)),
    ],
)
def test_cameras_at_the_limit_of_the_clearance(
    near: CameraPerturbation, clear: CameraPerturbation, test_set: TestSet
) -> None:
    assert near.nearest(test_set, MILK).distance < CameraPerturbation.clearance
    assert clear.nearest(test_set, MILK).distance >= CameraPerturbation.clearance


def test_nothing_to_compare_with() -> None:
    assert camera("distance", distance_scale=2).nearest(TestSet(()), MILK) == (np.inf, 0)


def test_order_of_listing_does_not_matter() -> None:
    moved = CameraAxis().sample(rng("a"), MILK, 0)
    noise = NoiseAxis().sample(rng("b"), MILK, 0)
    assert to_json([moved, noise]) == to_json([noise, moved])
    assert [p.axis for p in from_json(to_json([noise, moved]))] == ["camera", "noise"]


def test_no_camera_rolls_more_than_the_test_s() -> None:
    """The horizontal axis of a picture stays level: the test cameras tilt it by at most 1.7 degrees."""
    tilts_deg = {"test": 0.0, "ours": 0.0}
    perturbations = [CameraAxis().sample(rng("roll", key), MILK, 0) for key in range(600)]
    grid = [camera(component, **parameters) for component, parameters in benchmark_cameras()]
    for source, cameras in (("test", grid), ("ours", perturbations)):
        for one in cameras:
            _, quat_wxyz = one.pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
            right = Rotation.from_quat(quat_wxyz, scalar_first=True).apply([1.0, 0.0, 0.0])
            tilts_deg[source] = max(tilts_deg[source], abs(np.degrees(np.arcsin(right[2]))))
    assert max(tilts_deg.values()) <= 2.0, tilts_deg
