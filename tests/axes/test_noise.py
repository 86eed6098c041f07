"""Each corruption equals an independent implementation of it, and its samples are keyed and off the test grid."""

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from checkout import REPOSITORY
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from pydantic import ValidationError
from scipy.ndimage import zoom
from skimage.filters import gaussian

from pipeline import seeding
from pipeline.axes import from_json, to_json
from pipeline.axes.corruptions import Fog, Gaussian, Glass, Motion, Zoom
from pipeline.axes.noise import Effect, NoiseAxis, NoisePerturbation
from pipeline.evaluation import libero_plus
from pipeline.evaluation.selection import Selection
from pipeline.export_config import Where
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Frame, Task

Pixels = NDArray[np.floating]
Reference = Callable[[Frame, float, float, float], Frame]

AXIS = NoiseAxis()
COMPONENTS = ("motion", "gaussian_blur", "zoom", "fog", "glass")
STOCHASTIC = ("motion", "fog", "glass")
TASK = Task("libero_goal", "open_the_middle_drawer", "open the middle drawer", Path("open_the_middle_drawer.bddl"))

# LIBERO-Plus's ten severities, weakest first, in the benchmark's own parameters.
TEST_GRID: dict[str, list[tuple[float, ...]]] = {
    "motion": [(5, 2), (8, 3), (10, 4), (12, 5), (15, 6), (18, 8), (20, 10), (25, 12), (30, 15), (35, 20)],
    "gaussian_blur": [(1,), (2,), (3,), (4,), (5,), (6,), (7,), (8,), (9,), (10,)],
    "zoom": [
        (1.11, 0.01), (1.16, 0.01), (1.21, 0.02), (1.26, 0.02), (1.31, 0.03),
        (1.36, 0.01), (1.41, 0.01), (1.46, 0.02), (1.51, 0.02), (1.56, 0.03),
    ],
    "fog": [
        (0.5, 3.0), (1.0, 2.8), (1.5, 2.5), (2.0, 2.2), (2.5, 2.0),
        (3.0, 1.8), (3.5, 1.6), (4.0, 1.5), (4.5, 1.4), (5.0, 1.3),
    ],
    "glass": [
        (0.5, 1, 3), (0.7, 1, 3), (0.9, 2, 3), (1.0, 2, 2), (1.1, 3, 2),
        (1.3, 3, 2), (1.5, 4, 2), (1.8, 4, 2), (2.2, 5, 1), (2.5, 5, 1),
    ],
}  # fmt: skip


def levels(component: str) -> tuple[Effect, ...]:
    return tuple(getattr(AXIS, component))


