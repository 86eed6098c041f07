"""Portable names of the files that a scene's model uses.

MuJoCo opens meshes and images by absolute path, so a model that is to be compiled has the paths of this machine. A
stored model has portable names instead. A file of a package has its name in ``pipeline.libero.assets``. A file of a
converted object has its path in the folder of converted objects and a hash, because an object may be converted again.
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
from pipeline.origins import REINSTALL

_OBJECTS, _HASH = "objects/", "#sha256="
# The pattern matches attributes in ElementTree's notation. In addition to file, a cube texture has fileright, fileleft
# and so on. The pattern begins with letters, so that searching takes a tenth of the time.
_FILE = re.compile(r'(file(?<=\sfile)\w*)="([^"]*)"')


def portable(model_xml: str) -> str:
    """Replace this machine's paths in a scene's MJCF by portable names; nothing else changes.

    Raises:
        PipelineError: when the scene uses a file that belongs neither to a package nor to a converted object.
    """
    return _each_file(model_xml, _named)


def located(model_xml: str, where: object) -> str:
    """Undo ``portable``, on any machine that has the same packages and objects.

    Args:
        model_xml: a scene's MJCF with portable names.
        where: name of the model for error messages.

    Raises:
        PipelineError: when a file is missing, or has another hash.
    """
    return _each_file(model_xml, lambda name: _found(name, where))


def _each_file(model_xml: str, change: Callable[[str], str]) -> str:
    """Apply ``change`` to the value of every file attribute of a scene's MJCF."""

    def changed(match: re.Match[str]) -> str:
        file = change(html.unescape(match[2]))
        return f'{match[1]}="{escape(file, {chr(34): "&quot;"})}"'

    return _FILE.sub(changed, model_xml)


def _named(path: str) -> str:
    """Return the portable name of a path of this machine."""
    name = name_of(path)
    if name is not None:
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
    """Return this machine's path of a portable name, and check the hash of an object's file."""
    if not name.startswith(_OBJECTS):
        try:
            return installed(name)
        except ValueError as error:
            raise PipelineError(f"the scene uses {name}: {error}", where=where, remedy=REINSTALL) from error
    below, _, sha256 = name.removeprefix(_OBJECTS).rpartition(_HASH)
    file = object_sources.FOLDER.resolve() / below
    if not file.is_file() or checksum(file) != sha256:
        raise PipelineError(
            f"the file {below} of an added object {'has changed' if file.is_file() else 'is missing'}",
            where=where,
            expected=f"{file} with the SHA-256 {sha256}",
            remedy=f"copy {object_sources.FOLDER} from the machine that generated the trajectory, or move the object's "
            f"folder away and run {object_sources.AGAIN}",
        )
    return str(file)
