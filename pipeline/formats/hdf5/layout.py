"""Names and conventions of an episode in LIBERO's HDF5 layout."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.episode_schema import ALL_VIEWS
from pipeline.libero.carried import task_named
from pipeline.libero.hdf5 import SUFFIX
from pipeline.types import Floats, Start, Task

VALIDATION_FOLDER = "val"
"""Folder of the files of the validation episodes; the files of all other episodes are next to it."""

PROVENANCE = "attributes of data/demo_<number>"

INSTANCES, OBJECT_POSES = "instances", "obs/object_poses"

START_STATE = "start_state"
"""Attribute with the state of the replay's start, before the arm and the objects settled."""

NUMERIC_START = ("gripper", "posture_rad")
"""Fields of ``types.Start`` that are stored as numbers of HDF5; each other field is stored as JSON."""


def file_of(task: str, split: str) -> str:
    """Return the path of a task's file below the folder of the dataset; ``task`` is ``<suite>/<file_name>``."""
    folder = "" if split == "train" else f"{VALIDATION_FOLDER}/"
    return f"{folder}{task}{SUFFIX}"


def task_of(file: Path) -> Task:
    """Return the task of a file of the dataset.

    Raises:
        PipelineError: when no task has the file's name.
    """
    return task_named(file.parent.name, file.name.removesuffix(SUFFIX))


def camera(view: str) -> str:
    """Return the name of a view's camera in LIBERO's observations, such as ``agentview`` or ``eye_in_hand``."""
    return ALL_VIEWS[view].camera.removeprefix("robot0_")


def frames_key(view: str) -> str:
    """Return the name of a view's frames in the group of an episode."""
    return f"obs/{camera(view)}_rgb"


def maps_key(view: str, name: str) -> str:
    """Return the name of a view's depth, segmentation or boxes in the group of an episode."""
    return f"obs/{camera(view)}_{name}"


def matrix_attribute(view: str, name: str) -> str:
    """Return the attribute with a matrix of a view."""
    return f"{camera(view)}_{name}"


def start_attributes(start: Start) -> dict[str, Any]:
    """Return the attributes with a replay's start, such as ``start_gripper``; a field that is ``None`` has none."""
    attributes: dict[str, Any] = {}
    for name, value in start.to_json().items():
        if value is not None:
            attributes[f"start_{name}"] = np.array(value) if name in NUMERIC_START else json.dumps(value)
    return attributes


def start_of(attributes: Mapping[str, Any]) -> Start:
    """Return the start of a replay from the attributes that ``start_attributes`` returned.

    Raises:
        ValueError: if a required attribute is missing, or a value has another type.
    """
    stored: dict[str, Any] = {}
    for name in (field.name for field in fields(Start)):
        value = attributes.get(f"start_{name}")
        if value is not None:
            stored[name] = value.tolist() if name in NUMERIC_START else json.loads(value)
    return Start.of(stored)


def turned_back(intrinsics: NDArray[np.floating], size_px: int) -> Floats:
    """Return the intrinsics (3, 3) of frames that are rotated by 180 degrees: of raw ones from stored ones, or back.

    In double precision, the function is its own inverse for matrices of single precision.
    """
    matrix = intrinsics.astype(np.float64)
    matrix[:2] = (size_px - 1.0) * matrix[2] - matrix[:2]
    return matrix


def boxes_turned_back(boxes: NDArray[np.float32], size_px: int) -> NDArray[np.float32]:
    """Return boxes (T, N, 4) in frames that are rotated by 180 degrees: in raw ones from stored ones, or back.

    Boxes without pixels stay zeros.
    """
    turned = boxes.copy()
    turned[..., :2] = size_px - boxes[..., :2] - boxes[..., 2:]
    return np.asarray(np.where(boxes[..., 2:].any(axis=-1, keepdims=True), turned, boxes))


def quaternions(axis_angles: Floats) -> Floats:
    """Return the quaternions (T, 4: x, y, z, w) of axis-angles (T, 3), with the sign that robosuite had.

    An angle in [0, 2 pi], as of ``rotations.axis_angle``, has the sign of ``w``, which SciPy would change.
    """
    angles = np.linalg.norm(axis_angles, axis=1, keepdims=True)
    sine_by_angle = 0.5 * np.sinc(angles / (2 * np.pi))
    return np.hstack([axis_angles * sine_by_angle, np.cos(angles / 2)])
