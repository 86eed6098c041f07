"""One scene: put into stored states, perturbed, and drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.axes import RenderPerturbation
from pipeline.rendering.drawing import Drawing, SideBySide, Surfaces
from pipeline.rendering.savings import drawing_of
from pipeline.scenes.compiled import compiled
from pipeline.types import Frame


class Renderer:
    """Renders one scene; close it before the next is made.

    Args:
        scene: its MJCF, or a compiled model, which belongs to the renderer from then on.
        drawing: draws the model already; by default one is made.

    Raises:
        PipelineError: when nothing renders on this machine.
    """

    def __init__(self, scene: str | mujoco.MjModel, drawing: Drawing | None = None):
        self.model = compiled(scene) if isinstance(scene, str) else scene
        self.data = mujoco.MjData(self.model)
        self.drawing: Drawing = drawing or drawing_of(self.model)

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
        return self.drawing.frame(self.data, camera)

    def surfaces(self, camera: str) -> Surfaces:
        """What each pixel of :meth:`frame` shows of the restored state."""
        return self.drawing.surfaces(self.data, camera)

    def geoms(self, camera: str) -> NDArray[np.int32]:
        """(H, W) the geom that each pixel of :meth:`frame` shows, by its number in the model; -1 for none."""
        _, number, kind = self.surfaces(camera)
        return np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, -1)

    @contextmanager
    def perturbed(self, perturbations: Sequence[RenderPerturbation]) -> Iterator[list[int]]:
        """Apply render-layer perturbations to the model for a moment.

        Returns:
            The textures that they changed.
        """
        fields = {name for perturbation in perturbations for name in perturbation.fields}
        former = {name: getattr(self.model, name).copy() for name in fields}
        painted: list[int] = []
        try:
            for perturbation in perturbations:
                perturbation.apply(self.model)
            if "tex_data" in former:
                painted = self._textures_unlike(former["tex_data"])
            self.drawing.load(painted)
            yield painted
        finally:
            for name, values in former.items():
                getattr(self.model, name)[:] = values
            self.drawing.load(painted)

    @contextmanager
    def painted(self, choices: Sequence[Sequence[RenderPerturbation]]) -> Iterator[list[Callable[[], None]]]:
        """Show one of several choices of textures or another.

        Args:
            choices: for each, perturbations that write textures and nothing else. A drawing that holds none side by
                side gets one.

        Returns:
            A function for each choice, after which frames show it.
        """
        if len(choices) == 1:
            with self.perturbed(choices[0]):
                yield [lambda: None]
            return
        if not isinstance(self.drawing, SideBySide):
            raise TypeError(f"{type(self.drawing).__name__} holds one choice of textures, not {len(choices)}")
        shows = []
        try:
            for choice in choices:
                with self.perturbed(choice) as textures:
                    shows.append(self.drawing.hold(textures))
            yield shows
        finally:
            self.drawing.let_go()

    def _textures_unlike(self, former: NDArray[np.uint8]) -> list[int]:
        """The textures whose bytes are not what they were in a former ``tex_data``."""
        model = self.model
        ends = model.tex_adr + model.tex_height * model.tex_width * model.tex_nchannel
        slices = map(slice, model.tex_adr, ends)
        return [n for n, texels in enumerate(slices) if not np.array_equal(model.tex_data[texels], former[texels])]

    def close(self) -> None:
        self.drawing.close()
