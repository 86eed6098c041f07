"""Loops over pixels and characters, compiled by Numba when they are first called."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

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

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        result: Result = dispatcher()(*arguments, **named)
        return result

    return call
