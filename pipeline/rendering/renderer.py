"""One scene: put into stored states, perturbed, and rendered; the last one stays open for the next piece of work."""

import atexit
import copy
import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.axes import RenderPerturbation
from pipeline.rendering.drawing import PlainDrawing, Surfaces, texels
from pipeline.rendering.savings import drawing_of
from pipeline.scenes.compiled import compiled
from pipeline.types import Frame, State


class Renderer:
    """Renders one scene; close it before the next is made.

    Args:
        scene: its MJCF, or a compiled model, which belongs to the renderer from then on.
        drawing: renders the model already; by default one is made.

    Attributes:
        site_alpha: (nsite,) the sites' opacity in the first state.
    """

    def __init__(self, scene: str | mujoco.MjModel, drawing: PlainDrawing | None = None):
        self.model = compiled(scene) if isinstance(scene, str) else scene
        self.site_alpha = self.model.site_rgba[:, 3].copy()
        self.data = mujoco.MjData(self.model)
        self.drawing = drawing or drawing_of(self.model)
        self._perturbations: tuple[RenderPerturbation, ...] = ()

    def restore(self, state: NDArray[np.float64], site_alpha: NDArray[np.float32]) -> None:
        """Put the scene into a stored state (S,) with its sites' opacity (nsite,)."""
        State.of(state, self.model.nq).put_into(self.data)
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
    def perturbed(self, perturbations: Sequence[RenderPerturbation]) -> Iterator[None]:
        """Apply render-layer perturbations to the model, and undo them at the end.

        Entered again inside itself with the same perturbations, it does nothing.
        """
        if tuple(perturbations) == self._perturbations:
            yield
            return
        outer = self._perturbations
        fields = {name for perturbation in perturbations for name in perturbation.fields}
        former = {name: getattr(self.model, name).copy() for name in fields}
        textures: list[int] = []
        try:
            for perturbation in perturbations:
                perturbation.apply(self.model)
            if "tex_data" in former:
                pairs = zip(texels(self.model), texels(self.model, former["tex_data"]), strict=True)
                textures = [number for number, (now, then) in enumerate(pairs) if not np.array_equal(now, then)]
            self.drawing.load(textures)
            self._perturbations = tuple(perturbations)
            yield
        finally:
            self._perturbations = outer
            for name, values in former.items():
                getattr(self.model, name)[:] = values
            self.drawing.load(textures)

    def close(self) -> None:
        self.drawing.close()


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

        It is no longer to be used when another scene was asked for.

        Raises:
            PipelineError: when nothing renders on this machine.
            ValueError: when MuJoCo refuses the scene or one of its images.
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
