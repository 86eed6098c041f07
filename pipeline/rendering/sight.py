"""Whether the first frame of a perturbed scene shows enough: the task's things, the hand, and added objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.axes import RenderPerturbation
from pipeline.axes.camera import CameraPerturbation, Component
from pipeline.axes.light import exposure
from pipeline.episode_schema import SCHEMA
from pipeline.libero import bddl
from pipeline.planning.streams import Stream
from pipeline.rendering.renderer import Renderer
from pipeline.scenes.placement import added_objects, enough_seen
from pipeline.types import Floats, Task, Trajectory

CAMERA = "agentview"

LEAST_PX = 20
"""Pixels of each thing that must show in the first frame, of 256 x 256."""

MOST_OUTSIDE = 0.25
"""Share of the steps that the hand may be outside of the frame, where another axis than the camera changed the view."""

TESTED_OUTSIDE: dict[Component, float] = {"distance": 0.62, "spherical": 0.58, "orientation": 0.63}
"""The same under the camera axis, by component: the largest share of LIBERO-Plus's 1,599 test cameras, each over the
starter demonstration of its task (``benchmarks/test_cameras_seen.py``, rounded up). What a test shows, training may."""


@dataclass(frozen=True)
class Sight:
    """What is seen from one camera.

    Attributes:
        things_px: thing to the number of pixels that show it in the restored state.
        hand_outside: share of an episode's steps at which the hand is outside of the frame.
        added_px: the same as ``things_px`` for each object that the layout axis added.
    """

    things_px: dict[str, int]
    hand_outside: float
    added_px: tuple[int, ...] = ()

    @classmethod
    def of(cls, renderer: Renderer, task: Task, hand_m: Floats) -> Sight:
        """What the agent view sees in the restored state, of what LIBERO lists as of interest in the task.

        ``hand_m`` (T, 3) is where the grip site is at each step, in the world.
        """
        model, data = renderer.model, renderer.data
        seen = renderer.geoms(CAMERA)
        bodies = model.geom_bodyid[seen[seen >= 0]]
        trees = np.bincount(model.body_rootid[bodies], minlength=model.nbody)
        camera = model.camera(CAMERA).id
        things = bddl.read(task.bddl_file).things_of_interest
        # A camera looks along its -z axis.
        x, y, z = ((hand_m - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)).T
        reach = -z * np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
        return cls(
            {thing: int(trees[model.body(f"{thing}_main").rootid[0]]) for thing in things},
            float(np.mean((np.abs(x) > reach) | (np.abs(y) > reach))),
            tuple(int(trees[model.body(name).rootid[0]]) for name in added_objects(model)),
        )

    def faults(self, original: Sight, most_outside: float = MOST_OUTSIDE) -> list[str]:
        """Names of what a camera shows too little of; empty when it shows enough.

        Of the task's things and the hand, no more is asked than the scene's own camera shows.

        Args:
            most_outside: share of the steps that the hand may be outside of the frame.
        """
        least_px = {thing: min(LEAST_PX, px) for thing, px in original.things_px.items()}
        faults = {
            "task_object_not_seen": any(px < least_px[thing] for thing, px in self.things_px.items()),
            "hand_not_seen": self.hand_outside > max(most_outside, original.hand_outside),
            "added_objects_not_seen": bool(self.added_px) and not enough_seen(self.added_px),
        }
        return [name for name, holds in faults.items() if holds]


class FirstFrame:
    """Judges perturbed scenes of a trajectory by its first frame; the renderer is not perturbed at first.

    A perturbed scene is refused when a frame is black or blown out (``exposure``), or when the agent view shows too
    little (``Sight``).
    """

    def __init__(self, renderer: Renderer, trajectory: Trajectory, task: Task, hand_m: Floats):
        self._renderer, self._task, self._hand_m = renderer, task, hand_m
        self._first = trajectory.states[0], trajectory.site_alpha[0]
        renderer.restore(*self._first)
        self._original = Sight.of(renderer, task, hand_m)

    def fault(self, streams: Sequence[Stream]) -> str | None:
        """What is wrong with the streams' scene, which the renderer shows now; None when nothing is."""
        self._renderer.restore(*self._first)
        changes = streams[0].changes
        faults: list[str] = []
        cameras = dict.fromkeys(SCHEMA.views[stream.view].camera for stream in streams)
        if changes:
            faults += [fault for camera in cameras if (fault := exposure(self._renderer.frame(camera)))]
        if CAMERA in cameras:
            moved = any(change.sees_otherwise for change in changes)
            sight = Sight.of(self._renderer, self._task, self._hand_m) if moved else self._original
            faults += sight.faults(self._original, _most_outside(changes))
        return faults[0] if faults else None


def _most_outside(changes: Sequence[RenderPerturbation]) -> float:
    """Share of the steps that the hand may be outside of the frame under these changes."""
    cameras = [change.component for change in changes if isinstance(change, CameraPerturbation)]
    return max((TESTED_OUTSIDE[component] for component in cameras), default=MOST_OUTSIDE)
