"""Procedural surfaces: seven families of seamless colour maps, with any number of textures in each.

All patterns are periodic, so that they tile without a seam. A texture is determined by its family and index and
:data:`RECIPE` alone, and nothing but NumPy makes it, in about 0.1 s.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pipeline import seeding
from pipeline.types import Floats, Frame

RECIPE = 1
"""Raise it whenever a change here changes pixels: it is part of every texture's hash."""

SIDE_PX = 512

Rng = np.random.Generator
Colour = NDArray[np.float64]
"""(3,) RGB in [0, 1]."""


def texture(family: str, index: int) -> Frame:
    """(512, 512, 3) RGB of one texture of a family."""
    image = FAMILIES[family](seeding.rng("texture", RECIPE, family, index))
    return np.asarray(np.rint(image.clip(0.03, 0.94) * 255), np.uint8)


@cache
def _frequency() -> tuple[Floats, Floats]:
    """Whole cycles per image along rows (512, 1) and columns (1, 257), in the order of ``rfft2``."""
    down, right = np.fft.fftfreq(SIDE_PX, 1 / SIDE_PX), np.fft.rfftfreq(SIDE_PX, 1 / SIDE_PX)
    return np.asarray(down, np.float64)[:, None], np.asarray(right, np.float64)[None]


def _relief(rng: Rng, roughness: float, stretch: tuple[float, float] = (1, 1), coarsest: float = 1) -> Floats:
    """Fractal noise (512, 512) of mean 0 and deviation 1.

    Args:
        roughness: exponent of the amplitude spectrum, 0 for white noise; about 1 gives clouds, 2 soft hills.
        stretch: length of its features down and to the right, relative to that of round ones.
        coarsest: lowest frequency with full amplitude, in cycles per image.
    """
    down, right = _frequency()
    radius = np.hypot(down * stretch[0], right * stretch[1])
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE_PX, SIDE_PX))) * np.maximum(radius, coarsest) ** -roughness
    spectrum[0, 0] = 0
    relief = np.fft.irfft2(spectrum, (SIDE_PX, SIDE_PX))
    return np.asarray(relief / relief.std())


def _grid() -> tuple[Floats, Floats]:
    """Place of the pixels' centres, down (512, 1) and right (1, 512), in [0, 1]."""
    place = (np.arange(SIDE_PX) + 0.5) / SIDE_PX
    return place[:, None], place[None]


def _colour(rng: Rng, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]) -> Colour:
    h, s, v = (rng.uniform(*interval) for interval in (hue, saturation, value))
    return np.array(colorsys.hsv_to_rgb(h % 1, s, v))


def _mix(low: Colour, high: Colour, share: Floats) -> Floats:
    """(512, 512, 3) between two colours; ``share`` (512, 512) is cut to [0, 1]."""
    t = share.clip(0, 1)[..., None]
    return np.asarray(low * (1 - t) + high * t)


def _cells(
    rng: Rng, rows: int, columns: int, joint: float, offset: float
) -> tuple[Floats, NDArray[np.intp], tuple[Floats, Floats]]:
    """A wall of rectangular cells, every second row shifted by ``offset`` of a cell.

    Returns:
        Distance to the joint between cells, 0 in the joint and 1 within, softened over a pixel or two (512, 512);
        the number of the cell that each pixel belongs to; and the place of each pixel with its cell's own shift,
        for patterns that differ from cell to cell.
    """
    down, right = _grid()
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


