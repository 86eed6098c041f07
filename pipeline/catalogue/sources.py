"""A user's folder as a source of textures or of object models."""

from pathlib import Path

from pydantic import Field

from pipeline.errors import PipelineError
from pipeline.types import Frozen, Place


class Folder(Frozen):
    """Folder of textures or objects that the user has a right to use.

    Attributes:
        folder: Path of the folder. Textures are the PNG and JPEG files in it and its subfolders. Objects are
            ``<category>/<name>.obj`` (y up, in metres) and ``<category>/<name>.xml`` (MJCF, z up).
        licence: Licence of the textures or objects, recorded with every episode that shows one of them. An SPDX
            identifier, such as CC-BY-4.0, lets the dataset card derive its own licence.
        author: Author of the textures or objects, whom the dataset card names; none by default.
    """

    folder: Place
    licence: str = Field(min_length=1)
    # Excluded at its default, as a field that was added later.
    author: str = Field(default="", exclude_if=lambda author: not author)


def reject_undecodable(file: Path) -> None:
    """Reject a name that a plan cannot store.

    Raises:
        PipelineError: when the name is not UTF-8.
    """
    try:
        str(file).encode()
    except UnicodeEncodeError as error:
        raise PipelineError(
            f"the name {file.name!a} is not UTF-8",
            where=file.parent,
            expected="names of files and folders in UTF-8",
            remedy="rename the file or its folder",
        ) from error
