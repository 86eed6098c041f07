"""Change of the agent view that leads to a pose: the reverse of ``CameraPerturbation.pose``."""

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.axes.camera import ORBIT_CENTRE_M, PARAMETERS, CameraPerturbation
from pipeline.libero.arenas import ARENAS, Arena
from pipeline.types import Floats

UNMOVED = 0.05
"""Angle in degrees below which a camera counts as LIBERO's own. Matrices are stored in single precision."""


def moved_to(extrinsics: Floats, arena: Arena) -> CameraPerturbation | None:
    """Return the change of the agent view that leads to a pose, or ``None`` if the view was not moved.

    A roll, which no test camera has, is left out. The distance to a test camera is then the least possible one.

    Args:
        extrinsics: (4, 4) from the camera (z forward, y down) to the world.
        arena: arena whose nominal agent view the pose is compared with.
    """
    position_m, quat_wxyz = ARENAS[arena].camera_m, ARENAS[arena].camera_quat_wxyz
    offset_m, nominal_offset_m = extrinsics[:3, 3] - ORBIT_CENTRE_M, np.array(position_m) - ORBIT_CENTRE_M
    radius_m, nominal_radius_m = np.linalg.norm(offset_m), np.linalg.norm(nominal_offset_m)
    azimuth = np.arctan2(offset_m[1], offset_m[0])
    elevation = np.arcsin(offset_m[2] / radius_m) - np.arcsin(nominal_offset_m[2] / nominal_radius_m)
    nominal = Rotation.from_quat(np.roll(np.array(quat_wxyz), -1))
    # MuJoCo's cameras look along -z, with y up.
    turned = Rotation.from_matrix(extrinsics[:3, :3] * [1.0, -1.0, -1.0])
    orbited = Rotation.from_euler("z", azimuth) * Rotation.from_euler("y", -elevation) * nominal
    in_place = turned * orbited.inv()
    yaw, pitch, _ = in_place.as_euler("zyx")
    scale = float(radius_m / nominal_radius_m)
    moved = np.rad2deg([azimuth, elevation, np.log(scale), yaw, -pitch]).tolist()
    if max(map(abs, moved)) < UNMOVED:
        return None
    changes = dict(zip(PARAMETERS, moved, strict=True)) | {"distance_scale": scale}
    return CameraPerturbation.model_validate({"component": "spherical", "level": 1, **changes})
