"""What MuJoCo 3.2.7 does with OpenGL behind its interface, used to draw less and to keep what two scenes share.

Nothing else in the project knows where MuJoCo has a geom in its memory, how it numbers its display lists, in which
order it draws, or in which buffers. With another version all of that may be otherwise (``savings.py``).

* A context has two display lists for each mesh: ``baseMesh + 2 * mesh`` for its faces, and one for its convex hull.
* ``mjr_render`` draws a scene in passes (``Pass``), in each of them all opaque geoms in the scene's order; skins too,
  from buffers with a list of faces. What can be seen through comes last.
* A lamp's map of shadows has no geoms of the category decor.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum, auto
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.opengl import calls, check, failure
from pipeline.rendering.software.faces import PARTS, Faces

SKINS = 64
"""As many with places in a texture, and as many without; LIBERO's scenes have up to 50 large meshes."""

OPAQUE = 0.995
"""MuJoCo's least opacity of what it does not take to be seen through (``mjr_render``)."""

WIDEST_MAP_DEG = 80.0
"""Half the widest angle of MuJoCo's maps of what casts shadows (``mjr_render``)."""

REFLECTING_SQUARE = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
"""Corners of a box's upper z face, which is what reflects (``mjr_render``), in units of its half sizes."""

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
"""``mjvGeom``."""

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


def bare(model: mujoco.MjModel) -> mujoco.MjModel:
    """A model of nothing but another one's planes and ``SKINS`` of both kinds; its context is as the other's."""
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    made = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{'<geom type="plane" size="1 1 1"/>' * len(planes)}<body name="bone"/></worldbody>
        <deformable>{_SKIN.format(_TEXTURE) * SKINS + _SKIN.format("") * SKINS}</deformable></mujoco>"""
    )
    made.geom_size[:] = model.geom_size[planes]
    made.stat.extent = model.stat.extent
    for part, names in _ALIKE.items():
        for name in names:
            setattr(getattr(made.vis, part), name, getattr(getattr(model.vis, part), name))
    return made


def fixed(model: mujoco.MjModel) -> tuple[object, ...]:
    """What a context is made for once and for all: buffers, the fineness of round bodies, lines, fog and planes."""
    window, quality = model.vis.global_, model.vis.quality
    buffers = window.offwidth, window.offheight, quality.offsamples, quality.shadowsize
    fineness = quality.numslices, quality.numstacks, quality.numquads
    planes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    return *buffers, *fineness, window.linewidth, tuple(model.vis.rgba.fog), planes.tobytes()


def samples(count: int) -> NDArray[np.float32]:
    """(count, 2) where in a pixel of the current context its samples are, 0 to 1 to the right and up.

    Raises:
        PipelineError: when OpenGL cannot draw each of them by itself.
    """
    opengl = calls()
    if opengl.glGetIntegerv(opengl.GL_MAJOR_VERSION) < 4:
        raise failure("OpenGL has no shaders that run once for each sample, as underlays need")
    places = [opengl.glGetMultisamplefv(opengl.GL_SAMPLE_POSITION, sample) for sample in range(count)]
    return np.array(places, np.float32)


def adopt_size(context: mujoco.MjrContext, model: mujoco.MjModel) -> None:
    """Have a context know a model's size as ``mjr_makeContext`` works it out."""
    context.shadowClip = model.stat.extent * model.vis.map.shadowclip
    context.shadowScale = model.vis.map.shadowscale
    context.fogStart = model.stat.extent * model.vis.map.fogstart
    context.fogEnd = model.stat.extent * model.vis.map.fogend


_SKY = -mujoco.mjtTextureRole.mjNTEXROLE + mujoco.mjtTextureRole.mjTEXROLE_RGB
"""Where a context has the sky's texture: the last of all materials that it has room for is the sky's."""


def texels(model: mujoco.MjModel) -> list[NDArray[np.uint8]]:
    """The bytes of each texture, where the model has them."""
    sizes = model.tex_height * model.tex_width * model.tex_nchannel
    return [model.tex_data[start : start + size] for start, size in zip(model.tex_adr, sizes, strict=True)]


