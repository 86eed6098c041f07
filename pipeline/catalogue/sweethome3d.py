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
"""Of each library of the package, as its copyright file has them."""


@dataclass(frozen=True)
class Piece:
    """One model of the package.

    Attributes:
        member: ``<library>/<model>``, what it is called by here.
        title, creator: as its library names them.
        licence: SPDX identifier.
        size_m: real width, depth and height.
        turn: (3, 3) rotation that the model needs before it is measured, or None.
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
        """Write the model with its materials and textures; returns its OBJ file."""
        beside = f"{Path(self._obj).parent}/"
        self._archive.extractall(folder, [file for file in self._archive.namelist() if file.startswith(beside)])
        return folder / self._obj


def fetch(folder: Path) -> Path:
    """The package's file in ``folder``, downloaded by apt from the machine's own mirror unless it is there.

    Raises:
        PipelineError: when it cannot be downloaded, or is not the package that the catalogue was made for.
    """
    remedy = (
        f"`sudo apt-get update`, and run it again; or put {DEB} of Debian 12 there; or leave sweethome3d out of "
        "plan.axes.layout.sources: libero, robosuite and a folder work without it"
    )
    command = ["apt-get", "download", f"{PACKAGE}={VERSION}"]
    return fetched(folder / DEB, SHA256, command, f"Debian's {PACKAGE} {VERSION} (120 MB)", remedy)


def pieces(deb: Path) -> Iterator[Piece]:
    """Every model of the package."""
    for library, archive in _libraries(deb):
        for entry in _entries(archive.read("PluginFurnitureCatalog.properties").decode("latin-1")):
            width, depth, height = (float(entry[side]) / 100 for side in ("width", "depth", "height"))
            yield Piece(
                member=f"{library}/{Path(entry['model']).stem}",
                title=entry["name"],
                creator=entry.get("creator", library),
                licence=LICENCES[library],
                size_m=(width, depth, height),
                turn=np.array(entry["modelRotation"].split(), float).reshape(3, 3)
                if "modelRotation" in entry
                else None,
                _obj=entry["model"].lstrip("/"),
                _archive=archive,
            )


def _libraries(deb: Path) -> Iterator[tuple[str, zipfile.ZipFile]]:
    """The libraries of a Debian package of furniture: an ``ar`` archive with a tar file of zip files in it."""
    content = deb.read_bytes()
    at = len("!<arch>\n")
    while not (header := content[at : at + 60]).startswith(b"data.tar"):
        at += 60 + int(header[48:58]) + int(header[48:58]) % 2
    with tarfile.open(fileobj=io.BytesIO(content[at + 60 : at + 60 + int(header[48:58])])) as data:
        for library in LICENCES:
            file = data.extractfile(f"./usr/share/sweethome3d/furniture/{library}.sh3f")
            if file is not None:
                yield library, zipfile.ZipFile(io.BytesIO(file.read()))


def _entries(text: str) -> Iterator[dict[str, str]]:
    """The pieces of a catalogue, a Java properties file of ``<property>#<number>``, numbered from 1."""
    lines = re.findall(r"^\s*([^#!=:\s][^=:\s]*)\s*[=:]\s*(.*?)\s*$", re.sub(r"\\\r?\n\s*", "", text), re.MULTILINE)
    listed = {key: re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value) for key, value in lines}
    for number in takewhile(lambda number: f"id#{number}" in listed, count(1)):
        yield {key.rpartition("#")[0]: value for key, value in listed.items() if key.endswith(f"#{number}")}
