"""Chooses how a scene is rendered: plainly, or with savings that give the same pixels for less work.

Savings are used with the MuJoCo version and the device that they were tested with, if a small scene rendered both ways
has equal pixels (0.6 s for each process). Otherwise, and on request, a scene is rendered plainly, which takes several
times as long without a GPU.
"""

import functools
import importlib.util
import logging
import os
from contextlib import closing

import mujoco
import numpy as np

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.rendering.drawing import PlainDrawing
from pipeline.types import Frame

PLAIN = "PLAIN_RENDERING"
"""Environment variable: if it is set and not empty, all scenes are rendered plainly."""

MUJOCO = "3.2.7"
"""The version of MuJoCo whose internals ``software/mujoco_3_2_7/`` relies on."""

DEVICE = "llvmpipe"
"""How the names of tested devices begin: Mesa's renderer without a GPU."""

STATES = 4
"""Poses of what moves, without and then with shadows. What stands still in two of them is an underlay."""

ANGLES, HEIGHTS = 2.4 * np.arange(400), np.linspace(-0.99, 0.99, 400)
BALL = np.column_stack([np.sqrt(1 - HEIGHTS**2) * wave(ANGLES) for wave in (np.cos, np.sin)] + [HEIGHTS])
"""(400, 3) vertices of a mesh of 796 faces: more than llvmpipe renders at once."""

SCENE = f"""
<mujoco>
  <visual><quality shadowsize="512"/></visual>
  <asset>
    <texture name="squares" type="2d" builtin="checker" width="32" height="32" rgb1="0.9 0.7 0.2" rgb2="0.2 0.3 0.6"/>
    <texture name="cube" type="cube" builtin="gradient" width="16" height="16" rgb1="0.9 0.3 0.2" rgb2="0.3 0.8 0.2"/>
    <material name="squares" texture="squares" texrepeat="3 2" specular="0.6"/>
    <material name="cube" texture="cube"/>
    <material name="mirror" reflectance="0.4"/>
    <mesh name="ball" vertex="{" ".join(f"{x:.4f}" for x in BALL.ravel())}" scale="0.2 0.2 0.15"/>
  </asset>
  <worldbody>
    <light pos="0.3 0.2 2" dir="0 -0.1 -1" castshadow="false"/>
    <light pos="-1 1 3" dir="0.3 -0.3 -1" diffuse="0.3 0.3 0.4" castshadow="false"/>
    <geom type="plane" size="3 3 0.1" pos="0 0 -0.5" group="1" material="squares"/>
    <geom type="box" size="0.4 0.4 0.02" pos="0 0.4 -0.4" group="1" material="mirror"/>
    <geom type="box" size="0.1 0.1 0.1" pos="0.3 0.3 -0.1" group="1" material="cube"/>
    <geom type="box" size="0.01 0.2 0.2" pos="0.6 -0.3 0" group="1" rgba="0.2 0.4 0.9 0.3"/>
    <geom type="mesh" mesh="ball" pos="-0.4 0.5 0" group="1" material="squares"/>
    <site pos="-0.3 -0.4 0" size="0.1" rgba="0.2 0.9 0.4 1"/>
    <body mocap="true" pos="0.2 0.1 0.1"><geom type="mesh" mesh="ball" group="1" rgba="0.8 0.4 0.5 1"/></body>
    <camera name="eye" pos="1.5 0 0.5" xyaxes="0 1 0 -0.3 0 1"/>
  </worldbody>
</mujoco>"""


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
    """The reason why this process renders plainly, logged where it could be quicker; None when it uses savings."""
    if os.environ.get(PLAIN):
        return f"{PLAIN} is set"
    device = gl.choose().device
    if not gl.choose().software:
        return f"{device} is quick without savings"
    if mujoco.__version__ != MUJOCO:
        reason = f"savings were tested with MuJoCo {MUJOCO}, this is {mujoco.__version__}"
    elif not device.startswith(DEVICE):
        reason = f"savings were tested with {DEVICE}, this is {device}"
    elif importlib.util.find_spec("pipeline.rendering.software") is None:
        reason = "this installation has no savings"
    elif found := fault():
        reason = f"on {device} {found}"
    else:
        return None
    _say(reason)
    return reason


@functools.cache
def _say(reason: str) -> None:
    logging.getLogger(__name__).warning("rendered by MuJoCo as it is: %s", reason)


def fault() -> str | None:
    """What is wrong with savings here; None when all pixels are equal."""
    from pipeline.rendering.software.drawing import SoftwareDrawing

    try:
        plain, saving = frames(PlainDrawing), frames(SoftwareDrawing)
    except PipelineError as error:
        return f"OpenGL does not do what they ask: {error.what}"
    wrong = sum(not np.array_equal(one, other) for one, other in zip(plain, saving, strict=True))
    return f"{wrong} of {len(plain)} frames of a small scene have other pixels" if wrong else None


def frames(kind: type[PlainDrawing]) -> list[Frame]:
    """The scene in all states, rendered in one way."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data, shown = mujoco.MjData(model), []
    with closing(kind(model)) as drawing:
        for shadows in (0, 1):
            model.light_castshadow[1] = shadows
            for state in range(STATES):
                data.mocap_pos[0, 1] = 0.1 * state
                data.mocap_quat[0] = np.cos(state), np.sin(state), 0, 0
                mujoco.mj_forward(model, data)
                shown.append(drawing.frame(data, "eye"))
    return shown
