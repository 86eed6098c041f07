"""Loops over pixels, faces and characters, compiled by Numba when they are first called.

Numba keeps what it compiled beside the source, for all processes that come later; ``setup.sh`` has it compile all loops
once (``pipeline/validation/loops.py``).
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

DISPATCHERS: dict[str, Callable[[], Any]] = {}
"""Name of each compiled function to what gives Numba's dispatcher for it."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """``numba.njit(cache=True)``, but Numba is not imported before it is needed.

    Its import takes over a second, and every process of a run imports the axes, most of them without such a loop.
    """

    @cache
    def dispatcher() -> Any:
        from numba import njit

        return njit(cache=True)(function)

    DISPATCHERS[f"{function.__module__}.{function.__qualname__}"] = dispatcher

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        result: Result = dispatcher()(*arguments, **named)
        return result

    return call
