"""The files that a scene's model names, under names that hold on every machine.

MuJoCo opens meshes and images by absolute path, so a model that is to be compiled has those of this machine. What is
stored has, in their place, where a file belongs: in a package, as ``pipeline.libero.assets`` names it, or in the folder
of converted objects, and then with a hash, as an object may be converted anew.
"""

import html
import re
from collections.abc import Callable
from pathlib import Path
from xml.sax.saxutils import escape

from pipeline.catalogue import object_sources
from pipeline.errors import PipelineError
from pipeline.files import checksum
from pipeline.libero.assets import installed, name_of

_OBJECTS, _HASH = "objects/", "#sha256="
# As ElementTree writes attributes; besides file, a cube texture has fileright, fileleft and so on. The pattern begins
# with letters, so that searching takes a tenth of the time.
_FILE = re.compile(r'(file(?<=\sfile)\w*)="([^"]*)"')


def portable(model_xml: str) -> str:
    """A scene's MJCF with names in place of this machine's paths; nothing else changes.

    Raises:
        PipelineError: when it uses a file that is neither installed nor of a converted object.
    """
    return _each_file(model_xml, _named)


def located(model_xml: str, where: object) -> str:
    """Undo ``portable``, on any machine that has the same packages and objects.

    Args:
        where: what to call the model in errors.

    Raises:
        PipelineError: when a file is not here, or is another one.
    """
    return _each_file(model_xml, lambda name: _found(name, where))


def _each_file(model_xml: str, change: Callable[[str], str]) -> str:
    def changed(match: re.Match[str]) -> str:
        return f'{match[1]}="{escape(change(html.unescape(match[2])), {chr(34): "&quot;"})}"'

    return _FILE.sub(changed, model_xml)


def _named(path: str) -> str:
    if (name := name_of(path)) is not None:
        return name
    file, converted = Path(path), object_sources.FOLDER.resolve()
    if not file.is_relative_to(converted):
        raise PipelineError(
            "the scene uses a file that only this machine has",
            where=path,
            expected=f"an asset of LIBERO or robosuite, or a file of an object in {object_sources.FOLDER}",
        )
    return f"{_OBJECTS}{file.relative_to(converted).as_posix()}{_HASH}{checksum(file)}"


def _found(name: str, where: object) -> str:
    if not name.startswith(_OBJECTS):
        try:
            return installed(name)
        except ValueError as error:
            raise PipelineError(
                f"the scene uses {name}: {error}", where=where, remedy="rm -rf .venv && bash setup.sh"
            ) from error
    below, _, sha256 = name.removeprefix(_OBJECTS).partition(_HASH)
    file = object_sources.FOLDER.resolve() / below
    if not file.is_file() or checksum(file) != sha256:
        raise PipelineError(
            f"the scene has an added object whose file {below} is {'another' if file.is_file() else 'not there'}",
            where=where,
            expected=f"{file} with the SHA-256 {sha256}",
            remedy=f"copy {object_sources.FOLDER} from where the trajectory was made, or move the object's folder away "
            f"and run {object_sources.AGAIN}",
        )
    return str(file)
