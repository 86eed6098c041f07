"""Visibility check of a perturbed scene's first frame: the task's things, the hand, and added objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.axes import RenderPerturbation
from pipeline.axes.camera import CameraPerturbation, Component
from pipeline.axes.light import exposure
from pipeline.episode_schema import SCHEMA, SIZE_PX
from pipeline.libero.carried import definition_of
from pipeline.planning.streams import Stream
from pipeline.rendering.renderer import Renderer
from pipeline.scenes.placement import added_objects, enough_seen
from pipeline.types import Floats, Task, Trajectory

CAMERA = "agentview"

LEAST_PX = 20
"""Least number of pixels of each thing in the first frame of 256 x 256."""

MOST_OUTSIDE = 0.25
"""Largest share of the steps with the hand outside of the frame, if an axis other than the camera changed the view."""

TESTED_OUTSIDE: dict[Component, float] = {"distance": 0.62, "spherical": 0.58, "orientation": 0.63}
"""Largest share of the steps with the hand outside of the frame under the camera axis, by component.

It is the largest share of LIBERO-Plus's 1,599 test cameras, rounded up: training may show any view that a test shows.
Each camera is measured over the starter demonstration of its task (``benchmarks/test_cameras_seen.py``).
"""


@dataclass(frozen=True)
class Sight:
    """Visible things in one camera's view.

    Numbers of pixels are those of a frame of 256 x 256, whatever the size of the frames.

    Attributes:
        things_px: thing to the number of pixels that show it in the restored state.
        hand_outside: share of an episode's steps at which the hand is outside of the frame.
        added_px: number of pixels of each object that the layout axis added, in the restored state.
    """

    things_px: dict[str, int]
    hand_outside: float
    added_px: tuple[int, ...] = ()

    @classmethod
    def of(cls, renderer: Renderer, task: Task, hand_m: Floats) -> Sight:
        """Measure the restored state in the agent view, for the things that LIBERO lists as of interest in the task.

        Args:
            renderer: the scene's renderer, with a restored state.
            task: the task.
            hand_m: (T, 3) position of the grip site at each step, in the world.
        """
        model, data = renderer.model, renderer.data
        seen = renderer.geoms(CAMERA)
        bodies = model.geom_bodyid[seen[seen >= 0]]
        pixels = np.bincount(model.body_rootid[bodies], minlength=model.nbody)
        trees = np.rint(pixels * (SIZE_PX / renderer.model_renderer.size_px) ** 2).astype(int)
        camera = model.camera(CAMERA).id
        things = definition_of(task).things_of_interest
        # A camera looks along its -z axis.
        x, y, z = ((hand_m - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
        half_width = -z * np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
        hand_outside = (np.abs(x) > half_width) | (np.abs(y) > half_width)
        return cls(
            {thing: int(trees[model.body(f"{thing}_main").rootid[0]]) for thing in things},
            float(np.mean(hand_outside)),
            tuple(int(trees[model.body(name).rootid[0]]) for name in added_objects(model)),
        )

    def faults(self, original: Sight, most_outside: float = MOST_OUTSIDE) -> list[str]:
        """Return the names of the faults of this sight; the list is empty if the camera shows enough.

        The task's things and the hand need not be more visible than in the original scene.

        Args:
            original: the sight of the original scene.
            most_outside: largest share of the steps with the hand outside of the frame.
        """
        least_px = {thing: min(LEAST_PX, px) for thing, px in original.things_px.items()}
        faults = {
            "task_object_not_seen": any(px < least_px[thing] for thing, px in self.things_px.items()),
            "hand_not_seen": self.hand_outside > max(most_outside, original.hand_outside),
            "added_objects_not_seen": bool(self.added_px) and not enough_seen(self.added_px),
        }
        return [name for name, holds in faults.items() if holds]


class FirstFrame:
    """Judge of perturbed scenes of a trajectory by their first frame.

    A perturbed scene is rejected if a frame is black or blown out (``exposure``), or if the agent view shows too little
    (``Sight``). Create the judge while the renderer is not perturbed.
    """

    def __init__(self, renderer: Renderer, trajectory: Trajectory, task: Task, hand_m: Floats):
        self._renderer, self._task, self._hand_m = renderer, task, hand_m
        self._first = trajectory.states[0], trajectory.site_alpha[0]
        renderer.restore(*self._first)
        self._original = Sight.of(renderer, task, hand_m)

    def fault(self, streams: Sequence[Stream]) -> str | None:
        """Return the first fault of the streams' scene, which the renderer shows now; ``None`` without a fault."""
        self._renderer.restore(*self._first)
        changes = streams[0].changes
        faults: list[str] = []
        # A view that a policy of LIBERO does not have decides nothing.
        judged_views = [stream.view for stream in streams if stream.view in SCHEMA.views]
        cameras = dict.fromkeys(SCHEMA.views[view].camera for view in judged_views)
        if changes:
            for camera in cameras:
                exposure_fault = exposure(self._renderer.frame(camera))
                if exposure_fault:
                    faults.append(exposure_fault)
        if CAMERA in cameras:
            moved = any(change.shows_other_surfaces for change in changes)
            sight = Sight.of(self._renderer, self._task, self._hand_m) if moved else self._original
            faults += sight.faults(self._original, _most_outside(changes))
        return faults[0] if faults else None


def _most_outside(changes: Sequence[RenderPerturbation]) -> float:
    """Return the largest share of the steps with the hand outside of the frame under these changes."""
    cameras = [change.component for change in changes if isinstance(change, CameraPerturbation)]
    return max((TESTED_OUTSIDE[component] for component in cameras), default=MOST_OUTSIDE)
