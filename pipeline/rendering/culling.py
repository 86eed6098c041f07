"""What a picture cannot show and need not draw: the same pixels for less work.

MuJoCo draws every geom of a scene whether it is in the picture or not, and all of them once more where a box or a plane
reflects. In LIBERO's wrist view most of the robot, which has more than half of a scene's triangles, is behind the
camera; what reflects is a plate of the stove, around which little is to be seen.
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.mesh_pieces import MARGIN_M, boxes_of
from pipeline.types import Floats

EDGE_PX = 3
"""How much wider than a reflecting box its rectangle is, for the smoothing of edges."""


class Part(NamedTuple):
    """A rectangle of a picture, and what has to be drawn for it.

    Attributes:
        geoms: (ngeom,) which geoms.
        boxes: (N,) which of the model's boxes (``Boxes``): of large geoms, the pieces.
        reflections: whether one of them reflects.
        layer: whether what is opaque in it can be drawn by itself and laid over the other layers, each sample at its
            depth. Else it takes the place of what the parts before it show there.
        rows, columns: of the picture, the first row at the top.
    """

    geoms: NDArray[np.bool_]
    boxes: NDArray[np.bool_]
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
        self._hidden_groups = list(hidden_groups)
        self.boxes = boxes_of(model, hidden_groups)
        # A plane has no bound: it is drawn wherever it is.
        self._planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
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

        The first part is all of the picture. Where a box reflects, a further part is the rectangle around it, for which
        mirror images are drawn too; in the first part nothing reflects.
        """
        model, boxes = self._model, self.boxes
        whole = slice(0, self._height), slice(0, self._width)
        if (model.light_castshadow & model.light_active).any():
            # A shadow may come from outside of the picture.
            return [self.everything()]
        view = _View(model, data, camera, self._height, self._width)
        turns = data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1)
        corners_m = data.geom_xpos[boxes.geom, None] + boxes.corners_m @ turns[boxes.geom]
        unbounded = self._planes[boxes.geom]
        seen = unbounded | view.shows(corners_m, *whole)
        reflects = model.mat_reflectance[model.geom_matid[self._flat]] > 0
        mirrors = self._flat[reflects & ~np.isin(model.geom_group[self._flat], self._hidden_groups)]
        # What reflects is no mesh, and so has one box.
        mirror_boxes = np.searchsorted(boxes.geom, mirrors)
        seen_mirrors = mirrors[seen[mirror_boxes]]
        rectangles = [
            whole if self._planes[mirror] else view.rectangle(corners_m[box]) or whole
            for mirror, box in zip(seen_mirrors, mirror_boxes[seen[mirror_boxes]], strict=True)
        ]
        images = [self._mirrored(data, corners_m, mirror) for mirror in seen_mirrors]
        clear = self.see_through()[boxes.geom]
        layers = self._layers and whole not in rectangles and not self._sites_see_through()
        parts = [] if whole in rectangles else [self._part(seen, False, layers, *whole)]
        for rectangle in [whole] if whole in rectangles else rectangles:
            reflected = unbounded.copy()
            # MuJoCo has the first of them reflect: without it, that would be another.
            reflected[mirror_boxes] = True
            for mirrored, image_m in images:
                reflected |= mirrored & view.shows(image_m, *rectangle)
            before = view.shows(corners_m, *rectangle)
            layer = layers and not (clear & reflected).any()
            parts.append(self._part(reflected if layer else reflected | before, True, layer, *rectangle))
        return parts

    def see_through(self) -> NDArray[np.bool_]:
        """(ngeom,) which geoms may show what is behind them: by their own colour, or by their material's."""
        model, materials = self._model, self._model.geom_matid
        opacity = np.minimum(model.geom_rgba[:, 3], np.append(model.mat_rgba[:, 3], 1)[materials])
        shown = ~np.isin(model.geom_group, self._hidden_groups)
        return np.asarray(shown & (opacity < 1))

    def _sites_see_through(self) -> bool:
        opacity = self._model.site_rgba[:, 3]
        return bool(((opacity > 0) & (opacity < 1)).any())

    def everything(self) -> Part:
        """All of a picture, with all that there is."""
        whole = slice(0, self._height), slice(0, self._width)
        return self._part(np.ones(len(self.boxes.geom), np.bool_), True, False, *whole)

    def _part(self, boxes: NDArray[np.bool_], reflections: bool, layer: bool, rows: slice, columns: slice) -> Part:
        geoms = np.zeros(self._model.ngeom, np.bool_)
        geoms[self.boxes.geom[boxes]] = True
        return Part(geoms, boxes, reflections, layer, rows, columns)

    def _mirrored(self, data: mujoco.MjData, corners_m: Floats, mirror: int) -> tuple[NDArray[np.bool_], Floats]:
        """(N,) which boxes have a part before a mirror, and (N, 8, 3) the images of their corners.

        The reflecting side is that of a plane, or a box's upper z face (``mjr_render``).
        """
        normal = data.geom_xmat[mirror].reshape(3, 3)[:, 2]
        face_m = 0 if self._planes[mirror] else self._model.geom_size[mirror, 2]
        heights_m = (corners_m - data.geom_xpos[mirror]) @ normal - face_m
        return (heights_m > 0).any(axis=1), corners_m - 2 * heights_m[..., None] * normal


class _View:
    """The pyramid that a camera sees, in its own frame: it looks along -z, with y up."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, height: int, width: int):
        number = model.camera(camera).id
        self._model, self._height, self._width = model, height, width
        self._position_m, self._axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
        half_tangent = np.tan(np.radians(model.cam_fovy[number]) / 2)
        # Pixels for each metre to the side at a metre of depth.
        self._scale_px = height / 2 / half_tangent

    def shows(self, corners_m: Floats, rows: slice, columns: slice) -> NDArray[np.bool_]:
        """(N,) whether boxes with ``corners_m`` (N, 8, 3) may be in what a rectangle shows."""
        right, up, back = np.moveaxis((corners_m - self._position_m) @ self._axes, -1, 0)
        inside = np.ones(len(corners_m), np.bool_)
        for off_axis, low_px, high_px in (
            (right, columns.start - self._width / 2, columns.stop - self._width / 2),
            (up, self._height / 2 - rows.stop, self._height / 2 - rows.start),
        ):
            # A box is outside when all of it is beyond one side; the sides pass through the camera.
            inside &= ~(off_axis + high_px / self._scale_px * back > 0).all(axis=1)
            inside &= ~(off_axis + low_px / self._scale_px * back < 0).all(axis=1)
        return inside

    def rectangle(self, corners_m: Floats) -> tuple[slice, slice] | None:
        """Rows and columns around ``corners_m`` (N, 3) of boxes, some pixels wider; None when it reaches behind the
        camera."""
        right, up, back = ((corners_m - self._position_m) @ self._axes).T
        if (back >= -MARGIN_M).any():
            return None
        rows = self._height / 2 + up / back * self._scale_px
        columns = self._width / 2 - right / back * self._scale_px
        return _around(rows, self._height), _around(columns, self._width)


def _around(places_px: Floats, size_px: int) -> slice:
    low, high = np.clip((np.floor(places_px.min()) - EDGE_PX, np.ceil(places_px.max()) + EDGE_PX), 0, size_px)
    return slice(int(low), int(high))
