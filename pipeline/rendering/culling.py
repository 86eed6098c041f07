"""What a picture cannot show and need not draw: the same pixels for less work.

MuJoCo draws every geom of a scene whether it is in the picture or not, all of them once more where a box or a plane
reflects, and for each lamp with shadows. In LIBERO's wrist view most of the robot, which has more than half of the
triangles, is behind the camera, and its pedestal below the table; what reflects is a plate of the stove, around which
little is to be seen; of the lamps, one lights no object.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.mesh_pieces import MARGIN_M, boxes_of
from pipeline.types import Floats

EDGE_PX = 3
"""How much wider than a reflecting box its rectangle is, for the smoothing of edges."""

LEAST_SCREEN_M = 0.1
"""Half the width of the boxes that are looked behind, and more of their length."""

WIDEST_CONE_DEG = 80.0
"""Half the opening angle of lamps' cones up to which it is worked out what is in them."""

SQUARE = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
"""Corners of a box's upper z face, which is what reflects (``mjr_render``), in units of its half sizes."""


class Part(NamedTuple):
    """A rectangle of a picture, and what has to be drawn for it.

    Attributes:
        name: tells it from the other parts of a picture.
        geoms: (ngeom,) which geoms.
        passes: (N,) which of the model's boxes (``Boxes``), for meshes in pieces, each pass of ``mjr_render`` needs:
            where something reflects, the mirror images; what is before the camera; for each lamp with shadows, what
            casts them and what it lights. Those after the last need the same.
        reflections: whether one of the geoms reflects.
        layer: whether what is opaque in it can be drawn by itself and laid over the other layers, each sample at its
            depth. Else it takes the place of what the parts before it show there.
        rows, columns: of the picture, the first row at the top.
    """

    name: str
    geoms: NDArray[np.bool_]
    passes: tuple[NDArray[np.bool_], ...]
    reflections: bool
    layer: bool
    rows: slice
    columns: slice


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
        # A plane has no bound: it is drawn wherever it is.
        self._planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._of_mesh = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)[self.boxes.geom]
        # What moves is left out, as layers are kept while what they show stands still.
        fixed = ((model.body_weldid == 0) & (model.body_mocapid[model.body_rootid] < 0))[model.geom_bodyid]
        wide = (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX) & (np.sort(model.geom_size)[:, 1] > LEAST_SCREEN_M)
        self._screens = np.flatnonzero(self._shown & fixed & wide)
        flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX))
        self._flat = np.flatnonzero(flat & (model.geom_matid >= 0))

    def of(self, model: mujoco.MjModel) -> Culling:
        """The same for a model that has the same geoms in other places."""
        other = copy.copy(self)
        other._model = model
        return other

    def parts(self, data: mujoco.MjData, camera: str) -> list[Part]:
        """What a picture of the data's state is made of, in the order in which it is put together; positions must be up
        to date.

        The first part is all of the picture. Where a box reflects, a second part is the rectangle around it, for which
        mirror images are drawn too; in the first part nothing reflects. With shadows there is one part.
        """
        model, boxes = self._model, self.boxes
        whole = slice(0, self._height), slice(0, self._width)
        view = _View(model, data, camera, self._height, self._width)
        try:
            mirror = self._mirror(data, view)
        except ValueError:
            return [self.everything()]
        turns = data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1)
        corners_m = data.geom_xpos[boxes.geom, None] + boxes.corners_m @ turns[boxes.geom]
        seen = self._planes[boxes.geom] | view.shows(corners_m, *whole)
        near = np.flatnonzero(seen & self._of_mesh)
        seen[near] = ~self._hidden(data, view, corners_m[near])
        none, clear = np.zeros_like(seen), self.see_through()[boxes.geom]
        lit = [reached & seen for reached in self._lit(data, corners_m)]
        # A shadow may come from outside of the picture, and out of a lamp's cone onto a triangle that reaches into it.
        drawn = seen | bool(lit)
        # What can be seen through is drawn last, with the pieces that are drawn then, and so are its mirror images.
        shadows = [wanted for shown in lit for wanted in (np.full_like(seen, shown.any()), shown | clear)]
        layers = self._layers and not lit and not self._sites_see_through()
        # What reflects is no mesh, and so has one box.
        box = None if mirror is None else np.searchsorted(boxes.geom, mirror)
        if mirror is None or not seen[box]:
            return [self._part("all", drawn, [seen, *shadows], False, layers, *whole)]
        heights_m = self._heights(data, mirror, corners_m)
        image_m = corners_m - 2 * heights_m[..., None] * self._normal(data, mirror)
        rectangle, imaged = whole, (heights_m > 0).any(axis=1) & view.shows(image_m, *whole)
        if not self._planes[mirror]:
            face_m = data.geom_xpos[mirror] + SQUARE * model.geom_size[mirror] @ data.geom_xmat[mirror].reshape(3, 3).T
            rectangle = view.rectangle(face_m) or whole
            imaged &= view.shows_through(image_m, face_m)
        images = imaged | self._planes[boxes.geom]
        images[box] = True
        if lit or rectangle == whole:
            passes = [images | clear, seen | clear, *shadows]
            return [self._part("all", drawn | images | clear, passes, True, False, *whole)]
        first = self._part("all", seen, [seen], False, layers, *whole)
        if layers and not (clear & images).any():
            return [first, self._part("mirror", images, [images, none], True, True, *rectangle)]
        before = view.shows(corners_m, *rectangle) | clear
        return [first, self._part("mirror", images | before, [images | clear, before], True, False, *rectangle)]

    def _hidden(self, data: mujoco.MjData, view: _View, corners_m: Floats) -> NDArray[np.bool_]:
        """(K,) whether all that is in a box of ``corners_m`` (K, 8, 3) is behind one large box, such as a table's top.

        What a convex body hides is convex: it has all of a box where it has its corners.
        """
        hidden = np.zeros(len(corners_m), np.bool_)
        for screen in self._screens[~self.see_through()[self._screens]]:
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

    def _lit(self, data: mujoco.MjData, corners_m: Floats) -> list[NDArray[np.bool_]]:
        """For each lamp with shadows, in MuJoCo's order, (N,) which boxes its light may reach: all but those out of its
        cone."""
        model = self._model
        reached: list[NDArray[np.bool_]] = []
        for lamp in np.flatnonzero(model.light_castshadow & model.light_active):
            if model.light_directional[lamp] or model.light_cutoff[lamp] > WIDEST_CONE_DEG:
                reached.append(np.ones(len(corners_m), np.bool_))
                continue
            middles_m = corners_m.mean(axis=1)
            radii_m = np.linalg.norm(corners_m[:, 0] - middles_m, axis=1)
            axis = data.light_xdir[lamp] / np.linalg.norm(data.light_xdir[lamp])
            ways_m = middles_m - data.light_xpos[lamp]
            along_m = ways_m @ axis
            across_m = np.linalg.norm(ways_m - along_m[:, None] * axis, axis=1)
            slope = np.radians(model.light_cutoff[lamp])
            near = across_m * np.cos(slope) - along_m * np.sin(slope) < radii_m
            reached.append(near | self._planes[self.boxes.geom])
        return reached

    def _mirror(self, data: mujoco.MjData, view: _View) -> int | None:
        """The geom whose mirror images MuJoCo draws: the first that reflects, if the camera is before it.

        Raises:
            ValueError: when the camera is about in its plane, or it can be seen through: what MuJoCo does is a matter
                of rounding.
        """
        reflects = self._model.mat_reflectance[self._model.geom_matid[self._flat]] > 0
        mirrors = self._flat[reflects & self._shown[self._flat]]
        for mirror in mirrors.tolist():
            height_m = float(self._heights(data, mirror, view.position_m))
            if abs(height_m) < MARGIN_M or self.see_through()[mirror]:
                raise ValueError(f"geom {mirror} may reflect or not")
            if height_m > 0:
                return int(mirror)
            # From behind, a plane can be seen through, and so another one may reflect.
            if not self._planes[mirror]:
                return None
        return None

    def _normal(self, data: mujoco.MjData, mirror: int) -> Floats:
        normal: Floats = data.geom_xmat[mirror].reshape(3, 3)[:, 2]
        return normal

    def _heights(self, data: mujoco.MjData, mirror: int, places_m: Floats) -> Floats:
        """(...) of ``places_m`` (..., 3) above the reflecting side: that of a plane, or a box's face."""
        face_m = 0 if self._planes[mirror] else self._model.geom_size[mirror, 2]
        heights_m: Floats = (places_m - data.geom_xpos[mirror]) @ self._normal(data, mirror) - face_m
        return heights_m

    def see_through(self) -> NDArray[np.bool_]:
        """(ngeom,) which geoms may show what is behind them: by their own colour, or by their material's."""
        model, materials = self._model, self._model.geom_matid
        opacity = np.minimum(model.geom_rgba[:, 3], np.append(model.mat_rgba[:, 3], 1)[materials])
        return np.asarray(self._shown & (opacity < 1))

    def _sites_see_through(self) -> bool:
        opacity = self._model.site_rgba[:, 3]
        return bool(((opacity > 0) & (opacity < 1)).any())

    def everything(self) -> Part:
        """All of a picture, with all that there is."""
        whole, every = (slice(0, self._height), slice(0, self._width)), np.ones(len(self.boxes.geom), np.bool_)
        return self._part("everything", every, [every], True, False, *whole)

    def _part(
        self,
        name: str,
        drawn: NDArray[np.bool_],
        passes: Sequence[NDArray[np.bool_]],
        reflections: bool,
        layer: bool,
        rows: slice,
        columns: slice,
    ) -> Part:
        geoms = np.zeros(self._model.ngeom, np.bool_)
        geoms[self.boxes.geom[drawn]] = True
        return Part(name, geoms, tuple(passes), reflections, layer, rows, columns)


