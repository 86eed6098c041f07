"""Camera matrices, depth and segmentation of a view, and which thing an instance id stands for.

Conventions are those of ``schemas/episode.json``.
"""

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import MAPS, SCHEMA
from pipeline.errors import PipelineError
from pipeline.images.jpeg import encode_exactly, to_policy
from pipeline.libero import bddl
from pipeline.planning.streams import Stream
from pipeline.rendering.drawing import Surfaces
from pipeline.rendering.renderer import Renderer
from pipeline.types import Extra, Floats, Geometry, Task, Trajectory

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
        added = [placed["name"] for placed in trajectory.scene.resolved.get("layout", {}).get("objects", [])]
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


def see(
    renderer: Renderer, trajectory: Trajectory, stream: Stream, instances: Instances | None, extras: Collection[Extra]
) -> Geometry:
    """The geometry of a view of a trajectory's scene: its matrices, and with extras its depth and segmentation before
    each executed action, by the ids of ``instances``."""
    view = SCHEMA.views[stream.view]
    maps: dict[Extra, list[bytes]] = {name: [] for name in MAPS if name in extras}
    with renderer.perturbed(stream.changes):
        renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
        intrinsics, extrinsics = matrices(renderer, stream.view)
        for step in range(len(trajectory.actions) if maps else 0):
            renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
            surfaces = renderer.surfaces(view.camera)
            if "depth" in maps:
                maps["depth"].append(encode_exactly(to_policy(_in_units(surfaces.depth_m))))
            if "segmentation" in maps and instances:
                maps["segmentation"].append(encode_exactly(to_policy(instances.ids(surfaces))))
    return Geometry(intrinsics, extrinsics, maps)


def matrices(renderer: Renderer, view: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Intrinsics (3, 3) and extrinsics (4, 4) of a view in the restored state; the same in every state.

    LIBERO's raw frames have their first row at the bottom; turned by 180 degrees, they are upright and have left and
    right exchanged. A rotation cannot mirror, so this stands in the sign of fx.
    """
    model, data = renderer.model, renderer.data
    spec = SCHEMA.views[view]
    height, width, _ = SCHEMA.frame.shape
    camera = model.camera(spec.camera).id
    focal_px = height / 2 / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
    intrinsics = np.array([[-focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    # MuJoCo's cameras have y up and look along -z.
    extrinsics = _pose(data.cam_xmat[camera].reshape(3, 3) * [1.0, -1.0, -1.0], data.cam_xpos[camera])
    if spec.seen_from == "end_effector":
        # As the state has it: where the grip site is, turned as the hand is.
        hand = _pose(data.body("robot0_right_hand").xmat.reshape(3, 3), data.site("gripper0_grip_site").xpos)
        extrinsics = np.linalg.inv(hand) @ extrinsics
    return intrinsics.astype(np.float32), extrinsics.astype(np.float32)


def _pose(rotation: Floats, position_m: Floats) -> Floats:
    """(4, 4) of a rotation (3, 3) and a position (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position_m
    return pose


def _in_units(depth_m: NDArray[np.float32]) -> NDArray[Any]:
    """Depth (H, W) as whole numbers of the schema's unit, the largest number for all that is further away."""
    furthest = np.iinfo(SCHEMA.depth.dtype).max
    return np.asarray(np.minimum(np.rint(depth_m / SCHEMA.depth.unit_m), furthest).astype(SCHEMA.depth.dtype))