def _wood(rng: Rng) -> Floats:
    """Boards or one sheet: long fibres, and year rings that the warp of the trunk bends."""
    light = _colour(rng, (0.045, 0.11), (0.2, 0.65), (0.35, 0.9))
    if rng.random() < 0.2:  # painted or stained
        light = _colour(rng, (0, 1), (0.1, 0.5), (0.35, 0.8))
    dark = light * rng.uniform(0.5, 0.8) * np.array([1, 0.93, 0.85])
    fibres = _relief(rng, 0.9, (1, 30), 12)
    warp = _relief(rng, 1.8, (1, 6))
    down, _ = _grid()
    rings = np.sin(2 * np.pi * (rng.integers(4, 12) * down + rng.uniform(0.3, 1.0) * warp))
    grain = 0.4 + rng.uniform(0.08, 0.25) * rings + rng.uniform(0.1, 0.25) * fibres
    boards = int(rng.choice([1, 2, 4, 6, 8]))
    if boards == 1:
        return _mix(light, dark, grain)
    inside, number, (y, x) = _cells(rng, boards, int(rng.integers(1, 3)), 0.004, 0.5)
    tone = 1 + rng.uniform(0.03, 0.12) * rng.standard_normal(number.max() + 1)[number]
    board = _mix(light, dark, grain[y, x]) * tone[..., None]
    return np.asarray(board * (0.45 + 0.55 * inside)[..., None])


def _stone(rng: Rng) -> Floats:
    """Marble with veins, or speckled granite."""
    base = _colour(rng, (0, 1), (0.0, 0.18), (0.3, 0.9))
    if rng.random() < 0.5:
        cloud, fold = _relief(rng, 1.3), _relief(rng, rng.uniform(1.2, 1.6))
        ridge = np.exp(-np.abs(fold) / rng.uniform(0.05, 0.2)) * (0.4 + 0.3 * _relief(rng, 1.2)).clip(0, 1)
        vein = base * rng.uniform(0.3, 0.6) if base.mean() > 0.5 else 0.35 * base + 0.6
        shade = base * rng.uniform(0.75, 0.95)
        clouded = _mix(base, shade, 0.5 + 0.35 * cloud)
        weight = (1.2 * ridge).clip(0, 1)[..., None]
        return np.asarray(clouded * (1 - weight) + vein * weight)
    grains = _relief(rng, rng.uniform(0.5, 0.8), coarsest=float(rng.uniform(20, 70)))
    specks = _relief(rng, 0.6, coarsest=float(rng.uniform(20, 70)))
    stone = _mix(base * 0.75, base * 1.15, 0.5 + 0.4 * grains)
    dark, light = (specks < -1.2)[..., None], (specks > 1.3)[..., None]
    return np.where(dark, base * 0.3, np.where(light, 0.3 * base + 0.6, stone))


