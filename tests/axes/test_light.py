"""Light: every lamp of every arena, only what renders, and frames that stay legible at the strongest perturbations."""

import colorsys
from collections.abc import Iterator
from itertools import pairwise
from statistics import mean
from typing import get_args

import mujoco
import numpy as np
import pytest
from arenas import TASKS, change, changed, checksums, frames
from short_demonstrations import MILK

from pipeline.axes.base import Level
from pipeline.axes.light import TILT_AZIMUTH_DEG, Component, LightAxis, LightPerturbation, exposure
from pipeline.libero.tasks import find_task
from pipeline.rendering.renderer import Renderer
from pipeline.seeding import rng
from pipeline.testset.benchmark import TestSet
from pipeline.types import Frame, Task

COMPONENTS: tuple[Component, ...] = get_args(Component)
NEUTRAL = LightPerturbation(component="combined", level=1)


NOTICED_LEVELS, NOTICED_SHARE = 8, 0.05
"""A change is noticed where this share of the pixels differs by so many grey levels in a channel."""


def sample(component: Component, level: Level, key: str | int, task: Task = MILK) -> LightPerturbation:
    axis = LightAxis(components=(component,), levels=(level,))
    return axis.sample(rng("light", component, level, key), task, 0)


def weakest(task: Task) -> Iterator[LightPerturbation]:
    """Samples of each component at level 1; ``test_stronger_levels_change_more`` compares level 5 with them.

    Of ``diffuse`` it is a darker, a brighter and a tinted one, where sampled; of ``combined`` one with shadows and one
    without; of ``direction`` one for each edge of the range of the azimuth, where a tilt changes least. Last comes the
    weakest tint in yellow, a hue that changes least in the study.
    """
    for component in COMPONENTS:
        kinds: dict[object, LightPerturbation] = {}
        for key in range(20 if component in ("diffuse", "combined") else 1):
            one = sample(component, 1, key, task)
            tint = "tinted" if len({*one.diffuse_scale_rgb}) > 1 else one.diffuse_scale_rgb[0] > 1
            kinds[tint if component == "diffuse" else one.shadows] = one
        if component == "direction":
            (edges,) = TILT_AZIMUTH_DEG
            kinds = {edge: one.model_copy(update={"tilt_azimuth_deg": edge}) for edge in edges}
        yield from kinds.values()
    ((saturation, _),) = LightAxis().ranges[0].saturation
    yield NEUTRAL.model_copy(update={"diffuse_scale_rgb": colorsys.hsv_to_rgb(1 / 6, saturation, 1.0)})


def share_changed(before: Frame, after: Frame) -> float:
    return float((np.abs(before.astype(int) - after).max(axis=2) >= NOTICED_LEVELS).mean())


def test_perturbations_depend_on_their_key_read_back_and_change_their_property_alone() -> None:
    properties = {
        "diffuse": {"diffuse_scale_rgb"},
        "direction": {"tilt_deg", "tilt_azimuth_deg"},
        "specular": {"specular_scale"},
        "shadows": {"shadows", "fill_scale", "tilt_deg", "tilt_azimuth_deg"},
    }
    everything = set().union(*properties.values())
    for key in range(100):
        one = LightAxis().sample(rng("key", key), MILK, 0)
        assert one == LightAxis().sample(rng("key", key), MILK, 5)
        assert LightPerturbation.model_validate_json(one.model_dump_json()) == one
        different = {name for name, value in one if value != getattr(NEUTRAL, name)} - {"component", "level"}
        properties["combined"] = everything - (set() if one.shadows else {"shadows", "fill_scale"})
        assert different == properties[one.component]


