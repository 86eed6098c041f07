"""Procedural images that look like the data maps of a material: normals, height, gloss and others.

LIBERO-Plus applies such maps to working surfaces as if they were colours: 751 of its 1,076 background tests name one.
Each map here is computed from a random relief.
"""

import colorsys
from collections.abc import Callable

import numpy as np

from pipeline.catalogue.patterns import SIDE_PX, Rng, cells, colour, frequency, grid, mix, relief
from pipeline.types import Floats


def _rock(rng: Rng) -> Floats:
    """Return heights (512, 512) of plaster, gravel or rock."""
    return relief(rng, float(rng.uniform(0.8, 1.7)), coarsest=float(rng.choice([2, 4, 8, 16])))


def _ridges(rng: Rng) -> Floats:
    """Return heights (512, 512) of cracks between rounded lumps, or of wrinkles."""
    folded = np.abs(relief(rng, float(rng.uniform(1.4, 1.9)), coarsest=float(rng.choice([2, 4, 8]))))
    return np.asarray(rng.choice([-1.0, 1.0]) * np.sqrt(folded) + 0.05 * relief(rng, 0.8))


def _blocks(rng: Rng) -> Floats:
    """Return heights (512, 512) of boards, tiles or bricks with joints between them."""
    rows, columns = (int(n) for n in rng.choice([(2, 2), (4, 4), (6, 6), (8, 2), (8, 4), (12, 6), (6, 1)]))
    inside, number, (y, x) = cells(rng, rows, columns, float(rng.uniform(0.006, 0.02)), 0.5 * (rows != columns))
    stretch = (1.0, float(rng.choice([1, 1, 12])))
    level = rng.uniform(0.0, 0.6) * rng.standard_normal(rows * columns)[number]
    return np.asarray(2 * inside + level + rng.uniform(0.1, 0.4) * relief(rng, 1.0, stretch, 6)[y, x])


def _weave(rng: Rng) -> Floats:
    """Return heights (512, 512) of a plain weave."""
    down, right = grid()
    threads = int(rng.choice([24, 32, 48, 64]))
    waves = np.sin(np.pi * threads * down), np.sin(np.pi * threads * right)
    over = waves[0] * waves[1] > 0
    return np.asarray(np.where(over, np.abs(waves[0]), np.abs(waves[1])) + 0.15 * relief(rng, 1.0, coarsest=4))


def _fibres(rng: Rng) -> Floats:
    """Return heights (512, 512) of grooves along one direction, like those of wood or brushed metal."""
    return relief(rng, float(rng.uniform(0.7, 1.2)), (1, float(rng.uniform(8, 40))), 6) + 0.4 * relief(rng, 1.7)


_RELIEFS = (_rock, _ridges, _blocks, _weave, _fibres)


def _heights(rng: Rng) -> Floats:
    """Generate a random relief (512, 512) with mean 0 and standard deviation 1."""
    heights = _RELIEFS[rng.integers(len(_RELIEFS))](rng)
    return np.asarray((heights - heights.mean()) / heights.std())


def _smooth(heights: Floats, sigma_px: float) -> Floats:
    """Smooth ``heights`` with a periodic Gaussian."""
    down, right = frequency()
    fall = np.exp(-2 * (np.pi * sigma_px / SIDE_PX) ** 2 * (down**2 + right**2))
    return np.asarray(np.fft.irfft2(np.fft.rfft2(heights) * fall, heights.shape))


def _grey(level: Floats) -> Floats:
    """Repeat a grey image (512, 512) as an RGB image (512, 512, 3)."""
    return np.repeat(level[..., None], 3, axis=2)


def _normal(rng: Rng) -> Floats:
    """Return a normal map: the directions that a relief faces, as red, green and blue.

    Level places have (0.5, 0.5, 1), so the map is bluish.
    """
    heights = _smooth(_heights(rng), 1.0)
    slopes = [(np.roll(heights, -1, axis) - np.roll(heights, 1, axis)) / 2 for axis in (1, 0)]
    steepness = rng.uniform(0.15, 0.6) / np.hypot(*slopes).std()
    # Maps for OpenGL and for DirectX differ in the sign of green.
    facing = np.stack([-slopes[0] * steepness, rng.choice([-1, 1]) * slopes[1] * steepness, np.ones_like(heights)], -1)
    return np.asarray(0.5 + 0.5 * facing / np.linalg.norm(facing, axis=-1, keepdims=True))


def _height(rng: Rng) -> Floats:
    """Return a height map, also called displacement or bump map: grey, and higher places are lighter."""
    return _grey(rng.uniform(0.3, 0.7) + rng.uniform(0.06, 0.2) * _heights(rng))


def _gloss(rng: Rng) -> Floats:
    """Return a gloss map: grey of low contrast, lighter where the surface is smoother.

    The surface is worn and smeared in places. An inverted gloss map is a roughness map.
    """
    worn = rng.uniform(0.02, 0.08) * _heights(rng) + rng.uniform(0.02, 0.07) * relief(rng, 1.5)
    return _grey(rng.uniform(0.2, 0.78) + worn + rng.uniform(0.0, 0.03) * relief(rng, 0.3))


def _reflection(rng: Rng) -> Floats:
    """Return a map of the colour that a surface reflects: grey of hardly any contrast, or a metal's tint."""
    tint = colour(rng, (0.05, 0.15), (0.0, 0.05) if rng.random() < 0.7 else (0.15, 0.4), (0.22, 0.8))
    faint = rng.uniform(0.02, 0.06) * _heights(rng) + rng.uniform(0.03, 0.07) * relief(rng, 1.6)
    return np.asarray(tint * (1 + faint)[..., None])


def _occlusion(rng: Rng) -> Floats:
    """Return an occlusion map: nearly white, and grey in the hollows that get little light."""
    heights = _heights(rng)
    hollow = (_smooth(heights, 4.0) - heights).clip(0) + (_smooth(heights, 16.0) - heights).clip(0)
    shadow = rng.uniform(0.06, 0.3) * hollow / hollow.std()
    return _grey(0.92 * np.exp(-shadow.clip(0, 1.6)) * (1 + rng.uniform(0.01, 0.03) * relief(rng, 1.7)))


def _flat(rng: Rng) -> Floats:
    """Return one colour with faint stains, or a map of object ids: patches of two pure colours.

    Maps of object ids distinguish the objects of a model by colour.
    """
    if rng.random() < 0.7:
        plain = colour(rng, (0, 1), (0.0, 0.7), (0.25, 0.9))
        return np.asarray(plain * (1 + rng.uniform(0.015, 0.04) * relief(rng, 1.7))[..., None])
    first, second = (np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.5, 0.9), 0.85)) for _ in range(2))
    return mix(first, second, 0.5 + 200 * _smooth(_heights(rng), 2.0))


DATA_MAPS: dict[str, Callable[[Rng], Floats]] = {
    make.__name__.removeprefix("_"): make for make in (_normal, _height, _gloss, _reflection, _occlusion, _flat)
}
"""Family to the function that generates an image (512, 512, 3) in [0, 1] of it."""
