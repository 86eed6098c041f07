"""The instance ids of a scene: which thing a pixel of a segmentation shows, and a row of the object poses describes."""

from __future__ import annotations

import json
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.rendering.drawing import Surfaces
from pipeline.types import Task, Trajectory

COMMON = ("nothing", "robot", "gripper", "floor", "wall", "room", "table")
"""The first names of every table. ``nothing`` is where no surface is, ``room`` other furniture."""

NOTHING, ROBOT, GRIPPER, FLOOR, WALL, ROOM, TABLE = range(len(COMMON))


class Instances:
    """The table of names of a trajectory, and what of its model belongs to which.

    After ``COMMON`` come the fixtures and then the objects in the order of the task's BDDL file, under their names
    there, so that an id means the same in all episodes of a task. Objects that the layout axis added come last.
    """

    def __init__(self, model: mujoco.MjModel, trajectory: Trajectory, task: Task):
        things = bddl.read(task.bddl_file).things
        added = [placed["name"] for placed in json.loads(trajectory.resolved).get("layout", {}).get("objects", [])]
        self.names: tuple[str, ...] = (*COMMON, *things, *added)
        rows = SCHEMA.object_poses.shape[0]
        if len(self.names) > rows:
            raise PipelineError(f"a scene of {task.name} has {len(self.names)} things", expected=f"{rows} or fewer")
        bodies = [model.body(number).name for number in range(model.nbody)]
        self._bodies = {ROBOT: model.body("robot0_base").id, GRIPPER: model.body("gripper0_right_gripper").id}
        for body, name in enumerate(bodies):
            if name.endswith("table") and model.body_parentid[body] == 0:
                self._bodies[TABLE] = body
        own = [*(f"{thing}_main" for thing in things), *(f"layout{number}" for number in range(len(added)))]
        self._bodies |= {len(COMMON) + place: model.body(name).id for place, name in enumerate(own)}
        place_of_tree = {body: place for place, body in self._bodies.items() if place != GRIPPER}
        of_body = np.array([place_of_tree.get(int(root), ROOM) for root in model.body_rootid], np.uint8)
        of_body[[name.startswith("gripper0_") for name in bodies]] = GRIPPER
        self._of_geom = of_body[model.geom_bodyid]
        for geom in np.flatnonzero(self._of_geom == ROOM).tolist():
            name = model.geom(geom).name
            if name.startswith("floor"):
                self._of_geom[geom] = FLOOR
            elif name.startswith("wall_") and name.endswith("_visual"):
                self._of_geom[geom] = WALL
        self._of_site = of_body[model.site_bodyid]

    def ids(self, surfaces: Surfaces) -> NDArray[np.uint8]:
        """(H, W) place in ``names`` of what each pixel shows."""
        ids = np.full(surfaces.number.shape, NOTHING, np.uint8)
        for kind, of_number in ((mujoco.mjtObj.mjOBJ_GEOM, self._of_geom), (mujoco.mjtObj.mjOBJ_SITE, self._of_site)):
            shown = surfaces.kind == kind
            ids[shown] = of_number[surfaces.number[shown]]
        return ids

    def poses(self, data: mujoco.MjData) -> NDArray[np.float32]:
        """Position (m) and quaternion (w, x, y, z) in the world of the body of each name, zeros where it has none."""
        poses: NDArray[Any] = np.zeros(SCHEMA.object_poses.shape, SCHEMA.object_poses.dtype)
        for place, body in self._bodies.items():
            poses[place] = *data.xpos[body], *data.xquat[body]
        return poses