def adopt_textures(context: mujoco.MjrContext, model: mujoco.MjModel, former: mujoco.MjModel) -> None:
    """Have a context of a former model's textures hold a model's: a scene has 140 MB, and those that both have stay."""
    kinds = [(m.tex_type, m.tex_height, m.tex_width, m.tex_nchannel) for m in (model, former)]
    there = texels(former)
    left = dict(enumerate(context.texture[: len(there)].tolist()))
    copied = []
    for texture, own in enumerate(texels(model)):
        for number in left:
            alike = all(mine[texture] == theirs[number] for mine, theirs in zip(*kinds, strict=True))
            if alike and np.array_equal(own, there[number]):
                context.texture[texture] = left.pop(number)
                break
        else:
            context.texture[texture] = calls().glGenTextures(1)
            copied.append(texture)
    calls().glDeleteTextures([*left.values()])
    context.texture[model.ntex :] = 0
    context.ntexture, context.textureType[: model.ntex] = model.ntex, model.tex_type
    context.mat_texid[: model.mat_texid.size] = model.mat_texid.ravel()
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    context.mat_texid[_SKY] = skies[0] if len(skies) else -1
    context.mat_texrepeat[: model.mat_texrepeat.size] = model.mat_texrepeat.ravel()
    context.mat_texuniform[: model.nmat] = model.mat_texuniform
    for texture in copied:
        mujoco.mjr_uploadTexture(model, context, texture)
        check("mjr_uploadTexture")


class HeldTextures:
    """Looks of a context's textures beside each other: OpenGL holds them under names of their own."""

    def __init__(self, context: mujoco.MjrContext):
        self._context, self._own = context, context.texture.copy()
        self._held: list[int] = []

    def hold(self, textures: Collection[int]) -> dict[int, int]:
        """Keep what the context has for these textures; the model's own get new names, and have to be loaded.

        Returns:
            Texture to the name of what was kept.
        """
        names = {texture: int(self._context.texture[texture]) for texture in textures}
        self._held += names.values()
        for texture in textures:
            self._own[texture] = self._context.texture[texture] = calls().glGenTextures(1)
        return names

    def show(self, names: Mapping[int, int]) -> None:
        """Draw with what was kept, and for other textures with the model's own."""
        self._context.texture[:] = self._own
        self._context.texture[[*names]] = [*names.values()]

    def let_go(self) -> None:
        self.show({})
        calls().glDeleteTextures(self._held)


class Draws(Enum):
    """What a pass of ``mjr_render`` is for; the passes come in this order, the last two for each lamp with shadows."""

    MIRROR = auto()
    """What shows in the mirror."""
    CAMERA = auto()
    """What the camera sees."""
    LAMP_MAP = auto()
    """What casts shadows, as the lamp sees it."""
    LAMP_LIGHT = auto()
    """What the camera sees, once more, in this lamp's light."""

    @property
    def by_camera(self) -> bool:
        return self in (Draws.CAMERA, Draws.LAMP_LIGHT)


class Pass(NamedTuple):
    """One pass and the geoms (ngeom,) that it has to draw of meshes."""

    draws: Draws
    geoms: NDArray[np.bool_]


@contextmanager
def _recorded(number: int) -> Iterator[None]:
    """Have a display list do, whenever it is called, what OpenGL is asked to do meanwhile."""
    calls().glNewList(number, calls().GL_COMPILE)
    try:
        yield
    finally:
        calls().glEndList()


class _Lists:
    """A pass's display lists: one for each mesh, one more, and for each mesh what follows its skin.

    Attributes:
        base, end, closing: numbers of the first, the one more, and the first that follows a skin.
        ends: what the one more does: the base that it sets, and a list that it calls before.
        drawn: (nmesh,) whose faces are drawn.
        opened: (nmesh,) which are followed by a skin.
        shut: (nmesh,) whose skin is not drawn.
    """

    def __init__(self, meshes: int):
        self.base = calls().glGenLists(2 * meshes + 1)
        self.end, self.closing = self.base + meshes, self.base + meshes + 1
        self.ends = (0, 0)
        self.drawn, self.opened, self.shut = np.zeros((3, meshes), np.bool_)


