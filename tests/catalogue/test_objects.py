"""Models of objects: what is installed stands and is tellable apart; what is converted keeps size, look and licence."""

import io
import re
import shutil
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import pytest
import yaml
from PIL import Image

from pipeline.axes.layout import LayoutAxis
from pipeline.catalogue import object_sources, scene_files, sweethome3d
from pipeline.catalogue.meshes import convert
from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.object_sources import Package, catalogue
from pipeline.catalogue.objects import TEST_CATEGORIES, find, goes_with, is_of_test_set, models, taken
from pipeline.catalogue.sources import Folder
from pipeline.commands.command_line import run
from pipeline.errors import PipelineError
from pipeline.libero.tasks import find_task, select_tasks, tasks
from pipeline.seeding import rng

INSTALLED = models(("libero", "robosuite"))

# A house of 10 x 10 x 20: width, depth, height; its texture is red at the left and blue at the right.
HOUSE = """mtllib house.mtl
v -5 0 -5
v 5 0 -5
v 5 0 5
v -5 0 5
v 0 20 0
vt 0 0
vt 1 0
vt 0.5 1
usemtl roof
f 1/1 5/3 2/2
f 2/1 5/3 3/2
f 3/1 5/3 4/2
f 4/1 5/3 1/2
usemtl floor
f 1/1 2/2 3/3
f 1/1 3/2 4/3
"""
BARE = HOUSE.replace("mtllib house.mtl\n", "")
MATERIALS = "newmtl roof\nKd 1 1 1\nmap_Kd roof.png\nnewmtl floor\nKd 0.2 0.4 0.6\n"

TWISTED = '<mujoco><worldbody><body><geom type="box" size="1"/></body></worldbody></mujoco>'
BADLY_PLACED = '<mujoco><worldbody><body><geom size=".02" %s/></body></worldbody></mujoco>'
BEREFT = (
    '<mujoco><asset><mesh name="m" file="lost.obj"/></asset>'
    '<worldbody><body><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of converted objects that is empty yet."""
    monkeypatch.setattr(object_sources, "FOLDER", tmp_path / "objects")
    models.cache_clear()
    yield tmp_path / "objects"
    models.cache_clear()


def house_files() -> dict[str, bytes]:
    picture = io.BytesIO()
    Image.new("RGB", (2000, 4), "red").save(picture, "PNG")
    return {"house.obj": HOUSE.encode(), "house.mtl": MATERIALS.encode(), "roof.png": picture.getvalue()}


def write_house(folder: Path, scale: float) -> None:
    folder.mkdir(parents=True)
    for name, content in house_files().items():
        (folder / name).write_bytes(content)
    corners = (line.split() for line in HOUSE.splitlines())
    scaled = (
        ["v", *(str(scale * float(number)) for number in corner[1:])] if corner[0] == "v" else corner
        for corner in corners
    )
    (folder / "house.obj").write_text("".join(f"{' '.join(corner)}\n" for corner in scaled))


def compiled(model: ObjectModel) -> mujoco.MjModel:
    assets, body = model.mjcf_of("thing")
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><asset>{assets}</asset><worldbody><geom type="plane" size="2 2 1"/>{body}</worldbody></mujoco>'
    )


def test_what_is_installed_is_many_and_each_its_own() -> None:
    assert len(INSTALLED) >= 55
    assert len({model.sha256 for model in INSTALLED.values()}) == len(INSTALLED)
    assert all(model.licence and model.attribution and len(model.files) > 0 for model in INSTALLED.values())


def test_the_catalogue_has_two_hundred_models_and_no_category_of_the_test_set() -> None:
    assert set(catalogue()) == set(get_args(Package))
    assert sum(len(members) for source in catalogue().values() for members in source.values()) >= 200
    assert not TEST_CATEGORIES & {category for source in catalogue().values() for category in source}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(INSTALLED))
