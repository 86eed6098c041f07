"""``schemas/episode.json`` as a typed object, and the check of an episode against it."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import model_validator

from pipeline.errors import PipelineError
from pipeline.files import schema_file
from pipeline.types import Episode, Extra, Frozen

JPEG_SCAN, JPEG_END = b"\xff\xda", b"\xff\xd9"
SCAN_HEADER_BYTES = 14


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
    def provenance(self) -> dict[str, str]:
        """Map the names of the provenance columns to their types."""
        outcome = OUTCOME if "outcome" in self.extras else {}
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


def labels_of(episode: Episode) -> dict[str, list[Any]]:
    """Return the lists of ``SCHEMA.labels``: the subtasks of an episode and the rewrites of its instruction."""
    return {
        "subtask_starts": [subtask.step for subtask in episode.subtasks],
        "subtask_texts": [subtask.text for subtask in episode.subtasks],
        "rewrites": list(episode.rewrites),
    }


def label_faults(labels: Mapping[str, Sequence[Any]], steps: int) -> Iterator[tuple[str, str]]:
    """Yield each fault of an episode's labels, and the expected content.

    Args:
        labels: the lists of ``SCHEMA.labels``.
        steps: number of the episode's steps.
    """
    starts, texts, rewrites = (labels[name] for name in ("subtask_starts", "subtask_texts", "rewrites"))
    if len(starts) != len(texts):
        yield f"{len(starts)} subtask_starts and {len(texts)} subtask_texts", "a text for each start"
    if starts and starts[0] != 0:
        yield f"the first of subtask_starts is {starts[0]}", "0"
    if any(later <= earlier for earlier, later in pairwise(starts)):
        yield f"subtask_starts {list(starts)} are not in order", "each start after the one before it"
    if starts and max(starts) >= steps:
        yield f"subtask_starts {list(starts)} leave the episode", f"starts below {steps}, the number of steps"
    for text in (*texts, *rewrites):
        if not text.strip() or "\n" in text:
            yield f"the label {text!r}", "words in one line"
    if len({*rewrites}) != len(rewrites):
        yield f"{len(rewrites)} rewrites, of which some are equal", "each text once"


STANDARD = Content()
"""Content of a run with default options."""


def check(episode: Episode, content: Content = STANDARD) -> None:
    """Reject an episode that training code would misread or fail on.

    Args:
        content: the content that the episode must have.

    Raises:
        PipelineError: naming the episode and the field.
    """
    steps = len(episode)
    if steps < SCHEMA.min_steps:
        expected = f"at least {SCHEMA.min_steps} steps, the length of the chunks that policies predict"
        raise _fault(episode, "action", f"has {steps} steps", expected)
    for name in MOTION:
        _check_array(episode, name, getattr(episode, name), getattr(SCHEMA, name), steps)
    low, high = SCHEMA.action.range
    if episode.action.min() < low or episode.action.max() > high:
        span = f"spans [{episode.action.min():g}, {episode.action.max():g}]"
        raise _fault(episode, "action", span, f"[{low:g}, {high:g}], as the controller clips it")
    for what, expected in label_faults(labels_of(episode), steps):
        raise _fault(episode, "labels", f"have a fault: {what}", expected)
    _check_frames(episode, steps, content)
    _check_geometry(episode, steps, content)
    if not episode.instruction.strip() or "_" in episode.instruction:
        # OpenVLA-OFT's loader never returns on an empty text; an underscore indicates a file name.
        raise _fault(episode, "instruction", f"is {episode.instruction!r}", "words without underscores")
    columns = content.provenance
    if set(episode.provenance) != set(columns):
        wrong = sorted(set(episode.provenance) ^ set(columns))
        raise _fault(episode, "provenance", f"lacks or adds {wrong}", f"exactly {list(columns)}")
    types = {"string": str, "int64": int, "float32": float, "bool": bool}
    mistyped = sorted(key for key, value in episode.provenance.items() if not isinstance(value, types[columns[key]]))
    if mistyped:
        expected = ", ".join(f"{columns[key]} in {key}" for key in mistyped)
        raise _fault(episode, "provenance", f"has another type in {mistyped}", expected)
    if episode.provenance["episode_id"] != episode.episode_id:
        raise _fault(episode, "provenance", f"names episode {episode.provenance['episode_id']!r}", "its own episode_id")


def _check_frames(episode: Episode, steps: int, content: Content) -> None:
    if set(episode.frames) != set(content.views):
        raise _fault(episode, "frames", f"has the views {sorted(episode.frames)}", f"{sorted(content.views)}")
    expected = (SCHEMA.frame.encoding.upper(), "RGB", (content.size_px, content.size_px))
    for view, frames in episode.frames.items():
        if len(frames) != steps:
            raise _fault(episode, view, f"has {len(frames)} frames", f"{steps}, one per action")
        for index, data in enumerate(frames):
            try:
                scan = data.find(JPEG_SCAN)
                properties = _look(data[: scan + SCAN_HEADER_BYTES] if scan >= 0 else data)
            except UnidentifiedImageError:
                raise _fault(episode, view, f"frame {index} is not an image", f"{expected}") from None
            if properties != expected:
                raise _fault(episode, view, f"frame {index} is {properties}", f"{expected}")
            if not data.endswith(JPEG_END):
                raise _fault(episode, view, f"frame {index} is cut short", "a whole JPEG file")


@lru_cache
def _look(header: bytes) -> tuple[str | None, str, tuple[int, int]]:
    """Read format, mode and size of an image.

    Calls are cached by the header: frames of one encoder begin with equal headers.
    """
    with Image.open(io.BytesIO(header)) as image:
        return image.format, image.mode, image.size


def _check_geometry(episode: Episode, steps: int, content: Content) -> None:
    if set(episode.geometry) != set(content.views):
        raise _fault(episode, "geometry", f"has the views {sorted(episode.geometry)}", f"{sorted(content.views)}")
    for view, geometry in episode.geometry.items():
        for name in MATRICES:
            _check_array(episode, f"{view}_{name}", getattr(geometry, name), getattr(SCHEMA, name))
        lengths = {name: len(files) for name, files in geometry.maps.items()}
        wanted = dict.fromkeys(content.maps, steps)
        if lengths != wanted:
            raise _fault(episode, f"{view} maps", f"have the lengths {lengths}", f"{steps} for each requested map")
        if ("boxes" in content.extras) != (geometry.boxes is not None):
            expected = "boxes if, and only if, render.extras lists them"
            raise _fault(episode, f"{view} boxes", "are missing or not requested", expected)
        if geometry.boxes is not None:
            _check_array(episode, f"{view}_boxes", geometry.boxes, SCHEMA.boxes, steps)
    if ("object_poses" in content.extras) != (episode.object_poses is not None):
        expected = "poses if, and only if, render.extras lists them"
        raise _fault(episode, "object_poses", "are missing or not requested", expected)
    if episode.object_poses is not None:
        _check_array(episode, "object_poses", episode.object_poses, SCHEMA.object_poses, steps)
    if content.has_names != bool(episode.instances):
        expected = "names if, and only if, render.extras lists segmentation, object_poses or boxes"
        raise _fault(episode, "instances", f"has {len(episode.instances)} names", expected)


def _check_array(
    episode: Episode, field: str, values: NDArray[np.float32], spec: VectorSpec | MatrixSpec, *steps: int
) -> None:
    if values.shape != (*steps, *spec.shape) or values.dtype != np.dtype(spec.dtype):
        expected = f"{(*steps, *spec.shape)} of {spec.dtype}"
        raise _fault(episode, field, f"is {values.shape} of {values.dtype}", expected)
    if not np.isfinite(values).all():
        raise _fault(episode, field, "contains NaN or infinity", "finite numbers")


def _fault(episode: Episode, field: str, what: str, expected: str) -> PipelineError:
    return PipelineError(
        f"{field} {what}",
        where=f"episode {episode.episode_id}",
        expected=expected,
        remedy="correct the source of this episode, or drop it from the plan",
    )
