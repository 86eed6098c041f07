"""What OpenGL reports is heard: what may spoil a picture stops, and what MuJoCo leaves behind is said once."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.rendering import opengl
from pipeline.rendering.renderer import Renderer

BALL = '<geom size="0.3" group="1" rgba="0.8 0.3 0.2 1"/>'


def scene(inside: str = "", lamps: int = 1, asset: str = "") -> str:
    lights = "".join(
        f'<light pos="{lamp / 10} 0 2" diffuse="0.1 0.1 0.1" castshadow="false"/>' for lamp in range(lamps)
    )
    return f"""
    <mujoco>
      <asset>{asset}</asset>
      <worldbody>{lights}<camera name="eye" pos="0 0 2"/>{inside or BALL}</worldbody>
    </mujoco>"""


def frame(renderer: Renderer) -> NDArray[np.uint8]:
    mujoco.mj_forward(renderer.model, renderer.data)
    return renderer.frame("eye")


@pytest.fixture
def renderer() -> Iterator[Renderer]:
    with closing(Renderer(scene())) as opened:
        yield opened


@pytest.fixture(autouse=True)
def nothing_said_yet() -> None:
    opengl.say_once.cache_clear()


def leave_an_error() -> None:
    """As other code in the process would."""
    from OpenGL import platform

    platform.PLATFORM.GL.glEnable(0x123456)


def test_a_wrong_call_of_ours_stops_by_its_name(renderer: Renderer) -> None:
    with pytest.raises(PipelineError, match="GL_INVALID_ENUM in glEnable") as caught:
        opengl.calls().glEnable(0x123456)
    assert "OpenGL on " in str(caught.value.where)
    assert "MUJOCO_GL=osmesa" in str(caught.value.remedy)
    frame(renderer)


def test_what_mujoco_leaves_behind_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    lamps = scene(lamps=20)
    for _ in range(2):
        with closing(Renderer(lamps)) as opened:
            ours = [frame(opened) for _ in range(4)]
    (warning,) = caplog.records
    assert "GL_INVALID_ENUM" in warning.getMessage()
    assert "mjr_render" in warning.getMessage()
    model = mujoco.MjModel.from_xml_string(lamps)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    option = mujoco.MjvOption()
    option.geomgroup[0] = 0
    with mujoco.Renderer(model, 256, 256) as plain:
        plain.update_scene(data, "eye", option)
        expected = plain.render()[::-1]
    assert all(np.array_equal(each, expected) for each in ours)


def test_few_lamps_leave_nothing(caplog: pytest.LogCaptureFixture, renderer: Renderer) -> None:
    for _ in range(4):
        frame(renderer)
    assert caplog.records == []


def test_what_others_left_is_said_once_and_is_not_ours(caplog: pytest.LogCaptureFixture, renderer: Renderer) -> None:
    before = frame(renderer)
    for _ in range(3):
        leave_an_error()
        opengl.calls().glFlush()
    assert np.array_equal(frame(renderer), before)
    (warning,) = caplog.records
    assert "GL_INVALID_ENUM" in warning.getMessage()


@pytest.mark.parametrize("call", ["mjr_uploadTexture", "mjr_readPixels"])
def test_an_error_in_what_mujoco_loads_or_reads_stops(renderer: Renderer, call: str) -> None:
    leave_an_error()
    with pytest.raises(PipelineError, match=f"GL_INVALID_ENUM in {call}"):
        opengl.check(call)
    opengl.check(call)


CUBE = '<texture name="cube" type="cube" builtin="flat" width="4" height="4"/><material name="m" texture="cube"/>'
HILLS = '<hfield name="hills" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 1 0"/>'

IN_SOFTWARE = f"""
import gc
import mujoco
from mujoco.osmesa import GLContext
from pipeline.errors import PipelineError
from pipeline.rendering.opengl import calls
from pipeline.rendering.renderer import Renderer


def textures(scene):
    # Larger than Mesa takes, which it says before it reads a byte.
    model = mujoco.MjModel.from_xml_string(scene)
    model.tex_width[:], model.tex_height[:] = 16384, 6 * 16384
    Renderer(model)


def underlay():
    renderer, gl = Renderer({scene()!r}), calls()
    gl.glBindTexture(gl.GL_TEXTURE_2D_MULTISAMPLE, gl.glGenTextures(1))
    gl.glTexImage2DMultisample(gl.GL_TEXTURE_2D_MULTISAMPLE, 4, gl.GL_RGBA8, 16384, 16384, True)


def window():
    model = mujoco.MjModel.from_xml_string({scene()!r})
    model.vis.global_.offwidth = model.vis.global_.offheight = 16384
    Renderer(model)


cases = {{
    "glTexImage2DMultisample": underlay,
    "mjr_uploadTexture": lambda: textures({scene(asset=CUBE)!r}),
    # Not what other scenes have too, so that the context is made for this one.
    "mjr_makeContext": lambda: textures({scene(BALL + '<geom type="hfield" hfield="hills"/>', asset=CUBE + HILLS)!r}),
    "framebuffer": window,
}}
for name, case in cases.items():
    try:
        case()
    except PipelineError as error:
        print(name, "|", *str(error).splitlines())
        if case is not underlay:
            # The exception still refers to the renderer that was not created.
            print("left open:", sum(isinstance(each, GLContext) and bool(each._context) for each in gc.get_objects()))
    gc.collect()
"""


@pytest.mark.slow
def test_too_little_memory_stops_wherever_it_is_met() -> None:
    """In Mesa's software, which has a limit that is told at once, on every machine."""
    software = {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
    done = subprocess.run(
        [sys.executable, "-c", IN_SOFTWARE],
        env=os.environ | software,
        capture_output=True,
        text=True,
        check=True,
    )
    said = dict(line.split(" | ", 1) for line in done.stdout.splitlines() if " | " in line)
    for call in ("glTexImage2DMultisample", "mjr_uploadTexture", "mjr_makeContext"):
        assert f"GL_OUT_OF_MEMORY in {call}" in said[call], said
        assert "compute.workers" in said[call]
    assert "framebuffer is not complete" in said["framebuffer"]
    assert [line for line in done.stdout.splitlines() if "left open" in line] == ["left open: 0"] * 3
