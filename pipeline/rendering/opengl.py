"""OpenGL's functions for the current context, with every error checked.

An error means that OpenGL did not do what it was asked to. PyOpenGL checks after each call of ours. MuJoCo does not
check after its own calls, so each of them that renders, uploads or reads is followed by ``check``.
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
"""OpenGL's errors by code. Those up to GL_INVALID_OPERATION skip one command and change nothing else."""

OTHERS = "calls that are not the pipeline's"

LEFT = {
    "mjr_render": ("GL_INVALID_ENUM",),
    OTHERS: ("GL_INVALID_ENUM", "GL_INVALID_VALUE", "GL_INVALID_OPERATION"),
}
"""Errors that are logged and ignored, by the call that they come from.

In LIBERO's five arenas MuJoCo 3.2.7 causes none. In a scene with more lights than OpenGL has (8 in Mesa, the head light
is one of them) it also enables and disables those that do not exist; they stay dark.
"""

_MEMORY = "fewer workers on this machine (compute.workers), smaller textures, or a GPU with more memory"
_DRIVER = "MUJOCO_GL=osmesa, which renders in software; and report this message with the driver's version"


def calls() -> Any:
    """PyOpenGL's functions and constants for the current context, which is one of MuJoCo's.

    A function raises PipelineError where OpenGL reports an error of it.
    """
    check(OTHERS)
    return _FUNCTIONS


def check(call: str) -> None:
    """Look for errors after a call of MuJoCo's, or of ``OTHERS``; those in ``LEFT`` are logged, once a process.

    Raises:
        PipelineError: for any other, such as GL_OUT_OF_MEMORY.
    """
    # OpenGL keeps one error of each kind.
    for _ in ERRORS:
        # MuJoCo's glGetError; a third of what it takes through PyOpenGL.
        if not (code := mujoco.mjr_getError()):
            return
        error = ERRORS.get(code, hex(code))
        if error not in LEFT.get(call, ()):
            raise _reported(error, call)
        say_once(error, call)


@functools.cache
def say_once(error: str, call: str) -> None:
    logging.getLogger(__name__).warning("OpenGL reports %s in %s; it is passed over and not said again", error, call)


@contextmanager
def making_context() -> Iterator[None]:
    """Raise the OpenGL errors that MuJoCo only warns of while it makes a context.

    Raises:
        PipelineError: when it reports any, or makes none.
    """
    said: list[str] = []
    former = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield
    except mujoco.FatalError as error:
        raise failure(f"MuJoCo makes no OpenGL context: {error}", f"{_MEMORY}; or {_DRIVER}") from error
    finally:
        mujoco.set_mju_user_warning(former)
    for warning in said:
        # "OpenGL error 0x505 in or before mjr_makeContext"
        if warning.startswith("OpenGL error "):
            code = int(warning.split()[2], 16)
            raise _reported(ERRORS.get(code, hex(code)), "mjr_makeContext")
        logging.getLogger(__name__).warning("%s", warning)
    check("mjr_setBuffer")


class _Functions:
    """What PyOpenGL has, looked up when it is first asked for, and by then a context is there: it chooses its platform
    when it is imported."""

    def __getattr__(self, name: str) -> Any:
        from OpenGL import GL

        found = getattr(GL, name)
        if name.startswith("gl"):
            found = _stopping(name, found)
        setattr(self, name, found)
        return found


_FUNCTIONS = _Functions()


def _stopping(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    from OpenGL.error import GLError

    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except GLError as error:
            raise _reported(ERRORS.get(error.err, str(error.err)), name) from error

    return call


def _reported(error: str, call: str) -> PipelineError:
    remedy = _MEMORY if error == "GL_OUT_OF_MEMORY" else _DRIVER
    return failure(f"OpenGL reports {error} in {call}, so that pictures may be wrong", remedy)


def failure(what: str, remedy: str = _DRIVER) -> PipelineError:
    """What this machine's OpenGL does not do."""
    return PipelineError(what, where=f"OpenGL on {gl.choose().device}", remedy=remedy)
