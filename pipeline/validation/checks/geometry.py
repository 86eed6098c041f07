"""Checks of camera matrices, depth, masks, boxes and poses."""

from collections.abc import Iterator

import cv2
import numpy as np

from pipeline.episode_schema import MATRICES
from pipeline.formats.read_back import Fault, sampled
from pipeline.images.jpeg import decode_exactly
from pipeline.libero.carried import definition_of
from pipeline.validation.case import Case, same_bits

DEPTH_SHARE, DEPTH_OFFSET_M = 1.65e-4, 3.5
"""Largest error of lerobot's depth, as a share of the distance plus 3.5 m: half of 4095 codes, which span a factor of
13.5 / 3.51."""

NEAREST_DEPTH_M = 0.01
"""Least distance that lerobot's codes state."""


def check_geometry(case: Case) -> Iterator[Fault]:
    """Check the matrices of the cameras, bit for bit, and the files and numbers of the extras."""
    for copy in case.comparable_copies:
        for view, geometry in case.episode.geometry.items():
            for name in MATRICES:
                matrix, expected = getattr(copy.episode.geometry[view], name), getattr(geometry, name)
                if matrix.dtype != expected.dtype or not np.array_equal(matrix, expected):
                    yield case.finding(copy.dataset, f"{view}_{name} is {matrix.tolist()}", expected.tolist())
            for name, files in geometry.maps.items():
                if name == "depth" and copy.depth_m:
                    continue  # ``depth`` compares videos.
                if list(copy.episode.geometry[view].maps[name]) != list(files):
                    yield case.finding(copy.dataset, f"{view}_{name} differs", "the stored PNG files")
            if not same_bits(copy.episode.geometry[view].boxes, geometry.boxes):
                yield case.finding(copy.dataset, f"{view}_boxes differ", "the stored boxes")
        if not same_bits(copy.episode.object_poses, case.episode.object_poses):
            yield case.finding(copy.dataset, "object_poses differ", "the stored poses")
        if list(copy.episode.instances) != list(case.episode.instances):
            yield case.finding(copy.dataset, f"instances {list(copy.episode.instances)}", list(case.episode.instances))


def check_depth(case: Case) -> Iterator[Fault]:
    """Check that depth in videos is within half a code of the stored depth."""
    for copy in case.comparable_copies:
        for (view, step), depth_m in copy.depth_m.items():
            expected_m = np.maximum(case.sampled_depth_m[view, step], NEAREST_DEPTH_M)
            if depth_m.shape != expected_m.shape:
                yield case.finding(copy.dataset, f"{view}_depth is {depth_m.shape}", expected_m.shape)
                continue
            errors_m = np.abs(depth_m - expected_m)
            wrong = errors_m > DEPTH_SHARE * (expected_m + DEPTH_OFFSET_M)
            if wrong.any():
                what = f"{view}_depth of step {step} differs by up to {1000 * errors_m.max():.1f} mm"
                yield case.finding(copy.dataset, what, "the stored depth, within half a code")


def check_boxes(case: Case) -> Iterator[Fault]:
    """Compare the stored boxes with the masks of the same steps, if both are stored.

    The masks give the boxes of the gripper and of the things that the goal names.
    """
    if not case.episode.instances:
        return  # Neither boxes nor masks are stored.
    places = [case.episode.instances.index("gripper"), *_list_goal_places(case)]
    for view, geometry in case.episode.geometry.items():
        if geometry.boxes is None or "segmentation" not in geometry.maps:
            continue
        for step in sampled(len(case.episode)):
            ids = decode_exactly(geometry.maps["segmentation"][step])
            expected = np.zeros_like(geometry.boxes[step])
            for place in places:
                # OpenCV's rectangle has the first column and row, and the numbers of columns and rows.
                expected[place] = cv2.boundingRect(np.asarray(ids == place, np.uint8))
            wrong = np.flatnonzero(np.any(expected != geometry.boxes[step], axis=1))
            if len(wrong):
                what = f"{view}_boxes of step {step} has {geometry.boxes[step][wrong[0]].tolist()} at place {wrong[0]}"
                yield case.finding("frames", what, expected[wrong[0]].tolist())
                break


def _list_goal_places(case: Case) -> list[int]:
    """List the places in ``instances`` of the things that the task's goal names."""
    things = definition_of(case.task).things_of_goal
    return [place for place, name in enumerate(case.episode.instances) if name in things]
