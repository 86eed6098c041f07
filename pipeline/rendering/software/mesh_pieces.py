"""Large meshes in pieces, so that what lies outside of a picture is not even handed to OpenGL.

MuJoCo's context has a display list for each mesh. Here each large mesh gets one more for every piece of it, and its own
list calls those that can be seen. A piece is a run of the mesh's faces in their order, so everything is drawn in
MuJoCo's order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Hashable, Sequence
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.opengl import calls, check
from pipeline.rendering.software import display_list
from pipeline.rendering.software.layer import Layer
from pipeline.types import Floats

BATCH_FACES = 341
"""llvmpipe draws so many faces of a display list or of a buffer at once. Where one of them has a corner outside of the
view, all of them are sorted by front and back before their corners are rounded, else afterwards."""

PIECE_FACES = 3 * BATCH_FACES
"""Faces of a piece; each piece that is drawn costs some microseconds by itself. Pieces are cut into the same batches as
the whole mesh."""

MOST_PARTS = 0.75
"""Where more than this share of a mesh is seen, all of it is drawn at once."""

MARGIN_M = 1e-3
"""Added around every box, for what the rasteriser rounds."""


PARTS = {
    "vert": ("vert",),
    "normal": ("normal",),
    "texcoord": ("texcoord",),
    "face": ("face", "facenormal", "facetexcoord"),
}
"""Arrays of a model that a mesh is drawn from, by what says which part of them is the mesh's."""


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
    """The boxes of a model's geoms; those of ``hidden_groups``, which are not drawn, have none."""
    corners: list[Floats] = [np.empty((0, 8, 3))]
    numbers: list[tuple[int, int]] = []
    for geom in np.flatnonzero(~np.isin(model.geom_group, list(hidden_groups))).tolist():
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            bounds = _piece_bounds(model, model.geom_dataid[geom])
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            bounds = np.array([[np.zeros(3), [*model.geom_size[geom, :2], 0]]])
        else:
            bounds = model.geom_aabb[geom].reshape(1, 2, 3)
        corners.append(_corners(bounds))
        numbers += [(geom, piece) for piece in range(len(bounds))]
    geoms, pieces = np.array(numbers, np.intp).reshape(-1, 2).T
    return Boxes(np.concatenate(corners), geoms, pieces)


def _piece_bounds(model: mujoco.MjModel, mesh: int) -> Floats:
    """(P, 2, 3) centre and half size of the box around each piece of a mesh, in its geom's frame."""
    start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices_m = model.mesh_vert[model.mesh_vertadr[mesh] :][model.mesh_face[start : start + faces].ravel()]
    firsts = np.arange(0, 3 * faces, 3 * PIECE_FACES)
    low_m, high_m = (least.reduceat(vertices_m, firsts).astype(float) for least in (np.minimum, np.maximum))
    return np.stack([(low_m + high_m) / 2, (high_m - low_m) / 2], axis=1)


def _corners(bounds: Floats) -> Floats:
    """(P, 8, 3) corners of boxes (P, 2, 3), with a margin."""
    signs = np.array(list(product((-1, 1), repeat=3)))
    corners: Floats = bounds[:, None, 0] + signs * (bounds[:, None, 1] + MARGIN_M)
    return corners


