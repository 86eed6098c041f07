"""Frustum culling: which geoms a picture can show, in each pass.

MuJoCo renders every geom of a scene, in the view or not. It renders all of them once more where a box or a plane
reflects, and again for each light with shadows. In LIBERO's wrist view most of the robot, with more than half of the
triangles, is behind the camera. What reflects is a plate of the stove, which mirrors little.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.rendering.software.mujoco_3_2_7.passes import REFLECTING_SQUARE, WIDEST_MAP_DEG
from pipeline.rendering.software.samples import Projection
from pipeline.types import Floats

MARGIN_M = 1e-3
"""Added around every box, for what the rasteriser rounds."""


WIDEST_CONE = np.radians(80)
"""Largest half opening angle (rad) of a cone that is tested; wider ones count as holding everything."""

SHADOW_MARGIN_M = 0.05
"""A shadow within this distance of the view counts as in it: more than two pixels of a shadow map."""


class Lamp(NamedTuple):
    """Of a light with shadows, (ngeom,) which geoms cast shadows into the picture, and which it may light there."""

    casts: NDArray[np.bool_]
    lights: NDArray[np.bool_]


class Picture(NamedTuple):
    """What has to be rendered for a picture.

    Attributes:
        opaque, clear: (ngeom,) geoms that hide what is behind them, and geoms that may be transparent.
        mirror: (ngeom,) the opaque geom that reflects, if there is one.
        seen: (ngeom,) geoms in the view of the camera.
        images: (ngeom,) geoms that show in the mirror.
        lamps: lights with shadows, in MuJoCo's order.
        sites: (nsite,) sites that may show.
        projection: for the choice of single faces, or None where all are rendered.
        underlaid: whether the picture may be composed of underlays (``Still``).
    """

    opaque: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    mirror: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    images: NDArray[np.bool_]
    lamps: tuple[Lamp, ...]
    sites: NDArray[np.bool_]
    projection: Projection | None
    underlaid: bool


class Culling:
    """Tests the bounding boxes of a model's geoms against a camera's view. All planes must have bounds.

    Args:
        hidden_groups: groups of geoms that are not rendered.
    """

    def __init__(self, model: mujoco.MjModel, hidden_groups: Collection[int]):
        self._model, self.shown = model, ~np.isin(model.geom_group, list(hidden_groups))
        self._planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        bounds = model.geom_aabb.reshape(-1, 2, 3).copy()
        bounds[self._planes, 0], bounds[self._planes, 1] = 0, model.geom_size[self._planes] * [1, 1, 0]
        signs = np.array(list(product((-1, 1), repeat=3)))
        # (ngeom, 8, 3) in the frame of the geom.
        self._corners_m = bounds[:, None, 0] + signs * (bounds[:, None, 1] + MARGIN_M)
        self._flat = np.flatnonzero(np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)))

    def picture(self, data: mujoco.MjData, camera: str) -> Picture:
        """What has to be rendered of the data's state; positions must be up to date."""
        view, clear = _View(self._model, data, camera), self._see_through()
        mirror, sure = self._mirror(data, view, clear)
        if not sure:
            return self.everything()
        turns = data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1)
        corners_m = data.geom_xpos[:, None] + self._corners_m @ turns
        seen = self.shown & view.shows(corners_m)
        with_shadows = np.flatnonzero(self._model.light_castshadow & self._model.light_active)
        lamps = tuple(self._lamp(data, view, corners_m, seen, lamp) for lamp in with_shadows.tolist())
        images, sites_alpha = np.zeros_like(seen), self._model.site_rgba[:, 3]
        if mirror is not None and seen[mirror]:
            images = self.shown & self._images(data, view, corners_m, mirror)
        return Picture(
            opaque=np.logical_or.reduce([seen, *(lamp.casts for lamp in lamps)]) & ~clear,
            clear=clear & (seen | images | bool(lamps)),
            mirror=(np.arange(len(seen)) == mirror) & images.any(),
            seen=seen,
            images=images,
            lamps=lamps,
            sites=self._sites(bool(lamps)),
            projection=view.projection(),
            # Each light with shadows renders what it lights once more, so an underlay gains little.
            underlaid=not lamps and not ((sites_alpha > 0) & (sites_alpha < 1)).any(),
        )

    def everything(self) -> Picture:
        """Everything, in every pass."""
        every, clear = np.ones_like(self.shown), self._see_through()
        flat = np.isin(np.arange(len(every)), self._flat)
        return Picture(self.shown & ~clear, clear, flat, every, every, (), self._sites(True), None, False)

    def _images(self, data: mujoco.MjData, view: _View, corners_m: Floats, mirror: int) -> NDArray[np.bool_]:
        """(ngeom,) which geoms show in a mirror."""
        heights_m = self._heights(data, mirror, corners_m)
        image_m = corners_m - 2 * heights_m[..., None] * data.geom_xmat[mirror, 2::3]
        half_x_m, half_y_m, _ = self._model.geom_size[mirror]
        square_m = REFLECTING_SQUARE * [half_x_m, half_y_m, self._face_m(mirror)]
        opening_m = data.geom_xpos[mirror] + square_m @ data.geom_xmat[mirror].reshape(3, 3).T
        above = (heights_m > 0).any(axis=1)
        return np.asarray(above & view.shows(image_m) & view.shows_through(image_m, opening_m))

    def _lamp(self, data: mujoco.MjData, view: _View, corners_m: Floats, seen: NDArray[np.bool_], lamp: int) -> Lamp:
        model, origin_m, clear = self._model, data.light_xpos[lamp], self._see_through()
        # What can be seen through is rendered in the last pass, with what is rendered there of meshes.
        if model.light_directional[lamp]:
            return Lamp(self.shown, seen | clear)
        middles_m = corners_m.mean(axis=1)
        radii_m = np.linalg.norm(corners_m[:, 0] - middles_m, axis=1)
        axis = data.light_xdir[lamp] / np.linalg.norm(data.light_xdir[lamp])
        lights = seen & _in_cone(middles_m, radii_m, origin_m, axis, np.radians(model.light_cutoff[lamp])) | clear
        # A square map of a part of the cone, within a cone through the square's corners.
        map_deg = min(model.light_cutoff[lamp] * model.vis.map.shadowscale, WIDEST_MAP_DEG)
        corner = np.arctan(np.sqrt(2) * np.tan(np.radians(map_deg)))
        # Out of the picture, it may still stand between the lamp and what is in it.
        # By a metre's distance from the lamp, its shadow reaches a hundred metres.
        shadows_m = np.concatenate([corners_m, corners_m + 100 * (corners_m - origin_m)], axis=1)
        casts = _in_cone(middles_m, radii_m, origin_m, axis, corner) & view.shows(shadows_m, SHADOW_MARGIN_M)
        return Lamp(self.shown & casts & lights.any(), lights)

    def _mirror(self, data: mujoco.MjData, view: _View, clear: NDArray[np.bool_]) -> tuple[int | None, bool]:
        """The geom whose mirror images MuJoCo renders: the first that reflects, if the camera is before it.

        The second value is false when the camera is about in its plane, or when it can be seen through: what MuJoCo
        does then is a matter of rounding.
        """
        # The last is for geoms without a material, whose number is -1.
        reflects = np.append(self._model.mat_reflectance, 0)[self._model.geom_matid[self._flat]] > 0
        for mirror in self._flat[reflects & self.shown[self._flat]].tolist():
            height_m = float(self._heights(data, mirror, view.position_m))
            if abs(height_m) < MARGIN_M or clear[mirror]:
                return None, False
            if height_m > 0:
                return mirror, True
            # From behind, a plane can be seen through, and so another one may reflect.
            if not self._planes[mirror]:
                break
        return None, True

    def _heights(self, data: mujoco.MjData, mirror: int, places_m: Floats) -> Floats:
        """(...) of ``places_m`` (..., 3) above the reflecting side: that of a plane, or a box's face."""
        heights_m: Floats = (places_m - data.geom_xpos[mirror]) @ data.geom_xmat[mirror, 2::3] - self._face_m(mirror)
        return heights_m

    def _face_m(self, mirror: int) -> float:
        """How far a geom's reflecting face is from its middle."""
        return 0.0 if self._planes[mirror] else float(self._model.geom_size[mirror, 2])

    def _see_through(self) -> NDArray[np.bool_]:
        """(ngeom,) which geoms may show what is behind them: by their own colour, or by their material's."""
        model, materials = self._model, self._model.geom_matid
        opacity = np.minimum(model.geom_rgba[:, 3], np.append(model.mat_rgba[:, 3], 1)[materials])
        return np.asarray(self.shown & (opacity < 1))

    def _sites(self, shadows: bool) -> NDArray[np.bool_]:
        """(nsite,) which sites may show.

        robosuite hides some by a negative opacity: MuJoCo renders them, and only where lamps cast shadows they show.
        """
        return np.asarray((self._model.site_rgba[:, 3] > 0) | shadows)


