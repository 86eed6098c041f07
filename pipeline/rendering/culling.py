"""What a picture cannot show and need not draw: the same pixels for less work.

MuJoCo draws every geom of a scene whether it is in the picture or not, and all of them once more where a box or a plane
reflects. In LIBERO's wrist view most of the robot, which has more than half of a scene's triangles, is behind the
camera.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.types import Floats

MARGIN_M = 1e-3
"""Added to every radius, for what the rasteriser rounds."""


class Drawn(NamedTuple):
    """What a picture has to draw.

    Attributes:
        geoms: (ngeom,) which geoms.
        reflections: whether a reflecting geom is in the picture.
    """

    geoms: NDArray[np.bool_]
    reflections: bool


class Culling:
    """Tells by bounding spheres what a camera can see of a model.

    Args:
        aspect: width of the pictures over their height.
    """

    def __init__(self, model: mujoco.MjModel, aspect: float):
        self._model, self._aspect = model, aspect
        # A plane has no bound: it is drawn wherever it is.
        unbounded = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._radius_m: Floats = np.where(unbounded, np.inf, model.geom_rbound + MARGIN_M)
        flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX))
        self._flat = np.flatnonzero(flat & (model.geom_matid >= 0))

    def drawn(self, data: mujoco.MjData, camera: str) -> Drawn:
        """What one picture of the data's state has to draw; positions must be up to date.

        Where something reflects, also what its mirror image may show: the reflecting side is a box's upper z face, or
        the plane (``mjr_render``).
        """
        model = self._model
        if (model.light_castshadow & model.light_active).any():
            # A shadow may come from outside of the picture.
            return Drawn(np.ones(model.ngeom, np.bool_), True)
        number = model.camera(camera).id
        seen = self._in_frustum(data, number, data.geom_xpos)
        mirrors = self._flat[model.mat_reflectance[model.geom_matid[self._flat]] > 0]
        geoms = seen.copy()
        # MuJoCo has the first of them reflect: without it, that would be another.
        geoms[mirrors] = True
        mirrors = mirrors[seen[mirrors]]
        for mirror in mirrors:
            normal = data.geom_xmat[mirror].reshape(3, 3)[:, 2]
            is_box = model.geom_type[mirror] == mujoco.mjtGeom.mjGEOM_BOX
            face_m = data.geom_xpos[mirror] + normal * (model.geom_size[mirror, 2] if is_box else 0)
            height_m = (data.geom_xpos - face_m) @ normal
            geoms |= self._in_frustum(data, number, data.geom_xpos - 2 * height_m[:, None] * normal)
        return Drawn(geoms, len(mirrors) > 0)

    def _in_frustum(self, data: mujoco.MjData, camera: int, centres_m: Floats) -> NDArray[np.bool_]:
        """(ngeom,) whether the bounding sphere at each of ``centres_m`` (ngeom, 3) is in or on the camera's pyramid."""
        # The camera looks along -z, with y up.
        right, up, back = ((centres_m - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
        half_rad = np.radians(self._model.cam_fovy[camera]) / 2
        inside = np.ones(len(centres_m), np.bool_)
        for off_axis, angle_rad in ((up, half_rad), (right, np.arctan(self._aspect * np.tan(half_rad)))):
            # How far outside of the nearer of two opposite sides, which pass through the camera.
            inside &= np.abs(off_axis) * np.cos(angle_rad) + back * np.sin(angle_rad) <= self._radius_m
        return inside