def test_the_four_properties_mostly_change_together() -> None:
    perturbations = [LightAxis().sample(rng("key", key), MILK, 0) for key in range(1000)]
    combined = [one for one in perturbations if one.component == "combined"]
    assert len(combined) == pytest.approx(600, abs=50)
    assert sum(one.shadows for one in combined) == pytest.approx(len(combined) / 2, abs=50)
    for component in ("diffuse", "direction", "specular", "shadows"):
        assert sum(one.component == component for one in perturbations) == pytest.approx(100, abs=30)
    tints = [one.diffuse_scale_rgb for one in perturbations if len({*one.diffuse_scale_rgb}) > 1]
    for brightest in range(3):
        assert sum(np.argmax(tint) == brightest for tint in tints) == pytest.approx(len(tints) / 3, abs=50)
    # Uniform from 135 to 270 degrees.
    azimuths_deg = [one.tilt_azimuth_deg for one in perturbations if one.tilt_deg]
    assert np.percentile(azimuths_deg, [10, 50, 90]) == pytest.approx([148.5, 202.5, 256.5], abs=5)


@pytest.mark.parametrize(
    ("components", "share", "expected"),
    [
        (("combined",), 0.0, {"combined"}),
        (("diffuse", "specular"), 1.0, {"diffuse", "specular"}),
        (("diffuse", "combined"), 0.0, {"diffuse"}),
        (("diffuse", "combined"), 1.0, {"combined"}),
    ],
)
def test_the_share_of_combined_perturbations_is_among_the_components(
    components: tuple[Component, ...], share: float, expected: set[Component]
) -> None:
    axis = LightAxis(components=components, combined_share=share)
    assert {axis.sample(rng("key", key), MILK, 0).component for key in range(30)} == expected


def test_ranges_grow_with_the_level() -> None:
    for component, name in (("direction", "tilt_deg"), ("specular", "specular_scale"), ("shadows", "tilt_deg")):
        values = [abs(getattr(sample(component, level, 0), name)) for level in (1, 2, 3, 4, 5)]  # type: ignore[arg-type]
        assert values == sorted(set(values))
    fills = [sample("shadows", level, 0).fill_scale for level in (1, 2, 3, 4, 5)]
    assert fills == sorted(set(fills), reverse=True)


LAMPS = """
<mujoco><worldbody>
  <light pos="1 1 4" dir="-1 -1 -4" diffuse=".8 .8 .8"/><light pos="-3 -3 4" dir="1 1 -1" diffuse=".8 .8 .8"/>
</worldbody></mujoco>"""


def test_no_recorded_brightness_is_lost_in_shadows() -> None:
    """Lamps with shadows are limited: what is recorded as brighter must not look like another perturbation."""
    shown: dict[float, float] = {}
    for key in range(200):
        one = sample("combined", 1 + key % 5, key)  # type: ignore[arg-type]
        if one.shadows and len({*one.diffuse_scale_rgb}) == 1:
            model = mujoco.MjModel.from_xml_string(LAMPS)
            NEUTRAL.model_copy(update={"diffuse_scale_rgb": one.diffuse_scale_rgb, "shadows": True}).apply(model)
            shown[one.diffuse_scale_rgb[0]] = float(model.light_diffuse.max())
    scales = sorted(shown)
    assert len(scales) > 30
    assert all(shown[low] < shown[high] for low, high in pairwise(scales))


def test_without_an_interval_below_1_brightness_is_never_raised_where_lamps_are_at_their_limit() -> None:
    ranges = [range_.model_copy(update={"brightness_scale": ((1.2, 1.5),)}) for range_ in LightAxis().ranges]
    axis = LightAxis.model_validate({"ranges": ranges, "components": ["combined"]})
    lights = [axis.sample(rng("key", key), MILK, 0) for key in range(100)]
    of_shadows = [light.diffuse_scale_rgb for light in lights if light.shadows]
    assert len(of_shadows) > 30
    assert all(max(scale) == 1.0 > min(scale) for scale in of_shadows), "tinted"
    assert any(min(light.diffuse_scale_rgb) >= 1.2 for light in lights if not light.shadows)


@pytest.mark.parametrize(("directional", "left"), [("false", 0.8), ("true", 0.4)])
def test_a_third_lamp_dims_the_others_where_it_lights_the_whole_room(directional: str, left: float) -> None:
    """Spot lamps light a part each, and at 0.8 stay; a directional one adds its 0.8 to that of each: 1.6, of which half
    is 0.8."""
    third = f'<light directional="{directional}" diffuse=".8 .8 .8"/></worldbody>'
    model = mujoco.MjModel.from_xml_string(LAMPS.replace("</worldbody>", third))
    NEUTRAL.apply(model)
    assert model.light_diffuse == pytest.approx(np.full((3, 3), left))


