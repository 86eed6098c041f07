"""Scenes one after the other through one OpenGL context, as long as they are alike."""

from __future__ import annotations

import atexit
import copy
import functools

import mujoco

from pipeline.rendering.renderer import Renderer
from pipeline.scenes.compiled import compiled


class LastScene:
    """Keeps the renderer of the last scene open for whoever asks for the same scene next, or for one of the same
    meshes and textures; only one is open at a time.

    To compile a scene takes a second on one core, and to open its context two.
    """

    def __init__(self) -> None:
        self._renderer: Renderer | None = None
        self._scene: str | mujoco.MjModel | None = None

    def renderer(self, scene: str | mujoco.MjModel) -> Renderer:
        """The renderer of a scene, by its MJCF or by a compiled model, which must not change meanwhile.

        Raises:
            PipelineError: when nothing renders on this machine.
        """
        if self._renderer is None or not self._is_last(scene):
            model = compiled(scene) if isinstance(scene, str) else copy.copy(scene)
            if self._renderer is None or not self._renderer.adopted(model):
                self.close()
                self._renderer = Renderer(model)
                # Of a process that ends before anyone is done, MuJoCo ends OpenGL, after what is registered later.
                atexit.register(self.close)
            self._scene = scene
        return self._renderer

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