def _tile(rng: Rng) -> Floats:
    """Square or oblong glazed tiles with grout, plain or in a chequered pair of colours."""
    rows = int(rng.choice([2, 3, 4, 6, 8, 12]))
    columns = rows if rng.random() < 0.7 else max(1, rows // 2)
    offset = 0.5 if columns != rows and rows % 2 == 0 else 0.0
    inside, number, (y, x) = _cells(rng, rows, columns, float(rng.uniform(0.004, 0.012)), offset)
    first = _colour(rng, (0, 1), (0.02, 0.5), (0.35, 0.92))
    second = first
    if rng.random() < 0.4 and rows % 2 == 0 and columns % 2 == 0:
        second = _colour(rng, (0, 1), (0.02, 0.5), (0.2, 0.92))
    chequer = (number // columns + number % columns) % 2
    tone = 1 + rng.uniform(0.0, 0.07) * rng.standard_normal(rows * columns)[number]
    glaze = 1 + rng.uniform(0.01, 0.06) * _relief(rng, 1.3)[y, x]
    face = np.where(chequer[..., None], second, first) * (tone * glaze)[..., None]
    grout = np.full(3, rng.uniform(0.25, 0.85))
    return np.asarray(grout + (face - grout) * inside[..., None])


def _brick(rng: Rng) -> Floats:
    """Running bond; each brick has its own tone and a rough face."""
    columns = int(rng.choice([2, 3, 4, 5]))
    inside, number, (y, x) = _cells(rng, 2 * columns + 2 * int(rng.integers(0, 2)), columns, 0.016, 0.5)
    brick = _colour(rng, (-0.02, 0.09), (0.15, 0.65), (0.35, 0.85))
    if rng.random() < 0.3:  # painted
        brick = _colour(rng, (0, 1), (0.0, 0.35), (0.35, 0.9))
    tone = 1 + rng.uniform(0.04, 0.16) * rng.standard_normal(number.max() + 1)[number]
    face = 1 + rng.uniform(0.05, 0.12) * _relief(rng, 0.8, coarsest=6)[y, x]
    mortar = np.full(3, rng.uniform(0.4, 0.8)) * (1 + 0.06 * _relief(rng, 0.4))[..., None]
    ragged = (inside + 0.25 * _relief(rng, 0.8, coarsest=20) * (inside < 1)).clip(0, 1)[..., None]
    return np.asarray(mortar + (brick * (tone * face)[..., None] - mortar) * ragged)


def _plaster(rng: Rng) -> Floats:
    """Painted plaster: stains over metres, the trowel's strokes, and grain."""
    paint = _colour(rng, (0, 1), (0.02, 0.35), (0.4, 0.9))
    stains = rng.uniform(0.005, 0.035) * _relief(rng, 1.5)
    strokes = rng.uniform(0.01, 0.06) * _relief(rng, 1.1, (1, float(rng.uniform(1, 4))), 10)
    grain = rng.uniform(0.01, 0.06) * _relief(rng, 0.4)
    return np.asarray(paint * (1 + stains + strokes + grain)[..., None])


def _fabric(rng: Rng) -> Floats:
    """Plain weave of uneven threads, of one colour, striped or chequered."""
    down, right = _grid()
    threads = int(rng.choice([48, 64, 96]))
    ground = _colour(rng, (0, 1), (0.05, 0.65), (0.25, 0.85))
    second = _colour(rng, (0, 1), (0.05, 0.65), (0.25, 0.85))
    bands = int(rng.choice([0, 0, 4, 6, 8, 12]))
    width = rng.uniform(0.2, 0.6)
    warp_on = ((right * bands) % 1 < width) & (bands > 0)
    weft_on = ((down * bands) % 1 < width) & (bands > 0) & bool(rng.random() < 0.6)
    over = np.sign(np.sin(np.pi * threads * down) * np.sin(np.pi * threads * right))
    shade_down = np.abs(np.sin(np.pi * threads * down)) + 0 * right
    shade_right = np.abs(np.sin(np.pi * threads * right)) + 0 * down
    is_weft = over > 0
    shade = 0.75 + 0.25 * np.where(is_weft, shade_down, shade_right)
    uneven = np.where(is_weft, _relief(rng, 0.6, (1, 20), 12), _relief(rng, 0.6, (20, 1), 12))
    dyed = np.where((is_weft & weft_on) | (~is_weft & warp_on), 1.0, 0.0)
    return np.asarray(_mix(ground, second, dyed) * (shade * (1 + rng.uniform(0.03, 0.1) * uneven))[..., None])


def _metal(rng: Rng) -> Floats:
    """Brushed, or dull with scratches and patina; steel, brass, copper or anodised."""
    hue = float(rng.choice([0.58, 0.58, 0.12, 0.05, rng.random()]))
    metal = _colour(rng, (hue - 0.02, hue + 0.02), (0.03, 0.12) if hue == 0.58 else (0.2, 0.5), (0.35, 0.8))
    patina = rng.uniform(0.005, 0.05) * _relief(rng, 1.5)
    if rng.random() < 0.5:
        brushed = rng.uniform(0.06, 0.16) * _relief(rng, 0.7, (1, 60), 20)
        return np.asarray(metal * (1 + patina + brushed)[..., None])
    scratches = sum(np.exp(-np.abs(_relief(rng, 1.8, s, 3)) / 0.03) for s in ((1, 9), (9, 1)))
    grain = rng.uniform(0.01, 0.04) * _relief(rng, 0.3)
    return np.asarray(metal * (1 + patina + grain + rng.uniform(0.05, 0.2) * scratches)[..., None])


FAMILIES: dict[str, Callable[[Rng], Floats]] = {
    "wood": _wood,
    "stone": _stone,
    "tile": _tile,
    "brick": _brick,
    "plaster": _plaster,
    "fabric": _fabric,
    "metal": _metal,
}
