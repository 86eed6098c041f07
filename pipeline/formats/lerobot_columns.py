"""The columns of LeRobot datasets: of v3.0, and of v2.1 in the conventions in use. Light to import."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.episode_schema import MAPS, MATRICES, MOTION, SCHEMA, MatrixSpec, PosesSpec
from pipeline.types import Extra

Frames = Literal["video", "images"]
"""``video`` is H.264 made from the stored frames; ``images`` are the stored JPEG files, three times as large."""

EPISODE_ID = "episode_id"
"""A column of every frame, because lerobot's tools to delete, split and merge number episodes anew and leave
``meta/provenance.parquet`` behind: with it, an episode is still found in the manifest."""

INSTANCES, OBJECT_POSES = "instances", "object_poses"
"""With extras: a JSON list of names in ``meta/provenance.parquet``, and in every frame the poses of what it names."""

FILE_MB = 200
"""About as large as a file of data or video may become."""

LANGUAGE = "language_persistent"
"""lerobot's column of what is said of an episode: all of it in every frame, from lerobot 0.6 on."""

COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""lerobot's own columns of every frame, beside ``timestamp``."""


def camera_column(view: str, name: str) -> str:
    """The column with a view's matrix (row by row, in ``meta/provenance.parquet``) or map (PNG in base64, every frame).

    Maps are text, and no name begins with ``observation``, because lerobot's policies take such columns and all images.
    """
    return f"{SCHEMA.views[view].lerobot_camera}.{name}"


def matrix_columns() -> dict[str, MatrixSpec]:
    """The columns of ``meta/provenance.parquet`` with what an episode's cameras have once."""
    return {camera_column(view, name): getattr(SCHEMA, name) for view in SCHEMA.views for name in MATRICES}


def _flat(spec: PosesSpec) -> dict[str, Any]:
    rows, columns = spec.shape
    names = [f"{row}_{name}" for row in range(rows) for name in spec.names]
    return {"dtype": spec.dtype, "shape": (rows * columns,), "names": names}


@dataclass(frozen=True)
class Convention:
    """What clients expect of a set.

    Attributes:
        robot_type: in ``meta/info.json``.
        names: columns that have another name than in v3.0.
        open_is_one: whether the gripper's command is 1 open, 0 closed, and not as LIBERO has it. GR00T and starVLA,
            which look for ``meta/modality.json``, take it so.
        language: whether there is lerobot's language column.
    """

    frames: Frames
    robot_type: str = SCHEMA.robot_type
    names: Mapping[str, str] = field(default_factory=dict)
    open_is_one: bool = False
    language: bool = False

    def name(self, column: str) -> str:
        """Of a column of v3.0."""
        return self.names.get(column, column)

    def columns(self, extras: Collection[Extra]) -> dict[str, dict[str, Any]]:
        """The columns of every frame, as ``meta/info.json`` describes them."""
        frame = {"dtype": "video", "shape": SCHEMA.frame.shape, "names": list(SCHEMA.frame.names)}
        if self.frames == "images":
            frame["dtype"] = "image"
        text, number = ({"dtype": dtype, "shape": (1,), "names": None} for dtype in ("string", "int64"))
        columns: dict[str, dict[str, Any]] = {view.lerobot_key: dict(frame) for view in SCHEMA.views.values()}
        for name in MOTION:
            spec = getattr(SCHEMA, name)
            columns[spec.lerobot_key] = {"dtype": spec.dtype, "shape": spec.shape, "names": list(spec.names)}
        columns[EPISODE_ID] = dict(text)
        columns |= {camera_column(view, name): dict(text) for view in SCHEMA.views for name in MAPS if name in extras}
        if "object_poses" in extras:
            columns[OBJECT_POSES] = _flat(SCHEMA.object_poses)
        if self.language:
            columns[LANGUAGE] = {"dtype": "language", "shape": (1,), "names": None}
        columns["timestamp"] = {"dtype": "float32", "shape": (1,), "names": None}
        columns |= {name: dict(number) for name in COUNTERS}
        return {self.name(column): of for column, of in columns.items()}


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
"""Each as its public code has it. Joint angles are in neither; under ``observation`` they would be a policy's input.

* ``ipec``, of IPEC-COMMUNITY's ``libero_*_no_noops_1.0.0_lerobot``, which cannot be had here. They were made by
  ``openx2lerobot/openx_rlds.py`` and its ``libero_dataset_transform`` (Tavish9/any4lerobot at 6937315): a set for each
  suite, videos, 20 Hz, gripper 1 open and 0 closed. ``examples/simBenchmarks/LIBERO/train_files`` in starVLA/starVLA at
  0ed0aad names the columns, and ``eval_files/eval_libero.py`` there turns the gripper back.
* ``openpi``, of ``examples/libero/convert_libero_data_to_lerobot.py`` (Physical-Intelligence/openpi at 15a9616), as
  ``LeRobotLiberoDataConfig`` in ``src/openpi/training/config.py`` repacks it: one set, images in the data files,
  gripper as LIBERO has it. openpi writes a frame rate of 10; here it is LIBERO's 20 Hz, which its loader takes too.
"""
