"""Debian's package of furniture models: fetched once, checked by hash, read as an archive and never installed."""

import io
import re
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path

import numpy as np

from pipeline.catalogue.downloads import fetched
from pipeline.types import Floats

PACKAGE = "sweethome3d-furniture"
VERSION = "1.8-1"
DEB = f"{PACKAGE}_{VERSION}_all.deb"
SHA256 = "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668"
LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}
"""Library of the package to its licence, according to the package's copyright file."""


@dataclass(frozen=True)
class Piece:
    """One model of the package.

    Attributes:
        member: ``<library>/<model>``, the name of the model in this project.
        title, creator: names that the library states.
        licence: SPDX identifier.
        size_m: real width, depth and height.
        turn: (3, 3) rotation that the model needs before it is measured, or `None`.
    """

    member: str
    title: str
    creator: str
    licence: str
    size_m: tuple[float, float, float]
    turn: Floats | None
    _obj: str
    _archive: zipfile.ZipFile

    def unpack(self, folder: Path) -> Path:
        """Write the model with its materials and textures into a folder; return its OBJ file."""
        same_folder = f"{Path(self._obj).parent}/"
        files = [file for file in self._archive.namelist() if file.startswith(same_folder)]
        self._archive.extractall(folder, files)
        return folder / self._obj


def fetch(folder: Path) -> Path:
    """Fetch the package's file into ``folder`` unless it exists, by apt from the machine's own mirror.

    Raises:
        PipelineError: when the file cannot be downloaded, or is not the package that the catalogue describes.
    """
    remedy = (
        f"run `sudo apt-get update`, then the command again; or put {DEB} of Debian 12 into {folder}; or leave "
        "sweethome3d out of plan.axes.layout.sources: libero, robosuite and a folder do not need it"
    )
    command = ["apt-get", "download", f"{PACKAGE}={VERSION}"]
    return fetched(folder / DEB, SHA256, command, f"Debian's {PACKAGE} {VERSION} (120 MB)", remedy)


def pieces(deb: Path) -> Iterator[Piece]:
    """Yield every model of the package."""
    for library, archive in _libraries(deb):
        for entry in _entries(archive.read("PluginFurnitureCatalog.properties").decode("latin-1")):
            width, depth, height = (float(entry[side]) / 100 for side in ("width", "depth", "height"))
            turn = None
            if "modelRotation" in entry:
                turn = np.array(entry["modelRotation"].split(), float).reshape(3, 3)
            yield Piece(
                member=f"{library}/{Path(entry['model']).stem}",
                title=entry["name"],
                creator=entry.get("creator", library),
                licence=LICENCES[library],
                size_m=(width, depth, height),
                turn=turn,
                _obj=entry["model"].lstrip("/"),
                _archive=archive,
            )


def _libraries(deb: Path) -> Iterator[tuple[str, zipfile.ZipFile]]:
    """Yield the libraries of a Debian package of furniture: an ``ar`` archive with a tar file of zip files in it."""
    content = deb.read_bytes()
    # Each member of the archive has a header of 60 bytes, which states its size; members begin at even places.
    start = len("!<arch>\n")
    while not (header := content[start : start + 60]).startswith(b"data.tar"):
        size = int(header[48:58])
        start += 60 + size + size % 2
    first = start + 60
    data_tar = content[first : first + int(header[48:58])]
    with tarfile.open(fileobj=io.BytesIO(data_tar)) as data:
        for library in LICENCES:
            file = data.extractfile(f"./usr/share/sweethome3d/furniture/{library}.sh3f")
            if file is not None:
                yield library, zipfile.ZipFile(io.BytesIO(file.read()))


def _entries(text: str) -> Iterator[dict[str, str]]:
    """Yield the pieces of a catalogue: a Java properties file of ``<property>#<number>``, numbered from 1.

    A piece is a dictionary of property to value.
    """
    joined = re.sub(r"\\\r?\n\s*", "", text)
    lines = re.findall(r"^\s*([^#!=:\s][^=:\s]*)\s*[=:]\s*(.*?)\s*$", joined, re.MULTILINE)
    listed = {}
    for key, value in lines:
        listed[key] = re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value)
    for number in takewhile(lambda number: f"id#{number}" in listed, count(1)):
        end = f"#{number}"
        yield {key.rpartition("#")[0]: value for key, value in listed.items() if key.endswith(end)}
