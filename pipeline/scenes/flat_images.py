"""Scenes without images: physics does not need them, and they are most of a model's memory."""

import posixpath
import xml.etree.ElementTree as ET
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.origins import REINSTALL

RESTORED = {"name", "type", "file", "width", "height"}
"""Attributes of a texture that ``restore_images`` can restore. MuJoCo ignores width and height of an image."""


def flat_images(scene: ET.Element) -> dict[str, str]:
    """Replace images of a scene by a plain colour; return the name of each replaced texture with its file.

    Textures with attributes other than ``RESTORED`` keep their images. LIBERO has no such textures.
    """
    files: dict[str, str] = {}
    for texture in scene.iterfind("asset/texture[@name][@file]"):
        if texture.attrib.keys() <= RESTORED:
            files[texture.attrib["name"]] = texture.attrib.pop("file")
            texture.attrib.update(builtin="flat", width="1", height="1")
    return files


def restore_images(scene: ET.Element, files: dict[str, str]) -> None:
    """Undo ``flat_images`` in a scene that MuJoCo has written since, so that it is as MuJoCo would have written it.

    Args:
        scene: the scene.
        files: result of ``flat_images``, with absolute paths.

    Raises:
        PipelineError: when an image does not exist.
    """
    for texture in scene.iterfind("asset/texture[@name]"):
        file = files.get(texture.attrib["name"])
        if file is None:
            continue
        if not Path(file).is_file():
            remedy = f"put the image there; {REINSTALL} installs the images of LIBERO again"
            raise PipelineError("an image of the scene does not exist", where=file, remedy=remedy)
        for name in ("builtin", "width", "height"):
            del texture.attrib[name]
        texture.attrib["file"] = posixpath.normpath(file)
