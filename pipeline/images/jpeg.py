"""Frames as a policy sees them, and as JPEG files. Light to import: no simulator, no axes."""

from __future__ import annotations

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.types import Frame, Jpeg

Pixels = TypeVar("Pixels", bound=np.integer)


def to_policy(frame: NDArray[Pixels]) -> NDArray[Pixels]:
    """Turn a raw LIBERO frame by 180 degrees, as OpenVLA trains and evaluates on it.

    This is the only place where frames are turned. LIBERO's raw frames have their first row at the bottom.
    """
    return np.asarray(cv2.flip(frame, -1), frame.dtype)


def resized(frame: Frame, height_px: int, width_px: int) -> Frame:
    """Resize a frame: smaller by the mean of the area that a pixel covers, larger as OpenCV's INTER_AREA.

    The latter repeats pixels at whole factors, and blends neighbours at others.
    If the frame has the requested size already, return the frame itself.
    """
    if frame.shape[:2] == (height_px, width_px):
        return frame
    return np.asarray(cv2.resize(frame, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)


def encode(frame: Frame, jpeg_quality: int) -> Jpeg:
    """Encode an RGB frame as a JPEG file; every dataset carries these bytes or pixels decoded from them."""
    bgr = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    _, packed = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    return Jpeg(packed.tobytes())


def encode_exactly(pixels: NDArray[Any]) -> bytes:
    """Encode pixels (H, W) of uint8 or uint16 as a PNG file."""
    _, packed = cv2.imencode(".png", pixels)
    return packed.tobytes()


def decode(packed: bytes) -> Frame:
    """Decode an encoded frame to (H, W, 3) uint8 RGB.

    Raises:
        ValueError: if OpenCV cannot decode the bytes.
    """
    frame = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR_RGB)
    if frame is None:
        raise ValueError("not an image that OpenCV can decode")
    return np.asarray(frame, np.uint8)


def decode_exactly(packed: bytes) -> NDArray[Any]:
    """Decode a PNG file of ``encode_exactly`` to its pixels (H, W).

    Raises:
        ValueError: if OpenCV cannot decode the bytes.
    """
    pixels = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("not an image that OpenCV can decode")
    return np.asarray(pixels)
