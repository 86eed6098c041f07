"""An HDF5 file of arrays with checksums: made when it is written, checked when something of it is read.

Every array has its own, so that a reader of some arrays need not read the others. The file has one over the names and
checksums of all arrays, so that what is missing is seen when the file is opened.

HDF5's own structure has checksums since version 1.10 of the format, all but strings of variable length. On damaged ones
the library crashes, so all texts are in one array.
"""

import errno
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

FORMAT = ("v110", "v110")
"""The oldest and the newest version of HDF5's format that a file may use."""

SEAL = "sha256"
"""The attribute that holds a checksum, of an array and of the file."""

ATTRIBUTES = "attributes"
"""The array that holds a file's attributes, as JSON."""


_WRONG_BYTES = (OSError, LookupError, ValueError, TypeError, RuntimeError, ArithmeticError)
"""What h5py and JSON raise where they read wrong bytes."""

_REFUSED = {errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.ENOMEM}
"""What the system refuses whatever the file holds."""


class BrokenSealError(Exception):
    """What was read is not what was written, or cannot be read."""


@contextmanager
def _reading() -> Iterator[None]:
    """Have wrong bytes be one error, whichever way they are noticed. Memory that is short is no fault of the file."""
    try:
        yield
    except _WRONG_BYTES as error:
        if isinstance(error, OSError) and error.errno in _REFUSED:
            raise
        raise BrokenSealError(str(error)) from error


class SealedFile:
    """A file that is open for reading.

    Attributes:
        attributes: what the file says beside its arrays.

    Raises:
        BrokenSealError: when its attributes, or the list of its arrays, are not what was written.
    """

    def __init__(self, file: h5py.File):
        self._file = file
        with _reading():
            self._seals = {name: _seal_of(file, name) for name in _arrays(file)}
            if _seal_of(file, ".") != _outline(self._seals):
                raise BrokenSealError("the list of its arrays is not what was written")
            self.attributes: Mapping[str, Any] = json.loads(self.array(ATTRIBUTES).tobytes())

    def __contains__(self, name: str) -> bool:
        return name in self._seals

    def array(self, name: str) -> NDArray[Any]:
        """An array, whole; KeyError when there is none, BrokenSealError when it is not what was written."""
        seal = self._seals[name]
        with _reading():
            values = _read(self._file, name)
            if seal != _digest(values):
                raise BrokenSealError(f"{name} is not what was written")
        return values

    def length(self, name: str) -> int:
        """Of an array, which is not read."""
        with _reading():
            return len(self._file[name])

    def groups(self, name: str) -> list[str]:
        """Names of the groups in a group; BrokenSealError when they cannot be read."""
        with _reading():
            return sorted(self._file[name])

    def check_all(self) -> None:
        """Read every array; BrokenSealError when one is not what was written."""
        for name in self._seals:
            self.array(name)


@contextmanager
def unsealed(path: Path) -> Iterator[SealedFile]:
    """A file that ``sealed`` made, open for reading.

    Raises:
        BrokenSealError: when it cannot be read, or its attributes or arrays' list are not what was written.
        OSError: when the system does not open it.
    """
    with _reading():
        file = h5py.File(path, "r")
    with file:
        yield SealedFile(file)


@contextmanager
def sealed(path: Path, attributes: Mapping[str, Any]) -> Iterator[h5py.File]:
    """A new file to fill with arrays; it gets its checksums when the block ends. The same arrays make the same bytes.

    Args:
        path: where it will lie.
        attributes: JSON-serialisable, what it says beside its arrays.
    """
    with h5py.File(path, "w", libver=FORMAT) as file:
        yield file
        # Or a compressed array finds its place when its last reference goes, and a profiler may hold one for a moment.
        file.flush()
        file[ATTRIBUTES] = np.frombuffer(json.dumps(dict(attributes), sort_keys=True).encode(), np.uint8)
        seals = {name: _digest(_read(file, name)) for name in _arrays(file)}
        for name, seal in seals.items():
            file[name].attrs[SEAL] = np.bytes_(seal)
        file.attrs[SEAL] = np.bytes_(_outline(seals))


# By h5py's lower layer: a file of frames has about 60 arrays, and what takes longest is to make h5py's objects of them.


def _arrays(file: h5py.File) -> list[str]:
    """Names of the arrays, in the file's order."""
    names: list[bytes] = []

    def note(name: bytes, item: h5py.h5o.ObjInfo) -> None:
        if item.type == h5py.h5o.TYPE_DATASET:
            names.append(name)

    # Leaves out what lies in other files.
    h5py.h5o.visit(file.id, note, info=True)
    return [name.decode() for name in names]


def _seal_of(file: h5py.File, name: str) -> str:
    stored, seal = h5py.h5a.open(file.id, SEAL.encode(), obj_name=name.encode()), np.zeros((), "S64")
    if (stored.shape, stored.dtype) != (seal.shape, seal.dtype):  # HDF5 would write past the end.
        raise BrokenSealError(f"the checksum of {name} is not what was written")
    stored.read(seal)
    return bytes(seal[()]).decode(errors="replace")


def _read(file: h5py.File, name: str) -> NDArray[Any]:
    stored = h5py.h5d.open(file.id, name.encode())
    values = np.empty(stored.shape, stored.dtype)
    stored.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _digest(values: NDArray[Any]) -> str:
    described = f"{values.dtype.str} {values.shape} ".encode()
    return sha256(described + np.ascontiguousarray(values).tobytes()).hexdigest()


def _outline(seals: Mapping[str, str]) -> str:
    return sha256(json.dumps(seals).encode()).hexdigest()
