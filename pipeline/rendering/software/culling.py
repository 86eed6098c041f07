"""What a picture cannot show and need not draw: the same pixels for less work.

MuJoCo draws every geom of a scene whether it is in the picture or not, all of them once more where a box or a plane
reflects, and for each lamp with shadows. In LIBERO's wrist view most of the robot, which has more than half of the
triangles, is behind the camera, and its pedestal below the table; what reflects is a plate of the stove, around which
little is to be seen; of the lamps, one lights no object.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.software.mesh_pieces import MARGIN_M, boxes_of
from pipeline.rendering.software.samples import Projection
from pipeline.types import Floats

LEAST_SCREEN_M = 0.1
"""Half the width of the boxes that are looked behind, and more of their length."""

WIDEST_CONE = np.radians(80)
"""Half the opening angle of cones up to which it is worked out what is in them."""

WIDEST_MAP_DEG = 80.0
"""Half the widest angle of MuJoCo's maps of what casts shadows (``mjr_render``)."""

SHADOW_MARGIN_M = 0.05
"""So near to a picture, a shadow counts as in it: more than two pixels of a lamp's map."""

SQUARE = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
"""Corners of a box's upper z face, which is what reflects (``mjr_render``), in units of its half sizes."""


class Picture(NamedTuple):
    """What has to be drawn for a picture; of meshes, which of the model's boxes (``Boxes``), and so which pieces.

    Attributes:
        opaque, clear: (ngeom,) which geoms; ``clear`` may show what is behind them.
        mirror: (ngeom,) the opaque one that reflects, if there is one.
        seen: (N,) which boxes are before the camera.
        images: (N,) which show in the mirror.
        shadows: (N,) for each lamp with shadows, which boxes cast them, and which are seen and lit.
        sites: (nsite,) which sites.
        layers: whether it can be put together of layers, of what is opaque and does not reflect.
        projection: by which to choose single faces, or None.
    """

    opaque: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    mirror: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    images: NDArray[np.bool_]
    shadows: tuple[NDArray[np.bool_], ...]
    sites: NDArray[np.bool_]
    layers: bool
    projection: Projection | None = None


