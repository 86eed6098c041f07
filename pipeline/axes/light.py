"""Light: colour, direction, gloss and shadows of the scene's lamps. Render layer; both views change.

All lamps of the model get one change, relative to their values in the scene, and keep their places. The kitchen has
three lamps, the other arenas have two. The head light that MuJoCo fixes to each camera stays too, so no perturbation
makes a frame black. docs/axes.md states the known and the unknown properties of LIBERO-Plus's light.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat

from pipeline.axes.base import Axis, Degrees, Intervals, Level, RenderPerturbation, Share, sample_number
from pipeline.axes.report_data import CoveragePlots, KeptPerturbation, Strips
from pipeline.libero import bddl
from pipeline.rotations import matrix
from pipeline.testset.benchmark import TestSet
from pipeline.types import Frame, Frozen, Task

if TYPE_CHECKING:
    import mujoco

Property = Literal["diffuse", "direction", "specular", "shadows"]
Component = Literal["diffuse", "direction", "specular", "shadows", "combined"]
Multiple = Annotated[float, Field(ge=0.0, le=100.0)]

SHADOWED_DIFFUSE, SHADOWED_SPECULAR = 0.7, 0.5
"""Largest sum of the light of lamps with shadows.

Without shadows all lamps are rendered in one pass, which cuts their sum off at the colour of the lit surface. With
shadows each lamp has its own pass and nothing is cut off. The kitchen's three lamps of 0.8 each would then make its
table white."""

SHOWN_DIFFUSE = 0.8
"""Largest sum of the light of changed lamps: the light of one of LIBERO's lamps.

LIBERO's kitchen has a directional lamp in addition to its two other lamps. Half of their sum could vanish without a
trace, because the sum is cut off anyway."""

FLOOR_SHININESS = 0.1
"""Shininess of LIBERO's floors once they have gloss; their own 0 would spread a highlight over the whole floor."""

TILT_AZIMUTH_DEG = ((135.0, 270.0),)
"""Directions towards which lamps are turned.

LIBERO's two lamps stand at (1, 1, 4) and (-3, -3, 4) m and light 45 degrees about their direction. The first lights the
scene, the second misses it. Turned by 20 degrees to the other side, from 315 to 90 degrees, they leave much of the
scene to the head light. Then their shadows do not show, and their colour hardly does."""

DARK_LEVEL, DARK_SHARE = 10, 0.6
BRIGHT_LEVEL, BRIGHT_SHARE = 250, 0.25
"""Grey levels and shares of pixels by which ``exposure`` rejects a frame.

A frame is too dark if more than ``DARK_SHARE`` of its pixels have no channel above ``DARK_LEVEL``. It is blown out if
more than ``BRIGHT_SHARE`` of its pixels have no channel below ``BRIGHT_LEVEL``."""


class LightPerturbation(RenderPerturbation):
    """A new colour, direction, gloss or shadow of the scene's lamps.

    Attributes:
        diffuse_scale_rgb: multiple of each lamp's diffuse colour, by channel. Lamps that add up to more than
            ``SHOWN_DIFFUSE``, as the kitchen's do, are always dimmed to it first. This changes 12 % of the kitchen's
            pixels by 8 grey levels or more.
        specular_scale: multiple of each lamp's specular colour; above 1 it polishes the surfaces too.
        tilt_deg: angle by which every lamp is turned in place.
        tilt_azimuth_deg: horizontal direction of this turn (0 is the world's x axis, 90 its y axis).
        shadows: true if lamps cast shadows.
        fill_scale: share of the lamps' diffuse light that reaches into shadows.
    """

    axis: Literal["light"] = "light"
    component: Component
    diffuse_scale_rgb: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0, 1.0)
    specular_scale: NonNegativeFloat = 1.0
    tilt_deg: float = 0.0
    tilt_azimuth_deg: float = 0.0
    shadows: bool = False
    fill_scale: float = Field(default=0.0, ge=0.0, le=1.0)

    fields: ClassVar[tuple[str, ...]] = (
        *("light_diffuse", "light_specular", "light_dir", "light_castshadow"),
        *("mat_emission", "mat_specular", "mat_shininess"),
    )
    measure: ClassVar[str] = "unknown offline: the test tasks' light values are only in the benchmark's asset archive"

    def apply(self, model: mujoco.MjModel) -> None:
        """Change every lamp of the model."""
        _limit(model.light_diffuse, model.light_directional, SHOWN_DIFFUSE)
        model.light_diffuse *= np.array(self.diffuse_scale_rgb)
        model.light_specular *= self.specular_scale
        if self.tilt_deg:
            azimuth = np.deg2rad(self.tilt_azimuth_deg)
            # A rotation about this axis turns a direction that points down towards the azimuth.
            across = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
            model.light_dir[:] = model.light_dir @ matrix(across, self.tilt_deg).T
        if self.shadows:
            model.light_castshadow[:] = True
            _limit(model.light_diffuse, model.light_directional, SHADOWED_DIFFUSE)
            _limit(model.light_specular, model.light_directional, SHADOWED_SPECULAR)
            model.light_diffuse *= 1 - self.fill_scale
            # In MuJoCo a lamp's ambient light stops at shadows, the emission of a surface does not. The emission is a
            # third of the light taken from the lamps. With more, walls outshine the table; with less, it is dark.
            model.mat_emission += self.fill_scale * SHADOWED_DIFFUSE / 3
        if self.specular_scale > 1:
            # A surface does not scatter the light of its highlights. The root maps scales 2 to 30 to 0.9 to 0.6.
            # This step follows the limits: else a bright lamp with shadows would be as bright as without gloss.
            scattered = self.specular_scale ** (-1 / 6)
            model.light_diffuse *= scattered
            model.mat_shininess[model.mat_specular == 0] = FLOOR_SHININESS
            model.mat_specular[:] = np.maximum(model.mat_specular, 1 - scattered**2)


