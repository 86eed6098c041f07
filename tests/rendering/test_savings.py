"""Savings are used where they were tested and give equal pixels; everywhere else MuJoCo renders a scene as it is."""

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
from checkout import REPOSITORY

from pipeline import gl
from pipeline.rendering import savings
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.in_flight import InFlightRenderer
from pipeline.rendering.software.layers import LayeredRenderer
from pipeline.rendering.software.skins import SkinnedMeshes
from pipeline.rendering.software.software_renderer import SoftwareRenderer

SCENE = '<mujoco><worldbody><light/><camera name="eye" pos="0 0 3"/><geom size="1" group="1"/></worldbody></mujoco>'


@pytest.fixture(autouse=True)
def ask_again() -> Iterator[None]:
    savings.why_plain.cache_clear()
    savings._say.cache_clear()
    yield
    savings.why_plain.cache_clear()


def renderer_in_use() -> type:
    """The kind of renderer that a scene gets, which renders it."""
    with closing(Renderer(SCENE)) as renderer:
        mujoco.mj_forward(renderer.model, renderer.data)
        assert renderer.frame("eye")[128, 128].max() > 100
        return type(renderer.model_renderer)


@pytest.mark.slow
def test_on_a_tested_device_savings_are_used_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    assert gl.choose().device.startswith(savings.DEVICE)
    assert renderer_in_use() is SoftwareRenderer
    assert caplog.records == []


@pytest.mark.parametrize(
    ("what", "name", "other"), [(mujoco, "__version__", "3.3.0"), (savings, "DEVICE", "NVIDIA H100")]
)
def test_another_version_or_device_renders_plainly_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, what: object, name: str, other: str
) -> None:
    monkeypatch.setattr(what, name, other)
    assert [renderer_in_use(), renderer_in_use()] == [PlainRenderer, PlainRenderer]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert other in record.getMessage()


@pytest.mark.slow
@pytest.mark.parametrize(("sharing", "kind"), [(1, InFlightRenderer), (2, InFlightRenderer), (3, LayeredRenderer)])
def test_a_gpu_renders_layers_if_enough_processes_share_it(
    sharing: int, kind: type, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    on_gpu = replace(gl.choose(), device="NVIDIA H200", sharing=sharing)
    monkeypatch.setattr(gl, "choose", lambda: on_gpu)
    assert renderer_in_use() is kind
    assert caplog.records == []


@pytest.mark.slow
def test_a_scene_that_shares_no_context_is_rendered_plainly(caplog: pytest.LogCaptureFixture) -> None:
    endless = SCENE.replace("</worldbody>", '<geom type="plane" size="0 0 1" pos="0 0 -1" group="1"/></worldbody>')
    with closing(Renderer(endless)) as renderer:
        assert type(renderer.model_renderer) is PlainRenderer
    (record,) = caplog.records
    assert "an unbounded floor" in record.getMessage()


@pytest.mark.slow
def test_other_pixels_of_the_small_scene_force_plain_rendering(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(savings, "SCENE", savings.SCENE.replace('pos="0.2 0.1 0.1"', 'pos="0.2 0.1 0.2"'))
    assert savings.fault(SoftwareRenderer) is None
    put = SkinnedMeshes.put

    def wrong(*arguments: object) -> object:
        skinned = put(*arguments)  # type: ignore[arg-type]
        arguments[0]._skins.rendered[:] //= 2  # type: ignore[attr-defined]
        return skinned

    monkeypatch.setattr(SkinnedMeshes, "put", wrong)
    assert renderer_in_use() is PlainRenderer
    assert "frames of a small scene have other pixels" in caplog.text


@pytest.mark.slow
def test_a_variable_forces_plain_and_imports_none_of_the_savings() -> None:
    program = f"""
import sys
from pipeline.rendering.renderer import Renderer
print(type(Renderer({SCENE!r}).model_renderer).__name__, [name for name in sys.modules if "software" in name])
"""
    environment = os.environ | {savings.PLAIN: "1"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("PlainRenderer []", "")


@pytest.mark.slow
def test_without_the_folder_of_savings_scenes_are_rendered_plainly(tmp_path: Path) -> None:
    for folder in ("pipeline", "schemas"):
        shutil.copytree(REPOSITORY / folder, tmp_path / folder, ignore=shutil.ignore_patterns("software"))
    program = (
        f"from pipeline.rendering.renderer import Renderer\nprint(type(Renderer({SCENE!r}).model_renderer).__name__)"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "PlainRenderer"
    assert "this installation has no savings" in done.stderr
