"""Meshes rendered as skins by MuJoCo 3.2.7, which takes the faces of a skin from an index buffer."""

import ctypes

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.opengl import calls
from pipeline.rendering.software.faces import Faces

GEOM = np.dtype(
    [
        *((n, np.int32) for n in ("type", "dataid", "objtype", "objid", "category", "matid", "texcoord", "segid")),
        *(("size", np.float32, 3), ("pos", np.float32, 3), ("mat", np.float32, 9), ("rgba", np.float32, 4)),
        *((name, np.float32) for name in ("emission", "specular", "shininess", "reflectance")),
        *(("label", np.uint8, 100), ("camdist", np.float32), ("modelrbound", np.float32), ("transparent", np.uint8)),
    ],
    align=True,
)
"""``mjvGeom``."""


class Skins:
    """Skins of a context and a scene that come from a ``bare`` model; they render chosen faces of meshes.

    A display list has fixed faces. Recording a list takes as long as rendering a third of its faces. For a skin, MuJoCo
    renders the faces of an index buffer. Before each rendering, MuJoCo would overwrite the skins with the bare model's.
    Setting ``nskin`` to 0 hides the skins from this step.

    Attributes:
        rendered: (2 ``SKINS``,) number of faces that each skin renders; the first ``SKINS`` have texture coordinates.
    """

    def __init__(self, context: mujoco.MjrContext, scene: mujoco.MjvScene):
        self._context, self._scene = context, scene
        self.rendered: NDArray[np.int32] = scene.skinfacenum
        scene.nskin = 0
        first = scene.geoms[0].size.ctypes.data - GEOM.fields["size"][1]  # type: ignore[index]
        memory = (ctypes.c_byte * (GEOM.itemsize * scene.maxgeom)).from_address(first)
        self._geoms: NDArray[np.void] = np.frombuffer(memory, GEOM)
        self._filled: dict[int, bytes] = {}

    def fill_vertices(self, skin: int, faces: Faces, content: bytes) -> None:
        """Upload a mesh's vertices to a skin, unless the skin has them already.

        Args:
            skin: the skin's number.
            faces: the mesh.
            content: hash of the mesh.
        """
        if self._filled.get(skin) == content:
            return
        opengl, context = calls(), self._context
        buffers = [(context.skinvertVBO, faces.vertices_m), (context.skinnormalVBO, faces.normals)]
        if faces.texture is not None:
            buffers.append((context.skintexcoordVBO, faces.texture))
        for numbers, values in buffers:
            opengl.glBindBuffer(opengl.GL_ARRAY_BUFFER, numbers[skin])
            opengl.glBufferData(opengl.GL_ARRAY_BUFFER, values.nbytes, values, opengl.GL_STATIC_DRAW)
        opengl.glBindBuffer(opengl.GL_ARRAY_BUFFER, 0)
        self._filled[skin] = content

    def meshes_of_scene(self) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
        """Return a copy of the scene's geoms (N,) of ``GEOM``, and a mask (N,) of a model's meshes among them."""
        scene_geoms = self._geoms[: self._scene.ngeom].copy()
        is_mesh = scene_geoms["type"] == mujoco.mjtGeom.mjGEOM_MESH
        of_mesh = is_mesh & (scene_geoms["objtype"] == mujoco.mjtObj.mjOBJ_GEOM)
        return scene_geoms, of_mesh

    def fill_faces(self, skin: int, corners: NDArray[np.uint32]) -> None:
        """Upload the index buffer (3 F,) of the faces that a skin renders."""
        self.rendered[skin] = len(corners) // 3
        if len(corners):
            opengl = calls()
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, self._context.skinfaceVBO[skin])
            opengl.glBufferData(opengl.GL_ELEMENT_ARRAY_BUFFER, corners.nbytes, corners, opengl.GL_STREAM_DRAW)
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, 0)

    def follow(self, shown: NDArray[np.void], skins: NDArray[np.intp], closing: NDArray[np.intp]) -> None:
        """Write the scene's geoms; after each geom with a skin come the skin and its closing mesh (``Meshes``).

        Args:
            shown: (N,) the scene's geoms, of ``GEOM``.
            skins: (N,) the skin of each geom, -1 without a skin.
            closing: (K,) number of the closing mesh of each geom that has a skin.
        """
        has_skin = skins >= 0
        written = np.repeat(shown, np.where(has_skin, 3, 1))
        # Each earlier geom with a skin shifts a geom by two places.
        mesh = np.flatnonzero(has_skin) + 2 * np.arange(np.count_nonzero(has_skin))
        skin, close = mesh + 1, mesh + 2
        written["type"][skin], written["objid"][skin] = mujoco.mjtGeom.mjGEOM_SKIN, skins[has_skin]
        written["matid"][close] = -1
        written["dataid"][close] = closing
        # Shadow maps have no geoms of the category decor.
        written["category"][skin] = written["category"][close] = mujoco.mjtCatBit.mjCAT_DECOR
        self._scene.ngeom = len(written)
        self._geoms[: len(written)] = written
