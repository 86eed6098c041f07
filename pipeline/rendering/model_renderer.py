"""Interface of the renderers of a compiled model: plain rendering, and rendering with savings (``savings.py``)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SIZE_PX
from pipeline.types import Frame


class Surfaces(NamedTuple):
    """Depth, and geom or site, of each pixel, in the orientation of LIBERO's raw observations.

    Attributes:
        depth_m: (H, W) float32, along the camera's viewing axis.
        number, kind: (H, W) the geom or site, by its number in the model and ``mujoco.mjtObj``; -1 without a surface.
    """

    depth_m: NDArray[np.float32]
    number: NDArray[np.int32]
    kind: NDArray[np.int32]


class ModelRenderer(ABC):
    """Renderer of a model in its own OpenGL context.

    Close it before you create the next ``ModelRenderer``. A subclass overrides the methods that are not abstract if it
    can continue with another model, or lets the device work while the process does something else.

    Args:
        model: the model, which must not be replaced.
        size_px: height and width of its frames.

    Attributes:
        steps_ahead: number of steps, of up to two views each, to start by ``start_frame`` before the frames of an
            earlier step are taken; 0 if the device does not work meanwhile.
        adopts: True if the context may be able to switch to another model (``adopt``).

    Raises:
        PipelineError: if this machine cannot render.
    """

    steps_ahead = 0
    adopts = False
    size_px: int

    @abstractmethod
    def __init__(self, model: mujoco.MjModel, size_px: int = SIZE_PX): ...

    @staticmethod
    def possible(model: mujoco.MjModel) -> bool:
        """Return whether this class can render a model; by default, it can render every model."""
        return True

    def adopt(self, model: mujoco.MjModel) -> bool:
        """Switch to another model in the same OpenGL context if possible, and return whether it was; by default never.

        If the result is False, nothing has changed. After an error, close this ``ModelRenderer``.
        """
        return False

    def release(self) -> None:
        """Drop the reference to the model, so that its memory can be freed.

        Call it only if ``adopts`` is true. Only ``adopt`` or ``close`` may follow.
        """
        raise NotImplementedError("this renderer keeps its model")

    @abstractmethod
    def frame(self, data: mujoco.MjData, camera: str) -> Frame:
        """Render a frame (H, W, 3) of uint8 RGB, in the orientation of LIBERO's raw observations.

        Call ``mj_forward`` on the data before.
        """

    def start_frame(self, data: mujoco.MjData, camera: str) -> Callable[[], Frame]:
        """Start to render a frame, and return a function that waits for the frame and returns it.

        The state may change meanwhile. The default renders the frame at once.
        """
        frame = self.frame(data, camera)
        return lambda: frame

    @abstractmethod
    def surfaces(self, data: mujoco.MjData, camera: str) -> Surfaces:
        """Render the depth, and the geom or site, of each pixel of a frame."""

    @abstractmethod
    def load(self, textures: Collection[int]) -> None:
        """Upload these textures from the model's ``tex_data``."""

    @abstractmethod
    def close(self) -> None:
        """Free the OpenGL context."""