def test_gloss_takes_diffuse_light_and_fill_becomes_emission() -> None:
    """Of the lamp's 0.8, 0.7 are left with shadows, 0.7 of these beyond the fill, and half of these beyond the gloss.

    The sixth root of 64 is 2. The fill is 0.3 of 0.7, of which surfaces emit a third.
    """
    model = mujoco.MjModel.from_xml_string("""
        <mujoco>
          <asset><material name="floor" specular="0"/><material name="mug" specular="0.9" shininess="0.5"/></asset>
          <worldbody><light diffuse=".8 .8 .8" specular=".3 .3 .3"/></worldbody>
        </mujoco>""")
    NEUTRAL.model_copy(update={"specular_scale": 64.0, "shadows": True, "fill_scale": 0.3}).apply(model)
    assert model.light_diffuse == pytest.approx(np.full((1, 3), 0.245))
    assert model.light_specular == pytest.approx(np.full((1, 3), 0.5))
    assert model.mat_emission == pytest.approx(np.array([0.07, 0.07]))
    assert model.mat_specular == pytest.approx(np.array([0.75, 0.9]))
    assert model.mat_shininess == pytest.approx(np.array([0.1, 0.5]))


def test_the_kitchens_lamps_are_never_brightened() -> None:
    """Unlike the floor's, which some samples brighten."""
    kitchen, floor = find_task("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove"), MILK
    axis = LightAxis(components=("diffuse", "combined"))
    brightest = {}
    for task in (kitchen, floor):
        lights = [axis.sample(rng("key", key), task, 0) for key in range(200)]
        brightest[task] = max(max(light.diffuse_scale_rgb) for light in lights)
    assert brightest[kitchen] <= 1.0 < brightest[floor]


@pytest.mark.slow
@pytest.mark.parametrize("shown", TASKS, indirect=True)
def test_every_lamp_changes_and_nothing_but_lamps(shown: Renderer, request: pytest.FixtureRequest) -> None:
    before, clean = checksums(shown), frames(shown)
    directions, colours = shown.model.light_dir.copy(), shown.model.light_diffuse.copy()
    places = shown.model.light_pos.copy()
    everything = next(one for key in range(20) if (one := sample("combined", 5, key)).shadows)
    with shown.perturbed([everything]):
        assert changed(before, checksums(shown)) <= set(LightPerturbation.fields)
        assert np.array_equal(shown.model.light_pos, places)
        assert shown.model.light_castshadow.all()
        assert (shown.model.light_diffuse != colours).any(axis=1).all()
        assert np.allclose(np.linalg.norm(shown.model.light_dir, axis=1), 1)
        assert (shown.model.light_dir != directions).any(axis=1).all()
        after = frames(shown)
    assert all(change(clean[view], after[view]) > 3 for view in clean)
    assert changed(before, checksums(shown)) == set()
    restored = frames(shown)
    assert all(np.array_equal(clean[view], restored[view]) for view in clean)

    for perturbation in weakest(TASKS[request.node.callspec.params["shown"]]):
        with shown.perturbed([perturbation]):
            after = frames(shown, ["agentview"])
        assert share_changed(clean["agentview"], after["agentview"]) >= NOTICED_SHARE, perturbation

    # The corners of the ranges: as little light as there can be, and as much.
    assert [exposure(frame) for frame in clean.values()] == [None, None]
    dimmest = {"diffuse_scale_rgb": (0.0, 0.0, 0.0), "tilt_deg": 32.0}
    brightest = {"diffuse_scale_rgb": (2.0, 2.0, 2.0), "specular_scale": 30.0}
    # The table and the floor below the wrist's camera are brightest with lamps turned so.
    lit = {"shadows": True, "tilt_deg": 20.0, "tilt_azimuth_deg": 200.0}
    for corner in (dimmest, brightest | lit):
        with shown.perturbed([NEUTRAL.model_copy(update=corner)]):
            assert [exposure(frame) for frame in frames(shown).values()] == [None, None], corner


