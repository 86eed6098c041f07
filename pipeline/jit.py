"""Loops over pixels, faces and characters, compiled by Numba at their first call.

Numba stores compiled loops next to the source, for all later processes. ``setup.sh`` compiles all loops once
(``pipeline/validation/loops.py``).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

from pipeline.errors import PipelineError

DISPATCHERS: dict[str, Callable[[], Any]] = {}
"""Name of each compiled function to a function that returns its Numba dispatcher."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Apply ``numba.njit(cache=True)``, but import Numba only at the first call.

    The import takes over a second. Every process of a run imports the axes, but most processes call no such loop.
    """

    @cache
    def dispatcher() -> Any:
        from numba import njit

        with keeping_compiled():
            return njit(cache=True)(function)

    DISPATCHERS[f"{function.__module__}.{function.__qualname__}"] = dispatcher

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        result: Result = dispatcher()(*arguments, **named)
        return result

    return call


@contextmanager
def keeping_compiled() -> Iterator[None]:
    """Name the variable to set if Numba finds no folder for compiled loops.

    Numba tries the source's folder and then ``~/.cache/numba``, for robosuite's loops as soon as they are imported.

    Raises:
        PipelineError: when neither can be written.
    """
    try:
        yield
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        raise PipelineError(
            f"Numba has no folder for compiled loops ({error})",
            expected="permission to write to the folder of the source or to ~/.cache/numba",
            remedy="name a folder by the variable NUMBA_CACHE_DIR, such as `export NUMBA_CACHE_DIR=$PWD/numba`",
        ) from error
