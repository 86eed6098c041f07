"""Rendering of a scene by MuJoCo's public functions alone.

Subclasses of ``PlainRenderer`` (``savings.py``) must render equal pixels.
"""

from collections.abc import Collection
from contextlib import ExitStack

import mujoco
import numpy as np
from mujoco import gl_context
from numpy.typing import NDArray

from pipeline import gl
from pipeline.episode_schema import SIZE_PX
from pipeline.rendering.model_renderer import ModelRenderer, Surfaces
from pipeline.rendering.opengl import check, making_context
from pipeline.types import Frame

MOST_GEOMS = 1000
"""Largest number of geoms, sites and other elements of a scene that MuJoCo renders; LIBERO's scenes have up to 300."""


def texels(model: mujoco.MjModel, tex_data: NDArray[np.uint8] | None = None) -> list[NDArray[np.uint8]]:
    """Return a view of each texture's part of a model's ``tex_data``, or of another array of this layout."""
    data = model.tex_data if tex_data is None else tex_data
    ends = model.tex_adr + model.tex_height * model.tex_width * model.tex_nchannel
    return [data[first:end] for first, end in zip(model.tex_adr, ends, strict=True)]


class PlainRenderer(ModelRenderer):
    """Rendering of a whole model by ``mjv_updateScene``, ``mjr_render`` and ``mjr_readPixels``."""

    def __init__(self, model: mujoco.MjModel, size_px: int = SIZE_PX):
        gl.prepare()
        self.size_px = size_px
        self._model, self._rectangle = model, mujoco.MjrRect(0, 0, size_px, size_px)
        # MuJoCo's off-screen buffer has 640 x 480 pixels by default.
        model.vis.global_.offheight = max(model.vis.global_.offheight, size_px)
        self._gl = gl_context.GLContext(size_px, size_px)
        with ExitStack() as undo:
            # The driver has a limited number of OpenGL contexts, so free the context after an error.
            undo.callback(self._gl.free)
            self._gl.make_current()
            with making_context():
                self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
                mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
            undo.pop_all()
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, MOST_GEOMS)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        # Render visual meshes without the collision geometry, like robosuite's off-screen context.
        self._option.geomgroup[0] = 0

    def frame(self, data: mujoco.MjData, camera: str) -> Frame:
        self._gl.make_current()
        self._render_frame(data, camera)
        return self._pixels()

    def surfaces(self, data: mujoco.MjData, camera: str) -> Surfaces:
        self._gl.make_current()
        groups = self._model.site_group.copy()
        # robosuite hides sites by a negative opacity. A segmentation would show all sites with an opacity other than 0.
        self._model.site_group[self._model.site_rgba[:, 3] <= 0] = mujoco.mjNGROUP - 1
        try:
            self._update(data, camera)
        finally:
            self._model.site_group[:] = groups
        # A segmentation renders each geom in the colour ``segid + 1``.
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            self._render()
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        colours = self._pixels().astype(np.uint32) @ np.array([1, 2**8, 2**16], np.uint32)
        object_of_colour = np.full((self._scene.ngeom + 1, 2), -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0:
                object_of_colour[geom.segid + 1] = geom.objid, geom.objtype
        buffer = np.empty(colours.shape, np.float32)
        mujoco.mjr_readPixels(None, buffer, self._rectangle, self._context)
        check("mjr_readPixels")
        near, far = np.array([self._model.vis.map.znear, self._model.vis.map.zfar]) * self._model.stat.extent
        # MuJoCo's buffer is 1 at the near plane and 0 at the far plane; mujoco.Renderer inverts it in the same way.
        depth_m = near * far / (near + buffer.astype(float) * (far - near))
        number, kind = np.moveaxis(object_of_colour[colours], -1, 0)
        return Surfaces(depth_m.astype(np.float32), number, kind)

    def load(self, textures: Collection[int]) -> None:
        self._gl.make_current()
        for texture in textures:
            mujoco.mjr_uploadTexture(self._model, self._context, texture)
            check("mjr_uploadTexture")

    def close(self) -> None:
        self._gl.free()
        self._context.free()

    def _render_frame(self, data: mujoco.MjData, camera: str) -> None:
        """Render a frame into the off-screen buffer of the current context."""
        self._update(data, camera)
        self._render()

    def _update(self, data: mujoco.MjData, camera: str) -> None:
        self._camera.fixedcamid = self._model.camera(camera).id
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, everything, self._scene)

    def _render(self) -> None:
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        check("mjr_render")

    def _pixels(self) -> Frame:
        frame = np.empty((self.size_px, self.size_px, 3), np.uint8)
        mujoco.mjr_readPixels(frame, None, self._rectangle, self._context)
        check("mjr_readPixels")
        return frame
