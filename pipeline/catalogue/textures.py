"""Textures that may be sampled, with name, licence and hash: colour maps and procedural textures.

No image that the benchmark shows is among them.
"""

import re
from functools import cache, lru_cache
from typing import cast, get_args

from pipeline.catalogue.sources import Folder
from pipeline.catalogue.texture_sources import Package, Source, Texture, kept, libero_images, offered
from pipeline.errors import RUN_AGAIN, PipelineError
from pipeline.files import checksum
from pipeline.types import Frame

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
"""Images of LIBERO that may be sampled: three of the ten that no test task names.

`tile_grigia_caldera_porcelain_floor` and `smooth_light_gray_plaster` are byte for byte the test set's
light-gray-floor-tile and light-gray-plaster. `grigia_caldera_porcelain_floor`, `light_gray_plaster`,
`light_grey_plaster` and `new_light_gray_plaster` differ from these two by 0.1 to 2.3 grey levels.
`martin_novak_wood_table` is the image of the unperturbed table.
"""

_NOT_SURFACES = frozenset(
    {
        *("bread", "can", "cereal", "lemon", "soda", "glass", "dice", "foil", "silverraw", "skin", "square"),
        *("block", "block-hidden", "height1", "tennis", "real-door"),
    }
)
"""Skins of single objects among the packages' textures, by normalised name."""

_RECOLOURED = frozenset({"robosuite:yellow-plaster.png"})
"""Walls of test tasks in another colour: their thumbnail's correlation with the thumbnail of ``cream-plaster`` is 0.95.

The most similar other image of the packages has a correlation of 0.74 with a test image.
"""

_DATA_MAP = re.compile(
    r"(?:^|[-_ ])(ao|alpha\w*|bump|disp|displacement|gloss|height|metalness|nor|norm|normal|nrm|objectid|opacity|refl"
    r"|reflection|rough|roughness|spec|specular)(?=[-_ .]|$)",
    re.IGNORECASE,
)
"""Pattern in the names of data maps, which hold a surface's reflection or relief instead of its colour."""

TESTED_NAME = "it has the name of an image that test tasks show"


@cache
def normalise(name: str) -> str:
    """Normalise the name of an image file for comparisons: remove folders, ending, case and kind of separator."""
    stem = re.sub(r"\.(png|jpe?g)$", "", re.split(r"[/\\:]", name)[-1], flags=re.IGNORECASE)
    return re.sub(r"[^a-z0-9]+", "-", stem.lower()).strip("-")


@cache
def test_images() -> frozenset[str]:
    """Return the SHA-256 of each of LIBERO's images that test tasks show."""
    return frozenset(checksum(file) for file in libero_images() if file.stem in IN_TEST_SET)


test_images.__test__ = False  # type: ignore[attr-defined]  # not a test case, whatever its name starts with


def why_rejected(name: str, sha256: str) -> str | None:
    """Return the reason why an image must not be sampled; `None` if it may be sampled."""
    if sha256 in test_images():
        return "its bytes are those of an image that test tasks show"
    if normalise(name) in {normalise(used) for used in IN_TEST_SET}:
        return TESTED_NAME
    if _DATA_MAP.search(re.split(r"[/\\:]", name)[-1]):
        return "its name is that of a data map; rename it if it is a colour map"
    return None


@cache
def catalogue(sources: tuple[Source, ...]) -> dict[str, Texture]:
    """Collect the textures of some sources that may be sampled: name to texture, each content once.

    Sources that are not installed are fetched first.

    Raises:
        PipelineError: when a source cannot be fetched or read, or a user's folder holds an image that must not be
            sampled.
    """
    by_name: dict[str, Texture] = {}
    seen: set[str] = set()
    for source in sources:
        for texture in offered(source):
            if texture.sha256 not in seen and _may_be_sampled(texture, source):
                seen.add(texture.sha256)
                by_name[texture.name] = texture
    return by_name


def unusable(texture: Texture, reason: str) -> PipelineError:
    """Return the error about a user's image that must not be sampled."""
    return PipelineError(f"this image cannot be used: {reason}", where=texture.own, remedy="move it out of the folder")


def find(name: str, sha256: str) -> Texture:
    """Return the texture that an episode recorded.

    Raises:
        PipelineError: when the texture is missing, or its content differs from the recorded hash.
    """
    source = name.partition(":")[0]
    texture = kept(name, sha256) if source == "folder" else None
    if source in get_args(Package):
        texture = catalogue((cast(Package, source),)).get(name)
    if texture is None:
        raise PipelineError(f"there is no texture {name}", remedy=f"{RUN_AGAIN}, which plans again with this version")
    if texture.sha256 != sha256:
        raise PipelineError(f"the texture {name} has changed since the plan", remedy=f"{RUN_AGAIN}, which plans again")
    return texture


@lru_cache(maxsize=8)
def pixels(name: str, sha256: str) -> Frame:
    """Return (H, W, 3) RGB of a recorded texture; the array is shared, and therefore read-only."""
    image = find(name, sha256).load()
    image.setflags(write=False)
    return image


def _may_be_sampled(texture: Texture, source: Source) -> bool:
    """Return whether a package's image may be sampled.

    Raises:
        PipelineError: when a user's image may not be sampled, or is not readable.
    """
    reason = why_rejected(texture.name, texture.sha256)
    if isinstance(source, Folder):
        if reason is not None:
            raise unusable(texture, reason)
        texture.load()  # reports a file that is not an image now, not when it is rendered
        return True
    if texture.source == "libero":
        return texture.name.removeprefix("libero:") in _LIBERO_FREE
    return reason is None and texture.name not in _RECOLOURED and normalise(texture.name) not in _NOT_SURFACES
