"""Sources of object models, and the models that each source offers.

``libero`` and ``robosuite`` are installed with the pipeline. ``sweethome3d`` (Debian's package of furniture models, CC0
and CC-BY) and a user's :class:`Folder` are converted into ``FOLDER`` when they are first needed. A converted model is
kept until its origin or the conversion changes, so an interrupted conversion resumes where it stopped.
"""

import fcntl
import json
import re
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import yaml
from rich.console import Console
from rich.progress import track

from pipeline.catalogue import sweethome3d
from pipeline.catalogue.meshes import RECIPE, convert, material_files
from pipeline.catalogue.object_model import ObjectModel, asset_name
from pipeline.catalogue.sources import Folder, reject_undecodable
from pipeline.errors import PipelineError
from pipeline.files import checksum, remove_leftovers, replaced
from pipeline.libero.assets import libero_assets, package_folder
from pipeline.seeding import digest
from pipeline.types import LONGEST_NAME

Package = Literal["libero", "robosuite", "sweethome3d"]
Source = Package | Folder

FOLDER = Path("data/objects")
"""Folder of converted models, one folder each: ``<source>/<name>/model.xml`` and ``about.json``."""
AGAIN = "`python -m pipeline sources CONFIG`, which converts missing models"
"""Command that converts a missing model again, for error messages."""
CATALOGUE = Path(__file__).with_name("objects.yaml")

LARGEST_M = 0.5
"""Largest extent of a user's model in any direction: a larger model is not in metres, or too large for a table."""


def offered(source: Source) -> Iterator[ObjectModel]:
    """Yield every object of a source; a source that is not installed is fetched and converted first.

    Raises:
        PipelineError: when the source cannot be fetched or read, or a model cannot be converted.
    """
    match source:
        case "libero":
            assets = libero_assets()
            for category, members in catalogue()["libero"].items():
                for member, up in members.items():
                    stem = member.rpartition("/")[2]
                    mjcf = assets / member / f"{stem}.xml"
                    if mjcf.is_file():  # upstream LIBERO lacks LIBERO-PRO's additions
                        yield ObjectModel(f"libero/{stem}", category, "MIT", "LIBERO, LIBERO-PRO", mjcf, up)
        case "robosuite":
            folder = package_folder("robosuite") / "models" / "assets" / "objects"
            for category, members in catalogue()["robosuite"].items():
                for stem, up in members.items():
                    mjcf = folder / f"{stem}.xml"
                    yield ObjectModel(f"robosuite/{stem}", category, "MIT", "robosuite", mjcf, up)
        case "sweethome3d":
            yield from _sweethome3d()
        case Folder():
            yield from _own(source)


def converted(name: str) -> ObjectModel:
    """Return the converted model of the given name; nothing is fetched or converted.

    Raises:
        PipelineError: when no such model was converted.
    """
    about = _about(name)
    if about is None:
        raise PipelineError(f"the object {name} is missing", where=FOLDER / name, remedy=f"run {AGAIN}")
    return ObjectModel(name, about["category"], about["licence"], about["attribution"], FOLDER / name / "model.xml")


@cache
def catalogue() -> dict[str, dict[str, Any]]:
    """Read ``objects.yaml``: package to category to the members of the category."""
    catalogue: dict[str, dict[str, Any]] = yaml.safe_load(CATALOGUE.read_text())
    return catalogue


def _sweethome3d() -> Iterator[ObjectModel]:
    """Yield the objects of sweethome3d; missing or outdated models are converted first."""
    wanted: dict[str, str] = {}
    for category, members in catalogue()["sweethome3d"].items():
        wanted |= dict.fromkeys(members, category)
    names = {member: f"sweethome3d/{member.replace('/', '_').lower()}" for member in wanted}
    made_from = {}
    for member, category in wanted.items():
        made_from[member] = digest("object", RECIPE, sweethome3d.SHA256, member, category)

    def missing() -> set[str]:
        """Return the members that have no converted model, or one of another origin."""
        outdated = set()
        for member, name in names.items():
            about = _about(name) or {}
            if about.get("made_from") != made_from[member]:
                outdated.add(member)
        return outdated

    if missing():
        with _locked():
            deb = sweethome3d.fetch(FOLDER)
            todo = missing()
            pieces = [piece for piece in sweethome3d.pieces(deb) if piece.member in todo]
            for piece in track(pieces, "converting sweethome3d", console=Console(stderr=True)):
                about = {
                    "made_from": made_from[piece.member],
                    "category": wanted[piece.member],
                    "licence": piece.licence,
                    "attribution": f"{piece.title} by {piece.creator}, from Sweet Home 3D's "
                    f"{piece.member.partition('/')[0]} catalogue, simplified and converted to MJCF",
                }
                with _made(names[piece.member], about) as folder, tempfile.TemporaryDirectory() as scratch:
                    convert(piece.unpack(Path(scratch)), folder, piece.size_m, piece.turn)
            absent = missing()
            if absent:
                raise PipelineError(
                    f"the package lacks {', '.join(sorted(absent))}", where=deb, remedy="report this error"
                )
    for name in names.values():
        yield converted(name)