def test_an_object_stands_where_it_is_put(name: str) -> None:
    model = compiled(INSTALLED[name])
    data = mujoco.MjData(model)
    assert 0.05 - 1e-6 <= model.body("thing").mass[0] <= 0.5 + 1e-6
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qpos[:3]).max() < 0.01
    assert 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2) > np.cos(np.deg2rad(10))


def test_what_is_seen_weighs_and_touches_nothing() -> None:
    model = compiled(INSTALLED["libero/moka_pot"])
    seen = (model.geom_group == 1) & (model.geom_bodyid > 0)
    assert seen.any()
    assert not model.geom_contype[seen].any()
    assert not model.geom_conaffinity[seen].any()


def test_no_object_is_called_what_the_scene_or_the_instruction_already_names() -> None:
    task = find_task("libero_spatial", "pick_up_the_black_bowl_on_the_ramekin_and_place_it_on_the_plate")
    there = taken(task)
    assert {"bowl", "ramekin", "plate", "cookies"} <= there
    fitting = {model.category for model in INSTALLED.values() if goes_with(model, there)}
    assert not fitting & {"bowl", "ramekin", "plate", "cookies"}
    assert "basket" in fitting


@pytest.mark.parametrize(
    ("category", "task"),
    [
        ("bottle_of_milk", "pick_up_the_milk_and_place_it_in_the_basket"),
        ("box_of_butter", "pick_up_the_butter_and_place_it_in_the_basket"),
        ("bottle_of_ketchup", "pick_up_the_ketchup_and_place_it_in_the_basket"),
    ],
)
def test_a_user_s_object_is_not_added_where_the_instruction_asks_for_its_content(category: str, task: str) -> None:
    """``docs/configuration.md`` recommends such names."""
    model = replace(models(("libero",))["libero/basket"], category=category)
    assert not goes_with(model, taken(find_task("libero_object", task)))
    assert goes_with(model, taken(select_tasks(["libero_10/STUDY*"])[0]))


@pytest.mark.parametrize(
    ("category", "tested"),
    [
        *(("can_of_soda", True), ("soda_can", True), ("soda", True), ("barbecue_sauce", True)),
        *(("bottle", False), ("can_of_beans", False), ("soda_machine", False)),
    ],
)
def test_a_category_of_the_test_set_is_known_by_its_words(category: str, tested: bool) -> None:
    assert is_of_test_set(category) == tested


def test_every_task_leaves_enough_categories_to_choose_from() -> None:
    for suite in ("libero_spatial", "libero_object", "libero_goal", "libero_10"):
        for task in tasks(suite):
            there = taken(task)
            assert len({model.category for model in INSTALLED.values() if goes_with(model, there)}) >= 10, task.name


