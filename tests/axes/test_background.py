"""Background: the surfaces it names in every arena, nothing else in the model, and all as it was afterwards."""

import hashlib
from itertools import product
from statistics import mean, mode

import cv2
import mujoco
import numpy as np
import pytest
from arenas import TASKS, change, changed, checksums, frames
from checkout import REPOSITORY
from short_demonstrations import MILK

from pipeline.axes import RenderPerturbation
from pipeline.axes.background import PARTS, BackgroundAxis, BackgroundPerturbation, Component, Covering, skin_of
from pipeline.axes.base import Level
from pipeline.catalogue import procedural
from pipeline.catalogue.data_maps import DATA_MAPS
from pipeline.catalogue.textures import IN_TEST_SET, catalogue, pixels
from pipeline.errors import PipelineError
from pipeline.libero.assets import package_folder
from pipeline.rendering.renderer import Renderer
from pipeline.seeding import rng
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask


def sample(component: Component, level: Level, key: str | int) -> BackgroundPerturbation:
    axis = BackgroundAxis(components=(component,), levels=(level,), sources=("procedural",))
    return axis.sample(rng("background", component, level, key), MILK, 0)


def texture_bytes(shown: Renderer) -> list[bytes]:
    model = shown.model
    sizes = model.tex_height * model.tex_width * model.tex_nchannel
    return [model.tex_data[at : at + size].tobytes() for at, size in zip(model.tex_adr, sizes, strict=True)]


def worked_on(shown: Renderer) -> str:
    """The texture that most of MuJoCo's rays meet that come from above the middle of the scene."""
    model, groups, geom = shown.model, np.array([0, 1, 0, 0, 0, 0], np.uint8), np.array([-1], np.int32)
    met: list[str] = []
    for x_m, y_m in product(np.linspace(-0.25, 0.25, 7), repeat=2):
        mujoco.mj_ray(model, shown.data, np.array([x_m, y_m, 1.8]), np.array([0.0, 0, -1]), groups, 1, -1, geom)
        if (material := model.geom_matid[geom[0]]) >= 0 and (texture := model.mat_texid[material].max()) >= 0:
            met.append(str(model.texture(texture).name))
    return mode(met)


THEMES = {
    "tabletop": {"tex-wall", "texplane", "tex-table"},
    "floor": {"tex-wall", "texplane"},
    "kitchen": {"tex-wall", "texplane", "tex-kitchen_background", "tex-table"},
    "living_room": {"tex-wall", "texplane", "tex-living_room_table"},
    "study": {"tex-wall", "texplane", "tex-desk"},
}
"""As LIBERO's `scenes/*_base_style.xml` name them."""


@pytest.mark.slow
@pytest.mark.parametrize("shown", TASKS, indirect=True)
def test_only_the_named_surfaces_change_and_all_comes_back(shown: Renderer, request: pytest.FixtureRequest) -> None:
    arena = request.node.callspec.params["shown"]
    before, clean, textures = checksums(shown), frames(shown), texture_bytes(shown)
    for component in PARTS:
        perturbation = sample(component, 5, arena)
        with shown.perturbed([perturbation]):
            assert changed(before, checksums(shown)) == {"tex_data"}
            replaced = {shown.model.texture(i).name for i, now in enumerate(texture_bytes(shown)) if now != textures[i]}
            assert replaced == (THEMES[arena] if component == "theme" else {worked_on(shown)})
            assert worked_on(shown) in replaced
            visible = perturbation.list_shown(TASKS[arena])
            assert len(visible) == len(replaced)
            parts = [(place, skin) for place in visible if (skin := skin_of(shown.model, place.part))]
            assert {shown.model.texture(skin.texture).name for _, skin in parts} == replaced
            after = frames(shown)
        assert change(clean["agentview"], after["agentview"]) > 1
        assert change(clean["robot0_eye_in_hand"], after["robot0_eye_in_hand"]) > 3
    assert changed(before, checksums(shown)) == set()
    restored = frames(shown)
    assert all(np.array_equal(clean[view], restored[view]) for view in clean), "the GL context kept a texture"


@pytest.mark.slow
@pytest.mark.parametrize("shown", ["floor"], indirect=True)
def test_levels_move_the_average_colour_away(shown: Renderer) -> None:
    clean = frames(shown, ["agentview"])["agentview"]
    changes = []
    for scale in (0.2, 1.0):
        after = []
        for key in range(5):
            perturbation = sample("surface", 1, key).model_copy(update={"colour_scale": scale})
            with shown.perturbed([perturbation]):
                after.append(change(clean, frames(shown, ["agentview"])["agentview"]))
        changes.append(mean(after))
    weak, strong = changes
    assert strong > 1.5 * weak > 0

    class Broken(RenderPerturbation):
        """Writes, then fails."""

        fields = ("tex_data", "light_diffuse")

        def apply(self, model: object) -> None:
            sample("surface", 5, 0).apply(model)
            raise RuntimeError

    before = checksums(shown)
    with pytest.raises(RuntimeError), shown.perturbed([Broken(axis="broken", component="", level=1)]):
        pass
    assert changed(before, checksums(shown)) == set()
    assert np.array_equal(frames(shown, ["agentview"])["agentview"], clean)


