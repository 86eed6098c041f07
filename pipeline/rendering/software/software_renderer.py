"""Rendering of the pixels of ``PlainRenderer`` with less work for Mesa, and of successive scenes in one context.

* Geoms outside of the view are not rendered (``culling.py``).
* Large meshes are rendered only by their faces that cover a sample (``skins.py``, ``samples.py``).
* Geoms that stand still before a camera are rendered once; their colour and depth are kept as an underlay (``Still``).
* Meshes and textures that a scene shares with the previous scene stay in the context.
"""

from collections.abc import Collection
from contextlib import ExitStack
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.axes.base import FIELDS
from pipeline.episode_schema import SIZE_PX
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.software.culling import Culling, Picture
from pipeline.rendering.software.mujoco_3_2_7 import context as private
from pipeline.rendering.software.mujoco_3_2_7.meshes import Meshes
from pipeline.rendering.software.mujoco_3_2_7.passes import Pass, Purpose
from pipeline.rendering.software.mujoco_3_2_7.skins import Skins
from pipeline.rendering.software.mujoco_3_2_7.underlays import Underlay
from pipeline.rendering.software.samples import SAMPLES
from pipeline.rendering.software.skins import SkinnedMeshes

LOOK = tuple(name for name in FIELDS if name != "tex_data")
"""Arrays of a model, without textures, that perturbations may change and on which a picture depends."""

CULLED = mujoco.mjNGROUP - 1
"""A group of geoms and sites that LIBERO does not use and that is never rendered."""

LONGEST_WAIT = 16
"""Largest number of pictures for which a geom must stand still before it joins the underlay."""


class Shot(NamedTuple):
    """Picture to render: the state, the camera, and the geoms, lights and sites to render."""

    data: mujoco.MjData
    camera: str
    picture: Picture


