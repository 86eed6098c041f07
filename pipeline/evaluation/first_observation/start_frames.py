"""Frames of a LIBERO task at the start of an episode, from each camera and in starts that evaluations confuse."""

from collections.abc import Iterable
from contextlib import nullcontext
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.evaluation.policies import VIEWS
from pipeline.evaluation.simulator import Simulator
from pipeline.evaluation.tasks import libero_states
from pipeline.images.jpeg import to_policy
from pipeline.libero.starts import SETTLING_STEPS
from pipeline.libero.tasks import SUITES
from pipeline.physics.environment import DUMMY_ACTION
from pipeline.rendering.geometry import Instances
from pipeline.rendering.renderer import LastScene, Renderer
from pipeline.rendering.srgb import decoded as srgb_textures
from pipeline.types import Frame, Task

CAMERA_OF_VIEW = {view: SCHEMA.views[name].camera for view, name in VIEWS.items()}
"""View of a policy to the camera of LIBERO's scenes."""


class Start(NamedTuple):
    """Start of an episode.

    Attributes:
        number: number of LIBERO's initial state, from 0.
        seed: seed of LIBERO's reset, which places the fixtures.
        steps: number of settling steps.
        gripper: command of the gripper while settling: -1 opens, 1 closes.
    """

    number: int
    seed: int
    steps: int = SETTLING_STEPS
    gripper: float = -1.0


class StartFrames:
    """Renderer of the starts of one task; close it before another renderer is used.

    A start with more settling steps than the former one, and otherwise equal, continues from the former one.
    """

    def __init__(self, task: Task):
        self.task = task
        self._simulator, self._opened = Simulator(task), LastScene()
        self._restored: Start | None = None

    @property
    def count(self) -> int:
        """Return the number of LIBERO's initial states of the task."""
        return len(libero_states(self.task))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Return the names of the scene's cameras, first those of a policy's views."""
        model = self._simulator.model
        names = [model.camera(number).name for number in range(model.ncam)]
        return tuple(dict.fromkeys((*CAMERA_OF_VIEW.values(), *names)))

    def render(self, start: Start, cameras: Iterable[str], srgb: bool = False) -> dict[str, Frame]:
        """Return the frame (256, 256, 3) of a start from each camera, rotated by 180 degrees as policies see it.

        Args:
            srgb: True for the textures of MuJoCo 3.3.3 and later.

        Raises:
            RejectedError: if the scene does not settle.
        """
        renderer = self._restore(start)
        with srgb_textures(renderer) if srgb else nullcontext():
            return {camera: to_policy(renderer.frame(camera)) for camera in cameras}

    def things(self, start: Start, camera: str) -> dict[str, NDArray[np.bool_]]:
        """Return the pixels (256, 256) of each thing in a frame of a start: fixtures and objects by their names."""
        renderer = self._restore(start)
        instances = Instances(renderer.model, self.task)
        ids = to_policy(instances.ids(renderer.surfaces(camera)))
        return {name: ids == number for number, name in enumerate(instances.names)}

    def close(self) -> None:
        """Close the renderer and the simulator."""
        self._opened.close()
        self._simulator.close()

    def _restore(self, start: Start) -> Renderer:
        """Put the simulator into a start, and return the renderer of its scene in this state."""
        former, settled = self._restored, 0
        if former is not None and former.steps <= start.steps and former._replace(steps=start.steps) == start:
            settled = former.steps
        else:
            self._simulator.start(start.seed, libero_states(self.task)[start.number], settling_steps=0)
        action: NDArray[Any] = DUMMY_ACTION.copy()
        action[6] = start.gripper
        self._restored = None
        for _ in range(settled, start.steps):
            self._simulator.step(action)
        self._restored = start
        observed, renderer = self._simulator.observed, self._opened.renderer(self._simulator.model)
        state = np.concatenate([[0.0], observed.qpos, np.zeros(renderer.model.nv)])
        renderer.restore(state, observed.site_alpha)
        return renderer


class LastStartFrames:
    """Holder of the renderer of the last task; it closes a task's renderer before it opens that of another."""

    def __init__(self) -> None:
        self._frames: StartFrames | None = None

    def of(self, task: Task) -> StartFrames:
        """Return the renderer of a task."""
        if self._frames is None or self._frames.task != task:
            self.close()
            self._frames = StartFrames(task)
        return self._frames

    def close(self) -> None:
        """Close the renderer."""
        if self._frames is not None:
            self._frames.close()
        self._frames = None


def first_start(task: Task, number: int) -> Start:
    """Return the start of an evaluation in LIBERO's initial state with a number.

    Raises:
        PipelineError: if LIBERO has no such state, or the task is not LIBERO's.
    """
    if task.suite not in SUITES:
        raise PipelineError(
            "only LIBERO's tasks have initial states to compare with",
            where=str(task),
            expected=f"a task of {', '.join(SUITES)}",
            remedy="compare a frame of a LIBERO task from the same code: rotation, size and colours do not depend on "
            "the task",
        )
    count = len(libero_states(task))
    if not 0 <= number < count:
        raise PipelineError(
            f"LIBERO has no initial state {number}", where=str(task), expected=f"a number from 0 to {count - 1}"
        )
    return Start(number, seed=number)
