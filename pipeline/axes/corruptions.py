"""Image corruptions of the noise axis, each a frozen record of its parameters that acts on one frame.

The corruptions are those of ImageNet-C (Hendrycks and Dietterich, 2019), applied as in LIBERO-Plus. The benchmark
computes them with ImageMagick, scikit-image and SciPy. This module uses their arithmetic, and their order of operations
where it decides a grey level, because every component but motion ends by truncation.
"""

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.jit import compiled
from pipeline.types import Floats, Frame, Frozen

Component = Literal["motion", "gaussian_blur", "zoom", "fog", "glass"]
SigmaPx = Annotated[float, Field(ge=0.1, le=100.0)]
"""Standard deviation of a Gaussian. Smaller values change nothing, larger ones give a whole frame one colour."""
Pixels = NDArray[np.float32]
Samples = tuple[NDArray[np.intp], Floats]
"""Sampling positions along an image axis: lower neighbours (N,) and fractions (N,) of the way to the next pixel."""


def _to_frame(image: NDArray[np.floating]) -> Frame:
    """Convert an image (H, W, 3) in [0, 1] to grey levels, truncated as in the benchmark."""
    return (image.clip(0, 1) * 255).astype(np.uint8, order="C")


def _gaussian_blur(image: Floats, sigma_px: float) -> Floats:
    """Blur each channel of an image (H, W, 3) by a Gaussian cut off at 4 sigma, with repeated edges."""
    from scipy.ndimage import gaussian_filter  # takes long, and every process of a run imports the axes

    return np.asarray(gaussian_filter(image, (sigma_px, sigma_px, 0), mode="nearest", truncate=4))


class Motion(Frozen):
    """Blur by a one-sided Gaussian trail in a direction sampled from +-45 degrees; ImageMagick's MotionBlurImage.

    ``out(p) = sum_i w_i in(p + round(i u))`` for i = 0 .. 2 ``radius_px``, w_i ~ exp(-i^2 / 2 sigma^2), u the unit
    vector (cos, sin) of the angle in (x right, y down), halves rounded down, edges repeated.

    Attributes:
        radius_px: Half of the length of the trail, in pixels.
        sigma_px: Standard deviation of the trail's weights, in pixels.
    """

    component: ClassVar[Component] = "motion"
    strength: ClassVar[tuple[str, float]] = ("sigma_px", 0)
    radius_px: Annotated[int, Field(ge=1, le=100)]
    sigma_px: SigmaPx

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        height, width, _ = frame.shape
        angle_rad = math.radians(rng.uniform(-45, 45))
        reach = 2 * self.radius_px
        step = np.arange(reach + 1)
        weights = np.exp(-(step**2) / (2 * self.sigma_px**2))
        weights /= weights.sum()
        dy = np.ceil(step * math.sin(angle_rad) - 0.5).astype(int)
        dx = np.ceil(step * math.cos(angle_rad) - 0.5).astype(int)
        padded = np.pad(frame, ((reach, reach), (0, reach), (0, 0)), mode="edge").astype(np.float32)
        blurred = np.zeros(frame.shape, np.float32)
        for weight, y, x in zip(weights.astype(np.float32), dy + reach, dx, strict=True):
            blurred += weight * padded[y : y + height, x : x + width]
        return np.rint(blurred).astype(np.uint8)


class Gaussian(Frozen):
    """Defocus as a Gaussian blur; scikit-image's ``gaussian`` with its defaults.

    Attributes:
        sigma_px: Standard deviation of the blur, in pixels.
    """

    component: ClassVar[Component] = "gaussian_blur"
    strength: ClassVar[tuple[str, float]] = ("sigma_px", 0)
    sigma_px: SigmaPx

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        return _to_frame(_gaussian_blur(frame / 255, self.sigma_px))


@compiled
def _add_resampled(total: Pixels, image: Pixels, rows: Samples, columns: Samples) -> None:
    """Add to ``total`` (H, W, 3) the image interpolated bilinearly at H rows and W columns."""
    for i, y in enumerate(rows[0]):
        v = rows[1][i]
        for j, x in enumerate(columns[0]):
            u = columns[1][j]
            for c in range(3):
                upper = image[y, x, c] * (1 - v) * (1 - u) + image[y, x + 1, c] * (1 - v) * u
                lower = image[y + 1, x, c] * v * (1 - u) + image[y + 1, x + 1, c] * v * u
                total[i, j, c] += np.float32(upper + lower)