def make_frame(height: int, width: int, seed: int = 0) -> Frame:
    """(H, W, 3): flat blocks of 8 px over a gradient, a textured half, black and white areas; read-only."""
    rng = seeding.rng(seed, "frame")
    blocks = rng.integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), dtype=np.uint8)
    frame: Frame = np.kron(blocks, np.ones((8, 8, 1), np.uint8))[:height, :width]
    frame[height // 2 :] //= 2
    frame[height // 2 :] += rng.integers(0, 100, frame[height // 2 :].shape, dtype=np.uint8)
    frame[: height // 4, : width // 4] = 255
    frame[-height // 4 :, : width // 4] = 0
    frame.setflags(write=False)
    return frame


def to_frame(image: Pixels) -> Frame:
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def difference(one: Frame, other: Frame) -> int:
    """Greatest difference in grey levels."""
    return int(np.abs(one.astype(int) - other).max())


@pytest.fixture(scope="session")
def imagemagick() -> Reference:
    """Motion blur by ImageMagick itself: (frame, radius, sigma, angle in degrees) -> frame."""
    try:
        from wand.image import Image as Picture
    except ImportError as error:
        pytest.fail(f"ImageMagick's library is missing, install the Debian package imagemagick ({error})")

    def motion_blur(frame: Frame, radius_px: float, sigma_px: float, angle_deg: float) -> Frame:
        with Picture.from_array(frame) as picture:
            picture.motion_blur(radius=radius_px, sigma=sigma_px, angle=angle_deg)
            return np.array(picture)

    return motion_blur


# The last cuts its trail off while it is still heavy, so the length of the trail shows.
@pytest.mark.parametrize("effect", [*AXIS.motion, Motion(radius_px=3, sigma_px=9)], ids=repr)
@pytest.mark.parametrize("key", range(4))
def test_motion_equals_imagemagick_within_one_grey_level(effect: Motion, key: int, imagemagick: Reference) -> None:
    frame = make_frame(72, 96)
    angle_deg = seeding.rng(key).uniform(-45, 45)
    expected = imagemagick(frame, effect.radius_px, effect.sigma_px, angle_deg)
    assert difference(effect.apply(frame, seeding.rng(key)), expected) <= 1


@pytest.mark.parametrize("effect", AXIS.gaussian_blur, ids=repr)
def test_gaussian_equals_scikit_image(effect: Gaussian) -> None:
    frame = make_frame(72, 96)
    expected = to_frame(gaussian(frame / 255, effect.sigma_px, channel_axis=-1))
    assert np.array_equal(effect.apply(frame, seeding.rng(0)), expected)


def magnified(image: Pixels, scale: float) -> Pixels:
    """(H, H, 3): the central 1/scale of a square image, magnified to its size and trimmed around its centre."""
    side = len(image)
    crop = math.ceil(side / scale)
    inner = slice((side - crop) // 2, (side - crop) // 2 + crop)
    large = zoom(image[inner, inner], (scale, scale, 1), order=1)
    trim = (len(large) - side) // 2
    return np.asarray(large[trim : trim + side, trim : trim + side])


def zoomed(frame: Frame, scales: NDArray[np.floating]) -> Frame:
    """The benchmark's zoom blur by SciPy, at these scales."""
    image = (frame / 255).astype(np.float32)
    total = np.zeros_like(image)
    for scale in scales:
        total += magnified(image, scale)
    return to_frame((image + total) / (len(scales) + 1))


# With the step between two scales. The last magnifies so much that whole pixels are trimmed.
@pytest.mark.parametrize(
    ("effect", "step"),
    [*zip(AXIS.zoom, (0.01, 0.02, 0.015, 0.02, 0.02), strict=True), (Zoom(max_scale=2.9, copies=4), 1.9 / 3)],
    ids=repr,
)
def test_zoom_equals_scipy(effect: Zoom, step: float) -> None:
    frame = make_frame(128, 128)
    expected = zoomed(frame, np.arange(1, effect.max_scale + step / 2, step))
    assert np.array_equal(effect.apply(frame, seeding.rng(0)), expected)


def naive_relief(jitter: Floats, decay: float) -> Floats:
    """Diamond-square point by point with LIBERO-Plus's amplitudes: 100 at first, used twice."""
    side = step = len(jitter)
    relief = np.zeros_like(jitter)
    wibble = 100.0

    def fill(points: Iterable[tuple[int, int]], parents: tuple[tuple[int, int], ...]) -> None:
        for y, x in points:
            mean = sum(relief[(y + dy) % side, (x + dx) % side] for dy, dx in parents) / 4
            relief[y, x] = mean + wibble * (wibble * jitter[y, x])

    while step > 1:
        half = step // 2
        coarse, fine = range(0, side, step), range(half, side, step)
        fill(((y, x) for y in fine for x in fine), ((-half, -half), (-half, half), (half, -half), (half, half)))
        edges = [(y, x) for y in coarse for x in fine] + [(y, x) for y in fine for x in coarse]
        fill(edges, ((-half, 0), (half, 0), (0, -half), (0, half)))
        step, wibble = half, wibble / decay
    normalised: Floats = (relief - relief.min()) / (relief.max() - relief.min())
    return normalised


@pytest.mark.parametrize("effect", AXIS.fog, ids=repr)
@pytest.mark.parametrize(("height", "width", "side"), [(64, 64, 64), (48, 80, 128)])
def test_fog_equals_naive_diamond_square(effect: Fog, height: int, width: int, side: int) -> None:
    frame = make_frame(height, width) // 2  # the brightest pixel takes part in the formula, so let it not be 1
    image = frame / 255
    relief = naive_relief(seeding.rng(7).uniform(-1, 1, (side, side)), effect.roughness_decay)[:height, :width]
    foggy = (image + effect.density * relief[..., None]) * image.max() / (image.max() + effect.density)
    # Sums in another order can fall on the other side of a grey level, but hardly ever do.
    off = effect.apply(frame, seeding.rng(7)).astype(int) - to_frame(foggy)
    assert np.abs(off).max() <= 1
    assert np.count_nonzero(off) < 1e-3 * off.size


def naive_glass(frame: Frame, effect: Glass, offsets: NDArray[np.int8]) -> Frame:
    """The loop as ImageNet-C and LIBERO-Plus write it, with what looks like a swap of two pixels."""
    height, width, _ = frame.shape
    out = to_frame(gaussian(frame / 255, effect.sigma_px, channel_axis=-1))
    for pass_offsets in offsets:
        for y in range(height - effect.delta_px, effect.delta_px, -1):
            for x in range(width - effect.delta_px, effect.delta_px, -1):
                dy, dx = (int(offset) for offset in pass_offsets[y, x])
                out[y, x], out[y + dy, x + dx] = out[y + dy, x + dx], out[y, x]
    return to_frame(gaussian(out / 255, effect.sigma_px, channel_axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("effect", AXIS.glass, ids=repr)
def test_glass_equals_naive_loop(effect: Glass) -> None:
    frame = make_frame(40, 56)
    shape = (effect.passes, 40, 56, 2)
    offsets = seeding.rng(3).integers(-effect.delta_px, effect.delta_px, shape, dtype=np.int8)
    assert np.array_equal(effect.apply(frame, seeding.rng(3)), naive_glass(frame, effect, offsets))


def as_the_benchmark(component: str, row: tuple[float, ...], frame: Frame, key: int, motion_blur: Reference) -> Frame:
    """A frame under one severity of the benchmark, by its formulas from ``TEST_GRID``; random numbers are those of the
    effect."""
    rng, side = seeding.rng(key), len(frame)
    match component:
        case "motion":
            return motion_blur(frame, row[0], row[1], rng.uniform(-45, 45))
        case "gaussian_blur":
            return to_frame(gaussian(frame / 255, row[0], channel_axis=-1))
        case "zoom":
            return zoomed(frame, np.arange(1, row[0], row[1], dtype=float))
        case "fog":
            density, decay = row
            relief = naive_relief(rng.uniform(-1, 1, (side, side)), decay)
            image = frame / 255
            return to_frame((image + density * relief[..., None]) * image.max() / (image.max() + density))
    sigma_px, delta_px, passes = row[0], int(row[1]), int(row[2])
    offsets = rng.integers(-delta_px, delta_px, (passes, side, side, 2), dtype=np.int8)
    return naive_glass(frame, Glass(sigma_px=sigma_px, delta_px=delta_px, passes=passes), offsets)


@pytest.mark.slow
@pytest.mark.parametrize("severity", range(1, 11))
@pytest.mark.parametrize("component", COMPONENTS)
def test_every_severity_of_a_test_task_is_the_benchmarks(
    component: str, severity: int, test: TestSet, imagemagick: Reference
) -> None:
    """Frames of 256 x 256 pixels, as the benchmark's: there a scale of 1.35 or 1.5 is on the edge of a pixel more."""
    frame = make_frame(256, 256) // 2
    tasks = [task for task in test.on_axis("noise") if task.component == component]
    tested = next(task for task in tasks if task.parameters["severity"] == severity)
    seen = libero_plus.noise(tested, 0).effect.apply(frame, seeding.rng(severity))
    expected = as_the_benchmark(component, TEST_GRID[component][severity - 1], frame, severity, imagemagick)
    if component == "fog":
        # Sums in another order can fall on the other side of a grey level, but hardly ever do.
        assert np.count_nonzero(seen != expected) < 1e-3 * frame.size
    assert difference(seen, expected) <= (component in ("motion", "fog"))


def benchmark_parameters(effect: Effect) -> tuple[float, ...]:
    """An effect in the parameters of ``TEST_GRID``."""
    values = tuple(effect.model_dump().values())
    if isinstance(effect, Zoom):
        step = (effect.max_scale - 1) / (effect.copies - 1)
        return (round(effect.max_scale + step, 6), round(step, 6))
    return values


@pytest.mark.parametrize("component", COMPONENTS)
def test_training_grid_is_off_the_test_grid(component: str) -> None:
    tested = TEST_GRID[component]
    rows = [benchmark_parameters(effect) for effect in levels(component)]
    assert not set(rows) & set(tested)
    if component != "zoom":
        # What sets the strength is nowhere equal: sigma for the blurs, density for fog.
        strength = 1 if component == "motion" else 0
        assert not {row[strength] for row in rows} & {row[strength] for row in tested}
    else:
        tested_scales = {round(float(np.arange(1, stop, step)[-1]), 6) for stop, step in tested}
        assert not {effect.max_scale for effect in AXIS.zoom} & tested_scales


@pytest.mark.slow
def test_held_out_strengths_are_the_even_severities() -> None:
    for component, tested in TEST_GRID.items():
        held_out = [effect.model_dump() for effect in getattr(NoiseAxis.held_out(), component)]
        if component == "zoom":
            scales = [float(np.arange(1, *row)[-1]) for row in tested[1::2]]
            assert [effect["max_scale"] for effect in held_out] == pytest.approx(scales)
        else:
            assert [tuple(effect.values()) for effect in held_out] == tested[1::2]


def test_levels_lie_between_neighbouring_severities() -> None:
    scales: list[tuple[float, ...]] = [(float(np.arange(1, stop, step)[-1]),) for stop, step in TEST_GRID["zoom"]]
    for component, tested in (TEST_GRID | {"zoom": scales}).items():
        for level, effect in enumerate(levels(component)):
            names = ["max_scale"] if isinstance(effect, Zoom) else list(type(effect).model_fields)
            for name, weaker, stronger in zip(names, tested[2 * level], tested[2 * level + 1], strict=True):
                low, high = sorted((weaker, stronger))
                assert low <= getattr(effect, name) <= high, (component, level + 1, name)


@pytest.fixture(scope="module")
def test() -> TestSet:
    return benchmark.load(REPOSITORY / benchmark.FOLDER)


def test_the_parsed_severities_are_the_published_ones(test: TestSet) -> None:
    for component, published in TEST_GRID.items():
        parsed = {
            int(t.parameters["severity"]): t.parameters for t in test.on_axis("noise") if t.component == component
        }
        assert sorted(parsed) == list(range(1, 11))
        for severity, row in enumerate(published, 1):
            values = tuple(parsed[severity].values())[1:]
            if component == "zoom":
                scales = np.arange(1, *row)
                assert values == (round(float(scales[-1]), 6), len(scales))
            else:
                assert values == row


def perturbation(effect: Effect) -> NoisePerturbation:
    return NoisePerturbation(component=effect.component, effect=effect, level=1, seed=0)


@pytest.mark.parametrize(
    ("effect", "steps"),
    [
        (Gaussian(sigma_px=3), 0),
        (Gaussian(sigma_px=3.25), 0.25),
        (Gaussian(sigma_px=9.5), 0.5),
        (Gaussian(sigma_px=0.4), 0.6),  # between a clean frame and the weakest severity
        (Gaussian(sigma_px=12), 2),  # beyond the strongest
        (Motion(radius_px=99, sigma_px=17.5), 0.5),  # half way from 15 to 20
        (Motion(radius_px=99, sigma_px=20), 0),
        (Fog(density=0.75, roughness_decay=3), 0.5),
        (Zoom(max_scale=1.13, copies=14), 0.5),
        (Glass(sigma_px=2.2, delta_px=1, passes=1), 0),
    ],
    ids=repr,
)
def test_distance_counts_in_steps_between_severities(effect: Effect, steps: float, test: TestSet) -> None:
    nearest = perturbation(effect).nearest(test, TASK)
    assert nearest.distance == pytest.approx(steps)
    assert (
        nearest.compared
        == {"motion": 336, "gaussian_blur": 341, "zoom": 288, "fog": 272, "glass": 364}[effect.component]
    )


@pytest.mark.parametrize("component", COMPONENTS)
def test_the_default_grid_is_clear(component: str, test: TestSet) -> None:
    distances = [perturbation(effect).nearest(test, TASK).distance for effect in levels(component)]
    assert min(distances) >= 0.39 > NoisePerturbation.clearance


def test_only_the_levels_asked_for_are_sampled() -> None:
    axis = NoiseAxis(levels=(2, 5))
    perturbations = [axis.sample(seeding.rng(seed, "noise"), TASK, 0) for seed in range(200)]
    assert {(p.component, p.level) for p in perturbations} == {
        (component, level) for component in COMPONENTS for level in (2, 5)
    }
    assert all(p.effect == levels(p.component)[p.level - 1] for p in perturbations)


def test_only_the_components_asked_for_are_sampled() -> None:
    axis = NoiseAxis.model_validate({"components": ["gaussian_blur"]})
    assert {axis.sample(seeding.rng(seed, "noise"), TASK, 0).component for seed in range(50)} == {"gaussian_blur"}
    with pytest.raises(ValidationError, match="components"):
        NoiseAxis(components=())


def test_a_component_is_configured_by_its_former_name_too() -> None:
    rows = [{"sigma_px": sigma} for sigma in (0.5, 0.6, 0.7, 0.8, 0.9)]
    written = NoiseAxis.model_validate({"gaussian": rows, "components": ["gaussian", "fog"]})
    assert written == NoiseAxis.model_validate({"gaussian_blur": rows, "components": ["gaussian_blur", "fog"]})
    with pytest.raises(ValidationError, match="gaussian is the former name of gaussian_blur"):
        NoiseAxis.model_validate({"gaussian": rows, "gaussian_blur": rows})


def test_what_is_stored_keeps_the_former_name() -> None:
    """So that ids of episodes, and with them their frames, stay what they were."""
    stored = '[{"axis":"noise","component":"gaussian","level":2,"effect":{"sigma_px":3.5},"seed":1}]'
    (blur,) = from_json(stored)
    assert blur.component == "gaussian_blur"
    assert json.loads(to_json([blur])) == json.loads(stored)
    assert from_json(stored.replace("gaussian", "gaussian_blur")) == (blur,)


def sample(seed: int) -> NoisePerturbation:
    return AXIS.sample(seeding.rng(seed, "noise"), TASK, 0)


def test_every_component_and_level_is_sampled() -> None:
    sampled = {(p.component, p.level) for p in map(sample, range(400))}
    assert sampled == {(component, level) for component in COMPONENTS for level in range(1, 6)}


@given(st.integers())
def test_equal_keys_sample_equal_perturbations_and_json_reads_back(seed: int) -> None:
    sampled = sample(seed)
    assert sampled == sample(seed)
    assert sampled != sample(seed + 1)
    assert sampled.effect == levels(sampled.component)[sampled.level - 1]
    assert NoisePerturbation.model_validate_json(sampled.model_dump_json()) == sampled


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    height=st.integers(12, 70),
    width=st.integers(12, 70),
    frame_index=st.integers(0, 600),
)
def test_apply_is_pure_and_keeps_the_form(seed: int, height: int, width: int, frame_index: int) -> None:
    perturbation, frame = sample(seed), make_frame(height, width, seed)
    before = frame.copy()
    noisy = perturbation.apply(frame, frame_index)
    assert noisy.shape == frame.shape
    assert noisy.dtype == np.uint8
    assert noisy.flags.c_contiguous
    assert np.array_equal(frame, before)
    assert np.array_equal(noisy, perturbation.apply(frame, frame_index))
    # None of them can leave the range of the input: all average, and fog is scaled back to the brightest pixel.
    assert noisy.max() <= frame.max()
    view = np.ascontiguousarray(frame[::-1])[::-1]  # how a renderer hands over a frame it turned upside down
    assert np.array_equal(noisy, perturbation.apply(view, frame_index))


@pytest.mark.parametrize("component", COMPONENTS)
@pytest.mark.parametrize("level", [1, 3, 5])
@pytest.mark.parametrize("size_px", [128, 512])
def test_a_frame_of_another_size_looks_like_one_of_256_that_was_resized(
    component: str, level: int, size_px: int
) -> None:
    """Parameters that stay pixels of the frame differ by 2.7 to 39 grey levels at 128, and by 1.3 to 46 at 512."""

    def resized(frame: Frame, to_px: int) -> Floats:
        return np.asarray(Image.fromarray(frame).resize((to_px, to_px), Image.Resampling.BOX), float)

    effect = levels(component)[level - 1]
    noise = NoisePerturbation.model_validate({"component": component, "effect": effect, "level": level, "seed": 3})
    photo = resized(skimage.data.astronaut(), 256).astype(np.uint8)
    other = resized(photo, size_px).astype(np.uint8)
    expected = noise.apply(photo, 0)
    apart = np.abs(resized(noise.apply(other, 0), 64) - resized(expected, 64)).mean()
    # A frame of 128 pixels lacks detail that a weak noise keeps at 256.
    assert apart < {128: 2.5, 512: 0.6}[size_px]


@pytest.mark.parametrize("component", COMPONENTS)
@pytest.mark.parametrize("level", range(1, 6))
def test_only_stochastic_components_flicker(component: str, level: int) -> None:
    frame = make_frame(64, 64)
    effect = levels(component)[level - 1]
    one, other = (
        NoisePerturbation.model_validate({"component": component, "effect": effect, "level": level, "seed": seed})
        for seed in (1, 2)
    )
    flickers = not np.array_equal(one.apply(frame, 0), one.apply(frame, 1))
    depends_on_seed = not np.array_equal(one.apply(frame, 0), other.apply(frame, 0))
    assert (flickers, depends_on_seed) == (component in STOCHASTIC,) * 2


@pytest.mark.parametrize("component", COMPONENTS)
def test_levels_grow_stronger(component: str) -> None:
    frame = make_frame(128, 128)
    damage = [np.abs(effect.apply(frame, seeding.rng(5)).astype(float) - frame).mean() for effect in levels(component)]
    assert 0 < damage[0] == min(damage)
    # Frosted glass scatters fewer times where it scatters further, as on the test grid, so neighbours may tie.
    assert component == "glass" or damage == sorted(damage)


@pytest.mark.parametrize(
    "change",
    [{"component": "fog"}, {"level": 0}, {"level": 6}, {"effect": {"sigma_px": 0}}, {"effect": {"sigma": 3.5}}],
    ids=str,
)
def test_wrong_records_are_rejected(change: dict[str, object]) -> None:
    right = {"axis": "noise", "component": "gaussian_blur", "effect": {"sigma_px": 3.5}, "level": 2, "seed": 1}
    assert NoisePerturbation.model_validate(right).effect == Gaussian(sigma_px=3.5)
    with pytest.raises(ValidationError):
        NoisePerturbation.model_validate(right | change)


def test_a_grid_can_be_configured_but_needs_five_levels() -> None:
    rows = [{"sigma_px": sigma} for sigma in (0.5, 0.6, 0.7, 0.8, 0.9)]
    assert NoiseAxis.model_validate({"gaussian_blur": rows}).gaussian_blur[4] == Gaussian(sigma_px=0.9)
    with pytest.raises(ValidationError, match="gaussian_blur"):
        NoiseAxis.model_validate({"gaussian_blur": rows[:4]})


def test_filters_take_the_former_name_of_the_blur() -> None:
    assert Where(component=("gaussian",)).takes("noise", "gaussian_blur", "1", "libero_goal")
    assert Selection(components=("gaussian", "fog")).components == ("gaussian_blur", "fog")
