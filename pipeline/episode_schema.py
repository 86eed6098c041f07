"""``schemas/episode.json`` as a typed object, and the check of an episode against it."""

import io
from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import Literal, Self

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
        lerobot_camera: what LeRobot's columns about the camera begin with; without ``image``, which lerobot takes for
            the name of an image.
        seen_from: the frame that the view's extrinsics lead to.
    """

    camera: str
    lerobot_key: str
    lerobot_camera: str
    seen_from: Literal["world", "end_effector"]


class FrameSpec(Frozen):
    """How every frame is stored."""

    shape: tuple[int, int, int]
    dtype: str
    names: tuple[str, str, str]
    encoding: str


class MatrixSpec(Frozen):
    """A matrix of a view's camera, the same at every step."""

    shape: tuple[int, int]
    dtype: str
    meaning: str


class MapSpec(Frozen):
    """A picture of numbers for each step of a view, of the frame's size."""

    dtype: str
    encoding: str
    meaning: str


class DepthSpec(MapSpec):
    """``unit_m`` is what a number of 1 means."""

    unit_m: float


class PosesSpec(MatrixSpec):
    """A row for each of ``instances``, at every step; units stand in the names of its columns."""

    names: tuple[str, ...]


class VectorSpec(Frozen):
    """A per-step vector; units stand in the names of its entries."""

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
    """End-effector pose in ``frame`` and finger positions."""

    frame: str


class GripperSpec(Frozen):
    """The two commands of the gripper entry."""

    open: float
    close: float

    def others(self, commands: NDArray[np.floating]) -> set[float]:
        """Those of some commands (T,) that, as datasets have them, are neither."""
        return set(np.unique(commands.astype(np.float32)).tolist()) - {self.open, self.close}


class ActionSpec(VectorSpec):
    """Controller input; ``unit_m`` and ``unit_rad`` are what an entry of 1 asks for."""

    range: tuple[float, float]
    unit_m: float
    unit_rad: float
    gripper: GripperSpec
    controller: str


class EpisodeSchema(Frozen):
    """Names, shapes, units and signs that all writers read.

    Attributes:
        provenance: what each episode says of itself, as the manifest's column of that name does, to its type.
    """

    fps_hz: int
    robot_type: str
    image_rotation_deg: int
    min_steps: int
    views: dict[str, ViewSpec]
    frame: FrameSpec
    intrinsics: MatrixSpec
    extrinsics: MatrixSpec
    depth: DepthSpec
    segmentation: MapSpec
    object_poses: PosesSpec
    state: StateSpec
    joint_state: VectorSpec
    action: ActionSpec
    provenance: dict[str, Literal["string", "int64", "float32"]]


SCHEMA = EpisodeSchema.model_validate_json(schema_file("episode.json").read_text())

MOTION = ("action", "state", "joint_state")
"""What each step of an episode has in numbers."""

MATRICES = ("intrinsics", "extrinsics")
"""What each view of an episode has once."""

MAPS: tuple[Extra, ...] = ("depth", "segmentation")
"""What each view of an episode has at each step on request."""

OUTCOME: Mapping[str, Literal["bool", "string"]] = {"success": "bool", "reason": "string"}
"""What each failure says of itself beside its provenance: ``success`` is false, ``reason`` as in the manifest."""


def provenance_of(extras: Collection[Extra]) -> dict[str, str]:
    """What each episode says of itself, to its type."""
    return {**SCHEMA.provenance, **(OUTCOME if "outcome" in extras else {})}


def named(extras: Collection[Extra]) -> bool:
    """Whether episodes with these extras have a table of names."""
    return bool({"segmentation", "object_poses"} & set(extras))