class _View:
    """The pyramid that a camera sees, in its own frame: it looks along -z, with y up."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, height: int, width: int):
        number = model.camera(camera).id
        self._model, self._height, self._width = model, height, width
        self.position_m, self._axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
        # Some way behind the plane before which nothing is drawn.
        self.near_m = 1.1 * model.vis.map.znear * model.stat.extent
        half_tangent = np.tan(np.radians(model.cam_fovy[number]) / 2)
        # Pixels for each metre to the side at a metre of depth.
        self._scale_px = height / 2 / half_tangent

    def depths(self, corners_m: Floats) -> Floats:
        """(...) of ``corners_m`` (..., 3), along the axis that the camera looks along."""
        depths_m: Floats = -(corners_m - self.position_m) @ self._axes[:, 2]
        return depths_m

    def shows(self, corners_m: Floats, rows: slice, columns: slice) -> NDArray[np.bool_]:
        """(N,) whether boxes with ``corners_m`` (N, 8, 3) may be in what a rectangle shows."""
        right, up, back = np.moveaxis((corners_m - self.position_m) @ self._axes, -1, 0)
        inside = np.ones(len(corners_m), np.bool_)
        for off_axis, low_px, high_px in (
            (right, columns.start - self._width / 2, columns.stop - self._width / 2),
            (up, self._height / 2 - rows.stop, self._height / 2 - rows.start),
        ):
            # A box is outside when all of it is beyond one side; the sides pass through the camera.
            inside &= ~(off_axis + high_px / self._scale_px * back > 0).all(axis=1)
            inside &= ~(off_axis + low_px / self._scale_px * back < 0).all(axis=1)
        return inside

    def shows_through(self, corners_m: Floats, opening_m: Floats) -> NDArray[np.bool_]:
        """(N,) whether boxes with ``corners_m`` (N, 8, 3) may show through a convex opening with corners (K, 3)."""
        rays_m = opening_m - self.position_m
        sides = np.cross(rays_m, np.roll(rays_m, -1, axis=0))
        # Of each side, towards the middle of the opening.
        sides *= np.sign(sides @ rays_m.sum(axis=0))[:, None]
        return np.asarray(~((corners_m - self.position_m) @ sides.T < 0).all(axis=1).any(axis=1))

    def rectangle(self, corners_m: Floats) -> tuple[slice, slice] | None:
        """Rows and columns around ``corners_m`` (N, 3) of boxes, some pixels wider; None when it reaches behind the
        camera."""
        right, up, back = ((corners_m - self.position_m) @ self._axes).T
        if (back >= -MARGIN_M).any():
            return None
        rows = self._height / 2 + up / back * self._scale_px
        columns = self._width / 2 - right / back * self._scale_px
        return _around(rows, self._height), _around(columns, self._width)


def _around(places_px: Floats, size_px: int) -> slice:
    low, high = np.clip((np.floor(places_px.min()) - EDGE_PX, np.ceil(places_px.max()) + EDGE_PX), 0, size_px)
    return slice(int(low), int(high))
