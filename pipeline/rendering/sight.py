"""What an episode's agent view shows of its task: the things that the task is about, and the hand that moves them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.libero import bddl
from pipeline.rendering.renderer import Renderer
from pipeline.types import Floats, Task

CAMERA = "agentview"

LEAST_PX = 20
"""Pixels of each thing that must show in the first frame, of 256 x 256."""

MOST_OUTSIDE = 0.25
"""Share of the steps that the hand may be outside of the frame."""


@dataclass(frozen=True)
class Sight:
    """What is seen from one camera.

    Attributes:
        things_px: thing to the number of pixels that show it in the restored state.
        hand_outside: share of an episode's steps at which the hand is outside of the frame.
    """

    things_px: dict[str, int]
    hand_outside: float

    @classmethod
    def of(cls, renderer: Renderer, task: Task, hand_m: Floats) -> Sight:
        """What the agent view of a renderer sees, in the state that it was put in.

        Args:
            renderer: of a scene of the task.
            task: tells which things are meant: those that LIBERO lists as of interest, target and receptacle.
            hand_m: (T, 3) where the grip site is at each step, in the world.
        """
        model, data = renderer.model, renderer.data
        seen = renderer.geoms(CAMERA)
        bodies = model.geom_bodyid[seen[seen >= 0]]
        trees = np.bincount(model.body_rootid[bodies], minlength=model.nbody)
        camera = model.camera(CAMERA).id
        # A camera looks along its -z axis.
        x, y, z = ((hand_m - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
        reach = -z * np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
        return cls(
            {thing: int(trees[model.body(f"{thing}_main").rootid[0]]) for thing in _things(task)},
            float(np.mean((np.abs(x) > reach) | (np.abs(y) > reach))),
        )

    def faults(self, original: Sight) -> list[str]:
        """What a moved camera shows too little of, where the scene's own camera shows more; none when it is enough.

        ``task_object_not_seen`` when a thing shows on fewer than ``LEAST_PX`` pixels, ``hand_not_seen`` when the hand
        is outside of the frame for more than ``MOST_OUTSIDE`` of the steps.
        """
        lost = any(px < min(LEAST_PX, original.things_px[thing]) for thing, px in self.things_px.items())
        away = self.hand_outside > max(MOST_OUTSIDE, original.hand_outside)
        return [*(["task_object_not_seen"] if lost else []), *(["hand_not_seen"] if away else [])]


def _things(task: Task) -> set[str]:
    """The objects and fixtures that a task is about, without the table or the floor that they stand on.

    A region, such as a drawer of a cabinet or the burner of a stove, stands for the thing that it belongs to.
    """
    known = bddl.read(task.bddl_file)
    return {thing for name in known.of_interest for thing in known.things if f"{name}_".startswith(f"{thing}_")}
