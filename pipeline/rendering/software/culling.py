"""Frustum culling: choice of the geoms that a picture can show, in each pass.

MuJoCo renders every geom of a scene, in the view or not. It renders all geoms once more if a box or a plane reflects,
and again for each light with shadows. In LIBERO's wrist view most of the robot, with more than half of the triangles,
is behind the camera. A plate of the stove is the only reflecting geom, and it mirrors little.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.software.mujoco_3_2_7.passes import REFLECTING_SQUARE, WIDEST_MAP_DEG
from pipeline.rendering.software.samples import Projection
from pipeline.types import Floats

MARGIN_M = 1e-3
"""Margin around every box, for rounding by the rasteriser."""


WIDEST_CONE = np.radians(80)
"""Largest half opening angle (rad) of a cone that is tested; wider cones count as containing everything."""

SHADOW_MARGIN_M = 0.05
"""A shadow within this distance of the view counts as in it: more than two pixels of a shadow map."""


class Lamp(NamedTuple):
    """Geoms that a light with shadows affects in a picture.

    Attributes:
        casts: (ngeom,) geoms that cast shadows into the picture.
        lights: (ngeom,) geoms that the light may light in the picture.
    """

    casts: NDArray[np.bool_]
    lights: NDArray[np.bool_]


class Picture(NamedTuple):
    """Geoms, lights and sites to render for a picture.

    Attributes:
        opaque, clear: (ngeom,) geoms that hide the geoms behind them, and geoms that may be transparent.
        mirror: (ngeom,) the opaque geom that reflects, if the picture has such a geom.
        seen: (ngeom,) geoms in the view of the camera.
        images: (ngeom,) geoms that show in the mirror.
        lamps: lights with shadows, in MuJoCo's order.
        sites: (nsite,) sites that may show.
        projection: projection for the choice of single faces; ``None`` if all faces are rendered.
        underlaid: True if the picture may be composed of underlays (``Still``).
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
    """Test of the bounding boxes of a model's geoms against a camera's view. All planes must have bounds.

    Args:
        model: the model.
        hidden_groups: groups of geoms that are not rendered.
        size_px: height and width of the frames.

    Attributes:
        shown: (ngeom,) geoms that are not in a hidden group.
    """

    def __init__(self, model: mujoco.MjModel, hidden_groups: Collection[int], size_px: int):
        self._model, self._size_px = model, size_px
        self.shown = ~np.isin(model.geom_group, list(hidden_groups))
        self._planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        bounds = model.geom_aabb.reshape(-1, 2, 3).copy()
        bounds[self._planes, 0], bounds[self._planes, 1] = 0, model.geom_size[self._planes] * [1, 1, 0]
        signs = np.array(list(product((-1, 1), repeat=3)))
        # Shape (ngeom, 8, 3), in the frame of the geom.
        self._corners_m = bounds[:, None, 0] + signs * (bounds[:, None, 1] + MARGIN_M)
        self._flat = np.flatnonzero(np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)))

    def picture(self, data: mujoco.MjData, camera: str) -> Picture:
        """Choose the geoms, lights and sites to render for the data's state; positions must be up to date."""
        view, clear = _View(self._model, data, camera, self._size_px), self._see_through()
        mirror, certain = self._mirror(data, view, clear)
        if not certain:
            return self.everything()
        turns = data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1)
        corners_m = data.geom_xpos[:, None] + self._corners_m @ turns
        seen = self.shown & view.shows(corners_m)
        lights_with_shadows = np.flatnonzero(self._model.light_castshadow & self._model.light_active)
        lamps = tuple(self._lamp(data, view, corners_m, seen, light) for light in lights_with_shadows.tolist())
        seen_or_casting = np.logical_or.reduce([seen, *(lamp.casts for lamp in lamps)])
        images, sites_alpha = np.zeros_like(seen), self._model.site_rgba[:, 3]
        if mirror is not None and seen[mirror]:
            images = self.shown & self._images(data, view, corners_m, mirror)
        return Picture(
            opaque=seen_or_casting & ~clear,
            clear=clear & (seen | images | bool(lamps)),
            mirror=(np.arange(len(seen)) == mirror) & images.any(),
            seen=seen,
            images=images,
            lamps=lamps,
            sites=self._sites(bool(lamps)),
            projection=view.projection(),
            # For each light with shadows, MuJoCo renders the lit geoms once more, so an underlay gains little.
            underlaid=not lamps and not ((sites_alpha > 0) & (sites_alpha < 1)).any(),
        )

    def everything(self) -> Picture:
        """Return a picture with everything in every pass."""
        every, clear = np.ones_like(self.shown), self._see_through()
        flat = np.isin(np.arange(len(every)), self._flat)
        return Picture(self.shown & ~clear, clear, flat, every, every, (), self._sites(True), None, False)

    def _images(self, data: mujoco.MjData, view: _View, corners_m: Floats, mirror: int) -> NDArray[np.bool_]:
        """Return a mask (ngeom,) of the geoms that show in a mirror."""
        heights_m = self._heights(data, mirror, corners_m)
        image_m = corners_m - 2 * heights_m[..., None] * data.geom_xmat[mirror, 2::3]
        half_x_m, half_y_m, _ = self._model.geom_size[mirror]
        square_m = REFLECTING_SQUARE * [half_x_m, half_y_m, self._face_m(mirror)]
        opening_m = data.geom_xpos[mirror] + square_m @ data.geom_xmat[mirror].reshape(3, 3).T
        above = (heights_m > 0).any(axis=1)
        return np.asarray(above & view.shows(image_m) & view.shows_through(image_m, opening_m))

    def _lamp(self, data: mujoco.MjData, view: _View, corners_m: Floats, seen: NDArray[np.bool_], lamp: int) -> Lamp:
        """Choose the geoms that cast shadows by a light, and the geoms that it may light.

        Args:
            data: the state.
            view: the camera's view.
            corners_m: (ngeom, 8, 3) corners of the geoms' bounding boxes in the world.
            seen: (ngeom,) geoms in the view.
            lamp: the light's number in the model.
        """
        model, origin_m, clear = self._model, data.light_xpos[lamp], self._see_through()
        # Geoms that can be seen through are rendered in the last pass, with the meshes of that pass.
        if model.light_directional[lamp]:
            return Lamp(self.shown, seen | clear)
        middles_m = corners_m.mean(axis=1)
        radii_m = np.linalg.norm(corners_m[:, 0] - middles_m, axis=1)
        axis = data.light_xdir[lamp] / np.linalg.norm(data.light_xdir[lamp])
        lights = seen & _in_cone(middles_m, radii_m, origin_m, axis, np.radians(model.light_cutoff[lamp])) | clear
        # The map is a square that covers a part of the cone. It lies within a cone through the square's corners.
        map_deg = min(model.light_cutoff[lamp] * model.vis.map.shadowscale, WIDEST_MAP_DEG)
        corner = np.arctan(np.sqrt(2) * np.tan(np.radians(map_deg)))
        # A geom outside of the picture may stand between the lamp and a geom in the picture.
        # For each metre between lamp and geom, the shadow is taken to reach a hundred metres.
        shadows_m = np.concatenate([corners_m, corners_m + 100 * (corners_m - origin_m)], axis=1)
        casts = _in_cone(middles_m, radii_m, origin_m, axis, corner) & view.shows(shadows_m, SHADOW_MARGIN_M)
        return Lamp(self.shown & casts & lights.any(), lights)

    def _mirror(self, data: mujoco.MjData, view: _View, clear: NDArray[np.bool_]) -> tuple[int | None, bool]:
        """Find the geom whose mirror images MuJoCo renders: the first reflecting geom, if the camera is before it.

        Returns:
            The geom or ``None``; and True if the answer is certain. It is uncertain if the camera is about in the
            mirror's plane, or if the mirror can be seen through: then MuJoCo's behaviour depends on rounding.
        """
        # Geoms without a material have the number -1, so the appended last value is theirs.
        reflects = np.append(self._model.mat_reflectance, 0)[self._model.geom_matid[self._flat]] > 0
        for mirror in self._flat[reflects & self.shown[self._flat]].tolist():
            height_m = float(self._heights(data, mirror, view.position_m))
            if abs(height_m) < MARGIN_M or clear[mirror]:
                return None, False
            if height_m > 0:
                return mirror, True
            # From behind, a plane can be seen through, so a later geom may reflect.
            if not self._planes[mirror]:
                break
        return None, True

    def _heights(self, data: mujoco.MjData, mirror: int, places_m: Floats) -> Floats:
        """Return the heights (...) of ``places_m`` (..., 3) above the reflecting side: a plane, or a box's face."""
        heights_m: Floats = (places_m - data.geom_xpos[mirror]) @ data.geom_xmat[mirror, 2::3] - self._face_m(mirror)
        return heights_m

    def _face_m(self, mirror: int) -> float:
        """Return the distance of a geom's reflecting face from its middle."""
        return 0.0 if self._planes[mirror] else float(self._model.geom_size[mirror, 2])

    def _see_through(self) -> NDArray[np.bool_]:
        """Return a mask (ngeom,) of the geoms that may be transparent, by their own colour or by their material's."""
        model, materials = self._model, self._model.geom_matid
        opacity = np.minimum(model.geom_rgba[:, 3], np.append(model.mat_rgba[:, 3], 1)[materials])
        return np.asarray(self.shown & (opacity < 1))

    def _sites(self, shadows: bool) -> NDArray[np.bool_]:
        """Return a mask (nsite,) of the sites that may show.

        robosuite hides some sites by a negative opacity. MuJoCo renders them, but they show only if lamps cast shadows.
        """
        return np.asarray((self._model.site_rgba[:, 3] > 0) | shadows)


