"""Comparison of a user's picture with a rendered frame: orientation, colour channels, shape, brightness.

All differences are in grey levels, of pixels that are smoothed by ``SMOOTH_PX``. Smoothing leaves most of the noise of
JPEG files and of other renderers out.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.images.jpeg import decode, resized
from pipeline.types import Frame

Smooth = NDArray[np.float32]
"""(S, S, 3) smoothed pixels."""

SIZE_PX = 256
"""Side of our frames, and largest side of a comparison."""

SMALLEST_PX = 64
"""Smallest height and width of a picture that can be compared."""

SMOOTH_PX = 1.5
"""Standard deviation of the smoothing, in pixels of 256."""

PATCH_PX = 16
"""Side of the patch of the largest difference, in pixels of 256."""

FITTING = 10.0
"""Largest difference over a patch between pictures of equal places.

Measured: JPEG files of quality 50 differ by up to 5, the states after 8 and 12 settling steps by up to 13. Pictures of
other places differ by 16 or more (``benchmarks/LOG.md``).
"""

BRIGHTNESS = (0.3, 3.0)
"""Bounds of a fitted brightness."""

DARK = 20.0
"""Grey level below which pixels have no part in the brightness."""


class Orientation(NamedTuple):
    """Rotation or reflection of a picture.

    Attributes:
        words: the change that turns our frame into the picture.
        undo: function that turns the picture into our frame.
        code: the same in NumPy.
    """

    words: str
    undo: Callable[[Frame], Frame]
    code: str


UPRIGHT = Orientation("not rotated", lambda image: image, "image")
ORIENTATIONS = (
    UPRIGHT,
    Orientation("rotated by 180 degrees", lambda image: image[::-1, ::-1], "image[::-1, ::-1]"),
    Orientation("mirrored left to right", lambda image: image[:, ::-1], "image[:, ::-1]"),
    Orientation("mirrored top to bottom", lambda image: image[::-1], "image[::-1]"),
    Orientation("rotated by 90 degrees clockwise", lambda image: np.rot90(image), "np.rot90(image)"),
    Orientation("rotated by 90 degrees counterclockwise", lambda image: np.rot90(image, -1), "np.rot90(image, -1)"),
    Orientation("transposed", lambda image: image.swapaxes(0, 1), "image.swapaxes(0, 1)"),
    Orientation(
        "transposed and rotated by 180 degrees",
        lambda image: image[::-1, ::-1].swapaxes(0, 1),
        "image[::-1, ::-1].swapaxes(0, 1)",
    ),
)


class Variant(NamedTuple):
    """A picture with orientation, channels and shape undone.

    Attributes:
        swapped: True if red and blue were exchanged.
        shape: ``square``; ``stretched``, to another height or width; or ``widened``, by more of its surroundings.
        pixels: (S, S, 3) uint8; S is at most ``SIZE_PX``.
        smooth: the same, smoothed.
    """

    orientation: Orientation
    swapped: bool
    shape: str
    pixels: Frame
    smooth: Smooth


@dataclass(frozen=True)
class Fit:
    """Difference of a picture from a rendered frame.

    Attributes:
        brightness: brightness of the picture in multiples of the frame's: the median over pixels.
        error: mean absolute difference from the frame in this brightness.
        worst: largest mean of this difference over a patch of ``PATCH_PX``.
        residual: (S, S) this difference.
    """

    brightness: float
    error: float
    worst: float
    residual: NDArray[np.float32]

    @property
    def fits(self) -> bool:
        """Return whether the picture shows the frame's scene, places and view."""
        return self.worst <= FITTING


def read_picture(file: Path) -> Frame:
    """Read a picture file.

    Raises:
        PipelineError: if the file is no colour picture, or if it is too small.
    """
    expected = "a PNG or JPEG file of the first observation"
    if not file.is_file():
        raise PipelineError("there is no such file", where=file, expected=expected)
    try:
        picture = decode(file.read_bytes())
    except (ValueError, cv2.error) as error:
        raise PipelineError("the file is not a picture", where=file, expected=expected) from error
    if min(picture.shape[:2]) < SMALLEST_PX:
        height, width, _ = picture.shape
        raise PipelineError(
            f"the picture has {width} x {height} pixels",
            where=file,
            expected=f"{SMALLEST_PX} or more pixels in width and height",
            remedy="save the observation at its full size",
        )
    red, green, blue = np.moveaxis(picture, 2, 0)
    if np.array_equal(red, green) and np.array_equal(red, blue):
        raise PipelineError(
            "the picture has no colours", where=file, expected="RGB", remedy="save the observation with its colours"
        )
    return picture


def variants(picture: Frame) -> Iterator[Variant]:
    """Yield the picture with each orientation, order of channels and shape undone."""
    for shape, square in _cut_squares(picture).items():
        for swapped in (False, True):
            coloured = square[..., ::-1] if swapped else square
            for orientation in ORIENTATIONS:
                pixels = np.ascontiguousarray(orientation.undo(coloured))
                yield Variant(orientation, swapped, shape, pixels, smooth_picture(pixels))


def _cut_squares(picture: Frame) -> dict[str, Frame]:
    """Return the shapes that a picture may have, each cut or resized to a square of at most ``SIZE_PX``."""
    height, width, _ = picture.shape
    side = min(height, width)
    target = min(side, SIZE_PX)
    if height == width:
        return {"square": resized(picture, target, target)}
    top, left = (height - side) // 2, (width - side) // 2
    middle = picture[top : top + side, left : left + side]
    return {"stretched": resized(picture, target, target), "widened": resized(middle, target, target)}


def smooth_picture(pixels: Frame) -> Smooth:
    """Smooth a square picture."""
    deviation_px = SMOOTH_PX * len(pixels) / SIZE_PX
    return np.asarray(cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), deviation_px), np.float32)


def fit(picture: Smooth, frame: Frame) -> Fit:
    """Compare a smoothed picture (S, S, 3) with a rendered frame (256, 256, 3)."""
    side = len(picture)
    reference = smooth_picture(resized(frame, side, side))
    brightness = _measure_brightness(picture, reference)
    residual = np.abs(picture - brightness * reference).mean(axis=2)
    patch_px = max(round(PATCH_PX * side / SIZE_PX), 1)
    worst = float(cv2.blur(residual, (patch_px, patch_px), borderType=cv2.BORDER_REFLECT).max())
    return Fit(brightness, float(residual.mean()), worst, residual)


def _measure_brightness(picture: Smooth, reference: Smooth) -> float:
    """Return the median brightness of a picture in multiples of the reference's; 1.0 if the reference is black."""
    bright = reference.mean(axis=2) > DARK
    if not bright.any():
        return 1.0
    ratio = picture[bright].mean(axis=1) / reference[bright].mean(axis=1)
    return float(np.clip(np.median(ratio), *BRIGHTNESS))


def difference(picture: Frame, frame: Frame) -> float:
    """Return the mean absolute difference of a square picture from a frame, without smoothing or a fit."""
    side = len(picture)
    reference: NDArray[Any] = resized(frame, side, side).astype(np.int16)
    return float(np.abs(picture - reference).mean())
