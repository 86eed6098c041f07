"""Camera: the benchmark's own formulas, by an independent implementation, and clear of its test cameras."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import MILK
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.axes import from_json, to_json
from pipeline.axes.camera import CameraAxis, CameraPerturbation
from pipeline.axes.noise import NoiseAxis
from pipeline.seeding import rng

TABLETOP_POS_M = np.array([0.6586131746834771, 0.0, 1.6103500240372423])
TABLETOP_QUAT_WXYZ = np.array([0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349])
ANGLE = st.floats(-75, 75)


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
    perturbation = CameraPerturbation(
        component="spherical",
        azimuth_deg=azimuth,
        elevation_deg=elevation,
        distance_scale=scale,
        yaw_deg=yaw,
        pitch_deg=pitch,
    )
    pos, quat = perturbation.pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    expected_pos, expected = benchmark_pose(azimuth, elevation, scale, yaw, pitch)
    assert np.allclose(pos, expected_pos, atol=1e-9)
    assert (Rotation.from_quat(quat, scalar_first=True) * expected.inv()).magnitude() < 1e-6
    assert np.linalg.norm(quat) == pytest.approx(np.linalg.norm(TABLETOP_QUAT_WXYZ))


def test_nominal_is_exactly_nominal() -> None:
    pos, quat = CameraPerturbation(component="distance").pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert np.allclose(pos, TABLETOP_POS_M, rtol=0, atol=1e-15)
    assert np.array_equal(quat, TABLETOP_QUAT_WXYZ)


def test_directions_mean_what_the_docstrings_say() -> None:
    lifted, _ = CameraPerturbation(component="spherical", elevation_deg=10).pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert lifted[2] > TABLETOP_POS_M[2]
    turned, _ = CameraPerturbation(component="spherical", azimuth_deg=10).pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert turned[1] > 0, "counter-clockwise seen from above takes +x towards +y"

    def looks(quat: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(Rotation.from_quat(quat, scalar_first=True).apply([0, 0, -1]))

    _, pitched = CameraPerturbation(component="orientation", pitch_deg=5).pose(TABLETOP_POS_M, TABLETOP_QUAT_WXYZ)
    assert looks(pitched)[2] < looks(TABLETOP_QUAT_WXYZ)[2]


@given(st.integers(0, 10_000))
def test_draws_are_keyed_in_range_and_off_the_test_grid(variant: int) -> None:
    axis = CameraAxis()
    drawn = axis.sample(rng(1, "camera", "demo", variant), MILK, variant)
    assert drawn == axis.sample(rng(1, "camera", "demo", variant), MILK, variant)
    assert from_json(to_json([drawn])) == (drawn,)
    match drawn.component:
        case "distance":
            assert 0.75 <= drawn.distance_scale <= 0.95 or 1.05 <= drawn.distance_scale <= 1.13
        case "spherical":
            # The test set's elevations are 0 and 15 degrees, at any whole azimuth.
            assert min(abs(drawn.elevation_deg), abs(drawn.elevation_deg - 15)) >= 5
        case "orientation":
            # The test set turns by at most 10 degrees about either axis.
            assert abs(drawn.yaw_deg) >= 11


def test_order_of_listing_does_not_matter() -> None:
    moved = CameraAxis().sample(rng("a"), MILK, 0)
    noise = NoiseAxis().sample(rng("b"), MILK, 0)
    assert to_json([moved, noise]) == to_json([noise, moved])
    assert [p.axis for p in from_json(to_json([noise, moved]))] == ["camera", "noise"]
