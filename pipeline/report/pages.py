"""Self-contained HTML pages from ``templates/``: pictures and videos are ``data:`` addresses."""

import base64
import io
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from pipeline import templates
from pipeline.images.jpeg import decode
from pipeline.images.mp4 import mp4
from pipeline.report import figures
from pipeline.report.sheets import MOMENT
from pipeline.types import Frame, Jpeg

PICTURE_PX, PICTURE_QUALITY = 1100, 80
"""Largest width of a picture, at which captions of a contact sheet can be read, and its JPEG quality."""


def render(template: str, **values: Any) -> str:
    """Render a page; values are escaped, and a name without a value is an error."""
    pages = templates.environment("pipeline.report", escapes_html=True)
    pages.globals["colour"] = figures.colour
    pages.filters["counted"] = counted
    return pages.get_template(template).render(**values)


def counted(number: int, one: str, several: str = "") -> str:
    """Format a number with a noun, such as ``1 episode`` or ``10,030 episodes``.

    Args:
        number: the number.
        one: the noun in the singular.
        several: the noun in the plural, if it is not ``one`` with an s.
    """
    return f"{number:,} {one if number == 1 else several or f'{one}s'}"


class Clip(NamedTuple):
    """A video and its poster picture, both as ``data:`` addresses."""

    video: str
    poster: str


def picture(image: Image.Image) -> str:
    """Encode an image as the address of a JPEG."""
    scaled = image.convert("RGB")
    scaled.thumbnail((PICTURE_PX, scaled.height), Image.Resampling.LANCZOS)
    packed = io.BytesIO()
    scaled.save(packed, "jpeg", quality=PICTURE_QUALITY, optimize=True)
    return _address("image/jpeg", packed.getvalue())


def show_side_by_side(twin: Sequence[Jpeg], episode: Sequence[Jpeg]) -> Clip:
    """Show two episodes' stored frames side by side, in real time; the shorter episode stays at its last frame."""
    frames: list[Frame] = []
    left = right = decode(twin[0])
    for twin_frame, frame in zip_longest(map(decode, twin), map(decode, episode)):
        if twin_frame is not None:
            left = twin_frame
        if frame is not None:
            right = frame
        frames.append(np.concatenate([left, right], axis=1))
    poster = Image.fromarray(frames[int(MOMENT * len(frames))])
    return Clip(_address("video/mp4", mp4(frames, range(len(frames)))), picture(poster))


def video_of(file: Path) -> str:
    """Return the address of a video file, whose bytes stay unchanged."""
    return _address("video/mp4", file.read_bytes())


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
