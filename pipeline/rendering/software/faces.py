"""The faces of a model's meshes as MuJoCo uploads them."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

ROUND = 0.8
"""Least cosine between a corner's normal and its face's: else MuJoCo takes the face's (``mjr_uploadMesh``)."""

PARTS = {
    "vert": ("vert",),
    "normal": ("normal",),
    "texcoord": ("texcoord",),
    "face": ("face", "facenormal", "facetexcoord"),
}
"""Arrays of a model that a mesh is made from, by the array of addresses that says which part is the mesh's."""


class Faces(NamedTuple):
    """A mesh by its vertices, each a place with what is rendered there; faces that meet mostly differ in the normal.

    Attributes:
        vertices_m, normals: (V, 3) in the frame of the mesh's geoms.
        texture: (V, 2) place in a texture, or None where the mesh has no such places.
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
    """What MuJoCo's ``mjr_uploadMesh`` makes of a mesh, bit for bit; corners that are alike are one vertex."""
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
    first = int(getattr(model, f"mesh_{of}adr")[mesh])
    return first, first + int(getattr(model, f"mesh_{of}num")[mesh])


def _of(model: mujoco.MjModel, mesh: int, of: str) -> NDArray[np.float32]:
    first, last = _part(model, mesh, of)
    values: NDArray[np.float32] = getattr(model, f"mesh_{of}")[first:last]
    return values


def _flattened(vertices_m: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """(F, 3, 3) the normals of faces' corners, in MuJoCo's order of computing in single precision."""
    a, b = vertices_m[:, 1] - vertices_m[:, 0], vertices_m[:, 2] - vertices_m[:, 0]
    own = np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    length = np.sqrt(own[:, 0] * own[:, 0] + own[:, 1] * own[:, 1] + own[:, 2] * own[:, 2])
    none = length < np.float32(1e-10)
    own *= (np.float32(1) / np.where(none, np.float32(1), length))[:, None]
    own[none] = (0, 0, 1)
    own = own[:, None]
    cosine = normals[..., 0] * own[..., 0] + normals[..., 1] * own[..., 1] + normals[..., 2] * own[..., 2]
    return np.where((cosine.astype(float) < ROUND)[..., None], own, normals)


def _kinds(rows: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.uint32]]:
    """The number of one row of each kind, and for each row its kind."""
    bits = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, kind = np.unique(bits, return_index=True, return_inverse=True)
    return first, kind.astype(np.uint32)
