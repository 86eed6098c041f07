"""Building blocks of procedural images: periodic noise, places, colours and cells, which tile without a seam."""

import colorsys
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pipeline.types import Floats

SIDE_PX = 512

Rng = np.random.Generator
Colour = NDArray[np.float64]
"""(3,) RGB in [0, 1]."""


@cache
def frequency() -> tuple[Floats, Floats]:
    """Return whole cycles per image along rows (512, 1) and columns (1, 257), in the order of ``rfft2``."""
    down, right = np.fft.fftfreq(SIDE_PX, 1 / SIDE_PX), np.fft.rfftfreq(SIDE_PX, 1 / SIDE_PX)
    return np.asarray(down, np.float64)[:, None], np.asarray(right, np.float64)[None]


def relief(rng: Rng, roughness: float, stretch: tuple[float, float] = (1, 1), coarsest: float = 1) -> Floats:
    """Generate fractal noise (512, 512) with mean 0 and standard deviation 1.

    Args:
        rng: source of random numbers.
        roughness: exponent of the amplitude spectrum, 0 for white noise; about 1 gives clouds, 2 soft hills.
        stretch: length of the features down and to the right, relative to the length of round features.
        coarsest: lowest frequency with full amplitude, in cycles per image.
    """
    down, right = frequency()
    radius = np.hypot(down * stretch[0], right * stretch[1])
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE_PX, SIDE_PX))) * np.maximum(radius, coarsest) ** -roughness
    spectrum[0, 0] = 0
    relief = np.fft.irfft2(spectrum, (SIDE_PX, SIDE_PX))
    return np.asarray(relief / relief.std())


def grid() -> tuple[Floats, Floats]:
    """Return the place of the pixels' centres, down (512, 1) and right (1, 512), in [0, 1]."""
    place = (np.arange(SIDE_PX) + 0.5) / SIDE_PX
    return place[:, None], place[None]


def colour(rng: Rng, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]) -> Colour:
    """Sample a colour whose hue, saturation and value are uniform in the given intervals; hues are modulo 1."""
    h, s, v = (rng.uniform(*interval) for interval in (hue, saturation, value))
    return np.array(colorsys.hsv_to_rgb(h % 1, s, v))


def mix(low: Colour, high: Colour, share: Floats) -> Floats:
    """Mix two colours to an image (512, 512, 3); the share (512, 512) of ``high`` is clipped to [0, 1]."""
    t = share.clip(0, 1)[..., None]
    return np.asarray(low * (1 - t) + high * t)


def cells(
    rng: Rng, rows: int, columns: int, joint: float, offset: float
) -> tuple[Floats, NDArray[np.intp], tuple[Floats, Floats]]:
    """Divide an image into a wall of rectangular cells, every second row shifted by ``offset`` of a cell.

    Returns:
        Three values for each pixel. First the distance to the joint between cells (512, 512): 0 in the joint, 1 within
        a cell, softened over a pixel or two. Then the number of the pixel's cell. Last the place of the pixel,
        moved by a random shift of its cell, for patterns that differ from cell to cell.
    """
    down, right = grid()
    row = np.floor(down * rows).astype(np.intp)
    along = right * columns + offset * (row % 2)
    column = np.floor(along).astype(np.intp) % columns
    edge_down = np.minimum((down * rows) % 1, 1 - (down * rows) % 1) / rows
    edge_right = np.minimum(along % 1, 1 - along % 1) / columns
    inside = ((np.minimum(edge_down, edge_right) - joint / 2) * SIDE_PX / 1.5).clip(0, 1)
    number = row * columns + column
    shift = rng.integers(SIDE_PX, size=(2, rows * columns))[:, number]
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX]
    return inside, number, ((y + shift[0]) % SIDE_PX, (x + shift[1]) % SIDE_PX)
