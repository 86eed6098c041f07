"""Scenes without images: physics does not need them, and they are most of a model's memory."""

import posixpath
import xml.etree.ElementTree as ET


def flat_images(scene: ET.Element) -> dict[str, str]:
    """Replace each image of a scene by a plain colour; return the name of each replaced texture with its file."""
    files: dict[str, str] = {}
    for texture in scene.iterfind("asset/texture[@name][@file]"):
        files[texture.attrib["name"]] = texture.attrib.pop("file")
        texture.attrib.update(builtin="flat", width="1", height="1")
    return files


def restore_images(scene: ET.Element, files: dict[str, str]) -> None:
    """Undo ``flat_images`` in a scene that MuJoCo has written since, so that it is as MuJoCo would have written it.

    Args:
        scene: the scene.
        files: result of ``flat_images``.
    """
    for texture in scene.iterfind("asset/texture[@name]"):
        file = files.get(texture.attrib["name"])
        if file is not None:
            for name in ("builtin", "width", "height"):
                del texture.attrib[name]
            texture.attrib["file"] = posixpath.normpath(file)
