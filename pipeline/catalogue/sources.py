"""A user's folder as a source of textures or of object models."""

from pipeline.types import Frozen, Place


class Folder(Frozen):
    """Folder of textures or objects that the user has a right to use.

    Attributes:
        folder: Path of the folder. Textures are the PNG and JPEG files in it and its subfolders. Objects are
            ``<category>/<name>.obj`` (y up, in metres) and ``<category>/<name>.xml`` (MJCF, z up).
        licence: Licence of the textures or objects, recorded with every episode that shows one of them.
    """

    folder: Place
    licence: str