def _in_cone(middles_m: Floats, radii_m: Floats, tip_m: Floats, axis: Floats, angle: float) -> NDArray[np.bool_]:
    """Return a mask (N,) of the balls that may reach into a cone.

    Args:
        middles_m: (N, 3) middles of the balls.
        radii_m: (N,) radii of the balls.
        tip_m: (3,) tip of the cone.
        axis: (3,) unit vector along the cone's axis.
        angle: half the opening angle in rad.
    """
    if angle > WIDEST_CONE:
        return np.ones(len(radii_m), np.bool_)
    ways_m = middles_m - tip_m
    along_m = ways_m @ axis
    across_m = np.linalg.norm(ways_m - along_m[:, None] * axis, axis=1)
    return np.asarray(across_m * np.cos(angle) - along_m * np.sin(angle) < radii_m)


class _View:
    """Pyramid that a camera sees, in the camera's frame: it looks along -z, with y up."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, size_px: int):
        number = model.camera(camera).id
        self.position_m, self._axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
        # Tangent of half the angle of view, to the side and up.
        self._tangent = np.tan(np.radians(model.cam_fovy[number]) / 2)
        self._size_px = size_px
        self._depths_m = model.vis.map.znear * model.stat.extent, model.vis.map.zfar * model.stat.extent

    def projection(self) -> Projection:
        """Return the projection from the world to the picture."""
        half_px = self._size_px / 2
        focal_px = half_px / self._tangent
        onto = np.array([[focal_px, 0, -half_px], [0, focal_px, -half_px], [0, 0, -1]])
        matrix = onto @ np.column_stack([self._axes.T, -self._axes.T @ self.position_m])
        return Projection(matrix, *self._depths_m, (self._size_px, self._size_px))

    def shows(self, corners_m: Floats, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Return a mask (N,) of the hulls of ``corners_m`` (N, K, 3) that may be in the picture.

        Args:
            corners_m: the corners, in the world.
            margin_m: width of a margin around the picture that counts as part of it.
        """
        right, up, back = np.moveaxis((corners_m - self.position_m) @ self._axes, -1, 0)
        inside = np.ones(len(corners_m), np.bool_)
        for off_axis in (right, up):
            # A box is outside when all of it is beyond one side; the sides pass through the camera.
            inside &= ~(off_axis + self._tangent * back > margin_m).all(axis=1)
            inside &= ~(off_axis - self._tangent * back < -margin_m).all(axis=1)
        return inside

    def shows_through(self, corners_m: Floats, opening_m: Floats) -> NDArray[np.bool_]:
        """Return a mask (N,) of the boxes that may show through a convex opening.

        Args:
            corners_m: (N, 8, 3) corners of the boxes.
            opening_m: (K, 3) corners of the opening.
        """
        rays_m = opening_m - self.position_m
        sides = np.cross(rays_m, np.roll(rays_m, -1, axis=0))
        # Turn each side's normal towards the middle of the opening.
        sides *= np.sign(sides @ rays_m.sum(axis=0))[:, None]
        return np.asarray(~((corners_m - self.position_m) @ sides.T < 0).all(axis=1).any(axis=1))