class Meshes:
    """The display lists of a model's meshes in a context, which must be the current one.

    The list that MuJoCo calls for a mesh calls another one: the mesh's own in a set of lists that begins at OpenGL's
    list base. So one call of ``mjr_render`` can draw other meshes in each of its passes. The last mesh of every pass is
    one of ours (:meth:`show`): it puts underlays, and sets the list base for the next pass.

    MuJoCo takes skins to be in the world's frame. So a mesh that has a skin leaves its place on OpenGL's stack of
    matrices, and one more mesh of ours, drawn after the skin, takes it away.

    Attributes:
        closing: (nmesh,) of each mesh that is drawn, what follows its skin, as MuJoCo numbers meshes.

    Args:
        context: whose meshes they become.
        model: whose meshes they are.
        drawn: numbers of the meshes that are drawn.
        former: those that the context had. What both have stays; the rest is given up, and so is ``former``.
    """

    def __init__(
        self, context: mujoco.MjrContext, model: mujoco.MjModel, drawn: Sequence[int], former: Meshes | None = None
    ):
        self._context, self._meshes = context, drawn
        self._of_geom = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)
        kept = former._give_up() if former else {}
        calls().glDeleteLists(context.baseMesh, context.rangeMesh)
        context.rangeMesh = 2 * model.nmesh
        context.baseMesh = calls().glGenLists(context.rangeMesh)
        self.contents = {mesh: _content(model, mesh) for mesh in drawn}
        self._faces: dict[bytes, int] = {}
        for mesh, content in self.contents.items():
            if content not in self._faces:
                self._faces[content] = kept.pop(content, 0) or _uploaded(model, context, mesh)
        for number in kept.values():
            calls().glDeleteLists(number, 2)
        self._own = calls().glGenLists(1 + len(drawn))
        for place, mesh in enumerate(drawn):
            _call_from_base(context.baseMesh + 2 * mesh, place)
            _call_from_base(self._own + 1 + place, len(drawn) + 1 + place)
        _call_from_base(self._own, len(drawn))
        self.closing: NDArray[np.intp] = np.zeros(model.nmesh, np.intp)
        self.closing[[*drawn]] = self._own + 1 + np.arange(len(drawn)) - context.baseMesh
        self._nothing = _query_of_nothing()
        self._passes: dict[Hashable, list[_Lists]] = {}

    def _give_up(self) -> dict[bytes, int]:
        """Delete all but the faces, which are returned: what tells a mesh to the number of its list."""
        calls().glDeleteLists(self._own, 1 + len(self._meshes))
        for lists in (lists for made in self._passes.values() for lists in made):
            calls().glDeleteLists(lists.base, 2 * len(self._meshes) + 1)
        calls().glDeleteQueries(1, [self._nothing])
        return self._faces

    def show(
        self,
        name: Hashable,
        passes: Sequence[Pass],
        scene: mujoco.MjvScene,
        skinned: NDArray[np.bool_] | None = None,
        underlay: Underlay | None = None,
    ) -> None:
        """Have the next drawing of a scene draw of the meshes what its passes have to.

        Args:
            name: of what is drawn, for which most lists stay as they were the last time.
            passes: those of ``mjr_render``; any after the last draw the same.
            scene: of all that is drawn; it gets one more mesh, the last.
            skinned: (nmesh,) which meshes have a skin in the scene, that draws what the camera sees of them.
            underlay: put behind what the camera sees.
        """
        made = self._passes.setdefault(name, [])
        while len(made) < len(passes):
            made.append(_Lists(len(self._meshes)))
        by_skin = np.zeros(len(self._meshes), np.bool_) if skinned is None else skinned[[*self._meshes]]
        for number, (lists, one) in enumerate(zip(made, passes, strict=False)):
            self._write(lists, one, by_skin)
            then = made[min(number + 1, len(passes) - 1)]
            ends = then.base, underlay.number if underlay and one.draws is Draws.CAMERA else 0
            if lists.ends != ends:
                with _recorded(lists.end):
                    if underlay and one.draws is Draws.CAMERA:
                        calls().glCallList(underlay.number)
                    calls().glListBase(then.base)
                lists.ends = ends
        calls().glListBase(made[0].base)
        self._add_last(scene)

    def _write(self, lists: _Lists, one: Pass, by_skin: NDArray[np.bool_]) -> None:
        wanted = np.isin(self._meshes, self._of_geom[one.geoms])
        drawn = wanted & ~(by_skin & one.draws.by_camera)
        # Lamps' maps have no skins, mirror images must not show them.
        opened = by_skin & (one.draws is not Draws.LAMP_MAP)
        shut = opened & ((one.draws is Draws.MIRROR) | ~wanted)
        changed = (drawn != lists.drawn) | (opened != lists.opened) | (shut != lists.shut)
        for mesh in np.flatnonzero(changed).tolist():
            with _recorded(lists.base + mesh):
                if drawn[mesh]:
                    calls().glCallList(self._faces[self.contents[self._meshes[mesh]]])
                if opened[mesh]:
                    calls().glPushMatrix()
                if shut[mesh]:
                    calls().glBeginConditionalRender(self._nothing, calls().GL_QUERY_WAIT)
            with _recorded(lists.closing + mesh):
                if shut[mesh]:
                    calls().glEndConditionalRender()
                if opened[mesh]:
                    calls().glPopMatrix()
        lists.drawn, lists.opened, lists.shut = drawn, opened, shut

    def _add_last(self, scene: mujoco.MjvScene) -> None:
        """Have the one more list called as if it were a mesh of the scene, after all others that are opaque."""
        geom = scene.geoms[scene.ngeom]
        white, nowhere, straight = np.ones(4, np.float32), np.zeros(3), np.eye(3).ravel()
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_MESH, nowhere, nowhere, straight, white)
        # As decor, which mjv_initGeom makes it, it would not be called for shadows.
        geom.category, geom.dataid = mujoco.mjtCatBit.mjCAT_DYNAMIC, self._own - self._context.baseMesh
        # What mjv_initGeom leaves as it was: nothing to write beside it, and nothing to show of it in a segmentation.
        geom.label, geom.segid = "", -1
        scene.ngeom += 1


