"""Chooses how a scene is rendered: plainly, or with savings that give the same pixels for less work.

Savings are used with the MuJoCo version and the device that they were tested with, if a small scene rendered both ways
has equal pixels (0.6 s for each process). Otherwise, and on request, a scene is rendered plainly, which takes several
times as long without a GPU.
"""

from __future__ import annotations

import functools
import logging
import os

import mujoco

from pipeline import gl
from pipeline.rendering.drawing import PlainDrawing

PLAIN = "PLAIN_RENDERING"
"""Environment variable: if it is set and not empty, all scenes are rendered plainly."""

MUJOCO = "3.2.7"
"""The version of MuJoCo whose internals ``software/mujoco_3_2_7/`` relies on."""

DEVICE = "llvmpipe"
"""How the names of tested devices begin: Mesa's renderer without a GPU."""


def drawing_of(model: mujoco.MjModel) -> PlainDrawing:
    """A drawing of a model, with savings where they can be used."""
    if why_plain() is None:
        from pipeline.rendering.software.drawing import SoftwareDrawing

        if SoftwareDrawing.possible(model):
            return SoftwareDrawing(model)
        _say("a scene has height fields, skins, a floor without bounds, or not four samples a pixel")
    return PlainDrawing(model)


@functools.cache
def why_plain() -> str | None:
    """The reason why this process renders plainly, logged unless plain was asked for; None when it uses savings."""
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
    logging.getLogger(__name__).warning("rendered by MuJoCo as it is: %s", reason)
