"""LIBERO's environment class imported without OpenGL, and its resets, which draw from NumPy's global generator."""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from runpy import run_path
from types import ModuleType
from typing import Any

import numpy as np

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.jit import keeping_compiled
from pipeline.libero.assets import package_folder
from pipeline.types import Task

PLACEMENT_TRIES = 50
"""Resets, of which each draws 5,000 places for an object that finds none."""


def control_env() -> Any:
    """LIBERO's ``ControlEnv`` class, imported without OpenGL and without robosuite's banner.

    Raises:
        PipelineError: as ``gl.check_device`` and ``jit.keeping_compiled``.
    """
    logging.disable(logging.WARNING)
    try:
        with gl.left_out(), keeping_compiled():
            if "robosuite" not in sys.modules:
                _set_macros()
            from libero.libero.envs.env_wrapper import ControlEnv
    finally:
        logging.disable(logging.NOTSET)
    return ControlEnv


def _set_macros() -> None:
    """Unset robosuite's ``MUJOCO_GPU_RENDERING``, by which it loads EGL when it is imported, even where disabled, and
    its log ``/tmp/robosuite.log``, which it cannot open where it is another user's.

    The flags lie in a module of the package, and importing that module would import the package first.
    """
    macros, flags = ModuleType("robosuite.macros"), run_path(str(package_folder("robosuite") / "macros.py"))
    flags |= {"__name__": macros.__name__, "MUJOCO_GPU_RENDERING": False, "FILE_LOGGING_LEVEL": None}
    vars(macros).update(flags)
    sys.modules[macros.__name__] = macros


def until_placed(reset: Callable[[], Any], task: Task) -> Any:
    """Call LIBERO's reset, or its constructor, which resets too, until the random draws give every object a place.

    LIBERO's own wrapper repeats a reset without end, whatever went wrong, and its constructor never.

    Raises:
        PipelineError: after ``PLACEMENT_TRIES``.
    """
    from robosuite.utils.errors import RandomizationError

    for _ in range(PLACEMENT_TRIES):
        with suppress(RandomizationError):
            return reset()
    raise PipelineError(
        f"LIBERO finds no place for all objects in {PLACEMENT_TRIES} resets",
        where=task.bddl_file,
        expected="regions that are large enough for the objects in them",
    )


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """LIBERO's samplers draw from numpy's global generator: seed it for a moment, then put it back."""
    saved = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(saved)
