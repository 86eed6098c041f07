"""Procedural surfaces: seamless colour maps and data maps, with any number of textures in each family.

A texture depends on its family, its index and :data:`RECIPE` alone. NumPy generates it in about 0.1 s. The data maps
are in :mod:`pipeline.catalogue.data_maps`.
"""

from collections.abc import Callable

import numpy as np

from pipeline import seeding
from pipeline.catalogue.data_maps import DATA_MAPS
from pipeline.catalogue.patterns import Rng, cells, colour, grid, mix, relief
from pipeline.types import Floats, Frame

RECIPE = 1
"""Number to raise whenever a change here changes pixels: it is part of every texture's hash."""


def texture(family: str, index: int) -> Frame:
    """Generate the RGB image (512, 512, 3) of one texture of a family."""
    image = FAMILIES[family](seeding.rng("texture", RECIPE, family, index))
    return np.asarray(np.rint(image.clip(0.03, 0.94) * 255), np.uint8)


def _wood(rng: Rng) -> Floats:
    """Generate wood, as boards or one sheet: long fibres, and year rings that the warp of the trunk bends."""
    light = colour(rng, (0.045, 0.11), (0.2, 0.65), (0.35, 0.9))
    if rng.random() < 0.2:  # painted or stained
        light = colour(rng, (0, 1), (0.1, 0.5), (0.35, 0.8))
    dark = light * rng.uniform(0.5, 0.8) * np.array([1, 0.93, 0.85])
    fibres = relief(rng, 0.9, (1, 30), 12)
    warp = relief(rng, 1.8, (1, 6))
    down, _ = grid()
    rings = np.sin(2 * np.pi * (rng.integers(4, 12) * down + rng.uniform(0.3, 1.0) * warp))
    grain = 0.4 + rng.uniform(0.08, 0.25) * rings + rng.uniform(0.1, 0.25) * fibres
    boards = int(rng.choice([1, 2, 4, 6, 8]))
    if boards == 1:
        return mix(light, dark, grain)
    inside, number, (y, x) = cells(rng, boards, int(rng.integers(1, 3)), 0.004, 0.5)
    tone = 1 + rng.uniform(0.03, 0.12) * rng.standard_normal(number.max() + 1)[number]
    board = mix(light, dark, grain[y, x]) * tone[..., None]
    return np.asarray(board * (0.45 + 0.55 * inside)[..., None])


def _stone(rng: Rng) -> Floats:
    """Generate marble with veins, or speckled granite."""
    base = colour(rng, (0, 1), (0.0, 0.18), (0.3, 0.9))
    if rng.random() < 0.5:
        cloud, fold = relief(rng, 1.3), relief(rng, rng.uniform(1.2, 1.6))
        ridge = np.exp(-np.abs(fold) / rng.uniform(0.05, 0.2)) * (0.4 + 0.3 * relief(rng, 1.2)).clip(0, 1)
        vein = base * rng.uniform(0.3, 0.6) if base.mean() > 0.5 else 0.35 * base + 0.6
        shade = base * rng.uniform(0.75, 0.95)
        clouded = mix(base, shade, 0.5 + 0.35 * cloud)
        weight = (1.2 * ridge).clip(0, 1)[..., None]
        return np.asarray(clouded * (1 - weight) + vein * weight)
    grains = relief(rng, rng.uniform(0.5, 0.8), coarsest=float(rng.uniform(20, 70)))
    specks = relief(rng, 0.6, coarsest=float(rng.uniform(20, 70)))
    stone = mix(base * 0.75, base * 1.15, 0.5 + 0.4 * grains)
    dark, light = (specks < -1.2)[..., None], (specks > 1.3)[..., None]
    return np.where(dark, base * 0.3, np.where(light, 0.3 * base + 0.6, stone))


