"""Names and conventions of an episode in LIBERO's HDF5 layout."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import SCHEMA
from pipeline.libero.tasks import find_task
from pipeline.types import Floats, Task

VALIDATION_FOLDER = "val"
"""Folder of the files of the validation episodes; the files of all other episodes are next to it."""

SUFFIX = "_demo.hdf5"

PROVENANCE = "attributes of data/demo_<number>"

INSTANCES, OBJECT_POSES = "instances", "obs/object_poses"

START_STATE, START_GRIPPER = "start_state", "start_gripper"
START_POSTURE, START_PUSH = "start_posture_rad", "start_push"
"""Attributes with the start of the replay, before the arm and the objects settled: fields of ``types.Scene``.

A start without posture or push lacks the attribute.
"""

SUBTASK_STARTS, SUBTASK_TEXTS, REWRITES = "subtask_starts", "subtask_texts", "rewrites"
"""Attributes with the first step of each subtask, its text, and the rewrites of the instruction."""


def file_of(task: str, split: str) -> str:
    """Return the path of a task's file below the folder of the dataset; ``task`` is ``<suite>/<task>``."""
    folder = "" if split == "train" else f"{VALIDATION_FOLDER}/"
    return f"{folder}{task}{SUFFIX}"


def task_of(file: Path) -> Task:
    """Return the task of a file of the dataset.

    Raises:
        PipelineError: when no task has the file's name.
    """
    return find_task(file.parent.name, file.name.removesuffix(SUFFIX))


def camera(view: str) -> str:
    """Return the name of a view's camera in LIBERO's observations, such as ``agentview`` or ``eye_in_hand``."""
    return SCHEMA.views[view].camera.removeprefix("robot0_")


def frames_key(view: str) -> str:
    """Return the name of a view's frames in the group of an episode."""
    return f"obs/{camera(view)}_rgb"


def maps_key(view: str, name: str) -> str:
    """Return the name of a view's depth or segmentation in the group of an episode."""
    return f"obs/{camera(view)}_{name}"


def matrix_attribute(view: str, name: str) -> str:
    """Return the attribute with a matrix of a view."""
    return f"{camera(view)}_{name}"


def turned_back(intrinsics: NDArray[np.floating]) -> Floats:
    """Return the intrinsics (3, 3) of frames that are rotated by 180 degrees: of raw ones from stored ones, or back.

    In double precision, the function is its own inverse for matrices of single precision.
    """
    height_px, width_px, _ = SCHEMA.frame.shape
    matrix = intrinsics.astype(np.float64)
    last_pixel = np.array([[width_px - 1.0], [height_px - 1.0]])
    matrix[:2] = last_pixel * matrix[2] - matrix[:2]
    return matrix


def quaternions(axis_angles: Floats) -> Floats:
    """Return the quaternions (T, 4: x, y, z, w) of axis-angles (T, 3), with the sign that robosuite had.

    An angle in [0, 2 pi], as of ``rotations.axis_angle``, has the sign of ``w``, which SciPy would change.
    """
    angles = np.linalg.norm(axis_angles, axis=1, keepdims=True)
    sine_by_angle = 0.5 * np.sinc(angles / (2 * np.pi))
    return np.hstack([axis_angles * sine_by_angle, np.cos(angles / 2)])
