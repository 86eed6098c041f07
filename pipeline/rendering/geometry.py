"""Camera matrices, depth, segmentation and boxes of a view, and the table of instance ids.

All conventions follow ``schemas/episode.json``.
"""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import ALL_VIEWS, MAPS, SCHEMA
from pipeline.errors import PipelineError
from pipeline.images.jpeg import encode_exactly, to_policy
from pipeline.libero.carried import definition_of
from pipeline.planning.streams import Stream
from pipeline.rendering.model_renderer import Surfaces
from pipeline.rendering.renderer import Renderer
from pipeline.scenes.placement import added_names, added_objects
from pipeline.types import Extra, Floats, Geometry, Task, Trajectory

COMMON = ("nothing", "robot", "gripper", "floor", "wall", "room", "table")
"""First names of every table. ``nothing`` marks pixels without a surface, ``room`` other furniture."""

NOTHING, ROBOT, GRIPPER, FLOOR, WALL, ROOM, TABLE = range(len(COMMON))


class Instances:
    """Table of a scene's instance names, and the bodies, geoms and sites of each name.

    After ``COMMON`` come the fixtures and then the objects, in the order and under the names of the task's BDDL file.
    Thus an id has one meaning in all episodes of a task. Objects that a perturbation added come last.

    Args:
        resolved: the scene's ``Scene.resolved``, which names added objects.

    Attributes:
        names: the name of each id.
        boxed: ids of the things with boxes: the gripper, and the things that the task's goal names.

    Raises:
        PipelineError: if the scene has more things than ``object_poses`` and ``boxes`` have rows.
    """

    def __init__(self, model: mujoco.MjModel, task: Task, resolved: Mapping[str, Any] = MappingProxyType({})):
        problem = definition_of(task)
        things = problem.things
        self.names: tuple[str, ...] = (*COMMON, *things, *added_names(resolved))
        rows = SCHEMA.object_poses.shape[0]
        if len(self.names) > rows:
            raise PipelineError(
                f"a scene of {task.name} has {len(self.names)} things",
                where="render.extras",
                expected=f"{rows} or fewer",
                remedy="leave out segmentation, boxes and object_poses, or plan fewer added objects for this task",
            )
        self.boxed = (GRIPPER, *(self.names.index(name) for name in problem.things_of_goal))
        bodies = [model.body(number).name for number in range(model.nbody)]
        self._bodies = {ROBOT: model.body("robot0_base").id, GRIPPER: model.body("gripper0_right_gripper").id}
        for body, name in enumerate(bodies):
            if name.endswith("table") and model.body_parentid[body] == 0:
                self._bodies[TABLE] = body
        thing_bodies = [*(f"{thing}_main" for thing in things), *added_objects(model)]
        for instance, body_name in enumerate(thing_bodies, start=len(COMMON)):
            self._bodies[instance] = model.body(body_name).id
        instance_of_root = {body: instance for instance, body in self._bodies.items() if instance != GRIPPER}
        of_body = np.array([instance_of_root.get(int(root), ROOM) for root in model.body_rootid], np.uint8)
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
        """Return the instance id of each pixel, (H, W): the place in ``names`` of the thing that it shows."""
        ids = np.full(surfaces.number.shape, NOTHING, np.uint8)
        for kind, of_number in ((mujoco.mjtObj.mjOBJ_GEOM, self._of_geom), (mujoco.mjtObj.mjOBJ_SITE, self._of_site)):
            pixels = surfaces.kind == kind
            ids[pixels] = of_number[surfaces.number[pixels]]
        return ids

    def boxes(self, ids: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the box of each thing of ``boxed``, by the ids (H, W) of a frame as it is stored.

        The rows of other things, and of things without pixels, are zero.
        """
        boxes: NDArray[Any] = np.zeros(SCHEMA.boxes.shape, SCHEMA.boxes.dtype)
        for instance in self.boxed:
            shown = ids == instance
            columns, rows = np.flatnonzero(shown.any(axis=0)), np.flatnonzero(shown.any(axis=1))
            if len(rows):
                x, y = columns[0], rows[0]
                boxes[instance] = x, y, columns[-1] - x + 1, rows[-1] - y + 1
        return boxes

    def poses(self, data: mujoco.MjData) -> NDArray[np.float32]:
        """Return position (m) and quaternion (w, x, y, z) of each name's body in the world.

        Rows of names without a body are zero.
        """
        poses: NDArray[Any] = np.zeros(SCHEMA.object_poses.shape, SCHEMA.object_poses.dtype)
        for instance, body in self._bodies.items():
            poses[instance] = *data.xpos[body], *data.xquat[body]
        return poses


def render_geometry(
    renderer: Renderer, trajectory: Trajectory, stream: Stream, instances: Instances | None, extras: Collection[Extra]
) -> Geometry:
    """Render the geometry of a stream's view of a trajectory.

    The geometry has the camera matrices. With extras, it also has depth, and segmentation and boxes by the ids of
    ``instances``, before each executed action.
    """
    view = ALL_VIEWS[stream.view]
    maps: dict[Extra, list[bytes]] = {name: [] for name in MAPS if name in extras}
    boxes: list[NDArray[np.float32]] = []
    needs_surfaces = bool({*MAPS, "boxes"} & set(extras))
    with renderer.perturbed(stream.changes):
        renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
        intrinsics, extrinsics = matrices(renderer, stream.view)
        for step in range(len(trajectory.actions) if needs_surfaces else 0):
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            surfaces = renderer.surfaces(view.camera)
            if "depth" in maps:
                maps["depth"].append(encode_exactly(to_policy(_in_units(surfaces.depth_m))))
            if instances is None:
                continue
            ids = to_policy(instances.ids(surfaces))
            if "segmentation" in maps:
                maps["segmentation"].append(encode_exactly(ids))
            if "boxes" in extras:
                boxes.append(instances.boxes(ids))
    return Geometry(intrinsics, extrinsics, maps, np.stack(boxes) if boxes else None)


def matrices(renderer: Renderer, view: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return intrinsics (3, 3) and extrinsics (4, 4) of a view in the restored state; they are equal in every state.

    LIBERO's raw frames have their first row at the bottom. Turned by 180 degrees, they are upright, but left and right
    are exchanged. A rotation cannot mirror, so fx is negative.
    """
    model, data = renderer.model, renderer.data
    spec, size_px = ALL_VIEWS[view], renderer.model_renderer.size_px
    camera = model.camera(spec.camera).id
    focal_px = size_px / 2 / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
    intrinsics = np.array([[-focal_px, 0.0, (size_px - 1) / 2], [0.0, focal_px, (size_px - 1) / 2], [0.0, 0.0, 1.0]])
    # MuJoCo's cameras have y up and look along -z.
    extrinsics = _pose(data.cam_xmat[camera].reshape(3, 3) * [1.0, -1.0, -1.0], data.cam_xpos[camera])
    if spec.seen_from == "end_effector":
        # The end effector's pose is defined as in the state: position of the grip site, rotation of the hand.
        hand = _pose(data.body("robot0_right_hand").xmat.reshape(3, 3), data.site("gripper0_grip_site").xpos)
        extrinsics = np.linalg.inv(hand) @ extrinsics
    return intrinsics.astype(np.float32), extrinsics.astype(np.float32)


def _pose(rotation: Floats, position_m: Floats) -> Floats:
    """Return the transformation (4, 4) of a rotation (3, 3) and a position (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position_m
    return pose


def _in_units(depth_m: NDArray[np.float32]) -> NDArray[Any]:
    """Convert depth (H, W) to whole numbers of the schema's unit; larger depths become the largest number."""
    furthest = np.iinfo(SCHEMA.depth.dtype).max
    return np.asarray(np.minimum(np.rint(depth_m / SCHEMA.depth.unit_m), furthest).astype(SCHEMA.depth.dtype))
