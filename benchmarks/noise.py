"""Time per frame of each corruption at its strongest level, beside the straightforward way to compute it.

The reference is the library that LIBERO-Plus calls where there is one, else a plain loop over pixels.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom
from skimage.filters import gaussian
from wand.image import Image

from pipeline import seeding
from pipeline.axes.noise import Effect, NoiseAxis
from pipeline.types import Frame

SIDE_PX = 256
REPEATS = 5
AXIS = NoiseAxis()
MOTION, GAUSSIAN, ZOOM, FOG, GLASS = AXIS.motion[-1], AXIS.gaussian[-1], AXIS.zoom[-1], AXIS.fog[-1], AXIS.glass[-1]


def make_frame() -> Frame:
    """(256, 256, 3): shaded surfaces with edges and grain, like a rendered table top."""
    rng = seeding.rng("benchmark", "noise")
    surfaces = np.kron(rng.uniform(40, 200, (8, 8, 3)), np.ones((32, 32, 1)))
    shading = np.linspace(0.6, 1.2, SIDE_PX)[:, None, None]
    frame: Frame = (surfaces * shading + rng.normal(0, 4, surfaces.shape)).clip(0, 255).astype(np.uint8)
    return frame


def to_frame(image: NDArray[np.floating]) -> Frame:
    return (image * 255).astype(np.uint8)


def imagemagick_motion(frame: Frame) -> Frame:
    with Image.from_array(frame) as image:
        image.motion_blur(radius=MOTION.radius_px, sigma=MOTION.sigma_px, angle=30)
        return np.array(image)


def scikit_image_gaussian(frame: Frame) -> Frame:
    return to_frame(gaussian(frame / 255, GAUSSIAN.sigma_px, channel_axis=-1))


def scipy_zoom(frame: Frame) -> Frame:
    image = (frame / 255).astype(np.float32)
    total = image.copy()
    for scale in np.linspace(1, ZOOM.max_scale, ZOOM.copies):
        crop = math.ceil(SIDE_PX / scale)
        total += zoom(image[:crop, :crop], (scale, scale, 1), order=1)[:SIDE_PX, :SIDE_PX]
    return to_frame(total / (ZOOM.copies + 1))


def loop_fog(frame: Frame) -> Frame:
    jitter = seeding.rng(0).uniform(-1, 1, (SIDE_PX, SIDE_PX))
    relief = np.zeros_like(jitter)
    step, amplitude = SIDE_PX, 1.0
    while step > 1:
        half = step // 2
        centres = [(y, x) for y in range(half, SIDE_PX, step) for x in range(half, SIDE_PX, step)]
        sides = [(y, (x + half) % SIDE_PX) for y, x in centres] + [((y + half) % SIDE_PX, x) for y, x in centres]
        for points, reach in (centres, ((1, 1), (1, -1))), (sides, ((1, 0), (0, 1))):
            for y, x in points:
                total = 0.0
                for dy, dx in reach:
                    total += relief[(y + half * dy) % SIDE_PX, (x + half * dx) % SIDE_PX]
                    total += relief[(y - half * dy) % SIDE_PX, (x - half * dx) % SIDE_PX]
                relief[y, x] = total / 4 + amplitude * jitter[y, x]
        step, amplitude = half, amplitude / FOG.roughness_decay**2
    veil = (relief - relief.min()) / (relief.max() - relief.min())
    return to_frame((frame / 255 + FOG.density * veil[..., None]) / (1 + FOG.density))


def loop_glass(frame: Frame) -> Frame:
    out = to_frame(gaussian(frame / 255, GLASS.sigma_px, channel_axis=-1))
    rng, delta = seeding.rng(0), GLASS.delta_px
    for _ in range(GLASS.passes):
        for y in range(SIDE_PX - delta, delta, -1):
            for x in range(SIDE_PX - delta, delta, -1):
                dx, dy = rng.integers(-delta, delta, 2)
                out[y, x] = out[y + dy, x + dx]
    return to_frame(gaussian(out / 255, GLASS.sigma_px, channel_axis=-1))


REFERENCES: tuple[tuple[Effect, Callable[[Frame], object]], ...] = (
    (MOTION, imagemagick_motion),
    (GAUSSIAN, scikit_image_gaussian),
    (ZOOM, scipy_zoom),
    (FOG, loop_fog),
    (GLASS, loop_glass),
)


def fastest_ms(run: Callable[..., object], *arguments: object) -> float:
    """Wall time of the fastest of several runs, after one that compiles and warms the caches."""
    run(*arguments)
    times_s = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run(*arguments)
        times_s.append(time.perf_counter() - start)
    return 1000 * min(times_s)


def main() -> None:
    frame = make_frame()
    figures = {}
    for effect, reference in REFERENCES:
        ms, reference_ms = fastest_ms(effect.apply, frame, seeding.rng(0)), fastest_ms(reference, frame)
        figures[effect.component] = {
            "ms": round(ms, 2),
            "reference": reference.__name__,
            "reference_ms": round(reference_ms, 2),
            "speedup": round(reference_ms / ms, 1),
        }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