class Culling:
    """Tells by the boxes around geoms what a camera can see of a model.

    Args:
        height, width: of the pictures, in pixels.
        hidden_groups: groups of geoms that are not drawn.
        layers: whether pictures are to be made of layers.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, hidden_groups: Collection[int], layers: bool):
        self._model, self._height, self._width, self._layers = model, height, width, layers
        self._shown = ~np.isin(model.geom_group, list(hidden_groups))
        self.boxes = boxes_of(model, hidden_groups)
        self._planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        # A plane without bounds is drawn wherever it is.
        self._endless = self._planes & (model.geom_size[:, :2].min(axis=1) <= 0)
        self._of_mesh = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)[self.boxes.geom]
        # What moves is left out, as layers are kept while what they show stands still.
        fixed = ((model.body_weldid == 0) & (model.body_mocapid[model.body_rootid] < 0))[model.geom_bodyid]
        wide = (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX) & (np.sort(model.geom_size)[:, 1] > LEAST_SCREEN_M)
        self._screens = np.flatnonzero(self._shown & fixed & wide)
        self._flat = np.flatnonzero(np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX)))

    def picture(self, data: mujoco.MjData, camera: str) -> Picture:
        """What has to be drawn of the data's state; positions must be up to date."""
        view = _View(self._model, data, camera, self._height, self._width)
        clear = self._see_through()
        mirror, sure = self._mirror(data, view, clear)
        if not sure:
            return self.everything()
        of = self.boxes.geom
        turns = data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1)
        corners_m = data.geom_xpos[of, None] + self.boxes.corners_m @ turns[of]
        seen = self._endless[of] | view.shows(corners_m)
        near = np.flatnonzero(seen & self._of_mesh)
        seen[near] = ~self._hidden(data, view, corners_m[near], clear)
        casting = np.zeros_like(seen)
        shadows: list[NDArray[np.bool_]] = []
        for casts, reached in self._lamps(data, view, corners_m):
            # What can be seen through is drawn in the last pass, with what is drawn there of meshes.
            lit = reached & seen | clear[of]
            shadows += [casts & lit.any(), lit]
            casting |= casts
        images = np.zeros_like(seen)
        if mirror is not None and seen[np.searchsorted(of, mirror)]:
            images = self._images(data, view, corners_m, mirror)
        return Picture(
            opaque=self._geoms(seen | casting) & ~clear,
            clear=clear & self._geoms(seen | images | bool(shadows)),
            mirror=(np.arange(self._model.ngeom) == mirror) & images.any(),
            seen=seen,
            images=images,
            shadows=tuple(shadows),
            sites=self._sites(bool(shadows)),
            layers=self._layers and not self._sites_see_through(),
            projection=view.projection() if self._layers else None,
        )

    def _geoms(self, boxes: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(ngeom,) whose boxes (N,) are."""
        geoms = np.zeros(self._model.ngeom, np.bool_)
        geoms[self.boxes.geom[boxes]] = True
        return geoms

    def _images(self, data: mujoco.MjData, view: _View, corners_m: Floats, mirror: int) -> NDArray[np.bool_]:
        """(N,) which boxes show in a mirror."""
        heights_m = self._heights(data, mirror, corners_m)
        image_m = corners_m - 2 * heights_m[..., None] * self._normal(data, mirror)
        images: NDArray[np.bool_] = (heights_m > 0).any(axis=1) & view.shows(image_m)
        if not self._endless[mirror]:
            half_x_m, half_y_m, _ = self._model.geom_size[mirror]
            corners = SQUARE * [half_x_m, half_y_m, self._face_m(mirror)]
            images &= view.shows_through(
                image_m, data.geom_xpos[mirror] + corners @ data.geom_xmat[mirror].reshape(3, 3).T
            )
        return np.asarray(images | self._endless[self.boxes.geom])

    def _hidden(
        self, data: mujoco.MjData, view: _View, corners_m: Floats, clear: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """(K,) whether all that is in a box of ``corners_m`` (K, 8, 3) is behind one large box, such as a table's top.

        What a convex body hides is convex: it has all of a box where it has its corners.
        """
        hidden = np.zeros(len(corners_m), np.bool_)
        for screen in self._screens[~clear[self._screens]]:
            axes, half_m = data.geom_xmat[screen].reshape(3, 3), self._model.geom_size[screen] - MARGIN_M
            eye_m = (view.position_m - data.geom_xpos[screen]) @ axes
            thin = int(half_m.argmin())
            beyond_m = (corners_m - data.geom_xpos[screen]) @ axes[:, thin] * np.sign(eye_m[thin])
            behind = np.flatnonzero((beyond_m < half_m[thin]).all(axis=1))
            if not len(behind):
                continue
            ways_m = (corners_m[behind] - data.geom_xpos[screen]) @ axes - eye_m
            # Where each line of sight, 0 at the eye and 1 at the corner, is between two opposite faces.
            with np.errstate(divide="ignore", invalid="ignore"):
                crossed = np.stack([(-half_m - eye_m) / ways_m, (half_m - eye_m) / ways_m])
            enters, leaves = crossed.min(axis=0).max(axis=-1), crossed.max(axis=0).min(axis=-1)
            # What is nearer than the near plane is not drawn, and hides nothing.
            drawn = enters * view.depths(corners_m[behind]) > view.near_m
            hidden[behind] |= ((enters < leaves) & (enters < 1) & drawn).all(axis=1)
        return hidden

    def _lamps(
        self, data: mujoco.MjData, view: _View, corners_m: Floats
    ) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
        """For each lamp with shadows, in MuJoCo's order, (N,) which boxes may cast them into the picture, and which its
        light may reach: those in its map, and those in its cone."""
        model, lamps = self._model, np.flatnonzero(self._model.light_castshadow & self._model.light_active)
        if not len(lamps):
            return
        middles_m = corners_m.mean(axis=1)
        radii_m = np.linalg.norm(corners_m[:, 0] - middles_m, axis=1)
        for lamp in lamps:
            if model.light_directional[lamp]:
                yield np.ones(len(corners_m), np.bool_), np.ones(len(corners_m), np.bool_)
                continue
            # A square map of a part of the cone (`mjr_render`), within a cone through the square's corners.
            map_deg = min(model.light_cutoff[lamp] * model.vis.map.shadowscale, WIDEST_MAP_DEG)
            corner = np.arctan(np.sqrt(2) * np.tan(np.radians(map_deg)))
            axis, origin_m = data.light_xdir[lamp] / np.linalg.norm(data.light_xdir[lamp]), data.light_xpos[lamp]
            casts = self._in_cone(middles_m, radii_m, origin_m, axis, corner)
            # Out of the picture, it may still stand between the lamp and what is in it.
            # By a metre's distance from the lamp, its shadow reaches a hundred metres.
            far_m = corners_m + 100 * (corners_m - origin_m)
            shadows_m = np.concatenate([corners_m, far_m], axis=1)
            casts &= self._endless[self.boxes.geom] | view.shows(shadows_m, SHADOW_MARGIN_M)
            yield casts, self._in_cone(middles_m, radii_m, origin_m, axis, np.radians(model.light_cutoff[lamp]))

    def _in_cone(
        self, middles_m: Floats, radii_m: Floats, tip_m: Floats, axis: Floats, angle: float
    ) -> NDArray[np.bool_]:
        """(N,) which boxes, by the balls around them, may reach into a cone, by half its opening angle in radians."""
        if angle > WIDEST_CONE:
            return np.ones(len(radii_m), np.bool_)
        ways_m = middles_m - tip_m
        along_m = ways_m @ axis
        across_m = np.linalg.norm(ways_m - along_m[:, None] * axis, axis=1)
        near = across_m * np.cos(angle) - along_m * np.sin(angle) < radii_m
        return np.asarray(near | self._endless[self.boxes.geom])

    def _mirror(self, data: mujoco.MjData, view: _View, clear: NDArray[np.bool_]) -> tuple[int | None, bool]:
        """The geom whose mirror images MuJoCo draws: the first that reflects, if the camera is before it.

        The second value is false when the camera is about in its plane, or when it can be seen through: what MuJoCo
        does then is a matter of rounding.
        """
        # The last is for geoms without a material, whose number is -1.
        reflects = np.append(self._model.mat_reflectance, 0)[self._model.geom_matid[self._flat]] > 0
        for mirror in self._flat[reflects & self._shown[self._flat]].tolist():
            height_m = float(self._heights(data, mirror, view.position_m))
            if abs(height_m) < MARGIN_M or clear[mirror]:
                return None, False
            if height_m > 0:
                return mirror, True
            # From behind, a plane can be seen through, and so another one may reflect.
            if not self._planes[mirror]:
                break
        return None, True

    def _normal(self, data: mujoco.MjData, mirror: int) -> Floats:
        normal: Floats = data.geom_xmat[mirror].reshape(3, 3)[:, 2]
        return normal

    def _heights(self, data: mujoco.MjData, mirror: int, places_m: Floats) -> Floats:
        """(...) of ``places_m`` (..., 3) above the reflecting side: that of a plane, or a box's face."""
        heights_m: Floats = (places_m - data.geom_xpos[mirror]) @ self._normal(data, mirror) - self._face_m(mirror)
        return heights_m

    def _face_m(self, mirror: int) -> float:
        """How far a geom's reflecting face is from its middle."""
        return 0.0 if self._planes[mirror] else float(self._model.geom_size[mirror, 2])

    def _see_through(self) -> NDArray[np.bool_]:
        """(ngeom,) which geoms may show what is behind them: by their own colour, or by their material's."""
        model, materials = self._model, self._model.geom_matid
        opacity = np.minimum(model.geom_rgba[:, 3], np.append(model.mat_rgba[:, 3], 1)[materials])
        return np.asarray(self._shown & (opacity < 1))

    def _sites(self, shadows: bool) -> NDArray[np.bool_]:
        """(nsite,) which sites may show.

        robosuite hides some by a negative opacity: MuJoCo draws them, and only where lamps cast shadows they show.
        """
        return np.asarray((self._model.site_rgba[:, 3] > 0) | shadows)

    def _sites_see_through(self) -> bool:
        opacity = self._model.site_rgba[:, 3]
        return bool(((opacity > 0) & (opacity < 1)).any())

    def everything(self) -> Picture:
        """All that there is, in every pass."""
        every, clear = np.ones(len(self.boxes.geom), np.bool_), self._see_through()
        reflecting = self._shown & False
        reflecting[self._flat] = True
        return Picture(self._shown & ~clear, clear, reflecting, every, every, (), self._sites(shadows=True), False)


class _View:
    """The pyramid that a camera sees, in its own frame: it looks along -z, with y up."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, height: int, width: int):
        number = model.camera(camera).id
        self.position_m, self._axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
        # Some way behind the plane before which nothing is drawn.
        self.near_m = 1.1 * model.vis.map.znear * model.stat.extent
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

    def depths(self, corners_m: Floats) -> Floats:
        """(...) of ``corners_m`` (..., 3), along the axis that the camera looks along."""
        depths_m: Floats = -(corners_m - self.position_m) @ self._axes[:, 2]
        return depths_m

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
