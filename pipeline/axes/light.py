"""Light: colour, direction, gloss and shadows of the scene's lamps. Render layer; both views change.

Every lamp of the model changes in the same way (the kitchen has three, the other arenas two), relative to what it is
in the scene, and stays where it is. The head light that MuJoCo fixes to each camera stays too, so no draw makes a frame
black. What is known of LIBERO-Plus's light, and what is not, is in docs/axes.md.
"""

from __future__ import annotations

import colorsys
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat

from pipeline.axes.base import Axis, Degrees, Frozen, Intervals, Level, RenderPerturbation, Share, draw
from pipeline.libero import bddl
from pipeline.types import Frame, Task

if TYPE_CHECKING:
    import mujoco

Property = Literal["diffuse", "direction", "specular", "shadows"]
Component = Literal["diffuse", "direction", "specular", "shadows", "combined"]
Multiple = Annotated[float, Field(ge=0.0, le=100.0)]

SHADOWED_DIFFUSE, SHADOWED_SPECULAR = 0.7, 0.5
"""Most light that lamps with shadows may add up to. Without shadows all lamps are rendered in one pass, which cuts
their sum off at the colour of what they shine on; with shadows each has a pass of its own, nothing is cut off, and the
kitchen's three lamps of 0.8 each would make its table white."""

SHOWN_DIFFUSE = 0.8
"""Most light that lamps add up to once they are changed: that of one lamp of LIBERO's. Its kitchen has a directional
lamp beside its two, and of their sum a half could go without a trace, because the sum is cut off all the same."""

FLOOR_SHININESS = 0.1
"""Of LIBERO's floors, which have no gloss, once they have: at 0, a highlight would be spread over all of the floor."""

TILT_AZIMUTH_DEG = ((135.0, 270.0),)
"""Towards where lamps are turned. LIBERO's two stand at (1, 1, 4) and (-3, -3, 4) m and light 45 degrees about where
they point: the first lights the scene, the second misses it. Turned by 20 degrees to the other side, from 315 to 90,
they leave much of the scene to the head light: of their shadows nothing shows, and of their colour little."""

DARK_LEVEL, DARK_SHARE = 10, 0.6
BRIGHT_LEVEL, BRIGHT_SHARE = 250, 0.25
"""A frame is too dark or blown out where more than a share of its pixels have no channel above, or below, a level."""


