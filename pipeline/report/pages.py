"""HTML pages from ``templates/``, that need nothing beside themselves: pictures and videos are ``data:`` addresses."""

import base64
import io
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from pipeline.images.jpeg import decode
from pipeline.images.mp4 import mp4
from pipeline.report import figures
from pipeline.report.sheets import MOMENT
from pipeline.types import Frame

PICTURE_PX, PICTURE_QUALITY = 1100, 80
"""At most this wide: captions of a contact sheet can still be read."""


def render(template: str, **values: Any) -> str:
    """A page; names that ``values`` lacks are an error, and what they hold is escaped."""
    environment = Environment(
        loader=PackageLoader("pipeline.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["colour"] = figures.colour
    environment.filters["counted"] = counted
    return environment.get_template(template).render(**values)


def counted(number: int, one: str, several: str = "") -> str:
    """Such as ``1 episode`` and ``10,030 episodes``; ``several`` where it is not ``one`` with an s."""
    return f"{number:,} {one if number == 1 else several or f'{one}s'}"


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


def beside(twin: Sequence[bytes], episode: Sequence[bytes]) -> Clip:
    """Two episodes' stored frames side by side, in real time; the shorter one waits at its last frame."""
    shown: list[Frame] = []
    left = right = decode(twin[0])
    for one, other in zip_longest(map(decode, twin), map(decode, episode)):
        left, right = left if one is None else one, right if other is None else other
        shown.append(np.concatenate([left, right], axis=1))
    poster = Image.fromarray(shown[int(MOMENT * len(shown))])
    return Clip(_address("video/mp4", mp4(shown, range(len(shown)))), picture(poster))


def video_of(file: Path) -> str:
    """A video file as it is."""
    return _address("video/mp4", file.read_bytes())


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
