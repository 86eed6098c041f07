"""LIBERO's environment class, imported without OpenGL, and its resets, which sample from NumPy's global generator."""

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
"""Largest number of resets. Each reset samples up to 5,000 places for an object."""


def control_env() -> Any:
    """Return LIBERO's ``ControlEnv`` class, imported without OpenGL and without robosuite's banner.

    Raises:
        PipelineError: see ``gl.check_device`` and ``jit.keeping_compiled``.
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
    """Unset robosuite's ``MUJOCO_GPU_RENDERING`` and its log ``/tmp/robosuite.log``.

    ``MUJOCO_GPU_RENDERING`` makes robosuite load EGL on import, even if EGL is disabled. robosuite cannot open a log
    that belongs to another user. The flags are stored in a module of the package. Importing that module would import
    the package first.
    """
    macros = ModuleType("robosuite.macros")
    flags = run_path(str(package_folder("robosuite") / "macros.py"))
    flags |= {"__name__": macros.__name__, "MUJOCO_GPU_RENDERING": False, "FILE_LOGGING_LEVEL": None}
    vars(macros).update(flags)
    sys.modules[macros.__name__] = macros


def until_placed(reset: Callable[[], Any], task: Task) -> Any:
    """Call LIBERO's reset until the random samples give every object a place.

    ``reset`` may also be LIBERO's constructor, which resets too. LIBERO's own wrapper repeats a failed reset without
    end, for any error. Its constructor never repeats one.

    Raises:
        PipelineError: after ``PLACEMENT_TRIES`` resets.
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
    """Seed NumPy's global generator, from which LIBERO's samplers sample, and restore its state at the end."""
    saved = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(saved)
