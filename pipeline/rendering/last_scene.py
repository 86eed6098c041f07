"""Scenes one after the other, of which the last stays open."""

from __future__ import annotations

import atexit
import copy
import functools

import mujoco

from pipeline.rendering.renderer import Renderer
from pipeline.scenes.compiled import compiled


class LastScene:
    """Keeps the renderer of the last scene open for whoever asks for the same scene next, and its drawing for whoever
    asks for another one that it can go on with; only one is open at a time."""

    def __init__(self) -> None:
        self._renderer: Renderer | None = None
        self._scene: str | mujoco.MjModel | None = None

    def renderer(self, scene: str | mujoco.MjModel) -> Renderer:
        """The renderer of a scene, by its MJCF or by a compiled model, which must not change meanwhile.

        It is no longer to be used when another scene was asked for.

        Raises:
            PipelineError: when nothing renders on this machine.
            ValueError: when MuJoCo refuses the scene or one of its images.
        """
        if self._renderer is None or not self._is_last(scene):
            model = compiled(scene) if isinstance(scene, str) else copy.copy(scene)
            drawing = self._renderer.drawing if self._renderer and self._adopted(self._renderer, model) else None
            if drawing is None:
                self.close()
                # Of a process that ends before anyone is done, MuJoCo ends OpenGL, after what is registered later.
                self._renderer = Renderer(model)
                atexit.register(self.close)
            else:
                self._renderer = Renderer(model, drawing)
            self._scene = scene
        return self._renderer

    def _adopted(self, renderer: Renderer, model: mujoco.MjModel) -> bool:
        try:
            return renderer.drawing.adopt(model)
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