def test_perturbations_depend_on_their_key_read_back_and_use_all_sources() -> None:
    perturbations = [BackgroundAxis().sample(rng("draw", key), MILK, 0) for key in range(400)]
    assert perturbations == [BackgroundAxis().sample(rng("draw", key), MILK, 3) for key in range(400)]
    for one in perturbations:
        assert BackgroundPerturbation.model_validate_json(one.model_dump_json()) == one
        assert [covering.part for covering in one.coverings] == list(PARTS[one.component])
    names = [c.texture for one in perturbations for c in one.coverings if family(c) not in DATA_MAPS]
    assert {name.partition(":")[0] for name in names} == {"libero", "robosuite", "procedural"}
    assert 0.2 < mean(not name.startswith("procedural:") for name in names) < 0.4
    assert {one.level for one in perturbations} == {1, 2, 3, 4, 5}
    assert {covering.quarter_turns for one in perturbations for covering in one.coverings} == {0, 1, 2, 3}


def family(covering: Covering) -> str:
    return covering.texture.partition(":")[2].partition("/")[0]


def test_own_colours_are_level_5() -> None:
    """Half of the perturbations and a fifth of the others; a configuration without the level has none of them."""
    sampled = [BackgroundAxis().sample(rng("own", key), MILK, 0) for key in range(600)]
    assert all(one.colour_scale == BackgroundAxis().colour_scale[one.level - 1] for one in sampled)
    assert 0.55 < mean(one.level == 5 for one in sampled) < 0.65
    weak = BackgroundAxis(levels=(1, 2))
    assert {weak.sample(rng("own", key), MILK, 0).colour_scale for key in range(100)} == {0.2, 0.4}


def test_half_of_the_perturbations_have_their_own_colours_and_show_every_kind_of_map() -> None:
    """A colour scale of 0.9 at level 5 tells the others of this level from those in own colours."""
    axis = BackgroundAxis(colour_scale=(0.2, 0.4, 0.6, 0.8, 0.9))
    perturbations = [axis.sample(rng("own", key), MILK, 0) for key in range(600)]
    own = [one for one in perturbations if one.colour_scale == 1]
    assert 0.45 < len(own) / len(perturbations) < 0.55
    worked_on = [family(one.coverings[-1]) for one in own]
    assert 0.63 < mean(name in DATA_MAPS for name in worked_on) < 0.77
    elsewhere = [c for one in perturbations for c in one.coverings if c.part != "surface" or one not in own]
    assert not any(family(covering) in DATA_MAPS for covering in elsewhere), "a map in another image's colours"
    for component in PARTS:
        shown = {family(one.coverings[-1]) for one in own if one.component == component}
        assert shown >= {"normal", "height", "gloss", "reflection", "occlusion", "flat"}


@pytest.mark.slow
def test_what_is_in_its_own_colours_is_the_image_as_it_is() -> None:
    """A normal map in MuJoCo's texture, next to the same image that OpenCV makes as large."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><texture name="t" type="2d" builtin="flat" rgb1="0.9 0.1 0.1" width="512" height="512"/>
        <material name="table_texture" texture="t"/></asset>
        <worldbody><geom type="plane" size="1 1 1" material="table_texture"/></worldbody></mujoco>"""
    )
    axis = BackgroundAxis(components=("surface",), own_colours=1, map_share=1)
    for key in range(20):
        one = axis.sample(rng("as it is", key), MILK, 0)
        (covering,) = one.coverings
        image = np.rot90(procedural.texture(family(covering), int(covering.texture[-3:])), covering.quarter_turns)
        one.apply(model)
        if 40 <= image.mean() <= 205:
            assert np.array_equal(model.tex_data.reshape(image.shape), image)
        else:
            assert 39 < model.tex_data.mean() < 206
            assert np.corrcoef(model.tex_data, image.ravel())[0, 1] > 0.99


