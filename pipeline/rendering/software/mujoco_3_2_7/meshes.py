"""Display lists of meshes in MuJoCo 3.2.7's context, which choose the meshes of each pass of ``mjr_render``."""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.opengl import calls, check
from pipeline.rendering.software.faces import PARTS
from pipeline.rendering.software.mujoco_3_2_7.passes import Pass, Purpose
from pipeline.rendering.software.mujoco_3_2_7.underlays import Underlay, recorded


class _Lists:
    """Display lists of one pass: a list for each mesh, an end list, and for each mesh a list that closes its skin.

    Attributes:
        base, end, closing: numbers of the first mesh's list, of the end list, and of the first closing list.
        ends: content of the end list: the list base that it sets, and the list that it calls before (0 without a list).
        rendered: (nmesh,) meshes whose faces are rendered.
        opened: (nmesh,) meshes that a skin follows.
        shut: (nmesh,) meshes whose skin is not rendered.
    """

    def __init__(self, meshes: int):
        self.base = calls().glGenLists(2 * meshes + 1)
        self.end, self.closing = self.base + meshes, self.base + meshes + 1
        self.ends = (0, 0)
        self.rendered, self.opened, self.shut = np.zeros((3, meshes), np.bool_)


class Meshes:
    """Display lists of a model's meshes in a context, which must be the current context.

    The list that MuJoCo calls for a mesh calls a second list, whose number is relative to OpenGL's list base. Each pass
    has its own second lists, so one call of ``mjr_render`` can render different meshes in each pass. An extra mesh is
    the last mesh of every pass (:meth:`show`). It writes underlays and sets the list base for the next pass.

    MuJoCo renders skins in the world's frame. The list of a mesh with a skin therefore pushes the mesh's matrix onto
    OpenGL's stack. An extra mesh after the skin, the closing mesh, pops the matrix.

    Attributes:
        closing: (nmesh,) number, as MuJoCo numbers meshes, of the closing mesh of each mesh that is rendered.
        contents: number of each rendered mesh to the hash of its content.

    Args:
        context: the context.
        model: the model.
        rendered: numbers of the meshes that are rendered.
        former: the display lists of the former model; they cannot be used afterwards. Lists of meshes that both models
            have are kept.
    """

    def __init__(
        self, context: mujoco.MjrContext, model: mujoco.MjModel, rendered: Sequence[int], former: Meshes | None = None
    ):
        self._context, self._meshes = context, rendered
        self._of_geom = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)
        kept = former._give_up() if former else {}
        calls().glDeleteLists(context.baseMesh, context.rangeMesh)
        # The extra lists form one block with MuJoCo's own lists. MuJoCo calls no list below its base, and OpenGL may
        # number a later block lower (Mesa 25 does, Mesa 22 does not).
        context.rangeMesh = 2 * model.nmesh + 1 + len(rendered)
        context.baseMesh = calls().glGenLists(context.rangeMesh)
        self._own = context.baseMesh + 2 * model.nmesh
        self.contents = {mesh: _content(model, mesh) for mesh in rendered}
        self._faces: dict[bytes, int] = {}
        for mesh, content in self.contents.items():
            if content not in self._faces:
                self._faces[content] = kept.pop(content, 0) or _uploaded(model, context, mesh)
        for number in kept.values():
            calls().glDeleteLists(number, 2)
        for place, mesh in enumerate(rendered):
            _call_from_base(context.baseMesh + 2 * mesh, place)
            _call_from_base(self._own + 1 + place, len(rendered) + 1 + place)
        _call_from_base(self._own, len(rendered))
        self.closing: NDArray[np.intp] = np.zeros(model.nmesh, np.intp)
        self.closing[[*rendered]] = self._own + 1 + np.arange(len(rendered)) - context.baseMesh
        self._nothing = _query_of_nothing()
        self._passes: dict[Hashable, list[_Lists]] = {}

    def _give_up(self) -> dict[bytes, int]:
        """Delete all lists except the context's own lists and the lists of faces.

        Returns:
            Hash of a mesh to the list of its faces.
        """
        for lists_of_passes in self._passes.values():
            for lists in lists_of_passes:
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
        """Choose the meshes of each pass of the next ``mjr_render``.

        Args:
            name: identifier of the kind of picture; unchanged lists are kept from the last picture with this name.
            passes: the passes of ``mjr_render``; any further passes repeat the last one.
            scene: the scene to render; the extra mesh is appended to it.
            skinned: (nmesh,) meshes with a skin in the scene, which renders them in the camera's passes.
            underlay: underlay of the camera's view.
        """
        lists_of_passes = self._passes.setdefault(name, [])
        while len(lists_of_passes) < len(passes):
            lists_of_passes.append(_Lists(len(self._meshes)))
        by_skin = np.zeros(len(self._meshes), np.bool_) if skinned is None else skinned[[*self._meshes]]
        for number, (lists, current_pass) in enumerate(zip(lists_of_passes, passes, strict=False)):
            self._write(lists, current_pass, by_skin)
            next_lists = lists_of_passes[min(number + 1, len(passes) - 1)]
            underlay_list = underlay.number if underlay and current_pass.purpose is Purpose.CAMERA else 0
            ends = next_lists.base, underlay_list
            if lists.ends != ends:
                with recorded(lists.end):
                    if underlay_list:
                        calls().glCallList(underlay_list)
                    calls().glListBase(next_lists.base)
                lists.ends = ends
        calls().glListBase(lists_of_passes[0].base)
        self._add_last(scene)

    def _write(self, lists: _Lists, written_pass: Pass, by_skin: NDArray[np.bool_]) -> None:
        """Record the lists of a pass again whose content has changed.

        Args:
            lists: the pass's lists.
            written_pass: the pass.
            by_skin: mask of ``self._meshes`` that have a skin in the scene.
        """
        purpose = written_pass.purpose
        wanted = np.isin(self._meshes, self._of_geom[written_pass.geoms])
        rendered = wanted & ~(by_skin & purpose.by_camera)
        # MuJoCo renders no skins into shadow maps, and mirror images must not show skins.
        opened = by_skin & (purpose is not Purpose.LAMP_MAP)
        shut = opened & ((purpose is Purpose.MIRROR) | ~wanted)
        changed = (rendered != lists.rendered) | (opened != lists.opened) | (shut != lists.shut)
        for mesh in np.flatnonzero(changed).tolist():
            with recorded(lists.base + mesh):
                if rendered[mesh]:
                    calls().glCallList(self._faces[self.contents[self._meshes[mesh]]])
                if opened[mesh]:
                    calls().glPushMatrix()
                if shut[mesh]:
                    calls().glBeginConditionalRender(self._nothing, calls().GL_QUERY_WAIT)
            with recorded(lists.closing + mesh):
                if shut[mesh]:
                    calls().glEndConditionalRender()
                if opened[mesh]:
                    calls().glPopMatrix()
        lists.rendered, lists.opened, lists.shut = rendered, opened, shut

    def _add_last(self, scene: mujoco.MjvScene) -> None:
        """Append the extra mesh to the scene: MuJoCo renders it after all other opaque geoms."""
        geom = scene.geoms[scene.ngeom]
        white, nowhere, straight = np.ones(4, np.float32), np.zeros(3), np.eye(3).ravel()
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_MESH, nowhere, nowhere, straight, white)
        # mjv_initGeom sets the category decor, for which MuJoCo would not call the mesh in shadow maps.
        geom.category, geom.dataid = mujoco.mjtCatBit.mjCAT_DYNAMIC, self._own - self._context.baseMesh
        # mjv_initGeom leaves label and segid unchanged. The mesh has no label, and a segmentation must not show it.
        geom.label, geom.segid = "", -1
        scene.ngeom += 1