def _magnified(size: int, scale: float) -> Samples:
    """Return the positions that magnify the central 1/``scale`` of ``size`` pixels to ``size`` pixels.

    The corners of the crop map to the corners of its magnification (``scipy.ndimage.zoom``), which is then trimmed
    around its centre.
    """
    crop = math.ceil(size / scale)
    zoomed = round(crop * scale)
    position = (np.arange(size) + (zoomed - size) // 2) * ((crop - 1) / (zoomed - 1))
    lower = np.minimum(position.astype(np.intp), crop - 2)
    return lower + (size - crop) // 2, position - lower


class Zoom(Frozen):
    """Mean of the frame and of ``copies`` magnifications, evenly spaced from 1 to ``max_scale``.

    The benchmark spaces them by ``np.arange``. The last digit counts: at a scale of 1.35 or 1.5 it decides whether 256
    pixels become 256 or 257 (``_magnified``), and with them every value.

    Attributes:
        max_scale: Largest magnification.
        copies: Number of magnified copies.
    """

    component: ClassVar[Component] = "zoom"
    strength: ClassVar[tuple[str, float]] = ("max_scale", 1)
    max_scale: Annotated[float, Field(gt=1.0, le=10.0)]
    copies: Annotated[int, Field(ge=2, le=100)]

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        height, width, _ = frame.shape
        image = (frame / 255).astype(np.float32, order="C")
        total = np.zeros_like(image)
        for scale in self.scales():
            _add_resampled(total, image, _magnified(height, scale), _magnified(width, scale))
        return _to_frame((image + total) / np.float32(self.copies + 1))

    def scales(self) -> Floats:
        """Return the magnifications (copies,), as ``np.arange`` computes them from the step between two of them."""
        # Without rounding, the step from 1 to 1.36 in 37 copies would not be the benchmark's 0.01.
        step = round((self.max_scale - 1) / (self.copies - 1), 12)
        # ``np.arange`` adds multiples of the difference of its first two values. Its own end would not be exact.
        spacing = (1 + step) - 1
        return np.asarray(1 + np.arange(self.copies) * spacing, float)


def _diamond_square(jitter: Floats, roughness_decay: float) -> Floats:
    """Return a fractal relief (S, S) in [0, 1] on a torus (Fournier, Fussell and Carpenter, 1982).

    Args:
        jitter: (S, S) uniform in [-1, 1], the random part of each point; S is a power of two, and (0, 0) is not used.
        roughness_decay: factor whose square divides the amplitude of the random part with each halving of the step.
    """
    side = len(jitter)
    relief = np.zeros_like(jitter)
    amplitude = 1.0
    while side > 1:
        half = side // 2
        corner = relief[::side, ::side]
        below = corner + np.roll(corner, -1, axis=0)
        centre = (below + np.roll(below, -1, axis=1)) / 4 + amplitude * jitter[half::side, half::side]
        right = corner + np.roll(corner, -1, axis=1) + centre + np.roll(centre, 1, axis=0)
        down = below + centre + np.roll(centre, 1, axis=1)
        relief[half::side, half::side] = centre
        relief[::side, half::side] = right / 4 + amplitude * jitter[::side, half::side]
        relief[half::side, ::side] = down / 4 + amplitude * jitter[half::side, ::side]
        side, amplitude = half, amplitude / roughness_decay**2
    relief -= relief.min()
    relief /= relief.max()
    return relief


class Fog(Frozen):
    """A fractal veil added to the frame x in [0, 1]: ``(x + density veil) m / (m + density)``, m = max(x).

    Attributes:
        density: Weight of the veil; the frame has the weight 1.
        roughness_decay: Factor whose square divides the veil's random part each time its structures halve in size.
            Smaller values give a rougher veil.
    """

    component: ClassVar[Component] = "fog"
    strength: ClassVar[tuple[str, float]] = ("density", 0)
    density: Annotated[float, Field(ge=0.01, le=100.0)]
    roughness_decay: Annotated[float, Field(gt=1.0, le=10.0)]

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        height, width, _ = frame.shape
        side = 1 << (max(height, width) - 1).bit_length()
        veil = _diamond_square(rng.uniform(-1, 1, (side, side)), self.roughness_decay)[:height, :width, None]
        image = frame / 255
        brightest = image.max()
        return _to_frame((image + self.density * veil) * brightest / (brightest + self.density))


@compiled
def _scatter(frame: Frame, offsets: NDArray[np.int8], delta_px: int) -> None:
    """Replace each pixel by one of its neighbours, in place, one after the other from bottom right to top left.

    Args:
        frame: (H, W, 3); rows and columns up to ``delta_px`` and beyond H or W - ``delta_px`` stay as they are.
        offsets: (passes, H, W, 2) from each pixel to the pixel that replaces it: rows down, columns right.
    """
    height, width, _ = frame.shape
    for pass_offsets in offsets:
        for y in range(height - delta_px, delta_px, -1):
            for x in range(width - delta_px, delta_px, -1):
                frame[y, x] = frame[y + pass_offsets[y, x, 0], x + pass_offsets[y, x, 1]]


class Glass(Frozen):
    """Frosted glass: blur, scatter pixels by -delta .. delta - 1 in each direction, blur again.

    ImageNet-C intends to swap pixels, but its assignment between NumPy views copies one over the other, as here.

    Attributes:
        sigma_px: Standard deviation of both blurs, in pixels.
        delta_px: Largest displacement of a pixel in each direction, in pixels.
        passes: Number of times that the pixels are scattered.
    """

    component: ClassVar[Component] = "glass"
    strength: ClassVar[tuple[str, float]] = ("sigma_px", 0)
    sigma_px: SigmaPx
    delta_px: Annotated[int, Field(ge=1, le=100)]
    passes: Annotated[int, Field(ge=1, le=20)]

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        shape = (self.passes, *frame.shape[:2], 2)
        offsets = rng.integers(-self.delta_px, self.delta_px, shape, dtype=np.int8)
        scattered = _to_frame(_gaussian_blur(frame / 255, self.sigma_px))
        _scatter(scattered, offsets, self.delta_px)
        return _to_frame(_gaussian_blur(scattered / 255, self.sigma_px))
