"""OpenGL's functions for the current context, with every error checked.

An error means that OpenGL did not execute a command. PyOpenGL checks after each call of the pipeline. MuJoCo does not
check after its own calls, so ``check`` follows each MuJoCo call that renders, uploads or reads.
"""

import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco

from pipeline import gl
from pipeline.errors import PipelineError

ERRORS = {
    0x0500: "GL_INVALID_ENUM",
    0x0501: "GL_INVALID_VALUE",
    0x0502: "GL_INVALID_OPERATION",
    0x0503: "GL_STACK_OVERFLOW",
    0x0504: "GL_STACK_UNDERFLOW",
    0x0505: "GL_OUT_OF_MEMORY",
    0x0506: "GL_INVALID_FRAMEBUFFER_OPERATION",
    0x0507: "GL_CONTEXT_LOST",
}
"""OpenGL's errors by code. Errors up to GL_INVALID_OPERATION skip one command and change nothing else."""

OTHERS = "calls that are not the pipeline's"

LEFT = {
    "mjr_render": ("GL_INVALID_ENUM",),
    OTHERS: ("GL_INVALID_ENUM", "GL_INVALID_VALUE", "GL_INVALID_OPERATION"),
}
"""Errors that are logged and ignored, by the call that causes them.

In LIBERO's five arenas, MuJoCo 3.2.7 causes no error. OpenGL has a limited number of lights: 8 in Mesa, including the
head light. In a scene with more lights, MuJoCo also enables and disables lights that OpenGL lacks; they stay dark.
"""

_MEMORY = "use fewer workers on this machine (compute.workers), smaller textures, or a GPU with more memory"
_DRIVER = "set MUJOCO_GL=osmesa, which renders in software, and report this message with the driver's version"


def calls() -> Any:
    """Return PyOpenGL's functions and constants for the current context, which a MuJoCo context owns.

    A function raises ``PipelineError`` if OpenGL reports an error of its call.

    Raises:
        PipelineError: see ``check``, for an earlier call that is not the pipeline's.
    """
    check(OTHERS)
    return _FUNCTIONS


def check(call: str) -> None:
    """Check for errors after a call of MuJoCo's, or of ``OTHERS``; log errors in ``LEFT`` once a process.

    Raises:
        PipelineError: for any error that is not in ``LEFT``, such as GL_OUT_OF_MEMORY.
    """
    # OpenGL stores one error of each kind.
    for _ in ERRORS:
        # MuJoCo's glGetError takes a third of the time of PyOpenGL's.
        code = mujoco.mjr_getError()
        if not code:
            return
        error = ERRORS.get(code, hex(code))
        if error not in LEFT.get(call, ()):
            raise _reported(error, call)
        say_once(error, call)


@functools.cache
def say_once(error: str, call: str) -> None:
    """Log an ignored error, once a process for each error and call."""
    logging.getLogger(__name__).warning(
        "OpenGL reports %s in %s; this error is ignored and not logged again", error, call
    )


@contextmanager
def making_context() -> Iterator[None]:
    """Raise the OpenGL errors of which MuJoCo only warns while it creates a context.

    Raises:
        PipelineError: if MuJoCo reports an OpenGL error, or cannot create the context.
    """
    warnings: list[str] = []
    former = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield
    except mujoco.FatalError as error:
        raise failure(f"MuJoCo cannot create an OpenGL context: {error}", f"{_MEMORY}; or {_DRIVER}") from error
    finally:
        mujoco.set_mju_user_warning(former)
    for warning in warnings:
        # Example: "OpenGL error 0x505 in or before mjr_makeContext"
        if warning.startswith("OpenGL error "):
            code = int(warning.split()[2], 16)
            raise _reported(ERRORS.get(code, hex(code)), "mjr_makeContext")
        logging.getLogger(__name__).warning("%s", warning)
    check("mjr_setBuffer")


class _Functions:
    """PyOpenGL's functions and constants, each looked up at its first use.

    PyOpenGL chooses its platform when it is imported, so it must be imported after a context exists.
    """

    def __getattr__(self, name: str) -> Any:
        from OpenGL import GL

        attribute = getattr(GL, name)
        if name.startswith("gl"):
            attribute = _stopping(name, attribute)
        setattr(self, name, attribute)
        return attribute


_FUNCTIONS = _Functions()


def _stopping(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function of PyOpenGL so that it raises ``PipelineError`` for its OpenGL errors."""
    from OpenGL.error import GLError

    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except GLError as error:
            raise _reported(ERRORS.get(error.err, str(error.err)), name) from error

    return call


def _reported(error: str, call: str) -> PipelineError:
    """Return the error to raise for an OpenGL error in a call."""
    remedy = _MEMORY if error == "GL_OUT_OF_MEMORY" else _DRIVER
    return failure(f"OpenGL reports {error} in {call}, so frames may be wrong", remedy)


def failure(what: str, remedy: str = _DRIVER) -> PipelineError:
    """Return the error to raise for a failure of this machine's OpenGL."""
    return PipelineError(what, where=f"OpenGL on {gl.choose().device}", remedy=remedy)
