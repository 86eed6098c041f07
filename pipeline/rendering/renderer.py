"""One scene through one OpenGL context."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes import RenderPerturbation
from pipeline.axes.base import FIELDS
from pipeline.episode_schema import SCHEMA
from pipeline.rendering.opengl import check, making_context
from pipeline.rendering.software.culling import Culling, Picture
from pipeline.rendering.software.layer import Layer
from pipeline.rendering.software.mesh_pieces import MeshPieces
from pipeline.rendering.software.samples import SAMPLES
from pipeline.rendering.software.skins import SKINS, Skins, bare
from pipeline.rendering.software.still import Still
from pipeline.rendering.software.textures import Textures
from pipeline.scenes.compiled import Images, compiled
from pipeline.types import Frame

_LOOK = tuple(name for name in FIELDS if name != "tex_data")
"""What a picture depends on in a model, of what may change, beside textures and where its geoms and sites are."""

_CULLED = mujoco.mjNGROUP - 1
"""A group of geoms and sites that nothing in LIBERO is in, and that is not drawn."""


class Surfaces(NamedTuple):
    """What each pixel shows, in the orientation of LIBERO's raw observations.

    Attributes:
        depth_m: (H, W) float32, along the axis that the camera looks along.
        number, kind: (H, W) the geom or site, by its number in the model and ``mujoco.mjtObj``; -1 for none.
    """

    depth_m: NDArray[np.float32]
    number: NDArray[np.int32]
    kind: NDArray[np.int32]


def _fixed(model: mujoco.MjModel) -> tuple[object, ...]:
    """What a GL context is made for once and for all: buffers, the fineness of round bodies, lines, fog and planes."""
    window, quality = model.vis.global_, model.vis.quality
    buffers = window.offwidth, window.offheight, quality.offsamples, quality.shadowsize
    fineness = quality.numslices, quality.numstacks, quality.numquads
    planes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    return *buffers, *fineness, window.linewidth, tuple(model.vis.rgba.fog), planes.tobytes()


def _shares(model: mujoco.MjModel) -> bool:
    """Whether a model can be shown by a GL context that was made for another one: not with what only that one's has."""
    planes = model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
    return not model.nhfield and not model.nskin and bool((planes[:, :2] > 0).all())


