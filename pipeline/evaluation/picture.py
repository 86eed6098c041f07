"""What an episode looks like: its scene, its perturbed looks and its noise, rendered when it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import mujoco
import numpy as np

from pipeline.axes import AnyPerturbation, PixelPerturbation, RenderPerturbation, of_layer
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.evaluation.settings import VIEWS
from pipeline.evaluation.simulator import Observed
from pipeline.images.jpeg import to_policy
from pipeline.rendering.last_scene import LastScene
from pipeline.rendering.renderer import Renderer
from pipeline.types import Frame


class Picture:
    """Renders one scene after the other; episodes of the same meshes and textures share an OpenGL context."""

    def __init__(self) -> None:
        self._opened = LastScene()
        self._scene: mujoco.MjModel | str | None = None
        self._looks: Sequence[AnyPerturbation] | None = None
        self._changes = ExitStack()

    def show(self, scene: mujoco.MjModel | str) -> None:
        """Render from here on a model, or a scene's MJCF where the model is without its images."""
        if scene is not self._scene:
            self.restore()
            self._scene = scene

    def frame(self, view: str, observed: Observed, perturbations: Sequence[AnyPerturbation], step: int) -> Frame:
        """(256, 256, 3) uint8 RGB, turned by 180 degrees.

        Args:
            view: one of ``VIEWS``.
            perturbations: of the episode; the same sequence in all of it.
            step: how many steps were taken, for noise that is random.
        """
        renderer = self._with_looks(perturbations)
        state = np.concatenate([[0.0], observed.qpos, np.zeros(renderer.model.nv)])
        renderer.restore(state, observed.site_alpha)
        frame = renderer.frame(SCHEMA.views[VIEWS[view]].camera)
        for noise in of_layer(perturbations, PixelPerturbation):
            if VIEWS[view] in noise.views:
                frame = noise.apply(frame, step)
        return to_policy(frame)

    def restore(self) -> None:
        """Undo an episode's looks."""
        self._changes.close()
        self._looks = None

    def close(self) -> None:
        self.restore()
        self._scene = None
        self._opened.close()

    def _with_looks(self, perturbations: Sequence[AnyPerturbation]) -> Renderer:
        if self._scene is None:
            raise PipelineError("no episode was started", remedy="reset first")
        if self._looks is not perturbations:
            self.restore()
        renderer = self._opened.renderer(self._scene)
        if self._looks is not perturbations:
            looks = of_layer(perturbations, RenderPerturbation)
            self._changes.enter_context(renderer.perturbed(looks))
            self._looks = perturbations
        return renderer