class LightRange(Frozen):
    """Ranges of one level.

    A change of the diffuse light changes either brightness or tint, with equal probability. Surfaces scatter less
    diffuse light as they become glossier. Otherwise one-pass lighting would cut highlights off at the surface's colour.

    Attributes:
        brightness_scale: Intervals of the multiple of the diffuse light. In the kitchen and in combination with
            shadows, intervals are cut at 1; without an interval below 1, the light is only tinted.
        saturation: Intervals of the saturation of tinted diffuse light, in any hue: 0 is white, 1 is a pure colour.
        specular_scale: Intervals of the multiple of the specular light. Above 1, surfaces become glossier too.
        tilt_deg: Intervals of the angle by which lamps are turned in place, in degrees.
        fill_scale: Intervals of the share of the diffuse light that reaches into shadows.
    """

    brightness_scale: Intervals[Multiple]
    saturation: Intervals[Share]
    specular_scale: Intervals[Multiple]
    tilt_deg: Intervals[Degrees]
    fill_scale: Intervals[Share]


def _range(dim: tuple[float, float], bright: tuple[float, float], *others: tuple[float, float]) -> LightRange:
    """Build a range from two intervals of ``brightness_scale`` and one interval of each other field, in their order."""
    intervals: list[tuple[tuple[float, float], ...]] = [(dim, bright)]
    intervals += [(interval,) for interval in others]
    return LightRange.model_validate(dict(zip(LightRange.model_fields, intervals, strict=True)))


