"""Sources of textures, and all textures that each source offers, including textures that must not be sampled.

``robosuite``, ``libero`` and ``procedural`` are installed with the pipeline. ``metaworld`` and ``gymnasium-robotics``
are wheels of the Python package index, fetched when they are first needed and read as archives. A :class:`Folder`
holds the user's own images.
"""

import hashlib
import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from pipeline import seeding
from pipeline.catalogue import procedural
from pipeline.catalogue.downloads import Wheel, fetch_wheel
from pipeline.catalogue.sources import Folder, reject_undecodable
from pipeline.errors import PipelineError
from pipeline.files import write
from pipeline.libero.assets import libero_assets, package_folder
from pipeline.types import Frame

Package = Literal["libero", "robosuite", "procedural", "metaworld", "gymnasium-robotics"]
Source = Package | Folder

FOLDER = Path("data/textures")
"""Folder of the wheels, and of copies of the user's images that were sampled: ``own/<SHA-256>``."""

PROCEDURAL_PER_FAMILY = 60

WHEELS = {
    "metaworld": Wheel(
        name="metaworld",
        version="3.1.1",
        sha256="99e25d9baf97f2f1a19ca89c0d2ca9c6a2b396d9a9be81729de64eedc683f0d3",
        content="metaworld's textures (37 MB)",
    ),
    "gymnasium-robotics": Wheel(
        name="gymnasium-robotics",
        version="1.4.2",
        sha256="a1743530431cb377e6b3b956d284bc96436fc68bac1648ef205054c178e7dc4b",
        content="gymnasium-robotics' textures (26 MB)",
    ),
}
LICENCES = {
    # The package states MIT for its code and leaves the images to their upstream authors.
    "libero": "MIT (LIBERO)",
    "robosuite": "MIT (robosuite)",
    "procedural": "CC0-1.0",
    "metaworld": "MIT (metaworld)",
    "gymnasium-robotics": "MIT, parts Apache-2.0 (gymnasium-robotics)",
}
LARGEST_PX = 64_000_000
"""Largest number of pixels of an image: 8,000 pixels square."""

REPLACE = "move the file to another place"

_IMAGES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Texture:
    """One image of a surface.

    Attributes:
        name: ``<source>:<file>``, ``procedural:<family>/<index>`` or ``folder:<start of the hash>/<file>``. It holds no
            path of this machine. Name and hash are enough to find the texture again.
        source: the part of the name before the colon, ``folder`` for a user's file.
        licence: licence that the source states.
        sha256: hash of the image file. A procedural texture has the hash of its recipe (generator's version, family,
            index), so that rounding on another processor does not make it another texture.
        author: author of a user's file, if the configuration names one.
        load: function that returns (H, W, 3) RGB; it raises a PipelineError when the file is missing or no image.
        own: the file of a user's image.
    """

    name: str
    source: str
    licence: str
    sha256: str
    load: Callable[[], Frame] = field(repr=False, compare=False)
    own: Path | None = field(default=None, repr=False, compare=False)
    author: str = ""

    @property
    def family(self) -> str | None:
        """Family of a procedural texture in :data:`pipeline.catalogue.procedural.FAMILIES`; `None` for an image."""
        if self.source != "procedural":
            return None
        return self.name.partition(":")[2].partition("/")[0]