def _content(model: mujoco.MjModel, mesh: int) -> bytes:
    """Tells what a mesh's faces look like from those of any other mesh."""
    digest = hashlib.sha256()
    for part, names in PARTS.items():
        first, count = getattr(model, f"mesh_{part}adr")[mesh], getattr(model, f"mesh_{part}num")[mesh]
        for name in names:
            digest.update(getattr(model, f"mesh_{name}")[first : first + count].tobytes())
    return digest.digest()


def _query_of_nothing() -> int:
    """A query whether something was drawn, answered with no."""
    opengl = calls()
    number = int(opengl.glGenQueries(1)[0])
    opengl.glBeginQuery(opengl.GL_ANY_SAMPLES_PASSED, number)
    opengl.glEndQuery(opengl.GL_ANY_SAMPLES_PASSED)
    return number


def _call_from_base(number: int, place: int) -> None:
    """Have a list call the one in a place after the list base."""
    with _recorded(number):
        calls().glCallLists(np.array([place], np.uint32))


def _uploaded(model: mujoco.MjModel, context: mujoco.MjrContext, mesh: int) -> int:
    """Have MuJoCo write a mesh's faces into the first of two new lists; the second is of no use."""
    base, hull = context.baseMesh, int(model.mesh_graphadr[mesh])
    number: int = calls().glGenLists(2)
    try:
        model.mesh_graphadr[mesh] = -1
        context.baseMesh = number - 2 * mesh
        mujoco.mjr_uploadMesh(model, context, mesh)
        check("mjr_uploadMesh")
    finally:
        context.baseMesh, model.mesh_graphadr[mesh] = base, hull
    return number


