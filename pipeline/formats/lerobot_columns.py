"""Columns of LeRobot datasets: of v3.0, and of v2.1 in the conventions in use. This module is light to import."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.episode_schema import MAPS, MATRICES, MOTION, SCHEMA, MatrixSpec, PosesSpec
from pipeline.formats.base import StepSizes
from pipeline.types import Extra

Frames = Literal["video", "images"]
"""``video`` is H.264 encoded from the stored frames; ``images`` are the stored JPEG files, three times as large."""

EPISODE_ID = "episode_id"
"""A column of every frame, by which an episode is still found in the manifest after an edit. lerobot's tools to delete,
split and merge number episodes again and do not keep ``meta/provenance.parquet``."""

INSTANCES, OBJECT_POSES = "instances", "object_poses"
"""Columns of extras: a JSON list of names in ``meta/provenance.parquet``, and the poses of the named objects in every
frame."""

FILE_MB = 200
"""Approximate largest size of a file of data or video."""

VIDEO_KB = 15.0
"""Size of one step, both views as video, rounded up from ``benchmarks/disk.py``."""

IN_TEXT = 1.2
"""Size of the base64 columns as a multiple of the PNG files in them."""

LANGUAGE = "language_persistent"
"""lerobot's column of an episode's language annotations, all of them in every frame, from lerobot 0.6 on."""

COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""lerobot's own columns of every frame, in addition to ``timestamp``."""


def camera_column(view: str, name: str) -> str:
    """Return the column with a view's matrix or map.

    A matrix is stored row by row in ``meta/provenance.parquet``, a map as PNG in base64 in every frame. Maps are text,
    and no name begins with ``observation``, because lerobot's policies use such columns and all images as inputs.
    """
    return f"{SCHEMA.views[view].lerobot_camera}.{name}"


def matrix_columns() -> dict[str, MatrixSpec]:
    """Return the columns of ``meta/provenance.parquet`` with the matrices of an episode's cameras."""
    return {camera_column(view, name): getattr(SCHEMA, name) for view in SCHEMA.views for name in MATRICES}


def _flat(spec: PosesSpec) -> dict[str, Any]:
    rows, columns = spec.shape
    names = [f"{row}_{name}" for row in range(rows) for name in spec.names]
    return {"dtype": spec.dtype, "shape": (rows * columns,), "names": names}


@dataclass(frozen=True)
class Convention:
    """Layout of a set that clients expect.

    Attributes:
        frames: storage of the frames.
        robot_type: robot type in ``meta/info.json``.
        names: column of v3.0 to its name here, where the names differ.
        open_is_one: True if the gripper's command is 1 open, 0 closed, instead of LIBERO's. GR00T and starVLA, which
            read ``meta/modality.json``, expect it.
        language: True if the set has lerobot's language column.
    """

    frames: Frames
    robot_type: str = SCHEMA.robot_type
    names: Mapping[str, str] = field(default_factory=dict)
    open_is_one: bool = False
    language: bool = False

    def name(self, column: str) -> str:
        """Return the name of a column of v3.0."""
        return self.names.get(column, column)

    def step_kb(self, sizes: StepSizes) -> float:
        """Estimate the size of one step of an episode, in KB."""
        views = len(SCHEMA.views)
        frames_kb = VIDEO_KB if self.frames == "video" else views * sizes.frame_kb + sizes.motion_kb
        return frames_kb + IN_TEXT * views * sizes.maps_kb + sizes.poses_kb

    def columns(self, extras: Collection[Extra]) -> dict[str, dict[str, Any]]:
        """Describe the columns of every frame, as ``meta/info.json`` does."""
        frame = {"dtype": "video", "shape": SCHEMA.frame.shape, "names": list(SCHEMA.frame.names)}
        if self.frames == "images":
            frame["dtype"] = "image"
        text, number = ({"dtype": dtype, "shape": (1,), "names": None} for dtype in ("string", "int64"))
        columns: dict[str, dict[str, Any]] = {view.lerobot_key: dict(frame) for view in SCHEMA.views.values()}
        for name in MOTION:
            spec = getattr(SCHEMA, name)
            columns[spec.lerobot_key] = {"dtype": spec.dtype, "shape": spec.shape, "names": list(spec.names)}
        columns[EPISODE_ID] = dict(text)
        maps = [name for name in MAPS if name in extras]
        columns |= {camera_column(view, name): dict(text) for view in SCHEMA.views for name in maps}
        if "object_poses" in extras:
            columns[OBJECT_POSES] = _flat(SCHEMA.object_poses)
        if self.language:
            columns[LANGUAGE] = {"dtype": "language", "shape": (1,), "names": None}
        columns["timestamp"] = {"dtype": "float32", "shape": (1,), "names": None}
        columns |= {name: dict(number) for name in COUNTERS}
        return {self.name(column): description for column, description in columns.items()}


CONVENTIONS = {
    "ipec": Convention(
        "video",
        "franka",
        {"observation.images.image2": "observation.images.wrist_image", "observation.joint_state": "joint_state"},
        open_is_one=True,
    ),
    "openpi": Convention(
        "images",
        "panda",
        {
            "observation.images.image": "image",
            "observation.images.image2": "wrist_image",
            "observation.state": "state",
            "observation.joint_state": "joint_state",
            "action": "actions",
        },
    ),
}
"""Conventions of public code. Neither has joint angles; under ``observation`` they would be a policy's input.

* ``ipec``: the convention of IPEC-COMMUNITY's ``libero_*_no_noops_1.0.0_lerobot``, which are not available here.
  ``openx2lerobot/openx_rlds.py`` and its ``libero_dataset_transform`` (Tavish9/any4lerobot at 6937315) generated them:
  a set for each suite, videos, 20 Hz, gripper 1 open and 0 closed. ``examples/simBenchmarks/LIBERO/train_files`` in
  starVLA/starVLA at 0ed0aad names the columns, and ``eval_files/eval_libero.py`` there inverts the gripper again.
* ``openpi``: the convention of ``examples/libero/convert_libero_data_to_lerobot.py`` (Physical-Intelligence/openpi at
  15a9616), as ``LeRobotLiberoDataConfig`` in ``src/openpi/training/config.py`` repacks it: one set, images in the data
  files, LIBERO's gripper. openpi writes a frame rate of 10; here it is LIBERO's 20 Hz, which its loader accepts too.
"""
