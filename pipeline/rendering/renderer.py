"""Renderer of one scene in stored states, with perturbations; the last scene stays open for the next piece of work."""

import atexit
import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.axes import RenderPerturbation
from pipeline.episode_schema import SIZE_PX
from pipeline.rendering.model_renderer import ModelRenderer, Surfaces
from pipeline.rendering.plain_renderer import texels
from pipeline.rendering.savings import create_model_renderer
from pipeline.scenes.compiled import compile_model
from pipeline.types import Frame, State


class Renderer:
    """Renderer of one scene; close it before you create the next renderer.

    Args:
        scene: the scene's MJCF, or a compiled model, which then belongs to the renderer.
        model_renderer: an open ``ModelRenderer`` of the model; by default it is created.
        size_px: height and width of the frames; an open ``ModelRenderer`` has its own.

    Attributes:
        site_alpha: (nsite,) the sites' opacity in the first state.
    """

    def __init__(
        self, scene: str | mujoco.MjModel, model_renderer: ModelRenderer | None = None, size_px: int = SIZE_PX
    ):
        self.model = compile_model(scene) if isinstance(scene, str) else scene
        self.site_alpha = self.model.site_rgba[:, 3].copy()
        self.data = mujoco.MjData(self.model)
        self.model_renderer = model_renderer or create_model_renderer(self.model, size_px)
        self._perturbations: tuple[RenderPerturbation, ...] = ()

    def restore(self, state: NDArray[np.float64], site_alpha: NDArray[np.float32]) -> None:
        """Put the scene into a stored state (S,) with its sites' opacity (nsite,)."""
        State.of(state, self.model.nq).put_into(self.data)
        self.model.site_rgba[:, 3] = site_alpha
        mujoco.mj_forward(self.model, self.data)

    def has_camera(self, camera: str) -> bool:
        """Return whether the scene has a camera of this name."""
        return bool(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, camera) >= 0)

    def frame(self, camera: str) -> Frame:
        """Render a frame (H, W, 3) of uint8 RGB of the restored state, oriented like LIBERO's raw observations."""
        return self.model_renderer.frame(self.data, camera)

    def start_frame(self, camera: str) -> Callable[[], Frame]:
        """Start to render :meth:`frame` of the restored state, and return a function that waits for the frame.

        Another state may be restored meanwhile.
        """
        return self.model_renderer.start_frame(self.data, camera)

    def surfaces(self, camera: str) -> Surfaces:
        """Render the depth, and the geom or site, of each pixel of :meth:`frame` in the restored state."""
        return self.model_renderer.surfaces(self.data, camera)

    def geoms(self, camera: str) -> NDArray[np.int32]:
        """Return for each pixel of :meth:`frame`, (H, W), its geom's number in the model; -1 without a geom."""
        _, number, kind = self.surfaces(camera)
        return np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, -1)

    @contextmanager
    def perturbed(self, perturbations: Sequence[RenderPerturbation]) -> Iterator[None]:
        """Apply render-layer perturbations to the model, and undo them at the end.

        If these perturbations are applied already, by an outer call, do nothing.
        """
        if tuple(perturbations) == self._perturbations:
            yield
            return
        outer = self._perturbations
        fields: set[str] = set()
        for perturbation in perturbations:
            fields.update(perturbation.fields)
        former = {name: getattr(self.model, name).copy() for name in fields}
        textures: dict[int, NDArray[np.uint8]] = {}
        try:
            for perturbation in perturbations:
                perturbation.apply(self.model)
            if "tex_data" in former:
                # All textures take up to 190 MB, and a perturbation changes few of them.
                textures = self._replaced_textures(former["tex_data"])
                del former["tex_data"]
            self.model_renderer.load(textures.keys())
            self._perturbations = tuple(perturbations)
            yield
        finally:
            self._perturbations = outer
            for name, values in former.items():
                getattr(self.model, name)[:] = values
            for texture, values in textures.items():
                texels(self.model)[texture][:] = values
            self.model_renderer.load(textures.keys())

    def _replaced_textures(self, former: NDArray[np.uint8]) -> dict[int, NDArray[np.uint8]]:
        """Return a copy of each texture of a former ``tex_data`` that differs from the model's texture now."""
        pairs = zip(texels(self.model), texels(self.model, former), strict=True)
        return {number: before.copy() for number, (now, before) in enumerate(pairs) if not np.array_equal(now, before)}

    def close(self) -> None:
        self.model_renderer.close()


class LastScene:
    """Holder of the open renderer; at most one renderer is open at a time.

    Repeated requests for a scene return its renderer. A request for another scene returns a new renderer. It takes over
    the ``ModelRenderer`` and its OpenGL context if ``adopt`` accepts the scene.
    """

    def __init__(self) -> None:
        self._model_renderer: ModelRenderer | None = None
        self._renderer: Renderer | None = None
        self._scene: str | mujoco.MjModel | None = None

    def renderer(self, scene: str | mujoco.MjModel, size_px: int = SIZE_PX) -> Renderer:
        """Return the renderer of a scene.

        A request for another scene or size makes the returned renderer unusable, so leave ``Renderer.perturbed``
        before. After an error, no scene is open.

        Args:
            scene: the scene's MJCF, or a compiled model, which must not change while its renderer is used.
            size_px: height and width of the frames.

        Raises:
            PipelineError: if this machine cannot render.
            ValueError: if MuJoCo rejects the scene or one of its images.
        """
        is_scene = scene is self._scene or (isinstance(scene, str) and scene == self._scene)
        has_size = self._model_renderer is not None and self._model_renderer.size_px == size_px
        if self._renderer is not None and is_scene and has_size:
            return self._renderer
        try:
            if self._model_renderer is not None and has_size and self._model_renderer.adopts:
                # A model takes 200 to 300 MB; the former model is freed before the next one is compiled.
                self._renderer = self._scene = None
                self._model_renderer.release()
            else:
                self.close()
            self._renderer = self._opened(compile_model(scene) if isinstance(scene, str) else copy.copy(scene), size_px)
        except BaseException:
            # The context may have parts of both scenes now.
            self.close()
            raise
        self._scene = scene
        return self._renderer

    def _opened(self, model: mujoco.MjModel, size_px: int) -> Renderer:
        """Open the renderer of a model in the context of the former model if possible, otherwise in a new context."""
        if self._model_renderer is not None and self._model_renderer.adopt(model):
            return Renderer(model, self._model_renderer)
        self.close()
        renderer = Renderer(model, size_px=size_px)
        self._model_renderer = renderer.model_renderer
        # If the process ends with the scene open, this runs before MuJoCo's own exit handler shuts OpenGL down.
        atexit.register(self.close)
        return renderer

    def close(self) -> None:
        self._renderer = self._scene = None
        if self._model_renderer is not None:
            atexit.unregister(self.close)
            self._model_renderer.close()
            self._model_renderer = None


@functools.cache
def scene_of_process() -> LastScene:
    """Return this process's ``LastScene``, which stays open between pieces of work; close it after the last one."""
    return LastScene()
