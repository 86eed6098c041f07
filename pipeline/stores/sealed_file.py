"""Store file: named arrays and JSON attributes in NumPy's ``.npz`` container, with a SHA-256 for each array.

``numpy.load`` reads the arrays without this project. They are not compressed: the same arrays give the same bytes.
"""

import json
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

HEADER = "attributes.json"

_DAMAGE = (BadZipFile, EOFError, LookupError, RuntimeError, TypeError, ValueError, ArithmeticError, zlib.error)
"""Errors that ``zipfile``, ``json`` and ``numpy`` raise on damaged bytes. An ``OSError`` is a fault of the system."""


class BrokenSealError(Exception):
    """Content of a file that has changed since it was written."""


@contextmanager
def _damage_as_one_error() -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        raise BrokenSealError(str(error)) from error


class SealedFile:
    """An open store file; every method raises ``BrokenSealError`` when the file is damaged."""

    @_damage_as_one_error()
    def __init__(self, archive: ZipFile):
        self._archive = archive
        header = json.loads(archive.read(HEADER))
        self.attributes: Mapping[str, Any] = header["attributes"]
        self.checksums: Mapping[str, str] = header["sha256"]
        if archive.namelist() != [*(f"{name}.npy" for name in self.checksums), HEADER]:
            raise BrokenSealError("the list of its arrays has changed since it was written")

    @_damage_as_one_error()
    def array(self, name: str) -> NDArray[Any]:
        """Read one array and compare its checksum."""
        content = self._archive.read(f"{name}.npy")
        if sha256(content).hexdigest() != self.checksums[name]:
            raise BrokenSealError(f"{name} has changed since it was written")
        values: NDArray[Any] = np.load(BytesIO(content), allow_pickle=False)
        return values


@contextmanager
def unsealed(path: Path) -> Iterator[SealedFile]:
    """Open a file that ``seal`` wrote; raise ``OSError`` when the system does not open it."""
    with _damage_as_one_error():
        archive = ZipFile(path)
        if any(not 0 <= member.header_offset < path.stat().st_size for member in archive.infolist()):
            raise BadZipFile("an array has a position outside of the file")
    with archive:
        yield SealedFile(archive)


def seal(path: Path, arrays: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]) -> None:
    """Write a file of named arrays and JSON-serialisable attributes; a ``/`` in a name groups arrays."""
    checksums = {}
    with ZipFile(path, "w") as archive:
        for name, values in arrays.items():
            content = BytesIO()
            np.save(content, values, allow_pickle=False)
            checksums[name] = sha256(content.getbuffer()).hexdigest()
            archive.writestr(ZipInfo(f"{name}.npy"), content.getbuffer())
        archive.writestr(ZipInfo(HEADER), json.dumps({"attributes": dict(attributes), "sha256": checksums}))
