"""Rotations behind stored and sampled numbers: SciPy's results differ from these in the last bits."""

from typing import Literal

import numpy as np

from pipeline.types import Floats


def about(axis: Literal["y", "z"], angle_deg: float) -> Floats:
    """Return the unit quaternion (w, x, y, z) of a right-handed rotation about an axis of the world."""
    half = np.deg2rad(angle_deg) / 2
    w, s = np.cos(half), np.sin(half)
    return np.array([w, 0.0, s, 0.0] if axis == "y" else [w, 0.0, 0.0, s])


def matrix(axis: Floats, angle_deg: float) -> Floats:
    """Return the matrix (3, 3) of a right-handed rotation about a unit axis."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(angle_deg)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def product(a: Floats, b: Floats) -> Floats:
    """Return the Hamilton product of two quaternions (w, x, y, z): the rotation ``b`` followed by ``a``."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def rotate(quat: Floats, vector: Floats) -> Floats:
    """Return ``vector`` (3,) rotated by the unit quaternion ``quat`` (w, x, y, z)."""
    return np.asarray(vector + 2 * np.cross(quat[1:], np.cross(quat[1:], vector) + quat[0] * vector))


def axis_angle(w: float, xyz: Floats) -> Floats:
    """Return axis times angle (rad) of a unit quaternion.

    The angle is in [0, 2 pi], as robosuite's ``quat2axisangle`` returns it.
    """
    w = float(np.clip(w, -1.0, 1.0))
    sine = np.sqrt(1.0 - w * w)
    if np.isclose(sine, 0.0):
        return np.zeros(3)
    return np.asarray(xyz * 2.0 * np.arccos(w) / sine)