def check(episode: Episode, extras: Collection[Extra] = ()) -> None:
    """Refuse an episode that training would misread or choke on; it must have the ``extras`` beside the frames.

    Raises:
        PipelineError: naming the episode and the field.
    """
    steps = len(episode)
    if steps < SCHEMA.min_steps:
        expected = f"at least {SCHEMA.min_steps}, the chunk policies predict"
        raise _fault(episode, "action", f"has {steps} steps", expected)
    for name in MOTION:
        _check_array(episode, name, getattr(episode, name), getattr(SCHEMA, name), steps)
    low, high = SCHEMA.action.range
    if episode.action.min() < low or episode.action.max() > high:
        found = f"spans [{episode.action.min():g}, {episode.action.max():g}]"
        raise _fault(episode, "action", found, f"[{low:g}, {high:g}], as the controller clips it")
    _check_frames(episode, steps)
    _check_geometry(episode, steps, extras)
    if not episode.instruction.strip() or "_" in episode.instruction:
        # OpenVLA-OFT's loader spins for ever on an empty text; an underscore betrays a file name.
        raise _fault(episode, "instruction", f"is {episode.instruction!r}", "words, without underscores")
    columns = provenance_of(extras)
    if set(episode.provenance) != set(columns):
        wrong = sorted(set(episode.provenance) ^ set(columns))
        raise _fault(episode, "provenance", f"lacks or adds {wrong}", f"exactly {list(columns)}")
    types = {"string": str, "int64": int, "float32": float, "bool": bool}
    if wrong := sorted(k for k, v in episode.provenance.items() if not isinstance(v, types[columns[k]])):
        expected = ", ".join(f"{columns[key]} in {key}" for key in wrong)
        raise _fault(episode, "provenance", f"holds something else in {wrong}", expected)
    if episode.provenance["episode_id"] != episode.episode_id:
        raise _fault(episode, "provenance", f"names episode {episode.provenance['episode_id']!r}", "its own episode_id")


def _check_frames(episode: Episode, steps: int) -> None:
    if set(episode.frames) != set(SCHEMA.views):
        raise _fault(episode, "frames", f"has the views {sorted(episode.frames)}", f"{sorted(SCHEMA.views)}")
    height, width, _ = SCHEMA.frame.shape
    expected = (SCHEMA.frame.encoding.upper(), "RGB", (width, height))
    for view, frames in episode.frames.items():
        if len(frames) != steps:
            raise _fault(episode, view, f"has {len(frames)} frames", f"{steps}, one per action")
        for index, data in enumerate(frames):
            try:
                scan = data.find(JPEG_SCAN)
                found = _look(data[: scan + SCAN_HEADER_BYTES] if scan >= 0 else data)
            except UnidentifiedImageError:
                raise _fault(episode, view, f"frame {index} is not an image", f"{expected}") from None
            if found != expected:
                raise _fault(episode, view, f"frame {index} is {found}", f"{expected}")
            if not data.endswith(JPEG_END):
                raise _fault(episode, view, f"frame {index} is cut short", "a whole JPEG file")


@lru_cache
def _look(header: bytes) -> tuple[str | None, str, tuple[int, int]]:
    """Format, mode and size of an image; frames of the same encoder begin with the same header."""
    with Image.open(io.BytesIO(header)) as image:
        return image.format, image.mode, image.size


def _check_geometry(episode: Episode, steps: int, extras: Collection[Extra]) -> None:
    if set(episode.geometry) != set(SCHEMA.views):
        raise _fault(episode, "geometry", f"has the views {sorted(episode.geometry)}", f"{sorted(SCHEMA.views)}")
    for view, geometry in episode.geometry.items():
        for name in MATRICES:
            _check_array(episode, f"{view}_{name}", getattr(geometry, name), getattr(SCHEMA, name))
        lengths = {name: len(files) for name, files in geometry.maps.items()}
        if lengths != {name: steps for name in MAPS if name in extras}:
            raise _fault(episode, f"{view} maps", f"have the lengths {lengths}", f"{steps} for each that is asked for")
    if ("object_poses" in extras) != (episode.object_poses is not None):
        raise _fault(episode, "object_poses", "are there or are not", "what render.extras asks for")
    if episode.object_poses is not None:
        _check_array(episode, "object_poses", episode.object_poses, SCHEMA.object_poses, steps)
    if named(extras) != bool(episode.instances):
        raise _fault(episode, "instances", f"has {len(episode.instances)} names", "some with segmentation or poses")


def _check_array(
    episode: Episode, field: str, values: NDArray[np.float32], spec: VectorSpec | MatrixSpec, *steps: int
) -> None:
    if values.shape != (*steps, *spec.shape) or values.dtype != np.dtype(spec.dtype):
        expected = f"{(*steps, *spec.shape)} of {spec.dtype}"
        raise _fault(episode, field, f"is {values.shape} of {values.dtype}", expected)
    if not np.isfinite(values).all():
        raise _fault(episode, field, "holds NaN or infinity", "finite numbers")


def _fault(episode: Episode, field: str, what: str, expected: str) -> PipelineError:
    return PipelineError(
        f"{field} {what}",
        where=f"episode {episode.episode_id}",
        expected=expected,
        remedy="mend what makes this episode, or drop it from the plan",
    )
