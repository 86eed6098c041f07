"""Meshes drawn as MuJoCo draws skins: from buffers, of which one says which faces, anew for each picture.

The display list of a mesh always draws the same faces, and to write one takes as long as to draw a third of them. For
a skin MuJoCo has OpenGL draw the faces that a buffer lists. It takes skins to be in the world's frame, so the mesh
itself, drawn before, leaves its place on OpenGL's stack of matrices, and one more mesh, drawn after, takes it away
(``MeshPieces``).
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.opengl import calls
from pipeline.rendering.software.faces import Faces, faces_of
from pipeline.rendering.software.mesh_pieces import Boxes, MeshPieces
from pipeline.rendering.software.samples import SAMPLES, Projection, faces_that_show, room

SKINS = 64
"""As many with places in a texture, and as many without; LIBERO's scenes have up to 50 large meshes."""

GEOM = np.dtype(
    [
        *(
            (name, np.int32)
            for name in ("type", "dataid", "objtype", "objid", "category", "matid", "texcoord", "segid")
        ),
        *(("size", np.float32, 3), ("pos", np.float32, 3), ("mat", np.float32, 9), ("rgba", np.float32, 4)),
        *((name, np.float32) for name in ("emission", "specular", "shininess", "reflectance")),
        *(("label", np.uint8, 100), ("camdist", np.float32), ("modelrbound", np.float32), ("transparent", np.uint8)),
    ],
    align=True,
)
"""MuJoCo 3.2.7's ``mjvGeom``."""

LEAST_FACES = 256
"""Smaller meshes are drawn as they are."""

OPAQUE = 0.995
"""MuJoCo's least opacity of what it does not take to be seen through (``mjr_render``)."""

_TEXTURE = ' texcoord="0 0 0 0 0 0"'
_SKIN = (
    '<skin vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"{}>'
    '<bone body="bone" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin>'
)
_ALIKE = {
    "global_": ("offwidth", "offheight", "linewidth"),
    "quality": ("offsamples", "shadowsize", "numslices", "numstacks", "numquads"),
    "map": ("shadowclip", "shadowscale", "fogstart", "fogend", "zfar"),
    "rgba": ("fog",),
}
"""What MuJoCo makes a context from, beside what is in a model."""


