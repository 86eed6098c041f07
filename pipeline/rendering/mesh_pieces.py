"""Large meshes in pieces, so that what lies outside of a picture is not even handed to OpenGL.

MuJoCo's context has a display list for each mesh. Here each large mesh gets one more for every piece of it, and its own
list is written anew to call those that can be seen. A piece is a run of the mesh's faces in their order, so everything
is drawn in MuJoCo's order.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.types import Floats

PIECE_FACES = 1024
"""Faces of a piece; each piece that is drawn costs some microseconds by itself."""

MOST_PARTS = 0.75
"""Where more than this share of a mesh is seen, all of it is drawn at once."""

MARGIN_M = 1e-3
"""Added around every box, for what the rasteriser rounds."""


class Boxes(NamedTuple):
    """Boxes around the geoms of a model: one for each, or one for each piece of its mesh.

    Attributes:
        corners_m: (N, 8, 3) in the frame of the geom.
        geom: (N,) whose they are.
        piece: (N,) of the geom's mesh, counted from 0.
    """

    corners_m: Floats
    geom: NDArray[np.intp]
    piece: NDArray[np.intp]


def boxes_of(model: mujoco.MjModel, hidden_groups: Collection[int]) -> Boxes:
    """The boxes of a model's geoms; those of ``hidden_groups``, which are not drawn, have one each."""
    shown = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & ~np.isin(model.geom_group, list(hidden_groups))
    corners: list[Floats] = []
    numbers: list[tuple[int, int]] = []
    for geom in range(model.ngeom):
        bounds = (
            _piece_bounds(model, model.geom_dataid[geom]) if shown[geom] else model.geom_aabb[geom].reshape(1, 2, 3)
        )
        corners.append(_corners(bounds))
        numbers += [(geom, piece) for piece in range(len(bounds))]
    geoms, pieces = np.array(numbers, np.intp).reshape(-1, 2).T
    return Boxes(np.concatenate(corners), geoms, pieces)


def _piece_bounds(model: mujoco.MjModel, mesh: int) -> Floats:
    """(P, 2, 3) centre and half size of the box around each piece of a mesh, in its geom's frame."""
    start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices_m = model.mesh_vert[model.mesh_vertadr[mesh] :][model.mesh_face[start : start + faces]]
    bounds = []
    for first in range(0, faces, PIECE_FACES):
        piece_m = vertices_m[first : first + PIECE_FACES].reshape(-1, 3).astype(float)
        low_m, high_m = piece_m.min(axis=0), piece_m.max(axis=0)
        bounds.append([(low_m + high_m) / 2, (high_m - low_m) / 2])
    return np.array(bounds)


def _corners(bounds: Floats) -> Floats:
    """(P, 8, 3) corners of boxes (P, 2, 3), with a margin."""
    signs = np.array(list(product((-1, 1), repeat=3)))
    corners: Floats = bounds[:, None, 0] + signs * (bounds[:, None, 1] + MARGIN_M)
    return corners


class MeshPieces:
    """The display lists of a model's large meshes in a context of MuJoCo, which must be the current one.

    Args:
        boxes: of the model.
    """

    def __init__(self, model: mujoco.MjModel, context: mujoco.MjrContext, boxes: Boxes):
        self._base = context.baseMesh
        meshes = model.geom_dataid[boxes.geom]
        counts = {int(mesh): int(boxes.piece[meshes == mesh].max()) + 1 for mesh in meshes[boxes.piece > 0]}
        self._boxes = {mesh: np.flatnonzero(meshes == mesh) for mesh in counts}
        self._piece = boxes.piece
        self._whole = {mesh: _upload(model, context, mesh, 0, model.mesh_facenum[mesh]) for mesh in counts}
        self._lists = {
            mesh: np.array(
                [_upload(model, context, mesh, piece * PIECE_FACES, PIECE_FACES) for piece in range(count)], np.uint32
            )
            for mesh, count in counts.items()
        }
        self._shown: dict[int, bytes] = {}

    def show(self, seen: NDArray[np.bool_]) -> None:
        """Have the pieces drawn of which a box is seen, of the geoms that are drawn.

        Args:
            seen: (N,) which of the boxes.
        """
        opengl = gl.calls()
        for mesh, boxes in self._boxes.items():
            lists = self._lists[mesh]
            pieces = np.zeros(len(lists), np.bool_)
            pieces[self._piece[boxes[seen[boxes]]]] = True
            called = lists[pieces] if pieces.mean() <= MOST_PARTS else np.array([self._whole[mesh]], np.uint32)
            if self._shown.get(mesh) != called.tobytes():
                opengl.glNewList(self._base + 2 * mesh, opengl.GL_COMPILE)
                opengl.glCallLists(called)
                opengl.glEndList()
                self._shown[mesh] = called.tobytes()


def _upload(model: mujoco.MjModel, context: mujoco.MjrContext, mesh: int, first: int, faces: int) -> int:
    """Have MuJoCo write some of a mesh's faces into a display list of their own; returns its number."""
    start, count, graph = (int(field[mesh]) for field in (model.mesh_faceadr, model.mesh_facenum, model.mesh_graphadr))
    base = context.baseMesh
    # A list for the faces, and one for the convex hull, which is drawn for collision geometry.
    number: int = gl.calls().glGenLists(2)
    try:
        model.mesh_faceadr[mesh], model.mesh_facenum[mesh] = start + first, min(faces, count - first)
        model.mesh_graphadr[mesh] = -1
        context.baseMesh = number - 2 * mesh
        mujoco.mjr_uploadMesh(model, context, mesh)
    finally:
        context.baseMesh = base
        model.mesh_faceadr[mesh], model.mesh_facenum[mesh], model.mesh_graphadr[mesh] = start, count, graph
    return number
