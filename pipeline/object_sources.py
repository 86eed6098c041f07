"""Objects made ready once: Debian's furniture models and a user's own, converted into ``pipeline.objects.FOLDER``."""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import subprocess
import tarfile
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pipeline.errors import PipelineError
from pipeline.files import keep_only, replaced
from pipeline.meshes import convert
from pipeline.objects import FOLDER, catalogue, models

PACKAGE = "sweethome3d-furniture"
DEB = f"{PACKAGE}_1.8-1_all.deb"
SHA256 = "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668"
LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}
"""As the package's copyright file has them."""

Say = Callable[[str], None]


def prepare_objects(folder: Path = FOLDER, own: Path | None = None, say: Say = print) -> int:
    """Convert the models of ``sweethome3d`` that the catalogue names, and those of a folder of one's own.

    Args:
        folder: where converted models go; the package is looked for there, and fetched when it is missing (120 MB).
        own: ``<own>/<category>/<name>.obj`` (y up, metres) or ``.xml`` (MJCF, z up); ``<own>/LICENSE`` is kept in mind.

    Returns:
        How many models there are now, of both sources.

    Raises:
        PipelineError: when the package cannot be had or is another, or a model cannot be converted.
    """
    made = prepare_sweethome3d(fetch_deb(folder), folder / "sweethome3d", say)
    if own is not None:
        made += prepare_own(own, folder / "own", say)
    models.cache_clear()
    return made


def fetch_deb(folder: Path) -> Path:
    """The Debian package, from ``folder`` or the machine's Debian mirror."""
    deb = folder / DEB
    if not deb.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            try:
                command = ["apt-get", "download", f"{PACKAGE}=1.8-1"]
                subprocess.run(command, cwd=scratch, check=True, capture_output=True, text=True)
                (Path(scratch) / DEB).rename(deb)
            except (OSError, subprocess.CalledProcessError) as error:
                reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
                raise PipelineError(
                    f"Debian's {PACKAGE} could not be downloaded ({reason})",
                    where=deb,
                    remedy=f"put {DEB} of Debian 12 there; or leave sweethome3d out of plan.axes.layout.sources: "
                    "libero, robosuite and own work without it",
                ) from error
    found = hashlib.sha256(deb.read_bytes()).hexdigest()
    if found != SHA256:
        raise PipelineError(
            f"not the package that the catalogue was made for: its SHA-256 is {found}",
            where=deb,
            expected=SHA256,
            remedy="delete it and run it again",
        )
    return deb


def prepare_sweethome3d(deb: Path, out: Path, say: Say) -> int:
    """Convert every model that the catalogue names, to its real size; those that are there already are kept."""
    wanted = {member: category for category, found in catalogue()["sweethome3d"].items() for member in found}
    made: set[str] = set()
    for library, archive in _libraries(deb):
        listed = _properties(archive.read("PluginFurnitureCatalog.properties").decode("latin-1"))
        for entry in _entries(listed):
            member = f"{library}/{Path(entry['model']).stem}"
            if member not in wanted:
                continue
            name = member.replace("/", "_").lower()
            made.add(name)
            if (out / name / "about.json").is_file():
                continue
            creator = entry.get("creator", library)
            about = {
                "category": wanted[member],
                "licence": LICENCES[library],
                "attribution": f"{entry['name']} by {creator}, from Sweet Home 3D's {library} catalogue, "
                "simplified and converted to MJCF",
            }
            width, depth, height = (float(entry[side]) / 100 for side in ("width", "depth", "height"))
            turn = np.array(entry["modelRotation"].split(), float).reshape(3, 3) if "modelRotation" in entry else None
            with replaced(out / name) as made_here, tempfile.TemporaryDirectory() as scratch:
                inside = str(Path(entry["model"]).parent).lstrip("/") + "/"
                archive.extractall(scratch, [file for file in archive.namelist() if file.startswith(inside)])
                made_here.mkdir()
                convert(Path(scratch) / entry["model"].lstrip("/"), made_here, (width, depth, height), turn)
                (made_here / "about.json").write_text(json.dumps(about, indent=2))
            say(f"{len(made)}/{len(wanted)} {name}")
    missing = len(wanted) - len(made)
    if missing:
        raise PipelineError(f"{missing} models of the catalogue are not in the package", where=deb, remedy="report it")
    keep_only(out, made)
    return len(made)


def prepare_own(own: Path, out: Path, say: Say) -> int:
    """Convert or copy a user's models."""
    found = sorted(path for path in own.glob("*/*") if path.suffix in (".obj", ".xml"))
    if not found:
        raise PipelineError("no models", where=own, expected="<category>/<name>.obj or <category>/<name>.xml")
    licence = own / "LICENSE"
    made: set[str] = set()
    for path in found:
        name = f"{path.parent.name}_{path.stem}".lower()
        if name in made:
            raise PipelineError(f"two models of the name {name}", where=path, remedy="rename one of them")
        made.add(name)
        with replaced(out / name) as made_here:
            made_here.mkdir()
            if path.suffix == ".obj":
                convert(path, made_here)
            else:
                _copy(path, made_here)
            about = {
                "category": path.parent.name.lower(),
                "licence": licence.read_text().strip().splitlines()[0] if licence.is_file() else "unknown",
                "attribution": f"{path.parent.name}/{path.name}",
            }
            (made_here / "about.json").write_text(json.dumps(about, indent=2))
        say(f"{len(made)}/{len(found)} {name}")
    keep_only(out, made)
    return len(made)


def _copy(mjcf: Path, out: Path) -> None:
    """Copy a model with the files that it names, side by side."""
    try:
        tree = ET.parse(mjcf)
        for number, asset in enumerate(tree.iterfind("asset/*[@file]")):
            file = mjcf.parent / asset.attrib["file"]
            asset.set("file", f"{number}{file.suffix}")
            shutil.copyfile(file, out / asset.attrib["file"])
    except (OSError, ET.ParseError) as error:
        raise PipelineError(f"cannot be copied ({error})", where=mjcf, expected="MJCF with its files") from error
    tree.write(out / "model.xml")


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


def _properties(text: str) -> dict[str, str]:
    """A Java properties file."""
    found = re.findall(r"^\s*([^#!=:\s][^=:\s]*)\s*[=:]\s*(.*?)\s*$", re.sub(r"\\\r?\n\s*", "", text), re.MULTILINE)
    return {key: re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value) for key, value in found}


def _entries(listed: dict[str, str]) -> Iterator[dict[str, str]]:
    """The pieces of a catalogue, whose properties are written ``<property>#<number>``, numbered from 1."""
    number = 1
    while f"id#{number}" in listed:
        yield {key.rpartition("#")[0]: value for key, value in listed.items() if key.endswith(f"#{number}")}
        number += 1