def _content(model: mujoco.MjModel, mesh: int) -> bytes:
    """Return a hash of all data from which a mesh's faces are rendered."""
    digest = hashlib.sha256()
    for part, names in PARTS.items():
        first = getattr(model, f"mesh_{part}adr")[mesh]
        count = getattr(model, f"mesh_{part}num")[mesh]
        for name in names:
            digest.update(getattr(model, f"mesh_{name}")[first : first + count].tobytes())
    return digest.digest()


def _query_of_nothing() -> int:
    """Create an occlusion query that no sample passed, and return its number."""
    opengl = calls()
    number = int(opengl.glGenQueries(1)[0])
    opengl.glBeginQuery(opengl.GL_ANY_SAMPLES_PASSED, number)
    opengl.glEndQuery(opengl.GL_ANY_SAMPLES_PASSED)
    return number


def _call_from_base(number: int, place: int) -> None:
    """Record a list that calls the list at an offset from the list base."""
    with recorded(number):
        calls().glCallLists(np.array([place], np.uint32))


def _uploaded(model: mujoco.MjModel, context: mujoco.MjrContext, mesh: int) -> int:
    """Upload a mesh's faces into a new display list by MuJoCo, and return its number.

    A second list after it stays unused.
    """
    base, hull = context.baseMesh, int(model.mesh_graphadr[mesh])
    number: int = calls().glGenLists(2)
    try:
        model.mesh_graphadr[mesh] = -1
        # The number is unsigned in C.
        context.baseMesh = (number - 2 * mesh) % 2**32
        mujoco.mjr_uploadMesh(model, context, mesh)
        check("mjr_uploadMesh")
    finally:
        context.baseMesh, model.mesh_graphadr[mesh] = base, hull
    return number
