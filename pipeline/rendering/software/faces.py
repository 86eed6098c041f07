"""The faces of a model's meshes as MuJoCo uploads them."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

ROUND = 0.8
"""Least cosine between a corner's normal and its face's normal.

Below it, MuJoCo uses the face's normal for the corner (``mjr_uploadMesh``).
"""

PARTS = {
    "vert": ("vert",),
    "normal": ("normal",),
    "texcoord": ("texcoord",),
    "face": ("face", "facenormal", "facetexcoord"),
}
"""Arrays of a model that make up a mesh, by the name of the addresses that select the mesh's part of them."""


class Faces(NamedTuple):
    """Mesh by its vertices. A vertex has a place, a normal and texture coordinates.

    Faces that share a place mostly differ in the normal there, so one place has several vertices.

    Attributes:
        vertices_m, normals: (V, 3) in the frame of the mesh's geoms.
        texture: (V, 2) texture coordinates; ``None`` if the mesh has none.
        corners: (F, 3) vertices of each face, in the mesh's order.
        places_m: (P, 3) each place once.
        place_of_corner: (F, 3) the place of each face's corners.
    """

    vertices_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    texture: NDArray[np.float32] | None
    corners: NDArray[np.uint32]
    places_m: NDArray[np.float32]
    place_of_corner: NDArray[np.uint32]


def faces_of(model: mujoco.MjModel, mesh: int) -> Faces:
    """Compute the faces that MuJoCo's ``mjr_uploadMesh`` uploads for a mesh, bit for bit.

    Equal corners become one vertex.
    """
    first, last = _part(model, mesh, "face")
    vertices_m = _of(model, mesh, "vert")[model.mesh_face[first:last]]
    normals = _of(model, mesh, "normal")[model.mesh_facenormal[first:last]]
    columns = [vertices_m.reshape(-1, 3)]
    if model.mesh_texcoordadr[mesh] >= 0:
        texture = _of(model, mesh, "texcoord")[model.mesh_facetexcoord[first:last]]
        columns += [normals.reshape(-1, 3), texture.reshape(-1, 2)]
    else:
        columns.append(_flattened(vertices_m, normals).reshape(-1, 3))
    rendered = np.ascontiguousarray(np.concatenate(columns, axis=1, dtype=np.float32))
    vertices, vertex_of_corner = _kinds(rendered)
    places, place_of_corner = _kinds(rendered[:, :3])
    kept = rendered[vertices]
    return Faces(
        vertices_m=np.ascontiguousarray(kept[:, :3]),
        normals=np.ascontiguousarray(kept[:, 3:6]),
        texture=np.ascontiguousarray(kept[:, 6:]) if kept.shape[1] > 6 else None,
        corners=vertex_of_corner.reshape(-1, 3),
        places_m=rendered[places, :3],
        place_of_corner=place_of_corner.reshape(-1, 3),
    )


def _part(model: mujoco.MjModel, mesh: int, of: str) -> tuple[int, int]:
    """Return the first row of a mesh's part of an array, and the row after its last."""
    first = int(getattr(model, f"mesh_{of}adr")[mesh])
    return first, first + int(getattr(model, f"mesh_{of}num")[mesh])


def _of(model: mujoco.MjModel, mesh: int, of: str) -> NDArray[np.float32]:
    """Return a mesh's part of an array of the model."""
    first, last = _part(model, mesh, of)
    values: NDArray[np.float32] = getattr(model, f"mesh_{of}")[first:last]
    return values


def _flattened(vertices_m: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the normals (F, 3, 3) of faces' corners: the face's normal where a corner's differs by too much.

    The order of operations is MuJoCo's, in single precision.

    Args:
        vertices_m: (F, 3, 3) the corners' positions.
        normals: (F, 3, 3) the corners' normals.
    """
    a, b = vertices_m[:, 1] - vertices_m[:, 0], vertices_m[:, 2] - vertices_m[:, 0]
    face_normals = np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    x, y, z = face_normals.T
    length = np.sqrt(x * x + y * y + z * z)
    degenerate = length < np.float32(1e-10)
    face_normals *= (np.float32(1) / np.where(degenerate, np.float32(1), length))[:, None]
    face_normals[degenerate] = (0, 0, 1)
    face_normals = face_normals[:, None]
    x, y, z = np.moveaxis(face_normals, -1, 0)
    cosine = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2] * z
    return np.where((cosine.astype(float) < ROUND)[..., None], face_normals, normals)


def _kinds(rows: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
    """Group equal rows into kinds.

    Returns:
        The number of one row of each kind; and for each row its kind.
    """
    bits = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, kind = np.unique(bits, return_index=True, return_inverse=True)
    return first, kind.astype(np.uint32)
