"""Machine code of NumPy and OpenBLAS: fixed before they are loaded, and reported where it is not.

OpenBLAS and NumPy choose machine code by the processor. The last bits of a torque follow from that choice, and a
contact amplifies them to decimetres. Every x86 processor with AVX2 uses the code for AVX2 here. One demonstration
therefore has one trajectory everywhere.
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
"""Environment variables, which OpenBLAS and NumPy read once, when they are loaded."""

FIXED = "Haswell AVX2"
"""Result of ``machine_code`` under these settings, on x86 processors with AVX2."""

_NUMPY_CAME_FIRST = "numpy" in sys.modules


def fix() -> None:
    """Set the variables for this process and its children; warn if NumPy has already chosen other machine code."""
    os.environ.update(SETTINGS)
    # Readers of a manifest need no machine code: a warning suffices. fixed_machine_code protects stored files.
    fault = _fault()
    if fault:
        warnings.warn(str(fault), RuntimeWarning, stacklevel=3)


def in_shell(settings: Mapping[str, str]) -> str:
    """Return settings in shell syntax, for use before a command or after ``export``."""
    return " ".join(f'{name}="{value}"' for name, value in settings.items())


@cache
def machine_code() -> str:
    """Return the kernels of OpenBLAS and NumPy in this process, such as ``Haswell AVX2``."""
    features = import_module("numpy._core._multiarray_umath").__cpu_features__
    widest = next((name for name in ("AVX512_SKX", "AVX512F", "AVX2", "AVX") if features.get(name)), "baseline")
    return f"{_openblas_kernel()} {widest}"


def fixed_machine_code() -> str:
    """Return ``machine_code``, for files that are stored or read.

    Raises:
        PipelineError: when NumPy was imported before this package and computes with other machine code than is fixed.
    """
    fault = _fault()
    if fault:
        raise fault
    return machine_code()


def _fault() -> PipelineError | None:
    """Return the error that NumPy computes with other machine code than is fixed, or ``None``.

    A processor without AVX2, and a NumPy with another library for linear algebra, always use different machine code.
    Neither is an error.
    """
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
    """Return the kernel of the OpenBLAS in NumPy's wheel, or ``unknown`` for another build of NumPy."""
    numpy = import_module("numpy")
    libraries = Path(str(numpy.__file__)).parent.parent / "numpy.libs"
    for library in sorted(libraries.glob("libscipy_openblas*")):
        corename = getattr(ctypes.CDLL(str(library)), "scipy_openblas_get_corename64_", None)
        if corename is not None:
            corename.restype = ctypes.c_char_p
            return str(corename().decode())
    return "unknown"