@pytest.mark.slow
@pytest.mark.parametrize("shown", ["tabletop"], indirect=True)
def test_stronger_levels_change_more(shown: Renderer) -> None:
    weak: dict[str, list[float]] = {component: [] for component in COMPONENTS}
    strong: dict[str, list[float]] = {component: [] for component in COMPONENTS}
    clean = frames(shown, ["agentview"])["agentview"]
    for component in COMPONENTS:
        for level, changes in ((1, weak), (5, strong)):
            for key in range(3):
                with shown.perturbed([sample(component, level, key)]):  # type: ignore[arg-type]
                    after = frames(shown, ["agentview"])["agentview"]
                changes[component].append(change(clean, after))
    for component in COMPONENTS:
        assert mean(strong[component]) > 1.2 * mean(weak[component]), component


@pytest.mark.slow
@pytest.mark.parametrize("shown", ["tabletop"], indirect=True)
def test_light_comes_from_where_the_parameters_say(shown: Renderer) -> None:
    lamp = shown.model.light("light1")
    nominal = lamp.dir.copy()
    for azimuth, towards in ((0.0, [1, 0]), (90.0, [0, 1])):
        tilted = NEUTRAL.model_copy(update={"tilt_deg": 20.0, "tilt_azimuth_deg": azimuth})
        with shown.perturbed([tilted]):
            assert (lamp.dir[:2] - nominal[:2]) @ towards > 0.3
            assert np.array_equal(lamp.pos, [1, 1, 4])


@pytest.mark.slow
@pytest.mark.parametrize("shown", ["floor"], indirect=True)
def test_shadows_are_there_and_soften(shown: Renderer) -> None:
    darkest = []
    for fill in (0.0, 0.3):
        light, dark = (NEUTRAL.model_copy(update={"shadows": shadows, "fill_scale": fill}) for shadows in (False, True))
        with shown.perturbed([light]):
            unshadowed = frames(shown, ["agentview"])["agentview"].astype(int)
        with shown.perturbed([dark]):
            shadowed = frames(shown, ["agentview"])["agentview"]
        darkest.append(np.percentile((shadowed - unshadowed).mean(axis=2), 3))
    hard, soft = darkest
    assert hard < -40, f"3 % of the pixels should be darker by 40 grey levels, are by {-hard:.0f}"
    assert hard < soft - 10


def test_exposure_names_what_is_wrong() -> None:
    rows = np.linspace(0, 255, 100)[:, None, None]
    assert exposure(np.broadcast_to(rows, (100, 100, 3)).astype(np.uint8)) is None
    assert exposure(np.full((64, 64, 3), 8, np.uint8)) == "too_dark"
    assert exposure(np.full((64, 64, 3), 252, np.uint8)) == "blown_out"
    blue = np.zeros((64, 64, 3), np.uint8)
    blue[..., 2] = 255
    assert exposure(blue) is None, "a pure colour is neither"


def with_share(level: int, share: float) -> Frame:
    """A grey frame (100, 100, 3) of which a share of the pixels has another level."""
    frame = np.full((100, 100, 3), 128, np.uint8)
    frame.reshape(-1, 3)[: round(10_000 * share)] = level
    return frame


@pytest.mark.parametrize(
    ("level", "share", "expected"),
    [
        (10, 0.59, None),
        (10, 0.61, "too_dark"),
        (11, 1.0, None),
        (250, 0.24, None),
        (250, 0.26, "blown_out"),
        (249, 1.0, None),
    ],
)
def test_a_frame_may_be_three_fifths_dark_and_a_quarter_bright(level: int, share: float, expected: str | None) -> None:
    assert exposure(with_share(level, share)) == expected


def test_it_claims_no_proof_that_cannot_be_had() -> None:
    nearest = sample("diffuse", 1, 0).nearest(TestSet(()), MILK)
    assert nearest.compared == 0
    assert nearest.distance >= LightPerturbation.clearance
    assert "unknown" in LightPerturbation.measure
