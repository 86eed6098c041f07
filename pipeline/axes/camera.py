"""Camera: where the agent view is seen from. Render layer; the wrist view moves with the arm and never changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.axes.base import Frozen, Intervals, RenderPerturbation, draw
from pipeline.types import Task

if TYPE_CHECKING:
    import mujoco

Component = Literal["distance", "spherical", "orientation"]

ORBIT_CENTRE_M = np.array([0.0, 0.0, 0.8])
"""World point that LIBERO-Plus turns and dollies the camera about, the same for every arena
(`Problem._setup_camera` of LIBERO-Plus)."""


class CameraPerturbation(RenderPerturbation):
    """A new pose for the agent view, relative to the scene's own.

    The order is LIBERO-Plus's: elevate about the orbit centre, turn about the world's z axis, dolly along the ray
    to the orbit centre, then yaw and pitch in place. Unlike there, nothing is rounded on the way.

    Attributes:
        azimuth_deg: counter-clockwise turn about the world's z axis.
        elevation_deg: rise about the world's y axis through the orbit centre; positive lifts the camera.
        distance_scale: multiple of the distance to the orbit centre.
        yaw_deg: turn in place about the world's z axis.
        pitch_deg: turn in place about the world's y axis; positive looks further down.
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

    def pose(
        self, pos_m: NDArray[np.float64], quat_wxyz: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The perturbed pose of a camera whose nominal world pose is ``pos_m`` (3,), ``quat_wxyz`` (4,)."""
        lift = _about("y", -self.elevation_deg)
        turn = _about("z", self.azimuth_deg)
        pos = _rotate(lift, pos_m - ORBIT_CENTRE_M) + ORBIT_CENTRE_M
        pos = _rotate(turn, pos)
        pos = ORBIT_CENTRE_M + self.distance_scale * (pos - ORBIT_CENTRE_M)
        quat = quat_wxyz
        for step in (lift, turn, _about("z", self.yaw_deg), _about("y", -self.pitch_deg)):
            quat = _product(step, quat)
        return pos, quat

    def apply(self, model: mujoco.MjModel) -> None:
        """Move the model's agent view; nothing else in the model changes."""
        camera = model.camera("agentview")
        camera.pos[:], camera.quat[:] = self.pose(camera.pos.copy(), camera.quat.copy())


class DistanceRange(Frozen):
    distance_scale: Intervals


class SphericalRange(Frozen):
    azimuth_deg: Intervals
    elevation_deg: Intervals


class OrientationRange(Frozen):
    yaw_deg: Intervals
    pitch_deg: Intervals


class CameraAxis(Frozen):
    """The ranges to draw from; the defaults keep clear of LIBERO-Plus's test cameras.

    The test set moves on azimuths of whole degrees in [-75, 75] at elevations 0 and 15, at distance scales
    1.15 to 2.00, and turns in place by 2 to 10 degrees about both axes at once.
    """

    distance: DistanceRange | None = DistanceRange(distance_scale=((0.75, 0.95), (1.05, 1.13)))
    spherical: SphericalRange | None = SphericalRange(
        azimuth_deg=((-60.0, 60.0),), elevation_deg=((5.0, 10.0), (20.0, 30.0))
    )
    orientation: OrientationRange | None = OrientationRange(
        yaw_deg=((-15.0, -11.0), (11.0, 15.0)), pitch_deg=((-8.0, 8.0),)
    )

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> CameraPerturbation:
        ranges: dict[Component, Frozen] = {
            name: value
            for name in ("distance", "spherical", "orientation")
            if (value := getattr(self, name)) is not None
        }
        component = list(ranges)[rng.integers(len(ranges))]
        drawn = {name: draw(rng, intervals) for name, intervals in ranges[component]}
        return CameraPerturbation.model_validate({"component": component, **drawn})


def _about(axis: Literal["y", "z"], angle_deg: float) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z) of a right-handed rotation about a world axis."""
    half = np.deg2rad(angle_deg) / 2
    w, s = np.cos(half), np.sin(half)
    return np.array([w, 0.0, s, 0.0] if axis == "y" else [w, 0.0, 0.0, s])


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hamilton product of two quaternions (w, x, y, z): the rotation ``b`` followed by ``a``."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def _rotate(quat: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """``vector`` (3,) turned by the unit quaternion ``quat`` (w, x, y, z)."""
    turned: NDArray[np.float64] = vector + 2 * np.cross(quat[1:], np.cross(quat[1:], vector) + quat[0] * vector)
    return turned
