"""Renders the pixels of ``PlainDrawing`` with less work for Mesa, and one scene after the other in one context.

* Geoms outside of the view are not rendered (``culling.py``).
* Of large meshes, only faces that cover a sample are rendered (``skins.py``, ``samples.py``).
* What stands still before a camera is rendered once, and its colour and depth are kept as an underlay (``Still``).
* Meshes and textures that a scene shares with the one before stay in the context.
"""

from collections.abc import Collection
from contextlib import ExitStack
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.axes.base import FIELDS
from pipeline.rendering.drawing import PlainDrawing
from pipeline.rendering.software.culling import Culling, Picture
from pipeline.rendering.software.mujoco_3_2_7 import context as private
from pipeline.rendering.software.mujoco_3_2_7.meshes import Meshes
from pipeline.rendering.software.mujoco_3_2_7.passes import Pass, Purpose
from pipeline.rendering.software.mujoco_3_2_7.skins import Skins
from pipeline.rendering.software.mujoco_3_2_7.underlays import Underlay
from pipeline.rendering.software.samples import SAMPLES
from pipeline.rendering.software.skins import SkinnedMeshes
from pipeline.types import Frame

LOOK = tuple(name for name in FIELDS if name != "tex_data")
"""Arrays of a model that perturbations may change and a picture depends on, beside textures."""

CULLED = mujoco.mjNGROUP - 1
"""A group of geoms and sites that LIBERO does not use and that is never rendered."""

LONGEST_WAIT = 16
"""Pictures that a geom must stand still, at most, before it joins the underlay."""


class Shot(NamedTuple):
    """A picture to render: the state, the camera, and what has to be rendered."""

    data: mujoco.MjData
    camera: str
    picture: Picture


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
        """(ngeom,) the geoms of the underlay for the next picture.

        Args:
            view: what a picture depends on beside the geoms: the camera, and where the lamps are.
            places: (ngeom, 12) positions and rotations of the geoms, as they are rendered.
            rendered: (ngeom,) which geoms are to be rendered.
        """
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


