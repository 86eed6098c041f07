"""Change of the agent view that leads to a pose: the reverse of ``CameraPerturbation.pose``."""

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.axes.camera import ORBIT_CENTRE_M, PARAMETERS, CameraPerturbation
from pipeline.libero.bddl import Arena
from pipeline.types import Floats

_TURN_WXYZ = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
_LOW_TURN_WXYZ = (0.6182166934013367, 0.3432307541370392, 0.3432314395904541, 0.6182177066802979)
AGENT_VIEWS: dict[Arena, tuple[tuple[float, float, float], tuple[float, float, float, float]]] = {
    "tabletop": ((0.6586131746834771, 0.0, 1.6103500240372423), _TURN_WXYZ),
    "kitchen": ((0.6586131746834771, 0.0, 1.6103500240372423), _TURN_WXYZ),
    "study": ((0.4586131746834771, 0.0, 1.6103500240372423), _TURN_WXYZ),
    "floor": ((0.8965773716836134, 0.0, 0.65), _LOW_TURN_WXYZ),
    "living_room": ((0.6065773716836134, 0.0, 0.96), _LOW_TURN_WXYZ),
}
"""Position (m) and orientation of LIBERO's agent view in the world, by arena (``_setup_camera`` of LIBERO's
problems)."""

UNMOVED = 0.05
"""Angle in degrees below which a camera counts as LIBERO's own. Matrices are stored in single precision."""


def moved_to(extrinsics: Floats, arena: Arena) -> CameraPerturbation | None:
    """Return the change of the agent view that leads to a pose, or ``None`` if the view was not moved.

    A roll, which no test camera has, is left out. The distance to a test camera is then the least possible one.

    Args:
        extrinsics: (4, 4) from the camera (z forward, y down) to the world.
        arena: arena whose nominal agent view the pose is compared with.
    """
    position_m, quat_wxyz = AGENT_VIEWS[arena]
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