class Still:
    """Choice of the geoms of one camera's underlay.

    An underlay has to be rendered again when one of its geoms moves, and an object at rest moves by a millionth now and
    then. Each time a geom leaves the underlay, it therefore has to stand still for twice as many pictures to join
    again. Geoms join once rendering them in addition to the underlay has cost more faces than a new underlay would
    have.
    """

    def __init__(self, model: mujoco.MjModel):
        meshes = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)
        self._faces = np.where(meshes >= 0, np.append(model.mesh_facenum, 0)[meshes], 12)
        self._wait: NDArray[np.intp] = np.ones(model.ngeom, np.intp)
        self._view = b""

    def geoms(self, view: bytes, places: NDArray[np.float32], rendered: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Choose the geoms of the underlay for the next picture, a mask (ngeom,).

        Args:
            view: bytes of the camera, the lamps and all other data on which a picture depends, without the geoms.
            places: (ngeom, 12) positions and rotations of the geoms, as they are rendered.
            rendered: (ngeom,) geoms that are to be rendered.
        """
        if view != self._view:
            self._view, self._places = view, places
            self._geoms: NDArray[np.bool_] = np.zeros(len(places), np.bool_)
            self._age: NDArray[np.intp] = np.zeros(len(places), np.intp)
            self._extra_faces = 0
            return self._geoms
        stood_still = (places == self._places).all(axis=1)
        self._places = places
        leaving = self._geoms & ~stood_still
        self._wait[leaving] = np.minimum(2 * self._wait[leaving], LONGEST_WAIT)
        self._age = np.where(stood_still, self._age + 1, 0)
        ready = rendered & (self._age >= self._wait)
        self._extra_faces += int(self._faces[ready & ~self._geoms].sum())
        if leaving.any() or self._extra_faces > self._faces[ready].sum():
            self._geoms, self._extra_faces = ready, 0
        return self._geoms


class SoftwareRenderer(PlainRenderer):
    """Rendering of models that are ``possible``, with all savings.

    Attributes:
        chooses_faces: True renders large meshes by the faces that cover a sample; False renders all meshes whole.

    Raises:
        PipelineError: if OpenGL reports an error.
    """

    chooses_faces = True
    adopts = True

    def __init__(self, model: mujoco.MjModel, size_px: int = SIZE_PX):
        # Create the context for the common parts of all scenes, and then switch it to this model.
        self._bare, self._fixed = private.bare(model), private.fixed(model)
        super().__init__(self._bare, size_px)
        with ExitStack() as undo:
            undo.callback(self.close)
            self._skins, self._samples = Skins(self._context, self._scene), private.samples(SAMPLES)
            self._textures = private.textures_of(self._bare)
            self._meshes = Meshes(self._context, self._bare, [])
            nothing = np.zeros(self._bare.ngeom, np.bool_)
            self._skinned = SkinnedMeshes(self._skins, self._samples, self._bare, self._meshes, nothing)
            self._still: dict[str, Still] = {}
            self._underlays: dict[str, Underlay] = {}
            self._show(model)
            undo.pop_all()

    @staticmethod
    def possible(model: mujoco.MjModel) -> bool:
        """Return whether this class can render a model, which must not need its own context.

        A model needs its own context for height fields, skins, planes without bounds, or a number of samples other than
        ``SAMPLES``. LIBERO's models have none of these.
        """
        bounded = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] > 0
        return not model.nhfield and not model.nskin and bool(bounded.all()) and model.vis.quality.offsamples == SAMPLES

    def adopt(self, model: mujoco.MjModel) -> bool:
        """Switch to another model in this context if possible, and return whether it was."""
        if not self.possible(model) or private.fixed(model) != self._fixed:
            return False
        self._gl.make_current()
        self._show(model)
        return True

    def release(self) -> None:
        """Drop the reference to the model; the context keeps its meshes and textures."""
        self._model = self._bare
        del self._culling

    def _show(self, model: mujoco.MjModel) -> None:
        """Replace the former model in the context; meshes and textures of both models stay."""
        former, self._textures = self._textures, private.textures_of(model)
        private.adopt_textures(self._context, model, self._textures, former)
        private.adopt_size(self._context, model)
        self._model = model
        hidden_groups = np.flatnonzero(np.logical_not(self._option.geomgroup)).tolist()
        self._culling = Culling(model, hidden_groups, self.size_px)
        shown = self._culling.shown
        rendered = np.unique(model.geom_dataid[shown & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)]).tolist()
        self._meshes = Meshes(self._context, model, rendered, self._meshes)
        by_faces = shown & self.chooses_faces
        self._skinned = SkinnedMeshes(self._skins, self._samples, model, self._meshes, by_faces, self._skinned)
        self._forget_underlays()

    def load(self, textures: Collection[int]) -> None:
        """Upload these textures from the model's ``tex_data``, and forget all underlays, which show the old ones."""
        super().load(textures)
        for texture in textures:
            self._textures[texture] = private.texture_of(self._model, texture)
        if textures:
            self._forget_underlays()

    def _forget_underlays(self) -> None:
        """Mark all underlays as out of date."""
        self._still.clear()
        for underlay in self._underlays.values():
            underlay.content = b""

    def _render_frame(self, data: mujoco.MjData, camera: str) -> None:
        """Render a picture like ``PlainRenderer``, with savings."""
        shot = Shot(data, camera, self._culling.picture(data, camera))
        if shot.picture.underlaid:
            self._render_over_still(shot)
        else:
            self._render_geoms(shot, shot.picture.opaque)

    def _render_over_still(self, shot: Shot) -> None:
        """Render a picture over an underlay of the geoms that stand still."""
        camera, opaque = shot.camera, shot.picture.opaque & ~shot.picture.mirror
        view = self._view(shot)
        places = np.concatenate([shot.data.geom_xpos, shot.data.geom_xmat], axis=1).astype(np.float32)
        if camera not in self._still:
            self._still[camera] = Still(self._model)
        # MuJoCo renders a geom of the mirror image in the camera's pass too, unless it is a mesh.
        mirrored = shot.picture.images & (self._model.geom_type != mujoco.mjtGeom.mjGEOM_MESH)
        still = self._still[camera].geoms(view, places, opaque) & opaque & ~mirrored
        underlay = None
        if still.any():
            if camera not in self._underlays:
                self._underlays[camera] = Underlay(self._context, self._rectangle.height, self._rectangle.width)
            underlay, content = self._underlays[camera], view + still.tobytes() + places[still].tobytes()
            if underlay.content != content:
                self._render_geoms(shot, still, last=False)
                underlay.keep(content)
        self._render_geoms(shot, opaque & ~still, underlay)
        if underlay is not None and underlay.ties():
            # At equal depth, the geom that MuJoCo renders last shows. An underlay does not know this order.
            self._render_geoms(shot, opaque)

    def _render_geoms(
        self, shot: Shot, opaque: NDArray[np.bool_], underlay: Underlay | None = None, last: bool = True
    ) -> None:
        """Render opaque geoms of a picture over an underlay.

        Args:
            shot: the picture.
            opaque: (ngeom,) the geoms.
            underlay: the underlay, or ``None``.
            last: True completes the picture with all parts that no underlay has: mirror, transparent geoms, sites,
                shadows and sky.
        """
        model, picture, flags = self._model, shot.picture, self._scene.flags
        rendered, passes = opaque, [Pass(Purpose.CAMERA, picture.seen & opaque)]
        if last:
            rendered = opaque | picture.mirror | picture.clear
            passes = [Pass(Purpose.CAMERA, picture.seen & (opaque | picture.mirror) | picture.clear)]
            if picture.mirror.any():
                # Geoms that show only in the mirror are rendered in the mirror's pass, not in the camera's.
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
                camera_passes = [single_pass for single_pass in passes if single_pass.purpose.by_camera]
                wanted = np.logical_or.reduce([single_pass.geoms for single_pass in camera_passes])
                skinned = self._skinned.put(self._scene, shot.data, picture.projection, wanted)
            self._meshes.show((shot.camera, last), passes, self._scene, skinned, underlay)
            self._render()
        finally:
            model.geom_group[:] = groups
            model.site_group[:] = site_groups
            flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1

    def _update(self, data: mujoco.MjData, camera: str) -> None:
        """Update the scene with everything in it, for ``surfaces``."""
        super()._update(data, camera)
        everything = Pass(Purpose.CAMERA, np.ones(self._model.ngeom, np.bool_))
        self._meshes.show("everything", [everything], self._scene)

    def _view(self, shot: Shot) -> bytes:
        """Return the bytes of all data on which a picture depends, without textures, geoms and sites."""
        data, number = shot.data, self._model.camera(shot.camera).id
        fields = [getattr(self._model, name) for name in LOOK]
        fields += [data.cam_xpos[number], data.cam_xmat[number], data.light_xpos, data.light_xdir]
        return b"".join(field.tobytes() for field in fields)
