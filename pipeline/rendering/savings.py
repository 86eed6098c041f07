"""Which drawing a scene gets: MuJoCo's own, or one that gives the same pixels for less work.

Savings are used only where they were tested, and where a small scene drawn both ways has equal pixels (0.6 s for each
process). Everywhere else, and by request, a scene is drawn by MuJoCo as it is, several times slower without a GPU.
"""

from __future__ import annotations

import functools
import logging
import os

import mujoco

from pipeline import gl
from pipeline.rendering.drawing import Drawing, PlainDrawing

PLAIN = "PLAIN_RENDERING"
"""Environment variable: anything but nothing has all scenes drawn by MuJoCo as it is."""

MUJOCO = "3.2.7"
"""The version of MuJoCo whose private ways ``software/mujoco_3_2_7/`` knows."""

DEVICE = "llvmpipe"
"""How the names of tested devices begin: Mesa's renderer without a GPU."""


def drawing_of(model: mujoco.MjModel) -> Drawing:
    """A drawing of a model, with savings where they can be used.

    Raises:
        PipelineError: when nothing renders on this machine.
    """
    if why_plain() is None:
        from pipeline.rendering.software.drawing import SoftwareDrawing

        if SoftwareDrawing.possible(model):
            return SoftwareDrawing(model)
        _say("a scene has height fields, skins, a floor without bounds, or not four samples a pixel")
    return PlainDrawing(model)


@functools.cache
def why_plain() -> str | None:
    """Why no savings are used in this process, logged where nobody asked for it; None where they are."""
    if os.environ.get(PLAIN):
        return f"{PLAIN} is set"
    device = gl.choose().device
    if mujoco.__version__ != MUJOCO:
        reason = f"savings were tested with MuJoCo {MUJOCO}, this is {mujoco.__version__}"
    elif not device.startswith(DEVICE):
        reason = f"savings were tested with {DEVICE}, this is {device}"
    else:
        from pipeline.rendering.software.trial import fault

        if (found := fault()) is None:
            return None
        reason = f"on {device} {found}"
    _say(reason)
    return reason


@functools.cache
def _say(reason: str) -> None:
    logging.getLogger(__name__).warning("drawn by MuJoCo as it is: %s", reason)
