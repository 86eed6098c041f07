"""Colours of textures as MuJoCo 3.3.3 and later render them.

These versions decode a PNG image as sRGB if the file has the chunk ``sRGB``; earlier versions use its numbers as they
are. Among LIBERO's 170 images, two floors and two textures of the salad dressing have the chunk.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.plain_renderer import texels
from pipeline.rendering.renderer import Renderer

FIRST_VERSION = "3.3.3"
"""First version of MuJoCo that decodes sRGB."""

SIGNATURE = b"\x89PNG\r\n\x1a\n"


@contextmanager
def decoded(renderer: Renderer) -> Iterator[None]:
    """Render with decoded textures, and undo the change at the end."""
    textures = [number for number in range(renderer.model.ntex) if _is_srgb(_file_of(renderer.model, number))]
    views = texels(renderer.model)
    former = {number: views[number].copy() for number in textures}
    try:
        for number in textures:
            views[number][:] = _LINEAR[views[number]]
        renderer.model_renderer.load(textures)
        yield
    finally:
        for number, values in former.items():
            views[number][:] = values
        renderer.model_renderer.load(textures)


def _linear() -> NDArray[np.uint8]:
    """Return the linear value (256,) of each sRGB value (IEC 61966-2-1)."""
    share = np.arange(256) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(linear * 255), np.uint8)


_LINEAR = _linear()


def _file_of(model: mujoco.MjModel, texture: int) -> Path | None:
    """Return the file of a texture; `None` if it has none."""
    first = int(model.tex_pathadr[texture])
    if first < 0:
        return None
    names: bytes = model.paths
    return Path(names[first : names.index(b"\0", first)].decode())


@cache
def _is_srgb(file: Path | None) -> bool:
    """Return whether a file is a PNG image with the chunk ``sRGB``."""
    if file is None or not file.is_file():
        return False
    content = file.read_bytes()
    place = len(SIGNATURE)
    if not content.startswith(SIGNATURE):
        return False
    while place + 8 <= len(content):
        length, kind = int.from_bytes(content[place : place + 4]), content[place + 4 : place + 8]
        if kind in (b"sRGB", b"IDAT"):
            return kind == b"sRGB"
        place += 12 + length  # length, kind and checksum have four bytes each
    return False
