"""A user's folder as a source of textures or of object models."""

from pydantic import BaseModel

from pipeline.types import Place


class Folder(BaseModel, frozen=True, extra="forbid"):
    """Folder of textures or objects that the user has a right to use.

    Attributes:
        folder: for textures, searched with its subfolders for PNG and JPEG files; for objects, it holds
            ``<category>/<name>.obj`` (y up, in metres) and ``<category>/<name>.xml`` (MJCF, z up).
        licence: what they may be used under, recorded with every episode that shows one.
    """

    folder: Place
    licence: str
