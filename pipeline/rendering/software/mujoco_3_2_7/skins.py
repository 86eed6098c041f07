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
    """The skins of a context and a scene made from a ``bare`` model; they render chosen faces of meshes.

    A display list always renders the same faces, and recording one takes as long as rendering a third of them. For a
    skin MuJoCo renders the faces of an index buffer. Before each rendering it would overwrite the skins with those of
    the bare model, so ``nskin`` is set to 0, which hides them from that step.

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
        """Upload a mesh's vertices to a skin, unless they are there."""
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
        """The scene's geoms (N,) of ``GEOM``, and which of them are a model's meshes."""
        shown = self._geoms[: self._scene.ngeom].copy()
        of_mesh = (shown["type"] == mujoco.mjtGeom.mjGEOM_MESH) & (shown["objtype"] == mujoco.mjtObj.mjOBJ_GEOM)
        return shown, of_mesh

    def fill_faces(self, skin: int, corners: NDArray[np.uint32]) -> None:
        """Upload the index buffer (3 F,) of the faces that a skin renders."""
        self.rendered[skin] = len(corners) // 3
        if len(corners):
            opengl = calls()
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, self._context.skinfaceVBO[skin])
            opengl.glBufferData(opengl.GL_ELEMENT_ARRAY_BUFFER, corners.nbytes, corners, opengl.GL_STREAM_DRAW)
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, 0)

    def follow(self, shown: NDArray[np.void], skins: NDArray[np.intp], closing: NDArray[np.intp]) -> None:
        """Write the scene's geoms; after each with a skin come the skin and its closing mesh (``Meshes``).

        Args:
            shown: (N,) of ``GEOM``.
            skins: (N,) the skin of each, -1 for none.
            closing: (K,) number of the closing mesh of each geom that has a skin.
        """
        having = skins >= 0
        written = np.repeat(shown, np.where(having, 3, 1))
        own = np.flatnonzero(having) + 2 * np.arange(np.count_nonzero(having))
        skin, close = own + 1, own + 2
        written["type"][skin], written["objid"][skin] = mujoco.mjtGeom.mjGEOM_SKIN, skins[having]
        written["matid"][close] = -1
        written["dataid"][close] = closing
        # Decor has no part in the maps of what casts shadows.
        written["category"][skin] = written["category"][close] = mujoco.mjtCatBit.mjCAT_DECOR
        self._scene.ngeom = len(written)
        self._geoms[: len(written)] = written
