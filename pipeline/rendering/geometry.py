"""Camera matrices, depth and segmentation of a view; conventions in ``schemas/episode.json``."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import RenderPerturbation, of_layer
from pipeline.episode_schema import MAPS, SCHEMA
from pipeline.images.jpeg import encode_exactly, to_policy
from pipeline.planning.streams import Stream
from pipeline.rendering.instances import Instances
from pipeline.rendering.renderer import Renderer
from pipeline.types import Extra, Floats, Geometry, Trajectory


def see(
    renderer: Renderer, trajectory: Trajectory, stream: Stream, instances: Instances | None, extras: Collection[Extra]
) -> Geometry:
    """The geometry of a view of a trajectory's scene: its matrices, and with extras its depth and segmentation before
    each executed action, by the ids of ``instances``."""
    view = SCHEMA.views[stream.view]
    maps: dict[Extra, list[bytes]] = {name: [] for name in MAPS if name in extras}
    with renderer.perturbed(of_layer(stream.perturbations, RenderPerturbation)):
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
    units: NDArray[Any] = np.minimum(np.rint(depth_m / SCHEMA.depth.unit_m), furthest).astype(SCHEMA.depth.dtype)
    return units
