"""Pictures and short videos as ``data:`` addresses, small enough to be part of a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from fractions import Fraction
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from PIL import Image

from pipeline.episode_schema import SCHEMA
from pipeline.publish.sheets import MOMENT
from pipeline.rendering.jpeg import decode
from pipeline.types import Frame

PICTURE_PX, PICTURE_QUALITY = 1100, 80
"""At most this wide: captions of a contact sheet can still be read."""

VIDEO_BYTES = 300_000
_ENCODER, _CRF = "libx264", "26"


class Clip(NamedTuple):
    """A video and the picture that stands for it, both as ``data:`` addresses."""

    video: str
    poster: str


def picture(image: Image.Image) -> str:
    """A JPEG of an image."""
    shown = image.convert("RGB")
    shown.thumbnail((PICTURE_PX, shown.height), Image.Resampling.LANCZOS)
    packed = io.BytesIO()
    shown.save(packed, "jpeg", quality=PICTURE_QUALITY, optimize=True)
    return _address("image/jpeg", packed.getvalue())


def picture_of(file: Path) -> str:
    """A JPEG of an image file."""
    with Image.open(file) as image:
        return picture(image)


def beside(twin: Sequence[bytes], episode: Sequence[bytes]) -> Clip:
    """Two episodes' stored frames side by side, in real time; the shorter one waits at its last frame."""
    pairs = zip_longest(map(decode, twin), map(decode, episode))
    shown: list[Frame] = []
    left = right = decode(twin[0])
    for one, other in pairs:
        left, right = left if one is None else one, right if other is None else other
        shown.append(np.concatenate([left, right], axis=1))
    poster = Image.fromarray(shown[int(MOMENT * len(shown))])
    return Clip(_address("video/mp4", _mp4(shown)), picture(poster))


def _mp4(frames: Sequence[Frame]) -> bytes:
    """H.264 that every browser plays, of at most ``VIDEO_BYTES``."""
    # A buffer of one second begins full, so that a video may have a second's bytes above its rate; a twentieth is left
    # for the container. One thread, as the bytes depend on their number.
    bits_per_s = int(0.95 * VIDEO_BYTES * 8 / (len(frames) / SCHEMA.fps_hz + 1))
    rate = {"maxrate": str(bits_per_s), "bufsize": str(bits_per_s)}
    limits = {"crf": _CRF, "preset": "medium", "threads": "1", **rate}
    packed = io.BytesIO()
    with av.open(packed, "w", format="mp4") as file:
        stream = file.add_stream(_ENCODER, SCHEMA.fps_hz, options=limits)
        stream.height, stream.width, _ = frames[0].shape
        stream.pix_fmt = "yuv420p"
        for index, shown in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(shown, format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, SCHEMA.fps_hz)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return packed.getvalue()


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