def _tile(rng: Rng) -> Floats:
    """Generate square or oblong glazed tiles with grout, plain or in a chequered pair of colours."""
    rows = int(rng.choice([2, 3, 4, 6, 8, 12]))
    columns = rows if rng.random() < 0.7 else max(1, rows // 2)
    offset = 0.5 if columns != rows and rows % 2 == 0 else 0.0
    inside, number, (y, x) = cells(rng, rows, columns, float(rng.uniform(0.004, 0.012)), offset)
    first = colour(rng, (0, 1), (0.02, 0.5), (0.35, 0.92))
    second = first
    if rng.random() < 0.4 and rows % 2 == 0 and columns % 2 == 0:
        second = colour(rng, (0, 1), (0.02, 0.5), (0.2, 0.92))
    chequer = (number // columns + number % columns) % 2
    tone = 1 + rng.uniform(0.0, 0.07) * rng.standard_normal(rows * columns)[number]
    glaze = 1 + rng.uniform(0.01, 0.06) * relief(rng, 1.3)[y, x]
    face = np.where(chequer[..., None], second, first) * (tone * glaze)[..., None]
    grout = np.full(3, rng.uniform(0.25, 0.85))
    return np.asarray(grout + (face - grout) * inside[..., None])


def _brick(rng: Rng) -> Floats:
    """Generate bricks in running bond; each brick has its own tone and a rough face."""
    columns = int(rng.choice([2, 3, 4, 5]))
    inside, number, (y, x) = cells(rng, 2 * columns + 2 * int(rng.integers(0, 2)), columns, 0.016, 0.5)
    brick = colour(rng, (-0.02, 0.09), (0.15, 0.65), (0.35, 0.85))
    if rng.random() < 0.3:  # painted
        brick = colour(rng, (0, 1), (0.0, 0.35), (0.35, 0.9))
    tone = 1 + rng.uniform(0.04, 0.16) * rng.standard_normal(number.max() + 1)[number]
    face = 1 + rng.uniform(0.05, 0.12) * relief(rng, 0.8, coarsest=6)[y, x]
    mortar = np.full(3, rng.uniform(0.4, 0.8)) * (1 + 0.06 * relief(rng, 0.4))[..., None]
    ragged = (inside + 0.25 * relief(rng, 0.8, coarsest=20) * (inside < 1)).clip(0, 1)[..., None]
    return np.asarray(mortar + (brick * (tone * face)[..., None] - mortar) * ragged)


def _plaster(rng: Rng) -> Floats:
    """Generate painted plaster: stains over metres, the trowel's strokes, and grain."""
    paint = colour(rng, (0, 1), (0.02, 0.35), (0.4, 0.9))
    stains = rng.uniform(0.005, 0.035) * relief(rng, 1.5)
    strokes = rng.uniform(0.01, 0.06) * relief(rng, 1.1, (1, float(rng.uniform(1, 4))), 10)
    grain = rng.uniform(0.01, 0.06) * relief(rng, 0.4)
    return np.asarray(paint * (1 + stains + strokes + grain)[..., None])


def _fabric(rng: Rng) -> Floats:
    """Generate a plain weave of uneven threads, of one colour, striped or chequered."""
    down, right = grid()
    threads = int(rng.choice([48, 64, 96]))
    ground = colour(rng, (0, 1), (0.05, 0.65), (0.25, 0.85))
    second = colour(rng, (0, 1), (0.05, 0.65), (0.25, 0.85))
    bands = int(rng.choice([0, 0, 4, 6, 8, 12]))
    width = rng.uniform(0.2, 0.6)
    warp_on = ((right * bands) % 1 < width) & (bands > 0)
    weft_on = ((down * bands) % 1 < width) & (bands > 0) & bool(rng.random() < 0.6)
    over = np.sign(np.sin(np.pi * threads * down) * np.sin(np.pi * threads * right))
    shade_down = np.abs(np.sin(np.pi * threads * down)) + 0 * right
    shade_right = np.abs(np.sin(np.pi * threads * right)) + 0 * down
    is_weft = over > 0
    shade = 0.75 + 0.25 * np.where(is_weft, shade_down, shade_right)
    uneven = np.where(is_weft, relief(rng, 0.6, (1, 20), 12), relief(rng, 0.6, (20, 1), 12))
    dyed = np.where((is_weft & weft_on) | (~is_weft & warp_on), 1.0, 0.0)
    return np.asarray(mix(ground, second, dyed) * (shade * (1 + rng.uniform(0.03, 0.1) * uneven))[..., None])


def _metal(rng: Rng) -> Floats:
    """Generate metal, brushed, or dull with scratches and patina: steel, brass, copper or anodised."""
    hue = float(rng.choice([0.58, 0.58, 0.12, 0.05, rng.random()]))
    metal = colour(rng, (hue - 0.02, hue + 0.02), (0.03, 0.12) if hue == 0.58 else (0.2, 0.5), (0.35, 0.8))
    patina = rng.uniform(0.005, 0.05) * relief(rng, 1.5)
    if rng.random() < 0.5:
        brushed = rng.uniform(0.06, 0.16) * relief(rng, 0.7, (1, 60), 20)
        return np.asarray(metal * (1 + patina + brushed)[..., None])
    scratches = sum(np.exp(-np.abs(relief(rng, 1.8, s, 3)) / 0.03) for s in ((1, 9), (9, 1)))
    grain = rng.uniform(0.01, 0.04) * relief(rng, 0.3)
    return np.asarray(metal * (1 + patina + grain + rng.uniform(0.05, 0.2) * scratches)[..., None])


COLOUR_MAPS: dict[str, Callable[[Rng], Floats]] = {
    make.__name__.removeprefix("_"): make for make in (_wood, _stone, _tile, _brick, _plaster, _fabric, _metal)
}

FAMILIES = COLOUR_MAPS | DATA_MAPS