class Skins:
    """The skins of a context and a scene that were made from a ``bare`` model, to draw chosen faces of meshes with.

    The display list of a mesh always draws the same faces, and to write one takes as long as to draw a third of them.
    For a skin MuJoCo has OpenGL draw the faces that a buffer lists. It would fill the skins with that model's own at
    every drawing, so they are hidden from it.

    Attributes:
        drawn: (2 ``SKINS``,) how many faces of each are drawn; the first ``SKINS`` have places in a texture.
    """

    def __init__(self, context: mujoco.MjrContext, scene: mujoco.MjvScene):
        self._context, self._scene = context, scene
        self.drawn: NDArray[np.int32] = scene.skinfacenum
        scene.nskin = 0
        first = scene.geoms[0].size.ctypes.data - GEOM.fields["size"][1]  # type: ignore[index]
        memory = (ctypes.c_byte * (GEOM.itemsize * scene.maxgeom)).from_address(first)
        self._geoms: NDArray[np.void] = np.frombuffer(memory, GEOM)
        self._filled: dict[int, bytes] = {}

    def fill_vertices(self, skin: int, faces: Faces, content: bytes) -> None:
        """Copy a mesh's vertices to a skin, unless they are there."""
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
        """Have a skin draw the faces of these corners (3 F,)."""
        self.drawn[skin] = len(corners) // 3
        if len(corners):
            opengl = calls()
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, self._context.skinfaceVBO[skin])
            opengl.glBufferData(opengl.GL_ELEMENT_ARRAY_BUFFER, corners.nbytes, corners, opengl.GL_STREAM_DRAW)
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, 0)

    def follow(self, shown: NDArray[np.void], skins: NDArray[np.intp], closing: NDArray[np.intp]) -> None:
        """Write the scene's geoms: after each with a skin comes the skin, and the mesh that takes away its place.

        Args:
            shown: (N,) of ``GEOM``.
            skins: (N,) their skins, -1 for none.
            closing: (K,) for each that has one, that mesh as MuJoCo numbers it.
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


_VERTICES = "#version 400 compatibility\nvoid main() { gl_Position = gl_Vertex; }"

# The far end of MuJoCo's depth is 0: nothing was drawn there, and what was is the sky, which is in every picture.
_SAMPLES = """#version 400 compatibility
uniform sampler2DMS colours, depths;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float depth = texelFetch(depths, pixel, gl_SampleID).r;
    if (depth == 0.0) discard;
    gl_FragColor = texelFetch(colours, pixel, gl_SampleID);
    gl_FragDepth = depth;
}
"""


class Underlay:
    """A part of a picture that is drawn once and laid into many: colour and depth of every sample.

    The context must be the current one.

    Attributes:
        number: of the display list that draws it into the off-screen buffer, where nothing nearer is drawn; what is at
            the same depth is drawn over. MuJoCo calls it after all that is opaque (``Meshes``).
        content: tells what was kept from anything else; empty at first.

    Args:
        context: of MuJoCo, in whose off-screen buffer the pictures are drawn.
        height, width: of the pictures, which begin in that buffer's corner.
    """

    def __init__(self, context: mujoco.MjrContext, height: int, width: int):
        opengl = calls()
        self._buffer, self._height, self._width = context.offFBO, height, width
        self._textures = [
            self._texture(context.offColor, context.offSamples),
            self._texture(context.offDepthStencil, context.offSamples),
        ]
        self._kept = opengl.glGenFramebuffers(1)
        opengl.glBindFramebuffer(opengl.GL_FRAMEBUFFER, self._kept)
        places = opengl.GL_COLOR_ATTACHMENT0, opengl.GL_DEPTH_STENCIL_ATTACHMENT
        for place, texture in zip(places, self._textures, strict=True):
            opengl.glFramebufferTexture2D(opengl.GL_FRAMEBUFFER, place, opengl.GL_TEXTURE_2D_MULTISAMPLE, texture, 0)
        opengl.glBindFramebuffer(opengl.GL_FRAMEBUFFER, self._buffer)
        self._program = self._shaders()
        self.number = calls().glGenLists(1)
        with _recorded(self.number):
            self._draw()
        self.content = b""

    def keep(self, content: bytes) -> None:
        """Copy what is drawn in the off-screen buffer."""
        # Of less than all, OpenGL here does not copy each sample by itself.
        opengl, rectangle = calls(), (0, 0, self._width, self._height)
        opengl.glPushAttrib(opengl.GL_SCISSOR_BIT)
        opengl.glDisable(opengl.GL_SCISSOR_TEST)
        opengl.glBindFramebuffer(opengl.GL_READ_FRAMEBUFFER, self._buffer)
        opengl.glBindFramebuffer(opengl.GL_DRAW_FRAMEBUFFER, self._kept)
        opengl.glBlitFramebuffer(
            *rectangle, *rectangle, opengl.GL_COLOR_BUFFER_BIT | opengl.GL_DEPTH_BUFFER_BIT, opengl.GL_NEAREST
        )
        opengl.glBindFramebuffer(opengl.GL_FRAMEBUFFER, self._buffer)
        opengl.glPopAttrib()
        self.content = content

    def _draw(self) -> None:
        opengl = calls()
        opengl.glPushAttrib(opengl.GL_ALL_ATTRIB_BITS)
        for setting in (
            opengl.GL_ALPHA_TEST,
            opengl.GL_BLEND,
            opengl.GL_CULL_FACE,
            opengl.GL_POLYGON_OFFSET_FILL,
            opengl.GL_STENCIL_TEST,
        ):
            opengl.glDisable(setting)
        opengl.glEnable(opengl.GL_DEPTH_TEST)
        # MuJoCo's depth grows towards the camera.
        opengl.glDepthFunc(opengl.GL_GEQUAL)
        opengl.glDepthMask(True)
        opengl.glColorMask(True, True, True, True)
        opengl.glPolygonMode(opengl.GL_FRONT_AND_BACK, opengl.GL_FILL)
        opengl.glViewport(0, 0, self._width, self._height)
        for unit, texture in enumerate(self._textures):
            opengl.glActiveTexture(opengl.GL_TEXTURE0 + unit)
            opengl.glBindTexture(opengl.GL_TEXTURE_2D_MULTISAMPLE, texture)
        opengl.glUseProgram(self._program)
        opengl.glRectf(-1, -1, 1, 1)
        opengl.glUseProgram(0)
        opengl.glPopAttrib()

    def _texture(self, renderbuffer: int, samples: int) -> int:
        """A texture for as many samples as a renderbuffer has, in its format: others cannot be copied as they are."""
        opengl = calls()
        opengl.glBindRenderbuffer(opengl.GL_RENDERBUFFER, renderbuffer)
        kind = opengl.glGetRenderbufferParameteriv(opengl.GL_RENDERBUFFER, opengl.GL_RENDERBUFFER_INTERNAL_FORMAT)
        texture: int = opengl.glGenTextures(1)
        opengl.glBindTexture(opengl.GL_TEXTURE_2D_MULTISAMPLE, texture)
        opengl.glTexImage2DMultisample(opengl.GL_TEXTURE_2D_MULTISAMPLE, samples, kind, self._width, self._height, True)
        opengl.glBindTexture(opengl.GL_TEXTURE_2D_MULTISAMPLE, 0)
        return texture

    def _shaders(self) -> int:
        opengl = calls()
        program: int = opengl.glCreateProgram()
        for kind, text in ((opengl.GL_VERTEX_SHADER, _VERTICES), (opengl.GL_FRAGMENT_SHADER, _SAMPLES)):
            shader = opengl.glCreateShader(kind)
            opengl.glShaderSource(shader, text)
            opengl.glCompileShader(shader)
            opengl.glAttachShader(program, shader)
            opengl.glDeleteShader(shader)
        opengl.glLinkProgram(program)
        if not opengl.glGetProgramiv(program, opengl.GL_LINK_STATUS):
            raise failure(f"OpenGL refuses the shaders of underlays: {opengl.glGetProgramInfoLog(program)!r}")
        opengl.glUseProgram(program)
        for unit, name in enumerate(("colours", "depths")):
            opengl.glUniform1i(opengl.glGetUniformLocation(program, name), unit)
        opengl.glUseProgram(0)
        return program
