"""Keeps the last scene open, for the next piece of work that needs the same one."""

from __future__ import annotations

import atexit
import copy
import functools

import mujoco

from pipeline.rendering.renderer import Renderer
from pipeline.scenes.compiled import compiled


class LastScene:
    """Holds one open renderer at a time.

    The next request for the same scene gets the same renderer. A request for another scene gets a new one, which takes
    over the drawing and its OpenGL context if the drawing can ``adopt`` the scene.
    """

    def __init__(self) -> None:
        self._renderer: Renderer | None = None
        self._scene: str | mujoco.MjModel | None = None

    def renderer(self, scene: str | mujoco.MjModel) -> Renderer:
        """The renderer of a scene, by its MJCF or by a compiled model, which must not change meanwhile.

        It is no longer to be used when another scene was asked for. PipelineError when nothing renders on this machine.
        ValueError when MuJoCo refuses the scene or one of its images.
        """
        same = scene is self._scene or (isinstance(scene, str) and scene == self._scene)
        if self._renderer is not None and same:
            return self._renderer
        model = compiled(scene) if isinstance(scene, str) else copy.copy(scene)
        try:
            adopted = self._renderer is not None and self._renderer.drawing.adopt(model)
        except BaseException:
            # It holds parts of both scenes now.
            self.close()
            raise
        if self._renderer is not None and adopted:
            self._renderer = Renderer(model, self._renderer.drawing)
        else:
            self.close()
            self._renderer = Renderer(model)
            # If the process ends with the scene open, this runs before MuJoCo's own exit handler shuts OpenGL down.
            atexit.register(self.close)
        self._scene = scene
        return self._renderer

    def close(self) -> None:
        if self._renderer is not None:
            atexit.unregister(self.close)
            self._renderer.close()
            self._renderer = self._scene = None


@functools.cache
def scene_of_process() -> LastScene:
    """The one of this process, open from one piece of work to the next; whoever has no more work closes it."""
    return LastScene()