def offered(source: Source) -> Iterator[Texture]:
    """Yield every image of a source, in a fixed order.

    Raises:
        PipelineError: when the source cannot be fetched or read.
    """
    match source:
        case Folder():
            files = _images(source.folder)
            if not files:
                raise PipelineError(
                    "the folder has no images" if source.folder.is_dir() else "there is no such folder",
                    where=source.folder,
                    expected="PNG or JPEG files",
                    remedy="correct the folder in plan.axes.background.sources",
                )
            for file in files:
                texture = from_file("folder:", file, source.licence)
                reject_undecodable(file)
                name = f"folder:{texture.sha256[:8]}/{file.relative_to(source.folder).as_posix()}"
                yield replace(texture, name=name, own=file, author=source.author)
        case "procedural":
            for family, index in product(procedural.FAMILIES, range(PROCEDURAL_PER_FAMILY)):
                sha256 = seeding.digest("texture", procedural.RECIPE, family, index)
                make = partial(procedural.texture, family, index)
                yield Texture(f"procedural:{family}/{index:03d}", source, LICENCES[source], sha256, make)
        case "libero":
            for file in libero_images():
                yield from_file(f"libero:{file.name}", file, LICENCES[source])
        case "robosuite":
            for file in _images(package_folder("robosuite") / "models" / "assets" / "textures"):
                yield from_file(f"robosuite:{file.name}", file, LICENCES[source])
        case "metaworld" | "gymnasium-robotics":
            without = f"leave {source} out of plan.axes.background.sources"
            path = fetch_wheel(WHEELS[source], FOLDER, without)
            with zipfile.ZipFile(path) as archive:
                members = sorted(member for member in archive.namelist() if member.lower().endswith(_IMAGES))
                for member in members:
                    name = f"{source}:{member.partition('/assets/')[2].replace('textures/', '')}"
                    sha256 = hashlib.sha256(archive.read(member)).hexdigest()
                    yield Texture(name, source, LICENCES[source], sha256, partial(_member, path, member))


def from_file(name: str, file: Path, licence: str) -> Texture:
    """Return the texture of an image file.

    Raises:
        PipelineError: when the file cannot be read.
    """
    try:
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise PipelineError(f"cannot read the texture ({error})", where=file, remedy="put the file back") from error
    return Texture(name, name.partition(":")[0], licence, sha256, lambda: _decode(file.read_bytes(), file))


def keep(texture: Texture) -> None:
    """Copy a user's image into ``FOLDER``, where ``kept`` finds it even if the user's folder changes."""
    copy = FOLDER / "own" / texture.sha256
    if texture.own is not None and not copy.exists():
        write(copy, texture.own.read_bytes())


def kept(name: str, sha256: str) -> Texture:
    """Return a user's image that was sampled, from its copy.

    Raises:
        PipelineError: when the copy is missing or damaged.
    """
    file = FOLDER / "own" / sha256
    texture = from_file(name, file, "the folder's") if file.is_file() else None
    if texture is None or texture.sha256 != sha256:
        raise PipelineError(
            f"the texture {name} is {'missing' if texture is None else 'damaged'}",
            where=file,
            remedy=f"{'' if texture is None else 'move the file away, then '}copy {FOLDER} from the machine that "
            "planned the run, or move its plan.parquet away and run python stages/plan.py CONFIG",
        )
    return texture


@cache
def libero_images() -> tuple[Path, ...]:
    """List LIBERO's images of walls, floors and tables."""
    return _images(libero_assets() / "textures")


def _member(wheel: Path, member: str) -> Frame:
    """Read an image (H, W, 3) from a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return _decode(archive.read(member), member)


def _images(root: Path) -> tuple[Path, ...]:
    """List the PNG and JPEG files in a folder and its subfolders, sorted."""
    return tuple(sorted(file for file in root.rglob("*") if file.suffix.lower() in _IMAGES))


def _decode(content: bytes, where: object) -> Frame:
    """Decode an image (H, W, 3); an error names it by ``where``."""
    import cv2  # imported here because it takes long, and every process of a run imports the axes

    try:
        # Read the header first: a small file may hold more pixels than fit into memory.
        with Image.open(io.BytesIO(content)) as header:
            width_px, height_px = header.size
        if width_px * height_px > LARGEST_PX:
            raise ValueError(f"{width_px} x {height_px} pixels, at most {LARGEST_PX} are read")
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR_RGB)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, cv2.error) as error:
        raise PipelineError(f"the file is not a readable image ({error})", where=where, remedy=REPLACE) from error
    if image is None:
        raise PipelineError("the file is not a readable image", where=where, remedy=REPLACE)
    return np.asarray(image, np.uint8)