def _in_cone(middles_m: Floats, radii_m: Floats, tip_m: Floats, axis: Floats, angle: float) -> NDArray[np.bool_]:
    """(N,) which balls may reach into a cone, by half its opening angle in radians."""
    if angle > WIDEST_CONE:
        return np.ones(len(radii_m), np.bool_)
    ways_m = middles_m - tip_m
    along_m = ways_m @ axis
    across_m = np.linalg.norm(ways_m - along_m[:, None] * axis, axis=1)
    return np.asarray(across_m * np.cos(angle) - along_m * np.sin(angle) < radii_m)


class _View:
    """The pyramid that a camera sees, in its own frame: it looks along -z, with y up."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str):
        number, (height, width, _) = model.camera(camera).id, SCHEMA.frame.shape
        self.position_m, self._axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
        tangent = np.tan(np.radians(model.cam_fovy[number]) / 2)
        # Of half the angles of view, to the side and up.
        self._tangents = tangent * width / height, tangent
        self._size_px = width, height
        self._depths_m = model.vis.map.znear * model.stat.extent, model.vis.map.zfar * model.stat.extent

    def projection(self) -> Projection:
        half_px = np.array(self._size_px) / 2
        focal_px = half_px[1] / self._tangents[1]
        onto = np.array([[focal_px, 0, -half_px[0]], [0, focal_px, -half_px[1]], [0, 0, -1]])
        matrix = onto @ np.column_stack([self._axes.T, -self._axes.T @ self.position_m])
        return Projection(matrix, *self._depths_m, self._size_px)

    def shows(self, corners_m: Floats, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """(N,) whether what has ``corners_m`` (N, K, 3) may be in the picture, or within a margin around it."""
        right, up, back = np.moveaxis((corners_m - self.position_m) @ self._axes, -1, 0)
        inside = np.ones(len(corners_m), np.bool_)
        for off_axis, tangent in ((right, self._tangents[0]), (up, self._tangents[1])):
            # A box is outside when all of it is beyond one side; the sides pass through the camera.
            inside &= ~(off_axis + tangent * back > margin_m).all(axis=1)
            inside &= ~(off_axis - tangent * back < -margin_m).all(axis=1)
        return inside

    def shows_through(self, corners_m: Floats, opening_m: Floats) -> NDArray[np.bool_]:
        """(N,) whether boxes with ``corners_m`` (N, 8, 3) may show through a convex opening with corners (K, 3)."""
        rays_m = opening_m - self.position_m
        sides = np.cross(rays_m, np.roll(rays_m, -1, axis=0))
        # Of each side, towards the middle of the opening.
        sides *= np.sign(sides @ rays_m.sum(axis=0))[:, None]
        return np.asarray(~((corners_m - self.position_m) @ sides.T < 0).all(axis=1).any(axis=1))
