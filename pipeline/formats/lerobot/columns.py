"""Layout of LeRobot datasets: columns, files and video encoding of v3.0, and of v2.1 in the conventions in use.

This module is light to import.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from pipeline.episode_schema import ALL_VIEWS, MATRICES, MOTION, SCHEMA, Content, MatrixSpec, PosesSpec
from pipeline.formats.base import StepSizes
from pipeline.formats.lerobot import depth
from pipeline.types import Extra

Frames = Literal["video", "images"]
"""``video`` is H.264 encoded from the stored frames; ``images`` are the stored JPEG files, three times as large."""

EPISODE_ID = "episode_id"
"""A column of every frame, by which an episode is still found in the manifest after an edit. lerobot's tools to delete,
split and merge number episodes again and do not keep ``meta/provenance.parquet``."""

SELECTED_BY = (EPISODE_ID, "suite", "axis", "component", "level")
"""Provenance that ``meta/episodes`` repeats. lerobot's ``episode_filter`` (0.6.1) selects episodes by the columns of
this table."""

INSTANCES, OBJECT_POSES = "instances", "object_poses"
"""Columns of extras: a JSON list of names in ``meta/provenance.parquet``, and the poses of the named objects in every
frame."""

STARVLA_STATISTICS = "stats_gr00t.json"
"""File of ``meta/`` from which starVLA takes the statistics of states and actions; it ignores ``stats.json``. Without
the file, it reads every column of all data files and writes it (``starVLA/dataloader/gr00t_lerobot/datasets.py`` at
0ed0aad)."""

STARVLA_FIGURES = ("mean", "std", "min", "max", "q01", "q99")
"""Statistics in this file. starVLA computes them as NumPy does by default, as in ``stats.json``, but in float32."""

IS_SUCCESS = "is_success"
"""A column of every frame in datasets of failures: whether the episode reached its goal. RLinf's RECAP requires it
(``compute_returns.py`` in RLinf/RLinf at a3816b5)."""

ENTRIES = 16
"""Number of a column's entries that are in memory at a time: 300 MB for 28,000 episodes."""

FILE_MB = 200
"""Approximate largest size of a file of data or video."""

VIEW_AS_VIDEO_KB = 7.5
"""Size of one step of a view of 256 x 256 as video, rounded up from ``benchmarks/disk.py``."""

IN_TEXT = 1.2
"""Size of the base64 columns as a multiple of the PNG files in them."""

LANGUAGE = "language_persistent"
"""lerobot's column of an episode's language annotations, all of them in every frame, from lerobot 0.6 on."""

EVENTS = "language_events"
"""lerobot's column of the annotations that begin at a frame, from lerobot 0.6 on."""

COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""lerobot's own columns of every frame, in addition to ``timestamp``."""

ENCODER: Final = "libx264"
ENCODER_OPTIONS = {
    # Measured on unperturbed frames (benchmarks/video_quality.py): 40 dB to the stored JPEG files in both views at
    # 6.7 kB a frame, a third of theirs, no frame below 37 dB. Fine colourful surfaces can have 29 dB, because colours
    # have half the resolution. "superfast" saves a tenth of the bytes for twice the time.
    "preset": "ultrafast",
    # The quantiser is fixed: 22, and 19 for key frames. A "crf" of 20 chooses it for each frame. Its files have equal
    # size and mean quality, but single frames of 35 dB, and take a third more time.
    "qp": "22",
    # lerobot's own choice: any frame is at most one frame away from a key frame, for random access in training.
    "g": "2",
    # The first frame of an episode does not depend on the episode before.
    "forced-idr": "1",
    # The bytes depend on the number of threads; files are written in parallel already.
    "threads": "1",
}
VIDEO_INFO = {
    "video.codec": "h264",
    "video.pix_fmt": "yuv420p",
    "video.is_depth_map": False,
    "video.fps": SCHEMA.fps_hz,
    "has_audio": False,
    # lerobot 0.6 encodes with these settings where an edit cuts a file. Without them it uses B-frames and cannot merge
    # its own files. It does not support "qp".
    "video.g": int(ENCODER_OPTIONS["g"]),
    "video.crf": 20,
    "video.preset": ENCODER_OPTIONS["preset"],
}
"""Properties of these files in ``meta/info.json``, in addition to their size."""

FILES_OF_A_CHUNK = 1000
"""Files in a folder of data or videos; lerobot's own value, which its tools for editing continue to use."""

PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH, VIDEO_PATH = f"data/{PLACE}.parquet", f"videos/{{video_key}}/{PLACE}.mp4"
"""Paths of v3.0 below the dataset's root, lerobot's own."""

DATA_PATH_V21 = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH_V21 = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
"""Paths of v2.1 below a set's root: each episode has files of its own."""