class MeshPieces:
    """The display lists of a model's meshes in a context of MuJoCo, which must be the current one.

    The list that MuJoCo calls for a mesh calls another one: the mesh's own in a set of lists that begins at OpenGL's
    list base. So one call of ``mjr_render`` can draw other pieces in each of its passes. The last mesh of every pass is
    one of ours (:meth:`show`): it puts layers, and sets the list base for the next pass.

    Attributes:
        contents: mesh to what tells it from any other, for those that are drawn.
        closing: (nmesh,) of each of them, the list to be called after its skin.

    Args:
        context: made from the model, or from another one.
        boxes: of the model.
        former: those of the model that the context was for before, where it is another one. What both have stays as it
            is; the rest is given up, and so is ``former``.
    """

    def __init__(
        self, model: mujoco.MjModel, context: mujoco.MjrContext, boxes: Boxes, former: MeshPieces | None = None
    ):
        self._context = context
        meshes = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)[boxes.geom]
        self._boxes = np.flatnonzero(meshes >= 0)
        drawn, self._mesh = np.unique(meshes[self._boxes], return_inverse=True)
        self._piece = boxes.piece[self._boxes]
        former_shapes = {} if former is None else former._free(model.nmesh)
        self._shapes: dict[bytes, _Shape] = {}
        self._meshes: list[_Shape] = []
        self.contents = {mesh: _content(model, mesh) for mesh in drawn.tolist()}
        for mesh, content in self.contents.items():
            shape = self._shapes.get(content) or former_shapes.pop(content, None) or _shape(model, context, mesh)
            self._shapes[content] = shape
            self._meshes.append(shape)
        for shape in former_shapes.values():
            shape.free()
        for number, mesh in enumerate(drawn.tolist()):
            with display_list.recorded(context.baseMesh + 2 * mesh):
                _call_from_base(number)
        self._turn = display_list.new()
        with display_list.recorded(self._turn):
            _call_from_base(len(drawn))
        self._close = display_list.new(len(drawn))
        for number in range(len(drawn)):
            with display_list.recorded(self._close + number):
                _call_from_base(len(drawn) + 1 + number)
        self.closing: NDArray[np.intp] = np.zeros(model.nmesh, np.intp)
        self.closing[drawn] = self._close + np.arange(len(drawn))
        self._nothing = _query_of_nothing()
        self._passes: dict[Hashable, list[_Lists]] = {}

    def _free(self, meshes: int) -> dict[bytes, _Shape]:
        """Have the context's lists of meshes do nothing, for as many meshes, and give up all but the shapes."""
        display_list.free(self._context.baseMesh, self._context.rangeMesh)
        display_list.free(self._turn)
        display_list.free(self._close, len(self._meshes))
        for lists in (lists for made in self._passes.values() for lists in made):
            display_list.free(lists.base, 2 * len(self._meshes) + 1)
        calls().glDeleteQueries(1, [self._nothing])
        # Of each mesh one for its faces and one for its convex hull.
        self._context.rangeMesh = 2 * meshes
        self._context.baseMesh = display_list.new(self._context.rangeMesh)
        return self._shapes

    def show(
        self,
        name: Hashable,
        passes: Sequence[NDArray[np.bool_]],
        scene: mujoco.MjvScene,
        main: int = 0,
        layers: Sequence[Layer] = (),
        skinned: NDArray[np.bool_] | None = None,
    ) -> None:
        """Have the pieces drawn of which a box is wanted, of the geoms that are in a scene.

        What the camera sees of a mesh that has a skin is drawn by the skin, for which the mesh leaves its place on the
        stack of matrices. In passes that are not to have the skin, OpenGL is told to draw it if something is there
        that is not.

        Args:
            name: of what is drawn, for which most lists stay as they were the last time.
            passes: (N,) which of the boxes each pass of ``mjr_render`` draws; those after the last draw the same.
            scene: of all that is drawn; it gets one more mesh, the last.
            main: which of ``passes`` gets the layers.
            layers: put after all other meshes.
            skinned: (nmesh,) which meshes have a skin in the scene, which is drawn in ``main``, and, like the camera's
                picture, in every second pass after it.
        """
        made = self._passes.setdefault(name, [])
        while len(made) < len(passes):
            made.append(_Lists(len(self._meshes)))
        by_skin = np.zeros(len(self._meshes), np.bool_) if skinned is None else skinned[[*self.contents]]
        for number, (lists, wanted) in enumerate(zip(made, passes, strict=False)):
            by_camera = number >= main and (number - main) % 2 == 0
            self._write(lists, wanted, by_skin, before=number < main, by_camera=by_camera)
            then = made[min(number + 1, len(passes) - 1)]
            end = then.base, *(layer.number for layer in layers if number == main)
            if lists.end != end:
                with display_list.recorded(lists.base + len(self._meshes)):
                    for layer in end[1:]:
                        calls().glCallList(layer)
                    calls().glListBase(then.base)
                lists.end = end
        calls().glListBase(made[0].base)
        display_list.add(self._turn, scene, self._context)

    def _write(
        self, lists: _Lists, seen: NDArray[np.bool_], by_skin: NDArray[np.bool_], before: bool, by_camera: bool
    ) -> None:
        wanted, drawn = seen[self._boxes], np.zeros(len(self._meshes), np.bool_)
        drawn[self._mesh[wanted]] = True
        # Lamps' maps have no skins, mirror images must not show them.
        opened = by_skin & (before or by_camera)
        shut = opened & (before | ~drawn)
        shown = wanted & ~(by_skin & by_camera)[self._mesh]
        changed = (opened != lists.opened) | (shut != lists.shut)
        changed[self._mesh[shown != lists.shown]] = True
        for mesh in np.flatnonzero(changed).tolist():
            pieces = np.unique(self._piece[shown & (self._mesh == mesh)]).tolist()
            whole, parts = self._meshes[mesh]
            most = len(pieces) > MOST_PARTS * len(parts)
            with display_list.recorded(lists.base + mesh):
                for number in [whole] if most else [parts[piece] for piece in pieces]:
                    calls().glCallList(number)
                if opened[mesh]:
                    calls().glPushMatrix()
                if shut[mesh]:
                    calls().glBeginConditionalRender(self._nothing, calls().GL_QUERY_WAIT)
            with display_list.recorded(lists.closing + mesh):
                if shut[mesh]:
                    calls().glEndConditionalRender()
                if opened[mesh]:
                    calls().glPopMatrix()
        lists.shown, lists.opened, lists.shut = shown, opened, shut