@pytest.mark.parametrize(("material", "repeats"), [("table_texture", 1), ("living_room_table", 2), ("desk", 4)])
def test_a_modelled_table_has_the_image_more_often_as_its_top_is_a_small_piece_of_its_skin(
    material: str, repeats: int
) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><texture name="t" type="2d" builtin="flat" width="512" height="512"/>
        <material name="{material}" texture="t"/></asset>
        <worldbody><geom type="plane" size="1 1 1" material="{material}"/></worldbody></mujoco>"""
    )
    wood = catalogue(("robosuite",))["robosuite:wood-tiles.png"]
    covering = Covering(part="surface", texture=wood.name, licence=wood.licence, sha256=wood.sha256)
    BackgroundPerturbation(component="surface", level=5, coverings=(covering,), colour_scale=1).apply(model)
    side = 512 // repeats
    resized = cv2.resize(pixels(wood.name, wood.sha256), (side, side), interpolation=cv2.INTER_AREA)
    image = np.asarray(resized, float).ravel()
    for tile in model.tex_data.reshape(repeats, side, repeats, side, 3).swapaxes(1, 2).reshape(-1, image.size):
        assert np.corrcoef(tile, image)[0, 1] > 0.99


def test_a_lighter_texture_keeps_its_pattern_and_has_the_mean_that_its_level_says() -> None:
    """On a light table, tiles with white joints go a fifth of the way to their own colour, or to a mean of 205: a shift
    would cut 39 % of their values off at white."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><texture name="t" type="2d" builtin="flat" rgb1=".9 .9 .9" width="256" height="256"/>
        <material name="table_texture" texture="t"/></asset>
        <worldbody><geom type="plane" size="1 1 1" material="table_texture"/></worldbody></mujoco>"""
    )
    tiles = next(each for each in catalogue(("procedural",)).values() if each.name == "procedural:tile/039")
    source = pixels(tiles.name, tiles.sha256)
    own = source.reshape(-1, 3).mean(axis=0)
    covering = Covering(part="surface", texture=tiles.name, licence=tiles.licence, sha256=tiles.sha256)
    BackgroundPerturbation(component="surface", level=1, coverings=(covering,), colour_scale=0.2).apply(model)
    covered = np.asarray(model.tex_data, float).reshape(-1, 3)
    wanted = 230 + 0.2 * (own - 230)
    assert covered.mean(axis=0) == pytest.approx(wanted * 205 / wanted.mean(), abs=1.0)
    resized = np.asarray(cv2.resize(source, (256, 256), interpolation=cv2.INTER_AREA), float).reshape(-1, 3)
    for channel in range(3):
        assert np.corrcoef(covered[:, channel], resized[:, channel])[0, 1] > 0.999


def test_only_what_procedural_offers_is_a_data_map() -> None:
    axis = BackgroundAxis(sources=("libero", "robosuite"), own_colours=1, map_share=1)
    for key in range(20):
        sampled = axis.sample(rng("no maps", key), MILK, 0)
        assert {covering.texture.partition(":")[0] for covering in sampled.coverings} <= {"libero", "robosuite"}


def test_nearest_knows_test_images_by_name_and_by_content() -> None:
    def shows(**images: str) -> TestSet:
        return TestSet((TestTask("libero_goal", "base", "name", "background", "surface", images),))

    wood = catalogue(("robosuite",))["robosuite:wood-tiles.png"]
    covering = Covering(part="surface", texture=wood.name, licence=wood.licence, sha256=wood.sha256)
    one = BackgroundPerturbation(component="surface", level=1, coverings=(covering,), colour_scale=1.0)
    assert one.nearest(shows(surface="Marble01_COL_3K.png"), MILK) == (1.0, 1)
    assert one.nearest(shows(surface="Marble01_COL_3K.png", wall="Wood_Tiles.png"), MILK) == (0.0, 1)
    # robosuite's ceramic is LIBERO's, which test tasks show as a wall: by any other name it is still that image.
    ceramic = package_folder("robosuite") / "models/assets/textures/ceramic.png"
    copy = covering.model_copy(update={"sha256": hashlib.sha256(ceramic.read_bytes()).hexdigest()})
    assert one.model_copy(update={"coverings": (copy,)}).nearest(shows(), MILK).distance < one.clearance


@pytest.mark.slow
def test_perturbations_keep_their_clearance_from_the_benchmark() -> None:
    test = benchmark.load(REPOSITORY / benchmark.FOLDER)
    shown = {other.parameters[part] for other in test.on_axis("background") for part in ("surface", "wall")
             if part in other.parameters}  # fmt: skip
    libero = {f"{name}.png".replace("cream-plaster", "cream_plaster") for name in IN_TEST_SET}
    assert libero <= shown, "images that no test task shows are shut out"
    for key in range(300):
        sampled = BackgroundAxis().sample(rng("clear", key), MILK, 0)
        nearest = sampled.nearest(test, MILK)
        assert nearest.distance >= sampled.clearance
        assert nearest.compared == 1076


def test_what_cannot_be_covered_is_an_error() -> None:
    bare = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(PipelineError, match="shows no surface"):
        sample("surface", 1, 0).apply(bare)