def data_path_v21(index: int) -> str:
    """Return the path of an episode's data below the root of its set of v2.1."""
    return DATA_PATH_V21.format(episode_chunk=index // FILES_OF_A_CHUNK, episode_index=index)


def video_path_v21(index: int, key: str) -> str:
    """Return the path of an episode's video below the root of its set of v2.1."""
    return VIDEO_PATH_V21.format(episode_chunk=index // FILES_OF_A_CHUNK, episode_index=index, video_key=key)


def camera_column(view: str, name: str) -> str:
    """Return the column with a view's matrix, map or boxes.

    A matrix is stored row by row in ``meta/provenance.parquet``, a map as PNG in base64 in every frame, and boxes as
    numbers, row by row, in every frame. Maps are text, and no name begins with ``observation``, because lerobot's
    policies use such columns and all images as inputs.
    """
    return f"{ALL_VIEWS[view].lerobot_camera}.{name}"


def matrix_columns(content: Content) -> dict[str, MatrixSpec]:
    """Return the columns of ``meta/provenance.parquet`` with the matrices of an episode's cameras."""
    return {camera_column(view, name): getattr(SCHEMA, name) for view in content.views for name in MATRICES}


def _flat(spec: PosesSpec) -> dict[str, Any]:
    rows, columns = spec.shape
    names = [f"{row}_{name}" for row in range(rows) for name in spec.names]
    return {"dtype": spec.dtype, "shape": (rows * columns,), "names": names}


def matrix(table: pa.Table, column: str) -> NDArray[Any]:
    """Return the values (T, D) of a column of numbers or of vectors."""
    values = table[column].combine_chunks()
    is_list = pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type)
    flat = values.flatten() if is_list else values
    return np.asarray(flat.to_numpy(zero_copy_only=False).reshape(len(values), -1))


def read_matrix(file: Path, column: str) -> NDArray[Any]:
    """Read the values (N, D) of a data file's column."""
    return matrix(pq.ParquetFile(file).read([column], use_threads=False), column)


Depth = Literal["text", "video"]
"""``text`` is the stored PNG file in base64; ``video`` is lerobot's own coding, which lerobot reads from 0.6 on."""

Action = Literal["delta", "absolute"]
"""Content of the column ``action``, on which policies train."""

_ABSOLUTE_KEYS = {"action": "delta_action", "action_absolute": "action"}
"""Columns that exchange their content; lerobot would take every column that begins with ``action`` as an action."""


@dataclass(frozen=True)
class Convention:
    """Names and values that clients expect, equal in all their sets.

    Attributes:
        frames: storage of the frames in v2.1; a user chooses that of v3.0.
        robot_type: robot type in ``meta/info.json``.
        names: column of v3.0 to its name here, where the names differ.
        open_is_one: True if the gripper's command is 1 open, 0 closed, instead of LIBERO's. GR00T and starVLA, which
            read ``meta/modality.json``, expect it.
    """

    frames: Frames
    robot_type: str = SCHEMA.robot_type
    names: Mapping[str, str] = field(default_factory=dict)
    open_is_one: bool = False


@dataclass(frozen=True)
class Layout:
    """Columns of a set and their storage.

    Attributes:
        content: content of the episodes.
        convention: names and values of the client.
        frames: storage of the frames.
        language: True if the set has lerobot's language columns.
        action: content of the column ``action``.
        depth: storage of the depth maps, if the content has them.
    """

    content: Content
    convention: Convention
    frames: Frames
    language: bool = False
    action: Action = "delta"
    depth: Depth = "text"

    @property
    def motion_keys(self) -> dict[str, str]:
        """Map each array of ``MOTION`` to its column in v3.0; policies train on the column ``action``."""
        keys = {name: getattr(SCHEMA, name).lerobot_key for name in MOTION}
        return keys | _ABSOLUTE_KEYS if self.action == "absolute" else keys

    def name(self, column: str) -> str:
        """Return the name of a column of v3.0."""
        return self.convention.names.get(column, column)

    def camera_column(self, view: str, name: str) -> str:
        """Return the column with a view's matrix, map or boxes.

        Depth as video has a name of lerobot's cameras, because lerobot passes no other images to policies.
        """
        if name == "depth" and self.depth == "video":
            return f"{self.name(ALL_VIEWS[view].lerobot_key)}_depth"
        return camera_column(view, name)

    @property
    def views(self) -> dict[str, str]:
        """Map the name of each view to its column."""
        return {view: self.name(spec.lerobot_key) for view, spec in self.content.cameras.items()}

    @property
    def text_maps(self) -> list[Extra]:
        """List the maps that are stored as text."""
        return [name for name in self.content.maps if name != "depth" or self.depth == "text"]

    @property
    def depth_videos(self) -> dict[str, str]:
        """Map each view to its column of depth as video; empty where depth is text or absent."""
        if self.depth == "text" or "depth" not in self.content.maps:
            return {}
        return {view: self.camera_column(view, "depth") for view in self.content.views}

    @property
    def pictures(self) -> dict[str, str]:
        """Map the name of each view, and of its depth if that is a video, to its column."""
        depths = {f"{view}_depth": column for view, column in self.depth_videos.items()}
        return self.views | depths

    @property
    def videos(self) -> dict[str, str]:
        """Return the part of ``pictures`` that is stored as videos."""
        columns = self.pictures
        if self.frames == "video":
            return columns
        return {name: column for name, column in columns.items() if name not in self.content.views}

    def step_kb(self, sizes: StepSizes) -> float:
        """Estimate the size of one step of an episode, in KB."""
        views = len(self.content.views)
        video_kb = VIEW_AS_VIDEO_KB * views * self.content.area
        frames_kb = video_kb if self.frames == "video" else views * sizes.frame_kb + sizes.motion_kb
        # Depth as video counts as text here, of which it takes a third.
        return frames_kb + IN_TEXT * views * sizes.maps_kb + sizes.poses_kb

    @property
    def columns(self) -> dict[str, dict[str, Any]]:
        """Describe the columns of every frame, without the encoding of videos."""
        frame = {"dtype": "video", "shape": self.content.frame_shape, "names": list(SCHEMA.frame.names)}
        if self.frames == "images":
            frame["dtype"] = "image"
        text, number = ({"dtype": dtype, "shape": (1,), "names": None} for dtype in ("string", "int64"))
        columns: dict[str, dict[str, Any]] = {view.lerobot_key: dict(frame) for view in self.content.cameras.values()}
        for name, key in self.motion_keys.items():
            spec = getattr(SCHEMA, name)
            columns[key] = {"dtype": spec.dtype, "shape": spec.shape, "names": list(spec.names)}
        columns[EPISODE_ID] = dict(text)
        columns |= {camera_column(view, name): dict(text) for view in self.content.views for name in self.text_maps}
        height, width, _ = self.content.frame_shape
        for column in self.depth_videos.values():
            columns[column] = {"dtype": "video", "shape": (height, width, 1), "names": list(SCHEMA.frame.names)}
        if "boxes" in self.content.extras:
            columns |= {camera_column(view, "boxes"): _flat(SCHEMA.boxes) for view in self.content.views}
        if "object_poses" in self.content.extras:
            columns[OBJECT_POSES] = _flat(SCHEMA.object_poses)
        if self.content.is_of_failures:
            columns[IS_SUCCESS] = {"dtype": "bool", "shape": (1,), "names": None}
        if self.language:
            columns |= {name: {"dtype": "language", "shape": (1,), "names": None} for name in (LANGUAGE, EVENTS)}
        columns["timestamp"] = {"dtype": "float32", "shape": (1,), "names": None}
        columns |= {name: dict(number) for name in COUNTERS}
        return {self.name(column): description for column, description in columns.items()}

    @property
    def described(self) -> dict[str, dict[str, Any]]:
        """Describe the columns as ``meta/info.json`` does, videos with the properties of their encoding."""
        depths = set(self.depth_videos.values())
        columns = {}
        for name, description in self.columns.items():
            columns[name] = dict(description)
            if description["dtype"] == "video":
                size = dict(zip(("video.height", "video.width", "video.channels"), description["shape"], strict=True))
                columns[name]["info"] = size | (depth.INFO if name in depths else VIDEO_INFO)
        return columns


CONVENTIONS = {
    "libero": Convention("video"),
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
"""Conventions of public code. The last two have no joint angles; under ``observation`` they would be a policy's input.

* ``libero``: the convention of lerobot's own LIBERO sets, only in v3.0: one set, LIBERO's gripper.
* ``ipec``: the convention of IPEC-COMMUNITY's ``libero_*_no_noops_1.0.0_lerobot``, which are not available here.
  ``openx2lerobot/openx_rlds.py`` and its ``libero_dataset_transform`` (Tavish9/any4lerobot at 6937315) generated them:
  a set for each suite, videos, 20 Hz, gripper 1 open and 0 closed. ``examples/simBenchmarks/LIBERO/train_files`` in
  starVLA/starVLA at 0ed0aad names the columns, and ``eval_files/eval_libero.py`` there inverts the gripper again.
* ``openpi``: the convention of ``examples/libero/convert_libero_data_to_lerobot.py`` (Physical-Intelligence/openpi at
  15a9616), as ``LeRobotLiberoDataConfig`` in ``src/openpi/training/config.py`` repacks it: one set, images in the data
  files, LIBERO's gripper. openpi writes a frame rate of 10; here it is LIBERO's 20 Hz, which its loader accepts too.
"""
