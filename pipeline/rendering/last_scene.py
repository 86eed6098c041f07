"""Scenes one after the other through one OpenGL context, as long as they are alike."""

from __future__ import annotations

import atexit
import copy
import functools

import mujoco

from pipeline.rendering.renderer import Renderer
from pipeline.scenes.compiled import Images, physics_of


class LastScene:
    """Keeps the renderer of the last scene open for whoever asks for the same scene next, or for another one, which
    goes on in the same OpenGL context; only one is open at a time.

    To open the first scene takes 4 s on one core, and another one with the same images 0.5 s.
    """

    def __init__(self) -> None:
        self._renderer: Renderer | None = None
        self._scene: str | mujoco.MjModel | None = None

    def renderer(self, scene: str | mujoco.MjModel) -> Renderer:
        """The renderer of a scene, by its MJCF or by a compiled model, which must not change meanwhile.

        Raises:
            PipelineError: when nothing renders on this machine.
            ValueError: when MuJoCo refuses the scene or one of its images; the next scene gets another context.
        """
        if self._renderer is None or not self._is_last(scene):
            # Of its images, a new scene mostly needs none: the context has them.
            images = Images(scene) if isinstance(scene, str) else None
            model = physics_of(scene) if isinstance(scene, str) else copy.copy(scene)
            if self._renderer is None or not self._adopted(self._renderer, model, images):
                self.close()
                self._renderer = Renderer(model, images)
                # Of a process that ends before anyone is done, MuJoCo ends OpenGL, after what is registered later.
                atexit.register(self.close)
            self._scene = scene
        return self._renderer

    def _adopted(self, renderer: Renderer, model: mujoco.MjModel, images: Images | None) -> bool:
        try:
            return renderer.adopted(model, images)
        except BaseException:
            # It shows something of both scenes now.
            self.close()
            raise

    def _is_last(self, scene: str | mujoco.MjModel) -> bool:
        return scene is self._scene or (isinstance(scene, str) and scene == self._scene)

    def close(self) -> None:
        if self._renderer is not None:
            atexit.unregister(self.close)
            self._renderer.close()
            self._renderer = self._scene = None


@functools.cache
def scene_of_process() -> LastScene:
    """The one that this process keeps open from one piece of work to the next; whoever is done closes it."""
    return LastScene()
