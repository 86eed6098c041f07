"""``schemas/episode.json`` as a typed object, and the content of a run's episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from pipeline.files import schema_file
from pipeline.types import Episode, Extra, Floats, Frozen


class ViewSpec(Frozen):
    """One camera: its name in MuJoCo and its key in LeRobot; its key here is its name in RLDS.

    Attributes:
        lerobot_camera: prefix of LeRobot's columns about the camera. It has no ``image``: lerobot treats columns with
            that word as images.
        seen_from: the frame into which the view's extrinsics transform.
    """

    camera: str
    lerobot_key: str
    lerobot_camera: str
    seen_from: Literal["world", "end_effector"]


class FrameSpec(Frozen):
    """Storage of every frame."""

    shape: tuple[int, int, int]
    dtype: str
    names: tuple[str, str, str]
    encoding: str


class MatrixSpec(Frozen):
    """A matrix of a view's camera, constant over the episode."""

    shape: tuple[int, int]
    dtype: str
    meaning: str


class MapSpec(Frozen):
    """A map of numbers for each step of a view, as large as the frame."""

    dtype: str
    encoding: str
    meaning: str


class DepthSpec(MapSpec):
    """A depth map; a value of 1 means ``unit_m`` metres."""

    unit_m: float


class PosesSpec(MatrixSpec):
    """A matrix per step with a row for each of ``instances``; the names of its columns contain the units."""

    names: tuple[str, ...]


class VectorSpec(Frozen):
    """A per-step vector; the names of its entries contain the units."""

    shape: tuple[int]
    dtype: str
    lerobot_key: str
    names: tuple[str, ...]
    meaning: str

    @model_validator(mode="after")
    def _one_name_per_entry(self) -> Self:
        if len(self.names) != self.shape[0]:
            raise ValueError(f"{self.lerobot_key}: {len(self.names)} names for {self.shape[0]} entries")
        return self


class StateSpec(VectorSpec):
    """End-effector pose in ``frame`` and finger positions, or the goal of this pose and the gripper's command."""

    frame: str


class GripperSpec(Frozen):
    """The two commands of the gripper entry."""

    open: float
    close: float

    def others(self, commands: NDArray[np.floating]) -> set[float]:
        """Return the values of ``commands`` (T,), rounded to float32 as in datasets, that are neither."""
        values = np.unique(commands.astype(np.float32)).tolist()
        return set(values) - {self.open, self.close}


class ActionSpec(VectorSpec):
    """Controller input; an entry of 1 commands ``unit_m`` or ``unit_rad``."""

    range: tuple[float, float]
    unit_m: float
    unit_rad: float
    gripper: GripperSpec
    controller: str

    @property
    def units(self) -> Floats:
        """Motion (6,) that entries of 1 command: three in m, three in rad."""
        return np.repeat([self.unit_m, self.unit_rad], 3)


class EpisodeSchema(Frozen):
    """Names, shapes, units and signs that all writers read.

    Attributes:
        views: name of each view of every episode to its camera.
        further_views: name of each view that a run may request to its camera.
        frame: storage of frames of the default size.
        provenance: name of each provenance column, as in the manifest, to its type.
        labels: name of each list of an episode's texts and their places, as in the manifest, to the type of its values.
    """

    fps_hz: int
    robot_type: str
    image_rotation_deg: int
    min_steps: int
    views: dict[str, ViewSpec]
    further_views: dict[str, ViewSpec]
    frame: FrameSpec
    intrinsics: MatrixSpec
    extrinsics: MatrixSpec
    depth: DepthSpec
    segmentation: MapSpec
    object_poses: PosesSpec
    boxes: PosesSpec
    state: StateSpec
    joint_state: VectorSpec
    action: ActionSpec
    action_absolute: StateSpec
    provenance: dict[str, Literal["string", "int64", "float32"]]
    labels: dict[str, Literal["string", "int64"]]


SCHEMA = EpisodeSchema.model_validate_json(schema_file("episode.json").read_text())

ALL_VIEWS = SCHEMA.views | SCHEMA.further_views
"""Name of each view that an episode may have, to its camera."""

SIZE_PX = SCHEMA.frame.shape[0]
"""Default height and width of frames."""

MOTION = ("action", "action_absolute", "state", "joint_state")
"""Numeric arrays of an episode, with a row for each step."""

MATRICES = ("intrinsics", "extrinsics")
"""Matrices that each view of an episode has once."""

MAPS: tuple[Extra, ...] = ("depth", "segmentation")
"""Maps that each view of an episode has at each step on request."""

OUTCOME: Mapping[str, Literal["bool", "string"]] = {"success": "bool", "reason": "string"}
"""Columns of failures in addition to provenance, to their types: ``success`` is false, ``reason`` is the manifest's."""


@dataclass(frozen=True)
class Content:
    """Content that all episodes of a run have in common.

    Attributes:
        views: names of the views, those of every episode first.
        size_px: height and width of the frames.
        extras: content in addition to the frames.
    """

    views: tuple[str, ...] = tuple(SCHEMA.views)
    size_px: int = SIZE_PX
    extras: tuple[Extra, ...] = ()

    @property
    def cameras(self) -> dict[str, ViewSpec]:
        """Map the name of each view to its camera."""
        return {view: ALL_VIEWS[view] for view in self.views}

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        return self.size_px, self.size_px, SCHEMA.frame.shape[2]

    @property
    def area(self) -> float:
        """Return the number of pixels of a frame, as a multiple of the default."""
        return (self.size_px / SIZE_PX) ** 2

    @property
    def maps(self) -> tuple[Extra, ...]:
        """List the requested maps of each view."""
        return tuple(name for name in MAPS if name in self.extras)

    @property
    def is_of_failures(self) -> bool:
        """Return whether the episodes missed their goal."""
        return "outcome" in self.extras

    @property
    def provenance(self) -> dict[str, str]:
        """Map the names of the provenance columns to their types."""
        outcome = OUTCOME if self.is_of_failures else {}
        return {**SCHEMA.provenance, **outcome}

    @property
    def has_names(self) -> bool:
        """Return whether the episodes have a table of names."""
        return bool({"segmentation", "object_poses", "boxes"} & set(self.extras))

    def including(self, extra: Extra) -> "Content":
        """Return the content with one more extra."""
        return replace(self, extras=(*self.extras, extra))

    def stated(self) -> list[object]:
        """Return the parts of a dataset's identity; parts with default values are left out, as in earlier versions."""
        is_standard = (self.views, self.size_px) == (Content.views, Content.size_px)
        return [self.extras] if is_standard else [self.extras, self.views, self.size_px]


STANDARD = Content()
"""Content of a run with default options."""


def labels_of(episode: Episode) -> dict[str, list[Any]]:
    """Return the lists of ``SCHEMA.labels``: the subtasks of an episode and the rewrites of its instruction."""
    return {
        "subtask_starts": [subtask.step for subtask in episode.subtasks],
        "subtask_texts": [subtask.text for subtask in episode.subtasks],
        "rewrites": list(episode.rewrites),
    }
