"""Choice between plain rendering and savings, which are optimizations of rendering with equal pixels.

Savings are used with the MuJoCo version with which they were tested, on the tested software renderer and on GPUs. The
kind depends on the device, and on the number of processes that share a GPU. Each process first renders a small scene
both ways (0.6 s in software) and uses savings only if all pixels are equal. Otherwise, and on request, scenes are
rendered plainly. Without a GPU, plain rendering takes several times as long.
"""

from __future__ import annotations

import functools
import importlib.util
import logging
import os
from contextlib import closing

import mujoco
import numpy as np

from pipeline import gl
from pipeline.episode_schema import SIZE_PX
from pipeline.errors import PipelineError
from pipeline.rendering.model_renderer import ModelRenderer
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.types import Frame

PLAIN = "PLAIN_RENDERING"
"""Environment variable: if it is set and not empty, all scenes are rendered plainly."""

MUJOCO = "3.2.7"
"""The version of MuJoCo whose internals ``software/mujoco_3_2_7/`` relies on."""

DEVICE = "llvmpipe"
"""Prefix of the names of tested devices: Mesa's renderer without a GPU."""

SHARING = 3
"""Number of processes that share a GPU from which layers are faster. An H200 renders 307 frames/s for each of four
processes with layers, and 820 in all without layers; two and three processes were not measured."""

STATES = 4
"""Poses of the moving body, without and then with shadows. Geoms that stand still in two poses join an underlay."""

ANGLES, HEIGHTS = 2.4 * np.arange(400), np.linspace(-0.99, 0.99, 400)
RADII = np.sqrt(1 - HEIGHTS**2)
BALL = np.column_stack([RADII * np.cos(ANGLES), RADII * np.sin(ANGLES), HEIGHTS])
"""(400, 3) vertices of a mesh of 796 faces: more than llvmpipe renders at once."""

_VERTICES = " ".join(f"{coordinate:.4f}" for coordinate in BALL.ravel())

SCENE = f"""
<mujoco>
  <visual><quality shadowsize="512"/></visual>
  <asset>
    <texture name="squares" type="2d" builtin="checker" width="32" height="32" rgb1="0.9 0.7 0.2" rgb2="0.2 0.3 0.6"/>
    <texture name="cube" type="cube" builtin="gradient" width="16" height="16" rgb1="0.9 0.3 0.2" rgb2="0.3 0.8 0.2"/>
    <material name="squares" texture="squares" texrepeat="3 2" specular="0.6"/>
    <material name="cube" texture="cube"/>
    <material name="mirror" reflectance="0.4"/>
    <mesh name="ball" vertex="{_VERTICES}" scale="0.2 0.2 0.15"/>
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


def create_model_renderer(model: mujoco.MjModel, size_px: int = SIZE_PX) -> ModelRenderer:
    """Create the ``ModelRenderer`` of a model, with savings if they can be used."""
    if why_plain(size_px) is None:
        kind = kind_with_savings(gl.choose())
        if kind.possible(model):
            return kind(model, size_px)
        _say("a scene has height fields, skins, an unbounded floor, or another number than four samples a pixel")
    return PlainRenderer(model, size_px)


def kind_with_savings(choice: gl.GlChoice) -> type[ModelRenderer]:
    """Return the kind of ``ModelRenderer`` that renders fastest on a device.

    In software, rendering a face takes longer than the choice of faces, so all savings are used. A GPU that few
    processes use would wait for their choice of geoms, so all geoms are rendered, with frames in flight.
    """
    if choice.software:
        from pipeline.rendering.software.software_renderer import SoftwareRenderer

        return SoftwareRenderer
    if choice.sharing < SHARING:
        from pipeline.rendering.software.in_flight import InFlightRenderer

        return InFlightRenderer
    from pipeline.rendering.software.layers import LayeredRenderer

    return LayeredRenderer


@functools.cache
def why_plain(size_px: int = SIZE_PX) -> str | None:
    """Return the reason why this process renders frames of a size plainly; ``None`` if it uses savings.

    Log the reason if savings would make rendering faster.
    """
    if os.environ.get(PLAIN):
        return f"{PLAIN} is set"
    device, software = gl.choose().device, gl.choose().software
    if mujoco.__version__ != MUJOCO:
        reason = f"savings were tested with MuJoCo {MUJOCO}, this is {mujoco.__version__}"
    elif software and not device.startswith(DEVICE):
        reason = f"savings were tested with {DEVICE}, this is {device}"
    elif importlib.util.find_spec("pipeline.rendering.software") is None:
        reason = "this installation has no savings"
    else:
        difference = fault(kind_with_savings(gl.choose()), size_px)
        if difference is None:
            return None
        reason = f"on {device} {difference}"
    _say(reason)
    return reason


@functools.cache
def _say(reason: str) -> None:
    """Log that scenes are rendered plainly, once a process for each reason."""
    logging.getLogger(__name__).warning("rendering optimizations are disabled: %s", reason)


def fault(kind: type[ModelRenderer], size_px: int = SIZE_PX) -> str | None:
    """Return the error or the difference that savings of a kind cause here; ``None`` if all pixels are equal."""
    try:
        plain, saving = frames(PlainRenderer, size_px), frames(kind, size_px)
    except PipelineError as error:
        return f"OpenGL rejects a command of the savings: {error.what}"
    frame_pairs = zip(plain, saving, strict=True)
    differing = sum(not np.array_equal(plain_frame, saving_frame) for plain_frame, saving_frame in frame_pairs)
    return f"{differing} of {len(plain)} frames of a small scene have other pixels" if differing else None


def frames(kind: type[ModelRenderer], size_px: int = SIZE_PX) -> list[Frame]:
    """Render the small scene in all states by one kind of ``ModelRenderer``."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data, started = mujoco.MjData(model), []
    with closing(kind(model, size_px)) as renderer:
        for shadows in (0, 1):
            model.light_castshadow[1] = shadows
            for state in range(STATES):
                data.mocap_pos[0, 1] = 0.1 * state
                data.mocap_quat[0] = np.cos(state), np.sin(state), 0, 0
                mujoco.mj_forward(model, data)
                started.append(renderer.start_frame(data, "eye"))
        return [wait() for wait in started]