class Renderer:
    """Renders one scene through one GL context; close it before the next is made.

    Args:
        scene: its MJCF, or a compiled model, which belongs to the renderer from then on.
        images: of a model that was compiled without them.

    Raises:
        PipelineError: when nothing renders on this machine.
    """

    def __init__(self, scene: str | mujoco.MjModel, images: Images | None = None):
        software = gl.prepare().software
        height, width, _ = SCHEMA.frame.shape
        model = compiled(scene) if isinstance(scene, str) else scene
        # A context is made for what all scenes have alike, and then goes on with this one.
        first = bare(model, SKINS if software else 0) if _shares(model) else model
        with making_context():
            self._renderer = mujoco.Renderer(first, height, width, max_geom=1000)
        self._option = mujoco.MjvOption()
        # As robosuite's off-screen context: visual meshes without the collision geometry.
        self._option.geomgroup[0], self._option.geomgroup[1] = 0, 1
        self._option.geomgroup[_CULLED] = self._option.sitegroup[_CULLED] = 0
        hidden = np.flatnonzero(np.logical_not(self._option.geomgroup))
        self._renderer._gl_context.make_current()
        # On a GPU the geoms are no effort, and what would spare them is.
        layers = software and Layer.possible()
        self._culling_of = partial(Culling, height=height, width=width, hidden_groups=hidden.tolist(), layers=layers)
        self._still: dict[str, Still] = {}
        self._layers: dict[tuple[str, str], Layer] = {}
        self._show(first, images if first is model else None)
        if first is not model:
            self._show(model, images, self)

    def adopted(self, model: mujoco.MjModel, images: Images | None = None) -> bool:
        """Go on with another model in the same GL context, where the meshes and textures that both have stay.

        Returns:
            Whether that can be, and the model belongs to the renderer now; else nothing is changed. Where it raises,
            something is: the renderer has to be closed then.
        """
        if not _shares(model) or not _shares(self.model) or _fixed(model) != _fixed(self.model):
            return False
        self._renderer._gl_context.make_current()
        self._show(model, images, self)
        return True

    def _show(self, model: mujoco.MjModel, images: Images | None, former: Renderer | None = None) -> None:
        """Have the context show a model: the one that it was made for, or another one after a former."""
        context, scene = self._renderer._mjr_context, self._renderer.scene
        self.model, self.data, self._renderer._model = model, mujoco.MjData(model), model
        self._culling = self._culling_of(model)
        boxes = self._culling.boxes
        self._pieces: MeshPieces = MeshPieces(model, context, boxes, former._pieces if former else None)
        before = former._skins if former else None
        having = context.nskin == 2 * SKINS and context.offSamples == SAMPLES
        self._skins: Skins | None = Skins(model, context, scene, boxes, self._pieces, before) if having else None
        self._textures: Textures = Textures(model, context, former._textures if former else None, images)
        self._painted: NDArray[np.bool_] = np.zeros(model.ngeom, np.bool_)
        self._paint = b""
        self._forget_layers()
        # What a context keeps of a model's size, as mjr_makeContext works it out.
        context.shadowClip = model.stat.extent * model.vis.map.shadowclip
        context.shadowScale = model.vis.map.shadowscale
        context.fogStart = model.stat.extent * model.vis.map.fogstart
        context.fogEnd = model.stat.extent * model.vis.map.fogend

    def restore(self, state: NDArray[np.float64], site_alpha: NDArray[np.float32]) -> None:
        """Put the scene into a stored state (S,) with its sites' opacity (nsite,)."""
        nq, nv = self.model.nq, self.model.nv
        self.data.time = state[0]
        self.data.qpos[:] = state[1 : 1 + nq]
        self.data.qvel[:] = state[1 + nq : 1 + nq + nv]
        self.model.site_rgba[:, 3] = site_alpha
        mujoco.mj_forward(self.model, self.data)

    def frame(self, camera: str) -> Frame:
        """(H, W, 3) uint8 RGB of the restored state in the orientation of LIBERO's raw observations."""
        self._renderer._gl_context.make_current()
        picture = self._culling.picture(self.data, camera)
        if picture.layers:
            self._draw_layers(picture, camera)
        else:
            self._draw(picture, picture.opaque, camera)
        frame = np.empty(SCHEMA.frame.shape, np.uint8)
        mujoco.mjr_readPixels(frame, None, self._renderer._rect, self._renderer._mjr_context)
        check("mjr_readPixels")
        return frame

    def _draw_layers(self, picture: Picture, camera: str) -> None:
        """Draw a picture with a layer of what no chosen texture is on, or of what stands still."""
        view, places = self._view(camera), self._places()
        opaque = picture.opaque & ~picture.mirror
        painted = opaque & self._painted
        # What lamps with shadows light is drawn once more for each of them, so that little is gained.
        if painted.any() and not picture.shadows:
            rest = opaque & ~painted
            content = view + rest.tobytes() + places[rest].tobytes()
            draw = partial(self._draw_beside_still, picture, rest, camera, view, places, last=False)
            self._draw(picture, painted, camera, [self._layer(camera, "not painted", content, draw)])
        else:
            self._draw_beside_still(picture, opaque, camera, view + self._paint, places)

    def _draw_beside_still(
        self,
        picture: Picture,
        opaque: NDArray[np.bool_],
        camera: str,
        view: bytes,
        places: NDArray[np.float32],
        last: bool = True,
    ) -> None:
        """Draw opaque geoms of a picture; those that stand still are a layer."""
        if camera not in self._still:
            self._still[camera] = Still(self.model)
        still = self._still[camera].geoms(view, places, opaque) & opaque
        layers = []
        if still.any():
            content = view + still.tobytes() + places[still].tobytes()
            layers = [self._layer(camera, "still", content, partial(self._draw, picture, still, camera, last=False))]
        self._draw(picture, opaque & ~still, camera, layers, last)

    def _layer(self, camera: str, name: str, content: bytes, draw: Callable[[], None]) -> Layer:
        """A layer of a camera's pictures; it is drawn if its content is not what it was."""
        if (camera, name) not in self._layers:
            context, height, width = self._renderer._mjr_context, self._renderer.height, self._renderer.width
            self._layers[camera, name] = Layer(context, height, width)
        layer, flags = self._layers[camera, name], self._renderer.scene.flags
        if layer.content != content:
            # The sky is behind all layers.
            sky, flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = flags[mujoco.mjtRndFlag.mjRND_SKYBOX], False
            # The light of lamps with shadows is added to a picture afterwards.
            active = self.model.light_active.copy()
            self.model.light_active[self.model.light_castshadow != 0] = 0
            try:
                draw()
            finally:
                flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = sky
                self.model.light_active[:] = active
            layer.keep(content)
        return layer

    def _draw(
        self,
        picture: Picture,
        opaque: NDArray[np.bool_],
        camera: str,
        layers: Sequence[Layer] = (),
        last: bool = True,
    ) -> None:
        """Draw opaque geoms (ngeom,) of a picture, over layers, into the emptied off-screen buffer.

        Args:
            last: with what no layer has: the mirror and what shows in it, what can be seen through, the sites, and
                the light of lamps with shadows.
        """
        of, main, drawn = self._culling.boxes.geom, picture.seen & opaque[self._culling.boxes.geom], opaque
        before, after = [], []
        reflections = last and bool(picture.mirror.any())
        if last:
            beside = picture.mirror | picture.clear
            main = main | picture.seen & beside[of] | picture.clear[of]
            drawn, after = opaque | beside, [*picture.shadows]
        if after:
            # Lamps light what is in the layers, too.
            drawn = drawn | picture.opaque
        if reflections:
            # A geom that is there for its image alone has no piece before the camera to draw.
            drawn[of[picture.images]] = True
            before = [picture.images | picture.clear[of]]
        groups, site_groups, scene = self.model.geom_group.copy(), self.model.site_group.copy(), self._renderer.scene
        try:
            self.model.geom_group[:] = np.where(drawn, groups, _CULLED)
            self.model.site_group[:] = np.where(last & picture.sites, site_groups, _CULLED)
            scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = reflections
            self._renderer.update_scene(self.data, camera, self._option)
            skinned = None
            if self._skins is not None and picture.projection is not None:
                # Of the passes for a lamp every second is drawn as the camera sees it.
                wanted = np.logical_or.reduce([main, *after[1::2]])
                skinned = self._skins.put(self.data, picture.projection, wanted)
            self._pieces.show((camera, last), [*before, main, *after], scene, len(before), layers, skinned)
            mujoco.mjr_render(self._renderer._rect, scene, self._renderer._mjr_context)
            check("mjr_render")
        finally:
            self.model.geom_group[:] = groups
            self.model.site_group[:] = site_groups

    def _view(self, camera: str) -> bytes:
        """All that a picture depends on beside textures, geoms and sites."""
        number, data, headlight = self.model.camera(camera).id, self.data, self.model.vis.headlight
        fields = [getattr(self.model, name) for name in _LOOK]
        fields += [data.cam_xpos[number], data.cam_xmat[number], data.light_xpos, data.light_xdir]
        fields += [headlight.ambient, headlight.diffuse, headlight.specular, np.array(headlight.active)]
        return b"".join(field.tobytes() for field in fields)

    def _places(self) -> NDArray[np.float32]:
        """(ngeom, 12) position and rotation of each geom, in the precision in which it is drawn."""
        places: NDArray[np.float32] = np.concatenate([self.data.geom_xpos, self.data.geom_xmat], axis=1)
        return places.astype(np.float32)

    def geoms(self, camera: str) -> NDArray[np.int32]:
        """(H, W) the geom that each pixel of :meth:`frame` shows, by its number in the model; -1 for none."""
        _, number, kind = self.surfaces(camera)
        return np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, -1)

    def surfaces(self, camera: str) -> Surfaces:
        """What each pixel of :meth:`frame` shows of the restored state."""
        self._renderer.enable_segmentation_rendering()
        self._renderer._gl_context.make_current()
        everything = np.ones(len(self._culling.boxes.geom), np.bool_)
        try:
            self._renderer.update_scene(self.data, camera, self._option)
            self._pieces.show("everything", [everything], self._renderer.scene)
            number, kind = np.moveaxis(self._renderer.render()[::-1], -1, 0)
            check("mjr_render")
        finally:
            self._renderer.disable_segmentation_rendering()
        # The depth buffer still has what was drawn last: one drawing serves both.
        buffer = np.empty(number.shape, np.float32)
        mujoco.mjr_readPixels(None, buffer, self._renderer._rect, self._renderer._mjr_context)
        check("mjr_readPixels")
        near, far = np.array([self.model.vis.map.znear, self.model.vis.map.zfar]) * self.model.stat.extent
        # MuJoCo's buffer is 1 at the near plane and 0 at the far one, as mujoco.Renderer inverts it.
        depth_m = near * far / (near + buffer.astype(float) * (far - near))
        return Surfaces(depth_m.astype(np.float32), number, kind)

    @contextmanager
    def perturbed(self, perturbations: Sequence[RenderPerturbation]) -> Iterator[None]:
        """Apply render-layer perturbations to the model for a moment."""
        written = {name for perturbation in perturbations for name in perturbation.fields}
        saved = {name: getattr(self.model, name).copy() for name in written - {"tex_data"}}
        painted = "tex_data" in written
        if painted:
            self._textures.keep()
        former: dict[int, NDArray[np.uint8]] = {}
        try:
            try:
                for perturbation in perturbations:
                    self._apply(perturbation)
            finally:
                former = self._textures.former() if painted else {}
            self._upload(former)
            yield
        finally:
            for name, value in saved.items():
                getattr(self.model, name)[:] = value
            self._textures.put_back(former)
            self._upload(former)

    def _apply(self, perturbation: RenderPerturbation) -> None:
        """Apply a perturbation; what paints writes into the model with its images, which may be another one."""
        if "tex_data" not in perturbation.fields:
            perturbation.apply(self.model)
            return
        painted, others = self._textures.model, [name for name in perturbation.fields if name != "tex_data"]
        for name in others:
            getattr(painted, name)[:] = getattr(self.model, name)
        perturbation.apply(painted)
        for name in others:
            getattr(self.model, name)[:] = getattr(painted, name)

    def _upload(self, textures: Collection[int]) -> None:
        if textures:
            self._renderer._gl_context.make_current()
            self._textures.upload(textures)
            self._forget_layers()

    @contextmanager
    def painted(self, choices: Sequence[Sequence[RenderPerturbation]]) -> Iterator[list[Callable[[], None]]]:
        """Hold the textures of several choices at once; what they are not on is drawn once for all of them.

        Args:
            choices: for each, perturbations that write textures and nothing else.

        Returns:
            A function for each choice, after which frames show it.
        """

        def show(names: Mapping[int, int]) -> None:
            self._textures.show(names)
            self._paint = repr(names).encode()

        self._renderer._gl_context.make_current()
        with self._textures.held(choices) as held:
            if len(choices) > 1:
                self._painted = self._textures.geoms_with({texture for names in held for texture in names})
            try:
                yield [partial(show, names) for names in held]
            finally:
                self._painted, self._paint = np.zeros_like(self._painted), b""
                self._forget_layers()
                self._renderer._gl_context.make_current()

    def _forget_layers(self) -> None:
        self._still.clear()
        for layer in self._layers.values():
            layer.content = b""

    def close(self) -> None:
        self._renderer.close()