class LightPerturbation(RenderPerturbation):
    """Changed lamps.

    Attributes:
        diffuse_scale_rgb: multiple of each lamp's diffuse colour, by channel. Before, lamps that add up to more than
            ``SHOWN_DIFFUSE``, the kitchen's, are dimmed to it, whatever else is drawn; it changes 12 % of their pixels
            by 8 grey levels or more.
        specular_scale: multiple of each lamp's specular colour; above 1 it polishes the surfaces too.
        tilt_deg: every lamp is turned in place by so much,
        tilt_azimuth_deg: towards this horizontal direction (0 is the world's x axis, 90 its y axis).
        shadows: whether lamps cast shadows.
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
            # Turning what points down about this axis takes it towards the azimuth.
            across = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
            model.light_dir[:] = model.light_dir @ _rotation(across, self.tilt_deg).T
        if self.shadows:
            model.light_castshadow[:] = True
            _limit(model.light_diffuse, model.light_directional, SHADOWED_DIFFUSE)
            _limit(model.light_specular, model.light_directional, SHADOWED_SPECULAR)
            model.light_diffuse *= 1 - self.fill_scale
            # In MuJoCo a lamp's ambient light stops at shadows, the emission of a surface does not. A third of what
            # is taken from the lamps: with more, walls outshine the table, with less, all darkens.
            model.mat_emission += self.fill_scale * SHADOWED_DIFFUSE / 3
        if self.specular_scale > 1:
            # What a surface reflects as a highlight it does not scatter. The root brings 2 to 30 to 0.9 to 0.6.
            # This comes after the limits: else a bright lamp with shadows would be as bright as without gloss.
            scattered = self.specular_scale ** (-1 / 6)
            model.light_diffuse *= scattered
            model.mat_shininess[model.mat_specular == 0] = FLOOR_SHININESS
            model.mat_specular[:] = np.maximum(model.mat_specular, 1 - scattered**2)


class LightRange(Frozen):
    """What one level draws from.

    Attributes:
        brightness_scale: multiple of the diffuse light, or else
        saturation: the diffuse light is tinted so much, in any hue: 0 leaves white, 1 is a pure colour.
        specular_scale: multiple of the specular light; surfaces get as glossy, and scatter less of the diffuse light.
            One-pass lighting cuts highlights off at the colour of the surface: without that, none would show.
        tilt_deg: how far lamps are turned in place.
        fill_scale: share of the light that reaches into shadows.
    """

    brightness_scale: Intervals[Multiple]
    saturation: Intervals[Share]
    specular_scale: Intervals[Multiple]
    tilt_deg: Intervals[Degrees]
    fill_scale: Intervals[Share]


def _range(dim: tuple[float, float], bright: tuple[float, float], *others: tuple[float, float]) -> LightRange:
    """Others are one interval for each of the other fields, in their order."""
    intervals = [(dim, bright), *((interval,) for interval in others)]
    return LightRange.model_validate(dict(zip(LightRange.model_fields, intervals, strict=True)))


class LightAxis(Axis):
    """The ranges to draw from, chosen by looking at all arenas: from just noticeable to as far as all still shows.

    Noticeable: of the agent view's pixels, 5 % differ by 8 grey levels or more. So it was at levels 1 and 5 of every
    component in every arena, twelve draws each (see docs/axes.md).

    Attributes:
        components: which of them. ``shadows`` turns the lamps, too. ``combined`` changes diffuse light, direction and
            gloss together, with shadows in half of its draws.
        combined_share: share of the draws that are ``combined``, where that is one of several components; the others
            are drawn as often as one another.
        ranges: one for each level.
    """

    draws: ClassVar = (LightPerturbation,)

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = get_args(Component)
    combined_share: float = Field(default=0.6, ge=0.0, le=1.0)
    ranges: tuple[LightRange, LightRange, LightRange, LightRange, LightRange] = (
        _range((0.7, 0.8), (1.25, 1.4), (0.25, 0.3), (3, 4), (8, 11), (0.24, 0.3)),
        _range((0.58, 0.7), (1.4, 1.55), (0.3, 0.37), (4, 6), (11, 15), (0.18, 0.24)),
        _range((0.44, 0.58), (1.55, 1.7), (0.37, 0.44), (6, 10), (15, 20), (0.12, 0.18)),
        _range((0.25, 0.44), (1.7, 1.85), (0.44, 0.53), (10, 17), (20, 26), (0.06, 0.12)),
        _range((0.05, 0.25), (1.85, 2.0), (0.53, 0.65), (17, 30), (26, 32), (0.0, 0.06)),
    )

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> LightPerturbation:
        component, level = self._draw_component(rng), self.draw_level(rng)
        properties: dict[Component, tuple[Property, ...]] = {
            "shadows": ("shadows", "direction"),
            "combined": ("diffuse", "direction", "specular", *(("shadows",) if rng.random() < 0.5 else ())),
        }
        drawn: dict[str, object] = {}
        names = properties.get(component, (component,))
        # These are as bright as can be already: the kitchen's lamps, and those whose shadows are to show.
        brightest = "shadows" in names or bddl.read(task.bddl_file).arena == "kitchen"
        for name in names:
            drawn |= self._draw(rng, name, level, brightest)
        return LightPerturbation.model_validate({"component": component, "level": level, **drawn})

    def _draw_component(self, rng: np.random.Generator) -> Component:
        single = [component for component in self.components if component != "combined"]
        if "combined" in self.components and (not single or rng.random() < self.combined_share):
            return "combined"
        return single[rng.integers(len(single))]

    def _draw(self, rng: np.random.Generator, component: str, level: Level, brightest: bool) -> dict[str, object]:
        ranges = self.ranges[level - 1]
        match component:
            case "diffuse":
                # Not both: a brighter lamp drives its tint back to white.
                if rng.random() < 0.5:
                    scales = ranges.brightness_scale
                    if brightest:
                        scales = tuple((low, min(high, 1.0)) for low, high in scales if low < 1) or scales
                    return {"diffuse_scale_rgb": [draw(rng, scales)] * 3}
                tint = colorsys.hsv_to_rgb(rng.random(), draw(rng, ranges.saturation), 1.0)
                return {"diffuse_scale_rgb": [round(channel, 4) for channel in tint]}
            case "specular":
                return {"specular_scale": draw(rng, ranges.specular_scale)}
            case "direction":
                return {"tilt_deg": draw(rng, ranges.tilt_deg), "tilt_azimuth_deg": draw(rng, TILT_AZIMUTH_DEG)}
            case _:
                return {"shadows": True, "fill_scale": draw(rng, ranges.fill_scale)}


def exposure(frame: Frame) -> str | None:
    """Why a clean frame (H, W, 3) shows too little to learn from; None when it shows enough.

    ``too_dark`` when more than 60 % of its pixels have no channel above 10, ``blown_out`` when more than 25 % have
    no channel below 250. LIBERO's own first frames, both views in all
    arenas, have at most 11 % and 1 % of these.
    """
    if (frame.max(axis=2) <= DARK_LEVEL).mean() > DARK_SHARE:
        return "too_dark"
    if (frame.min(axis=2) >= BRIGHT_LEVEL).mean() > BRIGHT_SHARE:
        return "blown_out"
    return None


def _limit(colours: NDArray[np.float32], directional: NDArray[np.bool_], most: float) -> None:
    """Dim lamps (N, 3) in place, all by the same factor, until what falls on any one spot is at most ``most``."""
    strength, everywhere = colours.max(1), np.asarray(directional, bool)
    # A spot light reaches its own part of the room, a directional one all of it.
    total = strength[everywhere].sum() + strength[~everywhere].max(initial=0.0)
    colours *= most / max(total, most)


def _rotation(axis: NDArray[np.float64], angle_deg: float) -> NDArray[np.float64]:
    """(3, 3) right-handed rotation about a unit axis."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(angle_deg)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
