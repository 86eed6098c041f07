"""Machine code of NumPy and OpenBLAS: the code for AVX2, on every x86 processor with AVX2.

OpenBLAS and NumPy choose machine code by the processor. The choice changes the last bits of a torque, and a contact
amplifies them to decimetres. Under ``MACHINE_CODE_VARIABLES``, a demonstration has the same trajectory everywhere.

Both libraries read the variables once, when they are loaded. Therefore a program of this project starts itself again
with them (``ensure_fixed_machine_code``), and its worker processes inherit them. An import changes nothing. A function
whose result must be reproducible bit for bit calls ``fixed_machine_code``, which raises an error under other machine
code.
"""

import ctypes
import os
import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path

from pipeline.errors import PipelineError

MACHINE_CODE_VARIABLES = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
}
"""Environment variables of OpenBLAS and NumPy."""

STARTED_AGAIN = "PERTURBED_LIBERO_STARTED_AGAIN"
"""Environment variable with the id of the process that has started itself again."""

FIXED = "Haswell AVX2"
"""Result of ``machine_code`` under these variables, on x86 processors with AVX2."""


def ensure_fixed_machine_code(variables: Mapping[str, str] = MACHINE_CODE_VARIABLES) -> None:
    """Start this program again with the same arguments, unless the environment already has the variables.

    The first statement of a program calls this. If it starts the program again, it does not return: the new program
    replaces this process. Code that calls a program from within, such as a notebook, sets the variables itself.

    Args:
        variables: environment variables that the program needs from its start.
    """
    if all(os.environ.get(name) == value for name, value in variables.items()):
        return
    # The new program has the same process id. It continues even if something else, such as a `sitecustomize.py`, sets
    # the variables at every start; `fixed_machine_code` then raises an error.
    if os.environ.get(STARTED_AGAIN) == str(os.getpid()):
        return
    os.environ.update(variables)
    os.environ[STARTED_AGAIN] = str(os.getpid())
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def in_shell(variables: Mapping[str, str]) -> str:
    """Return environment variables in shell syntax, for use before a command or after ``export``."""
    return " ".join(f'{name}="{value}"' for name, value in variables.items())


@cache
def machine_code() -> str:
    """Return the kernels of OpenBLAS and NumPy in this process, such as ``Haswell AVX2``."""
    # Imported after ``ensure_fixed_machine_code``, as NumPy reads the variables when it is loaded.
    numpy = import_module("numpy")
    extensions = numpy.show_config(mode="dicts")["SIMD Extensions"]
    used = {*extensions["baseline"], *extensions.get("found", ())}
    widest = next((name for name in ("AVX512_SKX", "AVX512F", "AVX2", "AVX") if name in used), "baseline")
    return f"{_openblas_kernel()} {widest}"


def fixed_machine_code() -> str:
    """Return ``machine_code``, for results that must be reproducible bit for bit.

    A processor without AVX2, and a NumPy with another library for linear algebra, always use different machine code.
    Neither is an error.

    Raises:
        PipelineError: when this process computes with other machine code than its processor would under
            ``MACHINE_CODE_VARIABLES``.
    """
    kernel, widest = machine_code().split()
    as_fixed = widest == "AVX2" and kernel in (MACHINE_CODE_VARIABLES["OPENBLAS_CORETYPE"], "unknown")
    if as_fixed or widest in ("AVX", "baseline"):
        return machine_code()
    raise PipelineError(
        f"NumPy computes with {machine_code()}, so no file of a run can be read or written: results differ in their "
        "last bits, and contacts amplify the differences",
        expected=f"{FIXED}, as in `python -m pipeline`",
        remedy=f"start your script with this prefix: env {in_shell(MACHINE_CODE_VARIABLES)} python ...",
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