def _own(source: Folder) -> Iterator[ObjectModel]:
    """Yield the objects of a user's folder; new or changed models are converted first."""
    visible = sorted(path for path in source.folder.glob("*/*") if not path.name.startswith("."))
    files_of = {path: _files_of(path) for path in visible if path.suffix.lower() == ".xml"}
    # The meshes of an MJCF model are no models of their own.
    meshes = {file.resolve() for file in chain.from_iterable(files_of.values())}
    for path in visible:
        if path.suffix.lower() == ".obj" and path.resolve() not in meshes:
            files_of[path] = _files_of(path)
    paths = sorted(files_of)
    if not paths:
        raise PipelineError(
            "the folder has no models",
            where=source.folder,
            expected="<category>/<name>.obj or <category>/<name>.xml",
            remedy="correct the folder in plan.axes.layout.sources",
        )
    for path in paths:
        reject_undecodable(path)
        category = path.parent.name
        if not re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)*", category):
            raise PipelineError(
                f"{category!r} is not a category",
                where=path.parent,
                expected="the noun of an instruction for the objects, in lower case, such as bottle_of_milk",
                remedy="rename the folder",
            )
        hashed = [(file.name, checksum(file)) for file in (path, *files_of[path])]
        made_from = digest("object", RECIPE, hashed)
        # The name holds a hash of the model's origin, so that an earlier plan still finds its own objects.
        name = f"own/{category}_{path.stem.lower()[:LONGEST_NAME]}_{made_from[:8]}"
        about = {"made_from": made_from, "category": category, "licence": source.licence}
        about["attribution"] = f"{category}/{path.name}" + (f" by {source.author}" if source.author else "")
        if _about(name) != about:
            with _locked(), _made(name, about) as folder:
                if path.suffix.lower() == ".obj":
                    convert(path, folder)
                    _check(folder / "model.xml", path)
                else:
                    _check(path, path)
                    _copy(path, folder)
        yield converted(name)


def _files_of(path: Path) -> list[Path]:
    """List the files that a user's model names.

    Raises:
        PipelineError: when the model cannot be read, or when a file is missing or outside of the model's folder. Also
            when a picture of an OBJ is damaged.
    """
    if path.suffix.lower() == ".obj":
        files = material_files(path)
    else:
        try:
            files = [path.parent / asset.attrib["file"] for asset in ET.parse(path).iterfind("asset/*[@file]")]
        except (OSError, ET.ParseError) as error:
            raise PipelineError(
                f"the model is not readable ({error})",
                where=path,
                expected="a MuJoCo model in XML",
                remedy="correct the file, or move it out of the folder",
            ) from error
    for file in files:
        if not file.resolve().is_relative_to(path.parent.resolve()):
            raise PipelineError(
                f"the file {file} is outside of the model's folder",
                where=path,
                expected="files in the model's folder, or below it",
                remedy="copy the file into the model's folder, and name it by its path from this folder",
            )
        if not file.is_file():
            raise PipelineError(
                f"the model names the file {file}, which is missing",
                where=path,
                remedy="put the file there, or correct its name in the model",
            )
    return files


def _check(mjcf: Path, path: Path) -> None:
    """Reject a user's model, by its ``path``, if it is larger than ``LARGEST_M`` or MuJoCo cannot use it."""
    import mujoco

    model = ObjectModel("", "", "", "", mjcf)
    low, high, _ = model.shape
    longest = max(up - down for up, down in zip(high, low, strict=True))
    if longest > LARGEST_M:
        raise PipelineError(
            f"the model measures {longest:.3g} m",
            where=path,
            expected=f"at most {LARGEST_M} m in any direction",
            remedy="scale the model to metres, or move it out of the folder",
        )
    assets, body = model.mjcf_of("object")
    try:
        mujoco.MjModel.from_xml_string(f"<mujoco><asset>{assets}</asset><worldbody>{body}</worldbody></mujoco>")
    except ValueError as error:
        raise PipelineError(
            f"MuJoCo cannot use the model ({error})",
            where=path,
            expected="a model that mujoco.MjModel.from_xml_path compiles",
            remedy="correct the file, or move it out of the folder",
        ) from error


def _copy(mjcf: Path, out: Path) -> None:
    """Copy a model and the files that it names into one folder."""
    tree = ET.parse(mjcf)
    for number, asset in enumerate(tree.iterfind("asset/*[@file]")):
        file = mjcf.parent / asset.attrib["file"]
        asset.set("name", asset_name(asset))
        asset.set("file", f"{number}{file.suffix}")
        shutil.copyfile(file, out / asset.attrib["file"])
    tree.write(out / "model.xml")


@contextmanager
def _made(name: str, about: dict[str, str]) -> Iterator[Path]:
    """Open the folder of a converted model for writing; afterwards the folder is complete or absent.

    The caller must hold ``_locked``.
    """
    remove_leftovers((FOLDER / name).parent)
    with replaced(FOLDER / name) as folder:
        folder.mkdir()
        yield folder
        (folder / "about.json").write_text(json.dumps(about, indent=2) + "\n")


def _about(name: str) -> dict[str, str] | None:
    """Read ``about.json`` of a converted model; return `None` if there is no such model, or the file is damaged."""
    try:
        about: dict[str, str] = json.loads((FOLDER / name / "about.json").read_text())
    except (FileNotFoundError, ValueError):
        return None
    return about


@contextmanager
def _locked() -> Iterator[None]:
    """Let only one process convert at a time; the next process finds the models converted."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        remove_leftovers(FOLDER)
        yield
