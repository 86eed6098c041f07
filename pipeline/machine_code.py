"""The machine code that NumPy and OpenBLAS compute with: fixed before they are loaded, and told of where it is not.

OpenBLAS and NumPy choose theirs by the processor, and the last bits of a torque follow from that choice; a contact
turns such bits into decimetres. Every x86 processor with AVX2 uses the code for AVX2 here, so that one demonstration
has one trajectory everywhere.
"""

import ctypes
import os
import sys
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path

from pipeline.errors import PipelineError

SETTINGS = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
}
"""Variables of the environment, which OpenBLAS and NumPy read once, when they are loaded."""

FIXED = "Haswell AVX2"
"""What ``machine_code`` says where the settings hold, on x86 processors with AVX2."""

_NUMPY_CAME_FIRST = "numpy" in sys.modules


def fix() -> None:
    """Make the settings, for this process and those that it starts; warn where NumPy has chosen otherwise before."""
    os.environ.update(SETTINGS)
    # Only told here: whoever reads a manifest needs no machine code. What is stored is refused, by fixed_machine_code.
    if fault := _fault():
        warnings.warn(str(fault), RuntimeWarning, stacklevel=3)


def in_shell(settings: Mapping[str, str]) -> str:
    """Settings as a shell takes them, before a command or after ``export``."""
    return " ".join(f'{name}="{value}"' for name, value in settings.items())


@cache
def machine_code() -> str:
    """Which kernels OpenBLAS and NumPy compute with in this process, such as ``Haswell AVX2``."""
    features = import_module("numpy._core._multiarray_umath").__cpu_features__
    widest = next((name for name in ("AVX512_SKX", "AVX512F", "AVX2", "AVX") if features.get(name)), "baseline")
    return f"{_openblas_kernel()} {widest}"


def fixed_machine_code() -> str:
    """``machine_code``, for what is stored or read.

    Raises:
        PipelineError: when NumPy was imported before this package and computes with other machine code than is fixed.
    """
    if fault := _fault():
        raise fault
    return machine_code()


def _fault() -> PipelineError | None:
    """A processor without AVX2, and a NumPy with another library for linear algebra, have machine code of their own."""
    if not _NUMPY_CAME_FIRST:
        return None
    kernel, widest = machine_code().split()
    as_fixed = widest == "AVX2" and kernel in (SETTINGS["OPENBLAS_CORETYPE"], "unknown")
    if as_fixed or widest in ("AVX", "baseline"):
        return None
    return PipelineError(
        f"NumPy was imported before pipeline and computes with {machine_code()}: results differ in their last bits, "
        "which contacts magnify, so that no file of a run can be read or written",
        expected=f"{FIXED}, which importing pipeline fixes before NumPy is loaded",
        remedy="import pipeline first, before numpy and what imports it (mujoco, pandas, torch and others), or start "
        f"Python with {in_shell(SETTINGS)} in the environment",
    )


def _openblas_kernel() -> str:
    """The kernel of the OpenBLAS that NumPy's wheel brings; ``unknown`` for another build of NumPy."""
    numpy = import_module("numpy")
    for library in sorted((Path(str(numpy.__file__)).parent.parent / "numpy.libs").glob("libscipy_openblas*")):
        corename = getattr(ctypes.CDLL(str(library)), "scipy_openblas_get_corename64_", None)
        if corename is not None:
            corename.restype = ctypes.c_char_p
            return str(corename().decode())
    return "unknown"