def test_without_the_package_the_error_names_it_and_what_works(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(PipelineError, match="sweethome3d-furniture") as raised:
        models(("libero", "sweethome3d"))
    assert "libero, robosuite and a folder do not need it" in str(raised.value)
    assert [left.name for left in folder.iterdir()] == [".lock"]


def test_a_worker_does_not_convert_what_the_plan_did_not(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweethome3d, "fetch", lambda _: pytest.fail("a worker fetched the package"))
    with pytest.raises(PipelineError, match=r"sweethome3d/scopia_teapot is missing(?s:.*)pipeline sources CONFIG"):
        find("sweethome3d/scopia_teapot", "0" * 64)


def own(folder: Path) -> tuple[Folder]:
    return (Folder(folder=folder, licence="CC0-1.0"),)


def test_a_model_that_is_gone_is_back_once_the_remedy_was_followed(folder: Path, tmp_path: Path) -> None:
    write_house(tmp_path / "mine" / "toy_house", scale=0.01)
    config = tmp_path / "mine.yaml"
    layout = {"sources": [one.model_dump(mode="json") for one in own(tmp_path / "mine")]}
    config.write_text(yaml.safe_dump({"name": "mine", "plan": {"episodes": {"layout": 1}, "axes": {"layout": layout}}}))
    (house,) = models(own(tmp_path / "mine")).values()
    sha256 = house.sha256
    shutil.rmtree(folder / house.name)
    models.cache_clear()
    with pytest.raises(PipelineError, match="run `python -m pipeline sources CONFIG`"):
        find(house.name, sha256)
    assert run(["sources", str(config)]) == 0
    assert find(house.name, sha256) == house


def test_a_user_s_models_are_converted_with_size_colours_and_texture(folder: Path, tmp_path: Path) -> None:
    write_house(tmp_path / "mine" / "toy_house", scale=0.01)
    (house,) = models(own(tmp_path / "mine")).values()
    assert house.name.startswith("own/toy_house_house_")
    assert (house.category, house.licence, house.attribution) == ("toy_house", "CC0-1.0", "toy_house/house.obj")
    assert find(house.name, house.sha256) == house
    low, high, _ = house.shape
    np.testing.assert_allclose(np.array(high) - np.array(low), [0.1, 0.1, 0.2], atol=1e-5)
    model = compiled(house)
    assert model.ntex == 1
    assert model.tex_width[0] == 512
    seen = model.geom_group == 1
    assert any(
        np.allclose(model.mat_rgba[material], [0.2, 0.4, 0.6, 1], atol=0.01) for material in model.geom_matid[seen]
    )
    assert np.isfinite(model.geom_aabb).all()
    assert model.geom_rbound[seen].max() < 0.2


def test_a_user_s_model_is_converted_once_and_again_when_its_texture_changes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_house(tmp_path / "mine" / "toy_house", scale=0.01)
    (before,) = models(own(tmp_path / "mine")).values()
    models.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(object_sources, "convert", lambda *_: pytest.fail("converted what was there"))
        assert models(own(tmp_path / "mine")) == {before.name: before}
    models.cache_clear()
    Image.new("RGB", (4, 4), "blue").save(tmp_path / "mine" / "toy_house" / "roof.png")
    (after,) = models(own(tmp_path / "mine")).values()
    assert after.sha256 != before.sha256
    # An earlier plan still finds what it was made with.
    assert find(before.name, before.sha256) == before


@pytest.mark.parametrize("stem", ["x" * 240, "house#sha256=1"])
def test_a_model_with_a_long_name_or_a_mark_in_it_is_found_in_a_stored_scene(
    stem: str, folder: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "mine" / "toy_house"
    write_house(mine, scale=0.01)
    (mine / "house.obj").rename(mine / f"{stem}.obj")
    ((_, model),) = models(own(tmp_path / "mine")).items()
    assets, body = model.mjcf_of("thing")
    stored = scene_files.portable(assets + body)
    assert 'file="objects/own/' in stored
    assert str(tmp_path) not in stored
    assert scene_files.located(stored, "a trajectory") == assets + body


def test_other_files_and_models_of_a_category_change_no_model(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine" / "toy_house"
    write_house(mine, scale=0.01)
    before = models(own(tmp_path / "mine"))
    (mine / "LICENSE.txt").write_text("added later")
    (mine / "hut.obj").write_text((mine / "house.obj").read_text())
    models.cache_clear()
    after = models(own(tmp_path / "mine"))
    assert len(after) == 2
    assert before.items() <= after.items()


def test_the_meshes_of_an_mjcf_model_are_no_objects(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine" / "toy_house"
    write_house(mine, scale=0.01)
    (mine / "tall.xml").write_text(
        '<mujoco><asset><mesh name="walls" file="house.obj"/></asset>'
        '<worldbody><body><geom type="mesh" mesh="walls"/></body></worldbody></mujoco>'
    )
    # MuJoCo does not read the materials of a mesh.
    (mine / "house.mtl").unlink()
    (tall,) = models(own(tmp_path / "mine")).values()
    assert tall.attribution == "toy_house/tall.xml"
    low, high, _ = tall.shape
    np.testing.assert_allclose(np.array(high) - np.array(low), [0.1, 0.2, 0.1], atol=1e-5)


@pytest.mark.parametrize("damage", ["missing", "no image", "cut short"])
@pytest.mark.parametrize("model", ["house.obj", "label.xml"])
def test_a_model_without_its_picture_is_rejected(folder: Path, tmp_path: Path, model: str, damage: str) -> None:
    mine = tmp_path / "mine" / "toy_house"
    write_house(mine, scale=0.01)
    if model == "label.xml":
        (mine / "house.obj").unlink()
        (mine / model).write_text(
            '<mujoco><asset><texture name="t" type="2d" file="roof.png"/><material name="m" texture="t"/></asset>'
            '<worldbody><body><geom type="box" size=".02 .02 .02" material="m"/></body></worldbody></mujoco>'
        )
    picture = (mine / "roof.png").read_bytes()
    # The intact picture comes last: MuJoCo does not read a file again in the same second.
    (mine / "roof.png").unlink()
    if damage != "missing":
        (mine / "roof.png").write_bytes(b"no image" if damage == "no image" else picture[: len(picture) // 2])
    with pytest.raises(PipelineError, match=r"mine/toy_house/(?s:.*)roof\.png"):
        models(own(tmp_path / "mine"))
    assert list(folder.glob("own/*")) == []
    (mine / "roof.png").write_bytes(picture)
    assert len(models(own(tmp_path / "mine"))) == 1


def test_a_name_after_a_tab_is_read_as_trimesh_reads_it(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine" / "toy_house"
    write_house(mine, scale=0.01)
    for name in ("house.obj", "house.mtl"):
        text = (mine / name).read_text()
        (mine / name).write_text(text.replace("mtllib ", "mtllib\t").replace("map_Kd ", "\tmap_Kd \t"))
    (before,) = models(own(tmp_path / "mine")).values()
    assert compiled(before).ntex == 1
    models.cache_clear()
    Image.new("RGB", (4, 4), "blue").save(mine / "roof.png")
    (after,) = models(own(tmp_path / "mine")).values()
    assert after.sha256 != before.sha256


def test_a_picture_outside_of_the_folder_of_a_model_is_rejected(folder: Path, tmp_path: Path) -> None:
    """trimesh does not read it, and would convert the model without a picture."""
    mine = tmp_path / "mine" / "toy_house"
    write_house(mine, scale=0.01)
    (mine / "roof.png").rename(tmp_path / "mine" / "roof.png")
    (mine / "house.mtl").write_text(MATERIALS.replace("roof.png", "../roof.png"))
    with pytest.raises(PipelineError, match=r"\.\./roof\.png is outside of the model's folder"):
        models(own(tmp_path / "mine"))
    assert list(folder.glob("own/*")) == []


def test_hidden_files_change_no_model_and_capital_suffixes_are_models(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine" / "cube"
    mine.mkdir(parents=True)
    (mine / "red.XML").write_text(
        '<mujoco><worldbody><body name="object"><geom type="box" size=".02 .03 .04"/></body></worldbody></mujoco>'
    )
    (folder / "own" / ".cube_red.0123.tmp").mkdir(parents=True)
    before = models(own(tmp_path / "mine"))
    assert [entry.name for entry in (folder / "own").iterdir()] == [Path(name).name for name in before], "leftovers go"
    (mine / ".DS_Store").write_bytes(b"written by a file manager")
    (mine / "._red.xml").write_bytes(b"and this")
    models.cache_clear()
    assert models(own(tmp_path / "mine")) == before


def test_a_user_s_mjcf_is_taken_with_its_files(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine" / "cube").mkdir(parents=True)
    (tmp_path / "mine" / "cube" / "red.xml").write_text(
        '<mujoco><worldbody><body name="object"><geom type="box" size=".02 .03 .04"/></body></worldbody></mujoco>'
    )
    (cube,) = models(own(tmp_path / "mine")).values()
    assert cube.shape.volume_m3 == pytest.approx(0.04 * 0.06 * 0.08)
    assert (compiled(cube).geom_group == 1).any(), "what is touched is also seen when the model shows nothing else"


LABELLED = """<mujoco>
  <asset>
    <texture name="stripes" type="2d" file="stripes.png"/>
    <texture type="2d" file="dots.png"/>
    <mesh file="parts/lid.obj"/>
    <material name="tin"><layer texture="stripes" role="rgb"/></material>
    <material name="paper" texture="dots"/>
  </asset>
  <worldbody>
    <body name="can">
      <geom type="box" size=".02 .03 .04" material="tin"/>
      <geom type="box" size=".01 .01 .01" pos="0 0 .05" rgba="1 0 0 1" group="2"/>
      <geom type="mesh" mesh="lid" rgba="0 0 1 1"/>
      <geom type="box" size=".021 .001 .02" material="paper" contype="0" conaffinity="0"/>
      <geom type="box" size=".05 .05 .05" group="3"/>
    </body>
  </worldbody>
</mujoco>"""


def seen_by_mujoco(model: mujoco.MjModel, groups: tuple[int, ...]) -> list[tuple[Any, ...]]:
    """Geoms of some groups: type, colour, and how wide the picture is that is laid over them."""
    shown = []
    for number in np.flatnonzero(np.isin(model.geom_group, groups) & (model.geom_bodyid > 0)):
        material = model.geom_matid[number]
        texture = model.mat_texid[material].max() if material >= 0 else -1
        width = int(model.tex_width[texture]) if texture >= 0 else 0
        shown.append((int(model.geom_type[number]), *model.geom_rgba[number].tolist(), width))
    return sorted(shown)


def test_a_user_s_mjcf_shows_what_mujoco_s_viewer_shows_of_it(folder: Path, tmp_path: Path) -> None:
    """A label that only looks hides nothing that collides too, and a texture of a layer is there."""
    mine = tmp_path / "mine" / "tin_can"
    (mine / "parts").mkdir(parents=True)
    (mine / "can.xml").write_text(LABELLED)
    Image.new("RGB", (8, 8), "red").save(mine / "stripes.png")
    Image.new("RGB", (16, 16), "green").save(mine / "dots.png")
    (mine / "parts" / "lid.obj").write_text(
        "v 0 0 0\nv .02 0 0\nv 0 .02 0\nv 0 0 .02\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    expected = seen_by_mujoco(mujoco.MjModel.from_xml_path(str(mine / "can.xml")), (0, 1, 2))
    assert sorted(shown[-1] for shown in expected) == [0, 0, 8, 16]
    (can,) = models(own(tmp_path / "mine")).values()
    assert seen_by_mujoco(compiled(can), (1,)) == expected


@pytest.mark.parametrize(
    ("model", "named"),
    [
        ('<worldbody><geom size=".1"/><body><geom size=".1"/></body></worldbody>', "<geom> outside of a body"),
        (
            '<asset><texture name="t" type="cube" fileright="a.png"/></asset>'
            '<worldbody><body><geom size=".1"/></body></worldbody>',
            "<texture fileright>",
        ),
        ('<compiler strippath="true"/><worldbody><body><geom size=".1"/></body></worldbody>', "<compiler strippath>"),
        (
            '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>'
            '<worldbody><body><geom size=".1"/><geom type="hfield" hfield="h"/></body></worldbody>',
            "<geom hfield>",
        ),
    ],
    ids=["outside", "texture", "compiler", "hfield"],
)
def test_parts_that_would_be_left_out_of_a_model_are_rejected_by_name(model: str, named: str, tmp_path: Path) -> None:
    file = tmp_path / "model.xml"
    file.write_text(f"<mujoco>{model}</mujoco>")
    with pytest.raises(PipelineError, match=re.escape(named)):
        _ = ObjectModel("own/x", "x", "", "", file).shape


@pytest.mark.parametrize(
    "geom",
    [
        '<geom size=".1" euler="90 0 0"/>',
        '<geom type="box" size=".1 .1 .1" axisangle="1 0 0 90"/>',
        '<geom type="box" size=".1 .1 .1" xyaxes="0 1 0 -1 0 0"/>',
        '<geom type="box" size=".1 .1 .1" zaxis="1 0 0"/>',
        '<geom type="capsule" size=".1" fromto="0 0 0 0 0 1"/>',
        '<frame quat="0 1 0 0"><geom size=".1"/></frame>',
    ],
)
def test_models_that_would_change_their_meaning_are_rejected(geom: str, tmp_path: Path) -> None:
    file = tmp_path / "model.xml"
    file.write_text(f"<mujoco><worldbody><body>{geom}</body></worldbody></mujoco>")
    mujoco.MjModel.from_xml_path(str(file))
    with pytest.raises(PipelineError, match="other than quat"):
        _ = ObjectModel("own/x", "x", "", "", file).shape


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (None, "", r"mine: the folder has no models(?s:.*)<category>/<name>\.obj"),
        ("can_of_soda/x.obj", BARE.replace("5", "0.05").replace("20", "0.2"), "can_of_soda"),
        ("Cube/x.obj", BARE, "'Cube' is not a category"),
        ("dot/dot.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", r"dot\.obj"),
        ("house/house.obj", HOUSE, r"house/house\.mtl: the model's file cannot be read"),
        ("house/house.obj", BARE, r"house\.obj: the model measures 20 m(?s:.*)at most 0\.5 m"),
        ("cube/x.xml", "<mujoco", r"x\.xml"),
        ("cube/x.xml", "<mujoco><worldbody/></mujoco>", r"x\.xml: .*no collision geometry"),
        ("cube/x.xml", TWISTED, r"mine/cube/x\.xml: MuJoCo cannot use the model"),
        ("cube/x.xml", BEREFT, r"mine/cube/x\.xml: the model names the file (?s:.*)lost\.obj, which is missing"),
        ("cube/x.xml", BADLY_PLACED % 'pos="a b c"', r"mine/cube/x\.xml: the model has <geom pos=\"a b c\">"),
        ("cube/x.xml", BADLY_PLACED % 'pos="0 0"', r"3 finite numbers"),
        ("cube/x.xml", BADLY_PLACED % 'quat="0 0 0 0"', r"4 finite numbers, not all zero"),
    ],
)
def test_what_is_wrong_with_a_user_s_folder_is_named(
    folder: Path, tmp_path: Path, file: str | None, content: str, message: str
) -> None:
    if file is not None:
        (tmp_path / "mine" / file).parent.mkdir(parents=True)
        (tmp_path / "mine" / file).write_text(content)
    with pytest.raises(PipelineError, match=message):
        models(own(tmp_path / "mine"))
    if file is not None and not file.startswith("can_of_soda"):
        assert list(folder.glob("own/*")) == []


@pytest.mark.slow
def test_a_configuration_can_name_a_folder(folder: Path, tmp_path: Path) -> None:
    write_house(tmp_path / "mine" / "toy_house", scale=0.01)
    sources = ["libero", {"folder": str(tmp_path / "mine"), "licence": "CC0-1.0", "author": "Jane Doe"}]
    axis = LayoutAxis.model_validate({"levels": [1], "sources": sources})
    perturbations = [
        axis.sample(rng("own", key), find_task("libero_goal", "turn_on_the_stove"), 0) for key in range(300)
    ]
    (added,) = {one.objects[0] for one in perturbations if one.objects[0].category == "toy_house"}
    assert (added.licence, added.attribution) == ("CC0-1.0", "toy_house/house.obj by Jane Doe")


@pytest.fixture
def two_pieces(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of two models, where the real one has hundreds."""
    monkeypatch.setattr(
        object_sources, "catalogue", lambda: {"sweethome3d": {"doll_house": ["Scopia/house", "Scopia/hut"]}}
    )
    deb = tmp_path / "package.deb"
    deb.write_bytes(package({"house": "Caf\\u00e9", "hut": "Hut"}))
    monkeypatch.setattr(sweethome3d, "fetch", lambda _: deb)


@pytest.mark.usefixtures("two_pieces")
def test_the_debian_package_is_read_and_scaled_to_the_catalogue_s_sizes() -> None:
    house, hut = models(("sweethome3d",)).values()
    low, high, _ = house.shape
    np.testing.assert_allclose(np.array(high) - np.array(low), [0.12, 0.06, 0.3], atol=1e-5)
    assert (house.name, house.category, house.licence) == ("sweethome3d/scopia_house", "doll_house", "CC-BY-3.0")
    assert house.attribution.startswith("Café by Somebody")
    assert hut.attribution.startswith("Hut by Somebody")


@pytest.mark.usefixtures("two_pieces")
def test_a_conversion_that_was_cut_short_goes_on_and_ends_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = {name: model.sha256 for name, model in models(("sweethome3d",)).items()}
    models.cache_clear()
    shutil.rmtree(folder / "sweethome3d")
    done: list[Path] = []

    def once(obj: Path, *arguments: Any) -> None:
        if done:
            raise KeyboardInterrupt
        convert(obj, *arguments)
        done.append(obj)

    with monkeypatch.context() as patch:
        patch.setattr(object_sources, "convert", once)
        with pytest.raises(KeyboardInterrupt):
            models(("sweethome3d",))
        assert len(list(folder.glob("sweethome3d/*"))) == 1
        done.clear()
        assert {name: model.sha256 for name, model in models(("sweethome3d",)).items()} == whole
        assert len(done) == 1
    # Another conversion makes other models: none of the old may pass for one of the new.
    models.cache_clear()
    monkeypatch.setattr(object_sources, "RECIPE", "another")
    with monkeypatch.context() as patch:
        patch.setattr(object_sources, "convert", once)
        with pytest.raises(KeyboardInterrupt):
            models(("sweethome3d",))


def test_a_catalogue_that_names_what_the_package_lacks_is_an_error(
    two_pieces: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_sources, "catalogue", lambda: {"sweethome3d": {"palace": ["Scopia/palace"]}})
    with pytest.raises(PipelineError, match="lacks Scopia/palace"):
        models(("sweethome3d",))


def package(names: dict[str, str]) -> bytes:
    """A Debian package of a few pieces of furniture, which are all the same house."""
    library = io.BytesIO()
    with zipfile.ZipFile(library, "w") as archive:
        listed = ""
        for number, (model, name) in enumerate(names.items(), start=1):
            piece = {"id": model, "name": name, "creator": "Somebody", "model": f"/scopia/{model}/{model}.obj"}
            sizes = {"width": "12", "depth": "6", "height": "30"}
            listed += "".join(f"{key}#{number}={value}\n" for key, value in {**piece, **sizes}.items())
            for file, content in house_files().items():
                archive.writestr(f"scopia/{model}/{file.replace('house.obj', f'{model}.obj')}", content)
        archive.writestr("PluginFurnitureCatalog.properties", listed)
    empty = io.BytesIO()
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", "id=nothing\n")
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:xz") as tar:
        for name in sweethome3d.LICENCES:
            content = (library if name == "Scopia" else empty).getvalue()
            entry = tarfile.TarInfo(f"./usr/share/sweethome3d/furniture/{name}.sh3f")
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    members = {"debian-binary": b"2.0\n", "control.tar.xz": b"odd", "data.tar.xz": data.getvalue()}
    return b"!<arch>\n" + b"".join(
        f"{name:<16}{0:<12}{0:<6}{0:<6}{100644:<8}{len(content):<10}`\n".encode() + content + b"\n" * (len(content) % 2)
        for name, content in members.items()
    )