class _Shape(NamedTuple):
    """A mesh's display lists, of which every second one is there because MuJoCo writes two.

    Attributes:
        whole: of all its faces.
        pieces: of each piece; that of a small mesh is all of it.
    """

    whole: int
    pieces: tuple[int, ...]

    def free(self) -> None:
        for number in {self.whole, *self.pieces}:
            display_list.free(number, 2)


def _shape(model: mujoco.MjModel, context: mujoco.MjrContext, mesh: int) -> _Shape:
    faces = int(model.mesh_facenum[mesh])
    whole = _upload(model, context, mesh, 0, faces)
    if faces <= PIECE_FACES:
        return _Shape(whole, (whole,))
    firsts = range(0, faces, PIECE_FACES)
    return _Shape(whole, tuple(_upload(model, context, mesh, first, PIECE_FACES) for first in firsts))


def _content(model: mujoco.MjModel, mesh: int) -> bytes:
    """Tells what a mesh's faces look like from those of any other mesh."""
    digest = hashlib.sha256()
    for part, names in PARTS.items():
        first, count = getattr(model, f"mesh_{part}adr")[mesh], getattr(model, f"mesh_{part}num")[mesh]
        for name in names:
            digest.update(getattr(model, f"mesh_{name}")[first : first + count].tobytes())
    return digest.digest()


class _Lists:
    """A display list for each mesh, one more, and for each mesh what follows its skin, one after the other.

    Attributes:
        base: number of the first.
        closing: number of the first that follows a skin.
        end: what the one more does: the base that it sets, and the lists that it calls before.
        shown: of the boxes of meshes, those whose pieces the lists draw.
        opened: of the meshes, those that are followed by a skin.
        shut: those whose skin is not drawn.
    """

    def __init__(self, meshes: int):
        self.base = display_list.new(2 * meshes + 1)
        self.closing = self.base + meshes + 1
        self.end: tuple[int, ...] = ()
        self.shown: NDArray[np.bool_] = np.zeros(1, np.bool_)
        self.opened: NDArray[np.bool_] = np.zeros(meshes, np.bool_)
        self.shut: NDArray[np.bool_] = np.zeros(meshes, np.bool_)


def _query_of_nothing() -> int:
    """A query whether something was drawn, answered with no."""
    opengl = calls()
    number = int(opengl.glGenQueries(1)[0])
    opengl.glBeginQuery(opengl.GL_ANY_SAMPLES_PASSED, number)
    opengl.glEndQuery(opengl.GL_ANY_SAMPLES_PASSED)
    return number


def _call_from_base(number: int) -> None:
    calls().glCallLists(np.array([number], np.uint32))


def _upload(model: mujoco.MjModel, context: mujoco.MjrContext, mesh: int, first: int, faces: int) -> int:
    """Have MuJoCo write some of a mesh's faces into a display list of their own; returns its number."""
    start, count, graph = (int(field[mesh]) for field in (model.mesh_faceadr, model.mesh_facenum, model.mesh_graphadr))
    base = context.baseMesh
    # A list for the faces, and one for the convex hull, which is drawn for collision geometry.
    number = display_list.new(2)
    try:
        model.mesh_faceadr[mesh], model.mesh_facenum[mesh] = start + first, min(faces, count - first)
        model.mesh_graphadr[mesh] = -1
        context.baseMesh = number - 2 * mesh
        mujoco.mjr_uploadMesh(model, context, mesh)
        check("mjr_uploadMesh")
    finally:
        context.baseMesh = base
        model.mesh_faceadr[mesh], model.mesh_facenum[mesh], model.mesh_graphadr[mesh] = start, count, graph
    return number