class SoftwareDrawing(PlainDrawing):
    """Renders models that are ``possible``.

    Raises:
        PipelineError: when OpenGL does not do what is asked of it.
    """

    def __init__(self, model: mujoco.MjModel):
        # The context is made for what all scenes have in common, and then goes on with this model.
        bare = private.bare(model)
        super().__init__(bare)
        with ExitStack() as undo:
            undo.callback(self.close)
            self._skins, self._samples = Skins(self._context, self._scene), private.samples(SAMPLES)
            self._meshes = Meshes(self._context, bare, [])
            self._skinned = SkinnedMeshes(self._skins, self._samples, self._meshes, np.zeros(bare.ngeom, np.bool_))
            self._still: dict[str, Still] = {}
            self._underlays: dict[str, Underlay] = {}
            self._show(model)
            undo.pop_all()

    @staticmethod
    def possible(model: mujoco.MjModel) -> bool:
        """Whether a model has nothing that needs a context of its own. LIBERO's models have no such thing."""
        bounded = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] > 0
        return not model.nhfield and not model.nskin and bool(bounded.all()) and model.vis.quality.offsamples == SAMPLES

    def adopt(self, model: mujoco.MjModel) -> bool:
        if not self.possible(model) or private.fixed(model) != private.fixed(self._model):
            return False
        self._gl.make_current()
        self._show(model)
        return True

    def _show(self, model: mujoco.MjModel) -> None:
        private.adopt_textures(self._context, model, self._model)
        private.adopt_size(self._context, model)
        self._model = model
        self._culling = Culling(model, np.flatnonzero(np.logical_not(self._option.geomgroup)).tolist())
        shown = self._culling.shown
        rendered = np.unique(model.geom_dataid[shown & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)]).tolist()
        self._meshes = Meshes(self._context, model, rendered, self._meshes)
        self._skinned = SkinnedMeshes(self._skins, self._samples, self._meshes, shown, self._skinned)
        self._forget_underlays()

    def load(self, textures: Collection[int]) -> None:
        super().load(textures)
        if textures:
            self._forget_underlays()

    def _forget_underlays(self) -> None:
        self._still.clear()
        for underlay in self._underlays.values():
            underlay.content = b""

    def frame(self, data: mujoco.MjData, camera: str) -> Frame:
        self._gl.make_current()
        shot = Shot(data, camera, self._culling.picture(data, camera))
        if shot.picture.underlaid:
            self._draw_over_still(shot)
        else:
            self._draw(shot, shot.picture.opaque)
        return self._pixels()

    def _draw_over_still(self, shot: Shot) -> None:
        """Render a picture over an underlay of the geoms that stand still."""
        camera, opaque = shot.camera, shot.picture.opaque & ~shot.picture.mirror
        view, places = self._view(shot), np.concatenate([shot.data.geom_xpos, shot.data.geom_xmat], axis=1)
        places = places.astype(np.float32)
        if camera not in self._still:
            self._still[camera] = Still(self._model)
        still = self._still[camera].geoms(view, places, opaque) & opaque
        underlay = None
        if still.any():
            if camera not in self._underlays:
                self._underlays[camera] = Underlay(self._context, self._rectangle.height, self._rectangle.width)
            underlay, content = self._underlays[camera], view + still.tobytes() + places[still].tobytes()
            if underlay.content != content:
                self._draw(shot, still, last=False)
                underlay.keep(content)
        self._draw(shot, opaque & ~still, underlay)

    def _draw(self, shot: Shot, opaque: NDArray[np.bool_], underlay: Underlay | None = None, last: bool = True) -> None:
        """Render opaque geoms (ngeom,) of a picture over an underlay.

        Args:
            last: whether this completes the picture, with what is in no underlay: mirror, transparent geoms, sites,
                shadows and sky.
        """
        model, picture, flags = self._model, shot.picture, self._scene.flags
        rendered, passes = opaque, [Pass(Purpose.CAMERA, picture.seen & opaque)]
        if last:
            rendered = opaque | picture.mirror | picture.clear
            passes = [Pass(Purpose.CAMERA, picture.seen & (opaque | picture.mirror) | picture.clear)]
            if picture.mirror.any():
                # A geom that is there for its image alone is not rendered before the camera.
                rendered = rendered | picture.images
                passes.insert(0, Pass(Purpose.MIRROR, picture.images | picture.clear))
            for lamp in picture.lamps:
                passes += [Pass(Purpose.LAMP_MAP, lamp.casts), Pass(Purpose.LAMP_LIGHT, lamp.lights)]
        groups, site_groups = model.geom_group.copy(), model.site_group.copy()
        try:
            model.geom_group[:] = np.where(rendered, groups, CULLED)
            model.site_group[:] = np.where(last & picture.sites, site_groups, CULLED)
            flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = passes[0].purpose is Purpose.MIRROR
            # The sky is behind all underlays.
            flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = last
            super()._update(shot.data, shot.camera)
            skinned = None
            if picture.projection is not None:
                wanted = np.logical_or.reduce([each.geoms for each in passes if each.purpose.by_camera])
                skinned = self._skinned.put(self._scene, shot.data, picture.projection, wanted)
            self._meshes.show((shot.camera, last), passes, self._scene, skinned, underlay)
            self._render()
        finally:
            model.geom_group[:] = groups
            model.site_group[:] = site_groups
            flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1

    def _update(self, data: mujoco.MjData, camera: str) -> None:
        """Include everything, as surfaces need."""
        super()._update(data, camera)
        everything = Pass(Purpose.CAMERA, np.ones(self._model.ngeom, np.bool_))
        self._meshes.show("everything", [everything], self._scene)

    def _view(self, shot: Shot) -> bytes:
        """The bytes of all that a picture depends on beside textures, geoms and sites."""
        data, number = shot.data, self._model.camera(shot.camera).id
        fields = [getattr(self._model, name) for name in LOOK]
        fields += [data.cam_xpos[number], data.cam_xmat[number], data.light_xpos, data.light_xdir]
        return b"".join(field.tobytes() for field in fields)