def bare(model: mujoco.MjModel, skins: int) -> mujoco.MjModel:
    """A model of nothing but another one's planes and so many skins of both kinds; its context is like the other's."""
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    made = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{'<geom type="plane" size="1 1 1"/>' * len(planes)}<body name="bone"/></worldbody>
        <deformable>{_SKIN.format(_TEXTURE) * skins + _SKIN.format("") * skins}</deformable></mujoco>"""
    )
    made.geom_size[:] = model.geom_size[planes]
    made.stat.extent = model.stat.extent
    for part, names in _ALIKE.items():
        for name in names:
            setattr(getattr(made.vis, part), name, getattr(getattr(model.vis, part), name))
    return made


class _Kept(NamedTuple):
    """What stays from one model to the next.

    Attributes:
        drawn: (2 ``SKINS``,) how many faces of each skin are drawn.
        geoms: (maxgeom,) of ``GEOM``: the scene's, in MuJoCo's own memory.
        samples: (``SAMPLES``, 2) where in a pixel they are.
        filled: skin to what tells the mesh that it has from any other.
    """

    drawn: NDArray[np.int32]
    geoms: NDArray[np.void]
    samples: NDArray[np.float32]
    filled: dict[int, bytes]


def _kept(scene: mujoco.MjvScene) -> _Kept:
    """Take over the skins of a scene from MuJoCo."""
    drawn = scene.skinfacenum
    scene.nskin = 0
    first = scene.geoms[0].size.ctypes.data - GEOM.fields["size"][1]  # type: ignore[index]
    memory = (ctypes.c_byte * (GEOM.itemsize * scene.maxgeom)).from_address(first)
    opengl = calls()
    places = [opengl.glGetMultisamplefv(opengl.GL_SAMPLE_POSITION, sample) for sample in range(SAMPLES)]
    return _Kept(drawn, np.frombuffer(memory, GEOM), np.array(places, np.float32), {})


class Skins:
    """The large meshes of a model as skins of an OpenGL context of MuJoCo, which must be the current one.

    Args:
        model: whose meshes they are.
        context, scene: made from a ``bare`` model. MuJoCo would fill the skins with that model's own at every drawing,
            so they are hidden from it.
        boxes: of the model.
        pieces: the meshes as they are.
        former: those of the model that the context was for before, where it is another one.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        context: mujoco.MjrContext,
        scene: mujoco.MjvScene,
        boxes: Boxes,
        pieces: MeshPieces,
        former: Skins | None = None,
    ):
        self._context, self._scene, self._boxes, self._closing = context, scene, boxes, pieces.closing
        self._kept: _Kept = former._kept if former else _kept(scene)
        known = {} if former is None else former._faces
        self._mesh: NDArray[np.intp] = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)
        self._skin: NDArray[np.intp] = np.full(model.ngeom, -1)
        self._faces: dict[bytes, Faces] = {}
        self._faces_of_geom: dict[int, Faces] = {}
        textured, plain = iter(range(SKINS)), iter(range(SKINS, 2 * SKINS))
        drawn = np.unique(boxes.geom[self._mesh[boxes.geom] >= 0])
        for geom, mesh in zip(drawn.tolist(), self._mesh[drawn].tolist(), strict=True):
            if model.mesh_facenum[mesh] >= LEAST_FACES:
                content = pieces.contents[mesh]
                faces = self._faces.get(content) or known.get(content) or faces_of(model, mesh)
                self._faces[content] = self._faces_of_geom[geom] = faces
                self._skin[geom] = next(plain if faces.texture is None else textured, -1)
                self._fill(int(self._skin[geom]), faces, content)
        # All geoms of a mesh are drawn in one way.
        self._skin[np.isin(self._mesh, self._mesh[drawn[self._skin[drawn] < 0]])] = -1
        most = max((room(len(faces.corners)) for faces in self._faces.values()), default=0)
        self._found: NDArray[np.uint32] = np.empty(most, np.uint32)

    def _fill(self, skin: int, faces: Faces, content: bytes) -> None:
        """Copy a mesh's vertices to a skin, unless they are there."""
        if skin < 0 or self._kept.filled.get(skin) == content:
            return
        opengl, context = calls(), self._context
        buffers = [(context.skinvertVBO, faces.vertices_m), (context.skinnormalVBO, faces.normals)]
        if faces.texture is not None:
            buffers.append((context.skintexcoordVBO, faces.texture))
        for numbers, values in buffers:
            opengl.glBindBuffer(opengl.GL_ARRAY_BUFFER, numbers[skin])
            opengl.glBufferData(opengl.GL_ARRAY_BUFFER, values.nbytes, values, opengl.GL_STATIC_DRAW)
        opengl.glBindBuffer(opengl.GL_ARRAY_BUFFER, 0)
        self._kept.filled[skin] = content

    def put(self, data: mujoco.MjData, projection: Projection, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Have the skins follow their meshes in the scene, with the faces that a picture can show.

        Args:
            data: says where the meshes are.
            projection: of the picture.
            wanted: (N,) which boxes are looked at.

        Returns:
            (nmesh,) which meshes have their skins in the scene.
        """
        shown = self._kept.geoms[: self._scene.ngeom].copy()
        of_mesh = (shown["type"] == mujoco.mjtGeom.mjGEOM_MESH) & (shown["objtype"] == mujoco.mjtObj.mjOBJ_GEOM)
        geoms = np.where(of_mesh, shown["objid"], 0)
        skins = np.where(of_mesh, self._skin[geoms], -1)
        # MuJoCo draws what can be seen through last, and in an order of its own.
        skins[np.isin(self._mesh[geoms], self._mesh[geoms[of_mesh & (shown["rgba"][:, 3] < OPAQUE)]])] = -1
        if len(shown) + 2 * np.count_nonzero(skins >= 0) >= self._scene.maxgeom:
            skins[:] = -1
        opengl = calls()
        for geom in geoms[skins >= 0].tolist():
            skin, count = self._skin[geom], 0
            pieces = wanted[slice(*np.searchsorted(self._boxes.geom, (geom, geom + 1)))]
            if pieces.any():
                place_m, turn, faces = data.geom_xpos[geom], data.geom_xmat[geom], self._faces_of_geom[geom]
                count = faces_that_show(projection, place_m, turn, faces, pieces, self._kept.samples, self._found)
                opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, self._context.skinfaceVBO[skin])
                listed = self._found[:count]
                opengl.glBufferData(opengl.GL_ELEMENT_ARRAY_BUFFER, listed.nbytes, listed, opengl.GL_STREAM_DRAW)
            self._kept.drawn[skin] = count // 3
        opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, 0)
        self._follow(shown, skins)
        skinned = np.zeros(len(self._closing), np.bool_)
        skinned[self._mesh[geoms[skins >= 0]]] = True
        return skinned

    def _follow(self, shown: NDArray[np.void], skins: NDArray[np.intp]) -> None:
        """Write the scene's geoms: after each with a skin comes the skin, and what takes away its place."""
        having = skins >= 0
        written = np.repeat(shown, np.where(having, 3, 1))
        own = np.flatnonzero(having) + 2 * np.arange(np.count_nonzero(having))
        skin, close = own + 1, own + 2
        written["type"][skin], written["objid"][skin] = mujoco.mjtGeom.mjGEOM_SKIN, skins[having]
        written["matid"][close] = -1
        written["dataid"][close] = self._closing[self._mesh[shown["objid"][having]]] - self._context.baseMesh
        # Decoration has no part in the maps of what casts shadows.
        written["category"][skin] = written["category"][close] = mujoco.mjtCatBit.mjCAT_DECOR
        self._scene.ngeom = len(written)
        self._kept.geoms[: len(written)] = written
