"""What a view shows: streams of frames, how frames are turned and how they are encoded. No simulator here."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.axes import AnyPerturbation, PixelPerturbation, RenderPerturbation, from_json, to_json
from pipeline.config import RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.seeding import digest
from pipeline.types import Frame


@dataclass(frozen=True)
class Stream:
    """One view under the perturbations that show in it.

    Attributes:
        view: ``image`` or ``wrist_image``.
        perturbations: render and pixel layers, in the order they apply.
    """

    view: str
    perturbations: tuple[AnyPerturbation, ...]

    @property
    def stream_id(self) -> str:
        return digest("stream", self.view, to_json(self.perturbations))[:16]


def streams_of(perturbations_json: str) -> dict[str, Stream]:
    """View name to the stream that shows it, for an episode with these perturbations."""
    visible = [p for p in from_json(perturbations_json) if isinstance(p, RenderPerturbation | PixelPerturbation)]
    return {view: Stream(view, tuple(p for p in visible if view in p.views)) for view in SCHEMA.views}


def to_policy(frame: Frame) -> Frame:
    """Turn a raw LIBERO frame by 180 degrees, as OpenVLA trains and evaluates on it.

    This is the only place where frames are turned. LIBERO's raw frames have their first row at the bottom.
    """
    return np.ascontiguousarray(frame[::-1, ::-1])


def encode(frame: Frame, config: RenderConfig) -> bytes:
    """JPEG file of an RGB frame; every dataset carries these bytes or pixels decoded from them."""
    done, packed = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
    if not done:
        raise RuntimeError("OpenCV could not encode a frame as JPEG")
    return packed.tobytes()


def decode(packed: bytes) -> Frame:
    """(H, W, 3) uint8 RGB of an encoded frame."""
    frame = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR_RGB)
    if frame is None:
        raise ValueError("not an image that OpenCV can decode")
    return np.asarray(frame, np.uint8)
