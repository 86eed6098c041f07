"""Textures: enough of them, distinct, with licence and hash, and none that the test set shows."""

import hashlib
import os
import shutil
import zipfile
from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from checkout import REPOSITORY
from libero.libero import get_libero_path
from numpy.typing import NDArray
from short_demonstrations import STOVE

from pipeline.axes import from_json, to_json
from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import Credit
from pipeline.catalogue import procedural, texture_sources, textures
from pipeline.catalogue.downloads import Wheel
from pipeline.catalogue.sources import Folder
from pipeline.catalogue.texture_sources import Package, Texture, from_file
from pipeline.catalogue.textures import catalogue, find, pixels, why_rejected
from pipeline.errors import PipelineError
from pipeline.seeding import rng

OFFLINE = catalogue(("libero", "robosuite", "procedural"))
LIBERO = Path(get_libero_path("assets")) / "textures"


def thumbnail(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    return cv2.resize(image, (32, 32), interpolation=cv2.INTER_AREA).astype(np.float64)


def likeness(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Correlation of two thumbnails, each channel about its mean."""
    flat = [(image - image.mean(axis=(0, 1))).ravel() for image in (one, other)]
    return float(np.corrcoef(*flat)[0, 1]) if all(np.ptp(values) for values in flat) else 0.0


def test_there_are_four_hundred_without_a_download() -> None:
    assert len(OFFLINE) >= 400
    assert sum(texture.source == "procedural" for texture in OFFLINE.values()) >= 300
    assert len({texture.sha256 for texture in OFFLINE.values()}) == len(OFFLINE)
    for name, texture in OFFLINE.items():
        assert texture.name == name
        assert texture.licence
        assert len(texture.sha256) == 64


@pytest.fixture(scope="module")
def everything() -> Iterator[dict[str, Texture]]:
    """With the real wheels, which are downloaded once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(texture_sources, "FOLDER", REPOSITORY / texture_sources.FOLDER)
        catalogue.cache_clear()
        yield catalogue(get_args(Package))
    catalogue.cache_clear()


def test_the_wheels_add_images_with_their_licences(everything: dict[str, Texture]) -> None:
    images = {"libero": 3, "robosuite": 20, "metaworld": 29, "gymnasium-robotics": 5}
    assert Counter(texture.source for texture in everything.values()) == {"procedural": 780, **images}
    granite = everything["metaworld:granite.png"]
    assert granite.licence == "MIT (metaworld)"
    assert np.array_equal(pixels(granite.name, granite.sha256), granite.load())


def test_none_looks_like_a_test_image_or_like_another(everything: dict[str, Texture]) -> None:
    # Two encodings of one image differ by up to 2.3 grey levels: light_grey_plaster and light-gray-plaster.
    images = [texture for texture in everything.values() if texture.source != "procedural"]
    made = [OFFLINE[f"procedural:{family}/{index:03d}"] for family in procedural.FAMILIES for index in range(0, 60, 6)]
    shown = [thumbnail(from_file("x", file, "").load()) for file in LIBERO.iterdir()
             if file.stem in textures.IN_TEST_SET]  # fmt: skip
    assert len(shown) == len(textures.IN_TEST_SET) == 25
    seen = [(texture.name, thumbnail(texture.load())) for texture in (*images, *made)]
    for name, thumb in seen:
        assert min(np.abs(thumb - other).mean() for other in shown) > 2.5, name
        # Also in another colour: the next likest comes to 0.74.
        assert max(likeness(thumb, other) for other in shown) < 0.9, name
    for (name, thumb), (other_name, other) in combinations(seen, 2):
        assert np.abs(thumb - other).mean() > 1.5, f"{name} and {other_name}"


@pytest.mark.parametrize("family", procedural.FAMILIES)
def test_procedural_textures_are_reproducible_and_seamless(family: str) -> None:
    for index in range(4):
        image = procedural.texture(family, index)
        assert image.shape == (512, 512, 3)
        assert image.dtype == np.uint8
        assert np.array_equal(image, procedural.texture(family, index))
        for axis in (0, 1):
            steps = np.abs(np.diff(image.astype(int), axis=axis)).mean(axis=(1 - axis, 2))
            seam = np.abs(np.take(image, 0, axis).astype(int) - np.take(image, -1, axis)).mean()
            assert seam <= 1.2 * steps.max()
    assert not np.array_equal(procedural.texture(family, 0), procedural.texture(family, 1))


def test_data_maps_look_like_what_they_are_named_after() -> None:
    """By the figures of their kind, over all of them: blue above red and green, grey, nearly white, or one colour."""
    for index in range(0, 60, 15):
        normal = procedural.texture("normal", index).astype(float) / 127.5 - 1
        assert np.allclose(normal.mean(axis=(0, 1))[:2], 0, atol=0.03)
        assert normal[..., 2].mean() > 0.55
        length = np.linalg.norm(normal, axis=-1)[np.abs(normal).max(axis=-1) < 0.87]  # not cut off
        assert np.allclose(length, 1, atol=0.03)
        for family in ("height", "gloss", "occlusion"):
            image = procedural.texture(family, index)
            assert (image == image[..., :1]).all()
        assert np.median(procedural.texture("occlusion", index)) > 200
        assert cv2.resize(procedural.texture("reflection", index), (32, 32), interpolation=cv2.INTER_AREA).std() < 30


def test_test_images_are_rejected_by_content_and_name_and_data_maps_by_name() -> None:
    used = (LIBERO / "light-gray-plaster.png").read_bytes()
    assert "bytes" in str(why_rejected("mine.png", hashlib.sha256(used).hexdigest()))
    assert "name" in str(why_rejected("folder:somewhere/Gray-Plaster.JPG", "0" * 64))
    for name in ("Bricks02_NRM_6K.png", "Wood_DISP.png", "metal-roughness.jpg", "CliffDesert006_AO_HIRES.png"):
        assert "colour" in str(why_rejected(name, "0" * 64))
    for name in ("Bricks02_COL_6K.png", "normandy_stone.png", "special-oak.png"):
        assert why_rejected(name, "0" * 64) is None


def test_a_folder_of_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture_sources, "FOLDER", tmp_path / "textures")
    folder = tmp_path / "mine"
    (folder / "wood").mkdir(parents=True)
    oak = folder / "wood" / "oak_COL.png"
    cv2.imwrite(str(oak), np.full((8, 8, 3), (10, 20, 200), np.uint8))
    offered = catalogue((Folder(folder=folder, licence="CC-BY-4.0", author="Jane Doe"),))
    (texture,) = offered.values()
    assert (texture.licence, texture.author) == ("CC-BY-4.0", "Jane Doe")
    assert texture.load()[0, 0].tolist() == [200, 20, 10]
    # A name that every machine may know, and that two images of one name do not share.
    assert texture.name == f"folder:{texture.sha256[:8]}/wood/oak_COL.png"
    # What was sampled is shown, whatever becomes of the folder.
    sources = (Folder(folder=folder, licence="CC-BY-4.0", author="Jane Doe"),)
    perturbation = BackgroundAxis(sources=sources).sample(rng("oak"), STOVE, 0)
    assert perturbation.credits(STOVE) == {Credit(texture.name, "texture", "CC-BY-4.0", "Jane Doe")}
    assert from_json(to_json([perturbation])) == (perturbation,)
    oak.unlink()
    assert pixels(texture.name, texture.sha256)[0, 0].tolist() == [200, 20, 10]
    with pytest.raises(PipelineError, match=r"oak_COL.png is missing(?s:.*)python stages/plan.py CONFIG"):
        find(texture.name, "0" * 64)
    (texture_sources.FOLDER / "own" / texture.sha256).write_bytes(b"rot")
    with pytest.raises(PipelineError, match=r"oak_COL.png is damaged(?s:.*)python stages/plan.py CONFIG"):
        find(texture.name, texture.sha256)


def test_two_images_of_one_name_are_two(tmp_path: Path) -> None:
    folders = [Folder(folder=tmp_path / name, licence="CC0") for name in ("one", "other")]
    for shade, source in enumerate(folders):
        source.folder.mkdir()
        cv2.imwrite(str(source.folder / "oak.png"), np.full((8, 8, 3), shade, np.uint8))
    assert sorted(texture.load().max() for texture in catalogue(tuple(folders)).values()) == [0, 1]


FAULTS = {
    "copy of a test image": "its bytes are those of an image that test tasks show",
    "surface of a test task": "it has the name of an image that test tasks show",
    "normal map": "its name is that of a data map",
    "not an image": "the file is not a readable image",
    "foreign letters": r"the name 'caf\\udce9.png' is not UTF-8",
    "empty": "the folder has no images",
    "missing": "there is no such folder",
}


@pytest.mark.parametrize(("fault", "message"), FAULTS.items())
def test_a_folder_with_a_fault_is_an_error_that_names_it(tmp_path: Path, fault: str, message: str) -> None:
    folder = tmp_path / fault
    if fault != "missing":
        folder.mkdir()
    match fault:
        case "copy of a test image":
            shutil.copy(LIBERO / "stucco_wall.png", folder / "mine.png")
        case "surface of a test task":
            cv2.imwrite(str(folder / "bricks02-col-var1-6k.jpg"), np.zeros((8, 8, 3), np.uint8))
        case "normal map":
            cv2.imwrite(str(folder / "wood_NRM_2K.png"), np.zeros((8, 8, 3), np.uint8))
        case "not an image":
            (folder / "mine.png").write_bytes(b"no image")
        case "foreign letters":
            encoded = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
            (folder / os.fsdecode(b"caf\xe9.png")).write_bytes(encoded)
    axis = BackgroundAxis(sources=(Folder(folder=folder, licence="CC0"),))
    with pytest.raises(PipelineError, match=f"{message}(?s:.*){fault}|{fault}(?s:.*){message}"):
        axis.offered()


def test_a_wheel_s_images_are_offered_once_and_only_surfaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encoded = cv2.imencode(".png", np.full((4, 4, 3), 100, np.uint8))[1].tobytes()
    with zipfile.ZipFile(tmp_path / "metaworld-1.0-py3-none-any.whl", "w") as archive:
        archive.writestr("metaworld/assets/textures/granite.png", encoded)
        archive.writestr("metaworld/assets/textures/again.png", encoded)
        archive.writestr("metaworld/assets/textures/tennis.png", b"another")
        archive.writestr("metaworld/assets/readme.txt", b"no image")
    sha256 = hashlib.sha256((tmp_path / "metaworld-1.0-py3-none-any.whl").read_bytes()).hexdigest()
    monkeypatch.setattr(texture_sources, "FOLDER", tmp_path)
    monkeypatch.setitem(texture_sources.WHEELS, "metaworld", Wheel("metaworld", "1.0", sha256, "textures"))
    catalogue.cache_clear()
    (texture,) = catalogue(("metaworld",)).values()
    assert (texture.name, texture.licence) == ("metaworld:again.png", "MIT (metaworld)")
    assert texture.load().mean() == 100
    catalogue.cache_clear()


def test_a_named_source_that_cannot_be_had_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Never fewer textures than the configuration says: a plan must not depend on the network."""
    monkeypatch.setattr(texture_sources, "FOLDER", tmp_path)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    catalogue.cache_clear()
    with pytest.raises(PipelineError, match=r"metaworld's textures(?s:.*)or leave metaworld out of plan\.axes"):
        catalogue(("procedural", "metaworld"))
    catalogue.cache_clear()


def test_an_unknown_texture_is_an_error() -> None:
    for name in ("procedural:wood/9999", "robosuite:ceramic.png", "elsewhere:x"):
        with pytest.raises(PipelineError, match=name):
            find(name, "0" * 64)
