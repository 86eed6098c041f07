"""Files whose checksums are no checksums: HDF5 would write what they are over other memory."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.stores.sealed_file import SEAL, BrokenSealError, sealed, unsealed


@pytest.mark.parametrize("place", ["/", "numbers"])
@pytest.mark.parametrize(
    "seal", [np.full(1000, b"0" * 64), np.zeros(100), 3, np.bytes_(b"0" * 100), "0" * 64, np.bytes_(b"0" * 63), None]
)
def test_a_checksum_of_another_kind_breaks_the_seal(seal: Any, place: str, tmp_path: Path) -> None:
    path = tmp_path / "one.h5"
    with sealed(path, {"told": 1}) as file:
        file["numbers"] = np.arange(6).reshape(2, 3)
    with unsealed(path) as whole:
        assert whole.array("numbers").tolist() == [[0, 1, 2], [3, 4, 5]]
    with h5py.File(path, "r+") as file:
        del file[place].attrs[SEAL]
        if seal is not None:
            file[place].attrs[SEAL] = seal
    with pytest.raises(BrokenSealError), unsealed(path):
        pass


def test_arrays_of_every_shape_are_read_as_they_were_written(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {
        "empty": np.zeros((0, 3)),
        "flat": np.zeros((5, 0), np.float32),
        "scalar": np.float64(3),
        "big-endian": np.arange(12, dtype=">i4").reshape(3, 4),
        "group/flags": np.array([True, False]),
    }
    with sealed(tmp_path / "one.h5", {}) as file:
        for name, values in arrays.items():
            file[name] = values
        file.create_dataset("packed", data=np.ones((50, 7)), compression="gzip")
    with unsealed(tmp_path / "one.h5") as read:
        for name, values in [*arrays.items(), ("packed", np.ones((50, 7)))]:
            found = read.array(name)
            assert (found.dtype, found.shape, found.tobytes()) == (values.dtype, values.shape, values.tobytes())
        assert (read.length("flat"), read.groups("group")) == (5, ["flags"])
