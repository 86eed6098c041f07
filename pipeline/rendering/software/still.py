"""Chooses the geoms of a camera's underlay: those that stand still, such as the table, fixtures and most objects."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

LONGEST_WAIT = 16
"""Pictures that a geom must stand still, at most, before it joins the underlay."""


class Still:
    """Chooses the geoms of one camera's underlay.

    An underlay has to be rendered anew when one of its geoms moves, and an object at rest moves by a millionth now and
    then. So each time a geom leaves the underlay, it has to stand still for twice as many pictures to join again. Geoms
    join once rendering them beside the underlay has cost more faces than a new underlay would have.
    """

    def __init__(self, model: mujoco.MjModel):
        meshes = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)
        self._faces = np.where(meshes >= 0, np.append(model.mesh_facenum, 0)[meshes], 12)
        self._wait: NDArray[np.intp] = np.ones(model.ngeom, np.intp)
        self._view = b""

    def geoms(self, view: bytes, places: NDArray[np.float32], rendered: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(ngeom,) the geoms of the underlay for the next picture of those that are to be ``rendered`` (ngeom,).

        ``view`` is what a picture depends on beside the geoms: the camera, and where the lamps are. ``places`` (ngeom,
        12) are positions and rotations of the geoms, as they are rendered."""
        if view != self._view:
            self._view, self._places = view, places
            self._geoms: NDArray[np.bool_] = np.zeros(len(places), np.bool_)
            self._age: NDArray[np.intp] = np.zeros(len(places), np.intp)
            self._beside = 0
            return self._geoms
        stood = (places == self._places).all(axis=1)
        self._places = places
        left = self._geoms & ~stood
        self._wait[left] = np.minimum(2 * self._wait[left], LONGEST_WAIT)
        self._age = np.where(stood, self._age + 1, 0)
        ready = rendered & (self._age >= self._wait)
        self._beside += int(self._faces[ready & ~self._geoms].sum())
        if left.any() or self._beside > self._faces[ready].sum():
            self._geoms, self._beside = ready, 0
        return self._geoms
