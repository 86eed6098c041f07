"""Models of objects: what is installed stands and is tellable apart; what is converted keeps size, look and licence."""

from __future__ import annotations

import io
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from pipeline import object_sources, objects
from pipeline.errors import PipelineError
from pipeline.object_model import ObjectModel
from pipeline.objects import TEST_CATEGORIES, goes_with, models, taken
from pipeline.tasks import find_task, tasks

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
MATERIALS = "newmtl roof\nKd 1 1 1\nmap_Kd roof.png\nnewmtl floor\nKd 0.2 0.4 0.6\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of prepared objects that is empty yet."""
    monkeypatch.setattr(objects, "FOLDER", tmp_path / "objects")
    models.cache_clear()
    yield tmp_path / "objects"
    models.cache_clear()


def house_files() -> dict[str, bytes]:
    picture = io.BytesIO()
    Image.new("RGB", (2000, 4), "red").save(picture, "PNG")
    return {"house.obj": HOUSE.encode(), "house.mtl": MATERIALS.encode(), "roof.png": picture.getvalue()}


def write_house(folder: Path) -> None:
    folder.mkdir(parents=True)
    for name, content in house_files().items():
        (folder / name).write_bytes(content)


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
    catalogue = objects.catalogue()
    assert sum(len(members) for source in catalogue.values() for members in source.values()) >= 200
    assert not TEST_CATEGORIES & {category for source in catalogue.values() for category in source}


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


def test_every_task_leaves_enough_categories_to_choose_from() -> None:
    for suite in ("libero_spatial", "libero_object", "libero_goal", "libero_10"):
        for task in tasks(suite):
            there = taken(task)
            assert len({model.category for model in INSTALLED.values() if goes_with(model, there)}) >= 10, task.name


def test_a_source_that_was_not_prepared_says_how(folder: Path) -> None:
    with pytest.raises(PipelineError, match=r"sweethome3d.*not been prepared") as raised:
        models(("sweethome3d",))
    assert "python -m pipeline objects" in str(raised.value)


def test_without_the_package_the_error_names_it_and_what_works(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(PipelineError, match="sweethome3d-furniture") as raised:
        object_sources.prepare_objects(folder)
    assert "libero, robosuite and own work without it" in str(raised.value)


def test_a_user_s_models_are_converted_with_size_colours_and_texture(folder: Path, tmp_path: Path) -> None:
    write_house(tmp_path / "mine" / "toy_house")
    for file in (tmp_path / "mine" / "toy_house").iterdir():
        file.write_bytes(file.read_bytes().replace(b"v -5 0", b"v -.05 0").replace(b"v 5 0", b"v .05 0"))
    text = (tmp_path / "mine" / "toy_house" / "house.obj").read_text()
    (tmp_path / "mine" / "toy_house" / "house.obj").write_text(
        text.replace("0 -5\n", "0 -.05\n").replace("0 5\n", "0 .05\n").replace("0 20 0", "0 .2 0")
    )
    (tmp_path / "mine" / "LICENSE").write_text("CC0-1.0\n")
    object_sources.prepare_own(tmp_path / "mine", folder / "own", say=lambda _: None)
    (house,) = models(("own",)).values()
    assert (house.name, house.category, house.licence) == ("own/toy_house_house", "toy_house", "CC0-1.0")
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


def test_a_user_s_mjcf_is_taken_with_its_files(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine" / "cube").mkdir(parents=True)
    (tmp_path / "mine" / "cube" / "red.xml").write_text(
        '<mujoco><worldbody><body name="object"><geom type="box" size=".02 .03 .04"/></body></worldbody></mujoco>'
    )
    object_sources.prepare_own(tmp_path / "mine", folder / "own", say=lambda _: None)
    (cube,) = models(("own",)).values()
    assert cube.shape.volume_m3 == pytest.approx(0.04 * 0.06 * 0.08)
    assert (compiled(cube).geom_group == 1).any(), "what is touched is also seen when the model draws nothing else"


def test_models_that_would_change_their_meaning_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "model.xml"
    file.write_text('<mujoco><worldbody><body><geom size=".1" euler="90 0 0"/></body></worldbody></mujoco>')
    with pytest.raises(PipelineError, match="euler"):
        _ = ObjectModel("own/x", "own", "x", "", "", file).shape


def test_a_category_of_the_test_set_is_refused(folder: Path, tmp_path: Path) -> None:
    write_house(tmp_path / "mine" / "can_of_soda")
    object_sources.prepare_own(tmp_path / "mine", folder / "own", say=lambda _: None)
    with pytest.raises(PipelineError, match="can_of_soda"):
        models(("own",))


def test_a_broken_obj_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine" / "dot").mkdir(parents=True)
    (tmp_path / "mine" / "dot" / "dot.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(PipelineError, match=r"dot\.obj"):
        object_sources.prepare_own(tmp_path / "mine", folder / "own", say=lambda _: None)
    assert not (folder / "own" / "dot_dot").exists()


def test_the_debian_package_is_read_and_scaled_to_the_catalogue_s_sizes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_sources, "catalogue", lambda: {"sweethome3d": {"doll_house": ["Scopia/house"]}})
    deb = tmp_path / "package.deb"
    deb.write_bytes(package("Caf\\u00e9", {"width": "12", "depth": "6", "height": "30"}))
    assert object_sources.prepare_sweethome3d(deb, folder / "sweethome3d", say=lambda _: None) == 1
    (house,) = models(("sweethome3d",)).values()
    low, high, _ = house.shape
    np.testing.assert_allclose(np.array(high) - np.array(low), [0.12, 0.06, 0.3], atol=1e-5)
    assert house.licence == "CC-BY-3.0"
    assert house.attribution.startswith("Café by Somebody")


def package(name: str, sizes: dict[str, str]) -> bytes:
    """A Debian package of one piece of furniture."""
    listed = {"id": "x", "name": name, "creator": "Somebody", "model": "/scopia/house/house.obj", **sizes}
    library = io.BytesIO()
    with zipfile.ZipFile(library, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", "".join(f"{k}#1={v}\n" for k, v in listed.items()))
        for file, content in house_files().items():
            archive.writestr(f"scopia/house/{file}", content)
    empty = io.BytesIO()
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", "id=nothing\n")
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:xz") as tar:
        for catalogue in object_sources.LICENCES:
            content = (library if catalogue == "Scopia" else empty).getvalue()
            entry = tarfile.TarInfo(f"./usr/share/sweethome3d/furniture/{catalogue}.sh3f")
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    members = {"debian-binary": b"2.0\n", "control.tar.xz": b"odd", "data.tar.xz": data.getvalue()}
    return b"!<arch>\n" + b"".join(
        f"{name:<16}{0:<12}{0:<6}{0:<6}{100644:<8}{len(content):<10}`\n".encode() + content + b"\n" * (len(content) % 2)
        for name, content in members.items()
    )
