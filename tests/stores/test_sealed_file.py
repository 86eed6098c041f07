"""Store files: readable by NumPy alone, the same bytes twice, and no damage that goes unnoticed."""

import json
from pathlib import Path
from typing import Any
from zipfile import ZipFile, ZipInfo

import numpy as np
import pytest

from pipeline.stores.sealed_file import HEADER, BrokenSealError, seal, unsealed

ARRAYS: dict[str, Any] = {
    "empty": np.zeros((0, 3)),
    "flat": np.zeros((5, 0), np.float32),
    "scalar": np.asarray(3.0),
    "big-endian": np.arange(12, dtype=">i4").reshape(3, 4),
    "transposed": np.arange(6.0).reshape(2, 3).T,
    "group/flags": np.array([True, False]),
}


def test_numpy_alone_reads_the_arrays_and_json_the_attributes(tmp_path: Path) -> None:
    seal(tmp_path / "one.npz", ARRAYS, {"reason": "kept"})
    with np.load(tmp_path / "one.npz") as file:
        assert {name: file[name].tolist() for name in ARRAYS} == {name: ARRAYS[name].tolist() for name in ARRAYS}
        assert json.loads(file[HEADER])["attributes"] == {"reason": "kept"}


def test_arrays_of_every_shape_are_read_as_they_were_written(tmp_path: Path) -> None:
    seal(tmp_path / "one.npz", ARRAYS, {})
    with unsealed(tmp_path / "one.npz") as file:
        for name, values in ARRAYS.items():
            found = file.array(name)
            assert (found.dtype, found.shape, found.tobytes()) == (values.dtype, values.shape, values.tobytes())


def test_the_same_arrays_give_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seal(tmp_path / "one.npz", ARRAYS, {"reason": "kept"})
    monkeypatch.setattr("time.time", lambda: 2e9)
    seal(tmp_path / "two.npz", ARRAYS, {"reason": "kept"})
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


def _rewritten(path: Path, change: Any) -> None:
    """Write the members of a file again after ``change``, with the checksums that the container asks for."""
    with ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(ZipInfo(name), content)


def _another_number(members: dict[str, bytes]) -> None:
    members["big-endian.npy"] = members["big-endian.npy"][:-1] + b"\x07"


def _one_array_less(members: dict[str, bytes]) -> None:
    del members["flat.npy"]


def _one_array_more(members: dict[str, bytes]) -> None:
    members["more.npy"] = members["flat.npy"]


def _no_header(members: dict[str, bytes]) -> None:
    del members[HEADER]


def _header_of_another_kind(members: dict[str, bytes]) -> None:
    members[HEADER] = b"[1, 2]"


CHANGES = [_another_number, _one_array_less, _one_array_more, _no_header, _header_of_another_kind]


def _read_all(path: Path) -> None:
    with unsealed(path) as file:
        for name in ARRAYS:
            file.array(name)


@pytest.mark.parametrize("change", CHANGES)
def test_content_that_was_changed_with_its_crc_breaks_the_seal(change: Any, tmp_path: Path) -> None:
    path = tmp_path / "one.npz"
    seal(path, ARRAYS, {})
    _rewritten(path, change)
    with pytest.raises(BrokenSealError):
        _read_all(path)


def test_a_pickle_is_never_loaded(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="allow_pickle"):
        seal(tmp_path / "one.npz", {"objects": np.array([{}])}, {})