class LightAxis(Axis):
    """Ranges to sample from, chosen by eye in all arenas: from barely noticeable to the limit of full visibility.

    Noticeable means that 5 % of the agent view's pixels differ by 8 grey levels or more. This holds at levels 1 and 5
    of every component in every arena, for twelve samples each (see docs/axes.md).

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), each entry with equal probability; all five by default.
        components: Components to sample; all of them by default. ``shadows`` also turns the lamps. ``combined`` changes
            diffuse light, direction and gloss together, with shadows in half of its perturbations.
        combined_share: Share of the perturbations with the component ``combined``, if ``components`` has it and others;
            0.6 by default. Each other entry of ``components`` has equal probability.
        ranges: Ranges of each level, weakest first.
    """

    kinds: ClassVar = (LightPerturbation,)
    colour: ClassVar = "#e59a00"
    dimension: ClassVar = "light"
    test_scene: ClassVar = "scene files"

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = get_args(Component)
    combined_share: float = Field(default=0.6, ge=0.0, le=1.0)
    ranges: tuple[LightRange, LightRange, LightRange, LightRange, LightRange] = (
        _range((0.7, 0.8), (1.25, 1.4), (0.25, 0.3), (3, 4), (8, 11), (0.24, 0.3)),
        _range((0.58, 0.7), (1.4, 1.55), (0.3, 0.37), (4, 6), (11, 15), (0.18, 0.24)),
        _range((0.44, 0.58), (1.55, 1.7), (0.37, 0.44), (6, 10), (15, 20), (0.12, 0.18)),
        _range((0.25, 0.44), (1.7, 1.85), (0.44, 0.53), (10, 17), (20, 26), (0.06, 0.12)),
        _range((0.05, 0.25), (1.85, 2.0), (0.53, 0.65), (17, 30), (26, 32), (0.0, 0.06)),
    )

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> LightPerturbation:
        component, level = self._sample_component(rng), self.sample_level(rng)
        # Sampled for every component: stored plans depend on the number of samples.
        casts_shadows = rng.random() < 0.5
        names: tuple[Property, ...]
        match component:
            case "shadows":
                names = ("shadows", "direction")
            case "combined":
                names = ("diffuse", "direction", "specular")
                if casts_shadows:
                    names += ("shadows",)
            case _:
                names = (component,)
        parameters: dict[str, object] = {}
        # The kitchen's lamps and lamps with shadows already have their largest brightness.
        brightest = "shadows" in names or bddl.read(task.bddl_file).arena == "kitchen"
        for name in names:
            parameters |= self._sample_property(rng, name, level, brightest)
        return LightPerturbation.model_validate({"component": component, "level": level, **parameters})

    def _sample_component(self, rng: np.random.Generator) -> Component:
        """Sample ``combined`` with probability ``combined_share``, else one of the other components."""
        single = [component for component in self.components if component != "combined"]
        if "combined" in self.components and (not single or rng.random() < self.combined_share):
            return "combined"
        return single[rng.integers(len(single))]

    def _sample_property(self, rng: np.random.Generator, name: str, level: Level, brightest: bool) -> dict[str, object]:
        """Sample the parameters of one property at a level.

        Args:
            brightest: true if the lamps must not become brighter.
        """
        ranges = self.ranges[level - 1]
        match name:
            case "diffuse":
                scales = ranges.brightness_scale
                if brightest:
                    scales = tuple((low, min(high, 1.0)) for low, high in scales if low < 1)
                # Not both: a brighter lamp drives its tint back to white.
                if rng.random() < 0.5 and scales:
                    return {"diffuse_scale_rgb": [sample_number(rng, scales)] * 3}
                tint = colorsys.hsv_to_rgb(rng.random(), sample_number(rng, ranges.saturation), 1.0)
                return {"diffuse_scale_rgb": [round(channel, 4) for channel in tint]}
            case "specular":
                return {"specular_scale": sample_number(rng, ranges.specular_scale)}
            case "direction":
                return {
                    "tilt_deg": sample_number(rng, ranges.tilt_deg),
                    "tilt_azimuth_deg": sample_number(rng, TILT_AZIMUTH_DEG),
                }
            case _:
                return {"shadows": True, "fill_scale": sample_number(rng, ranges.fill_scale)}

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[LightPerturbation]], test: TestSet) -> CoveragePlots:
        """Describe plots of brightness, tint, gloss and direction."""
        lights = [item.perturbation for item in kept]
        columns = {
            "Brightness": ("multiple of the diffuse light", [float(np.mean(p.diffuse_scale_rgb)) for p in lights]),
            "Tint": ("saturation", [1 - min(p.diffuse_scale_rgb) / max(*p.diffuse_scale_rgb, 1e-9) for p in lights]),
            "Gloss": ("multiple of the specular light", [p.specular_scale for p in lights]),
            "Direction": ("tilt of the lamps (°)", [p.tilt_deg for p in lights]),
        }
        return CoveragePlots(
            f"{len(test.on_axis('light')):,} test tasks. Their parameters are not plotted, because they are only in "
            f"the benchmark's asset archive. {sum(p.shadows for p in lights)} of {len(lights)} perturbations cast "
            "shadows.",
            [Strips(name, {"episodes": {"light": np.array(own)}}, label) for name, (label, own) in columns.items()],
        )


def exposure(frame: Frame) -> str | None:
    """Return why a clean frame (H, W, 3) shows too little to learn from, or ``None`` if it shows enough.

    ``too_dark``: more than 60 % of the pixels have no channel above 10. ``blown_out``: more than 25 % have no channel
    below 250. LIBERO's own first frames, both views in all arenas, have at most 11 % and 1 % of such pixels.
    """
    if (frame.max(axis=2) <= DARK_LEVEL).mean() > DARK_SHARE:
        return "too_dark"
    if (frame.min(axis=2) >= BRIGHT_LEVEL).mean() > BRIGHT_SHARE:
        return "blown_out"
    return None


def _limit(colours: NDArray[np.float32], directional: NDArray[np.bool_], most: float) -> None:
    """Dim lamps (N, 3) in place by one factor, until every spot receives at most ``most`` light."""
    strength, everywhere = colours.max(1), np.asarray(directional, bool)
    # A spot light reaches its own part of the room, a directional light the whole room.
    total = strength[everywhere].sum() + strength[~everywhere].max(initial=0.0)
    colours *= most / max(total, most)
