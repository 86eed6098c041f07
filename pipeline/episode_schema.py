"""``schemas/episode.json`` as a typed object, and the check of an episode against it."""

from __future__ import annotations

import io
from typing import Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import BaseModel, ConfigDict, model_validator

from pipeline.errors import PipelineError
from pipeline.files import schema_file
from pipeline.types import Episode

SCHEMA_FILE = schema_file("episode.json")

JPEG_END = b"\xff\xd9"


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ViewSpec(_Model):
    """One camera: its name in MuJoCo and its key in LeRobot; its key here is its name in RLDS."""

    camera: str
    lerobot_key: str


class FrameSpec(_Model):
    """How every frame is stored."""

    shape: tuple[int, int, int]
    dtype: str
    names: tuple[str, str, str]
    encoding: str


class VectorSpec(_Model):
    """A per-step vector; units stand in the names of its entries."""

    shape: tuple[int]
    dtype: str
    lerobot_key: str
    names: tuple[str, ...]

    @model_validator(mode="after")
    def _one_name_per_entry(self) -> Self:
        if len(self.names) != self.shape[0]:
            raise ValueError(f"{self.lerobot_key}: {len(self.names)} names for {self.shape[0]} entries")
        return self


class StateSpec(VectorSpec):
    """End-effector pose in ``frame`` and finger positions."""

    frame: str


class GripperSpec(_Model):
    """The two commands of the gripper entry."""

    open: float
    close: float


class ActionSpec(VectorSpec):
    """Controller input; ``unit_m`` and ``unit_rad`` are what an entry of 1 asks for."""

    range: tuple[float, float]
    unit_m: float
    unit_rad: float
    gripper: GripperSpec
    controller: str


class EpisodeSchema(_Model):
    """Names, shapes, units and signs that both writers read."""

    fps_hz: int
    robot_type: str
    image_rotation_deg: int
    min_steps: int
    views: dict[str, ViewSpec]
    frame: FrameSpec
    state: StateSpec
    joint_state: VectorSpec
    action: ActionSpec
    provenance: tuple[str, ...]


SCHEMA = EpisodeSchema.model_validate_json(SCHEMA_FILE.read_text())


def check(episode: Episode) -> None:
    """Refuse an episode that training would misread or choke on.

    Raises:
        PipelineError: naming the episode and the field.
    """
    steps = len(episode)
    if steps < SCHEMA.min_steps:
        raise _fault(
            episode, "action", f"has {steps} steps", f"at least {SCHEMA.min_steps}, the chunk policies predict"
        )
    _check_vector(episode, "state", episode.state, SCHEMA.state, steps)
    _check_vector(episode, "joint_state", episode.joint_state, SCHEMA.joint_state, steps)
    _check_vector(episode, "action", episode.action, SCHEMA.action, steps)
    low, high = SCHEMA.action.range
    if episode.action.min() < low or episode.action.max() > high:
        found = f"spans [{episode.action.min():g}, {episode.action.max():g}]"
        raise _fault(episode, "action", found, f"[{low:g}, {high:g}], as the controller clips it")
    _check_frames(episode, steps)
    if not episode.instruction.strip() or "_" in episode.instruction:
        # OpenVLA-OFT's loader spins for ever on an empty text; an underscore betrays a file name.
        raise _fault(episode, "instruction", f"is {episode.instruction!r}", "words, without underscores")
    if set(episode.provenance) != set(SCHEMA.provenance):
        wrong = sorted(set(episode.provenance) ^ set(SCHEMA.provenance))
        raise _fault(episode, "provenance", f"lacks or adds {wrong}", f"exactly {list(SCHEMA.provenance)}")
    if not all(isinstance(value, str) for value in episode.provenance.values()):
        wrong = sorted(key for key, value in episode.provenance.items() if not isinstance(value, str))
        raise _fault(episode, "provenance", f"holds something other than text in {wrong}", "text only")
    if episode.provenance["episode_id"] != episode.episode_id:
        raise _fault(episode, "provenance", f"names episode {episode.provenance['episode_id']!r}", "its own episode_id")


def _check_vector(episode: Episode, field: str, values: NDArray[np.float32], spec: VectorSpec, steps: int) -> None:
    expected = f"({steps}, {spec.shape[0]}) of {spec.dtype}"
    if values.shape != (steps, *spec.shape) or values.dtype != np.dtype(spec.dtype):
        raise _fault(episode, field, f"is {values.shape} of {values.dtype}", expected)
    if not np.isfinite(values).all():
        raise _fault(episode, field, "holds NaN or infinity", "finite numbers")


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
                with Image.open(io.BytesIO(data)) as image:  # reads the header only
                    found = (image.format, image.mode, image.size)
            except UnidentifiedImageError:
                raise _fault(episode, view, f"frame {index} is not an image", f"{expected}") from None
            if found != expected:
                raise _fault(episode, view, f"frame {index} is {found}", f"{expected}")
            if not data.endswith(JPEG_END):
                raise _fault(episode, view, f"frame {index} is cut short", "a whole JPEG file")


def _fault(episode: Episode, field: str, what: str, expected: str) -> PipelineError:
    return PipelineError(
        f"{field} {what}",
        where=f"episode {episode.episode_id}",
        expected=expected,
        remedy="mend what makes this episode, or drop it from the plan",
    )
