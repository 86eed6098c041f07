"""Pose: where things stand at the start: the object that a task moves, what it is put on or in, or the whole scene.

Physics layer. The component ``scene`` is in ``pipeline.axes.scene``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipeline.axes.base import Axis, PhysicsPerturbation, pick, point
from pipeline.axes.scene import ScenePerturbation, displacements, draw_scene
from pipeline.libero import bddl
from pipeline.testset.benchmark import TestSet
from pipeline.types import Demo, Floats, RollOut, Scene, Task

Component = Literal["target", "receptacle", "scene"]
"""What the goal puts somewhere, what it is put on or in, where that is an object that can be moved, or everything."""


class PosePerturbation(PhysicsPerturbation):
    """One object, by its name in the BDDL file, moved in the horizontal plane and turned on the spot.

    Displacements are along the world's axes from where the demonstration has it, the turn is counter-clockwise about
    the vertical through its origin."""

    axis: Literal["pose"] = "pose"
    component: Literal["target", "receptacle"]
    moved: str
    dx_m: float
    dy_m: float
    dyaw_deg: float

    # A quarter of the 2 cm square that LIBERO's own reset scatters an object in.
    clearance: ClassVar[float] = 0.005
    unit: ClassVar[str | None] = "m"
    measure: ClassVar[str] = "the norm of the difference between the displacements of the same object"

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """The scene with the object moved; its height and velocity and everything else stay as they are. RefusedError
        as of ``pipeline.scenes.moving.move_one``."""
        from pipeline.scenes.moving import move_one

        return move_one(scene, demo.task, self.moved, (self.dx_m, self.dy_m), self.dyaw_deg)

    per_task: ClassVar[bool] = True

    def distances_on_task(self, test: TestSet, task: Task) -> Floats:
        """Compared with the test tasks that move the same object, alone or with others.

        These move every other thing as well, each its own way, so even at distance zero the scenes would differ.
        """
        return self._apart_m(_test_moves_m(test, task, self.moved))

    def apart(self, others: Sequence[PosePerturbation]) -> Floats:
        """Compared with the draws that move the same object."""
        nowhere = (math.nan, math.nan)
        return self._apart_m([(p.dx_m, p.dy_m) if p.moved == self.moved else nowhere for p in others])

    def _apart_m(self, moves_m: ArrayLike) -> Floats:
        """(N,) from moves (N, 2) of the same object."""
        distances_m: Floats = np.linalg.norm(np.subtract(moves_m, (self.dx_m, self.dy_m)), axis=1)
        return distances_m


@cache
def _test_moves_m(test: TestSet, task: Task, moved: str) -> Floats:
    """(N, 2) how far each of the axis's test tasks of ``task`` moves one of its targets; NaN for another thing."""
    nowhere, is_target = (math.nan, math.nan), moved in bddl.read(task.bddl_file).targets
    moves_m = [displacements(one.parameters).get(moved, nowhere) for one in test.on(task, "pose")]
    return np.array(moves_m if is_target else [nowhere] * len(moves_m)).reshape(-1, 2)


class PoseAxis(Axis):
    """Displacements in all directions with equal chance.

    The component ``scene`` moves everything at once, as LIBERO-Plus does: see ``draw_scene``. The others move and turn
    one object; where there are several to choose from, one is drawn.

    Attributes:
        components: what to move.
        step_m: at level k one object is moved by k - 1 to k times this, uniform over the ring.
        turn_deg: one object is turned by up to so much to either side, uniform, whatever the level.
    """

    draws: ClassVar = (PosePerturbation, ScenePerturbation)

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = ("scene",)
    step_m: float = Field(default=0.016, ge=0.0001, le=0.2)
    turn_deg: float = Field(default=20.0, ge=0.0, le=180.0)

    def applies(self, task: Task) -> bool:
        """Whether there is something to move: some tasks only open, close or turn what stays where it is."""
        return bool(self._choices(task))

    def _choices(self, task: Task) -> list[tuple[Component, str]]:
        known = bddl.read(task.bddl_file)
        named: dict[Component, tuple[str, ...]] = {
            "target": known.targets,
            "receptacle": known.receptacles,
            "scene": ("all",),
        }
        return [(component, name) for component in self.components for name in named[component]]

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> PosePerturbation | ScenePerturbation:
        component, moved = pick(rng, self._choices(task))
        level = self.draw_level(rng)
        if component == "scene":
            return draw_scene(rng, level, task)
        dx_m, dy_m = point(rng, self.step_m * math.sqrt(rng.uniform((level - 1) ** 2, level**2)))
        turn_deg = round(rng.uniform(-self.turn_deg, self.turn_deg), 2)
        return PosePerturbation(level=level, component=component, moved=moved, dx_m=dx_m, dy_m=dy_m, dyaw_deg=turn_deg)
