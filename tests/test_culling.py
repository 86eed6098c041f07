"""What is left out of a picture cannot be seen in it."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from pipeline import seeding
from pipeline.rendering.culling import Culling, Drawn
from pipeline.rendering.renderer import Renderer

GEOMS = 30
SHAPES = {"sphere": "0.05", "box": "0.1 0.02 0.05", "cylinder": "0.03 0.2"}


def scene(shadows: bool) -> str:
    """Bodies around a camera in the middle, a floor, and two boxes and a plane that reflect."""
    rng = seeding.rng("test_culling")
    bodies = "".join(
        f'<geom type="{shape}" size="{size}" group="1" rgba="{rng.random():.2f} {rng.random():.2f} 0.4 1"'
        f' pos="{" ".join(f"{x:.3f}" for x in rng.uniform(-1, 1, 3))}" euler="{rng.integers(90)} 0 30"/>'
        for shape, size in list(SHAPES.items()) * (GEOMS // 3)
    )
    return f"""
    <mujoco>
      <asset><material name="mirror" reflectance="0.5"/></asset>
      <worldbody>
        <light pos="0.5 0 3" dir="0 0 -1" directional="true" castshadow="{str(shadows).lower()}"/>
        <geom type="plane" size="3 3 0.1" pos="0 0 -1.2" group="1" rgba="0.5 0.5 0.5 1"/>
        <geom type="box" size="0.2 0.2 0.01" pos="0.6 0 -0.3" group="1" material="mirror"/>
        <geom type="box" size="0.2 0.2 0.01" pos="-0.6 0.3 -0.5" group="1" material="mirror"/>
        {bodies}
        <body mocap="true" name="eye"><camera name="eye" fovy="60"/></body>
      </worldbody>
    </mujoco>"""


@pytest.fixture(params=[False, True], ids=["lights", "shadows"])
def renderer(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    opened = Renderer(scene(request.param))
    yield opened
    opened.close()


def test_the_same_pixels_with_less_drawn(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = seeding.rng("test_culling", "eyes")
    left_out, without_reflections = 0, 0
    for _ in range(24):
        quat_wxyz = rng.normal(size=4)
        renderer.data.mocap_quat[0] = quat_wxyz / np.linalg.norm(quat_wxyz)
        mujoco.mj_forward(renderer.model, renderer.data)
        drawn = Culling(renderer.model, 1.0).drawn(renderer.data, "eye")
        left_out += int((~drawn.geoms).sum())
        without_reflections += not drawn.reflections
        culled = renderer.frame("eye")
        with monkeypatch.context() as patch:
            patch.setattr(Culling, "drawn", lambda *_: Drawn(np.ones(renderer.model.ngeom, np.bool_), True))
            assert np.array_equal(renderer.frame("eye"), culled)
    if renderer.model.light_castshadow.any():
        assert left_out == without_reflections == 0, "what is not in the picture may cast a shadow into it"
    else:
        assert left_out > 24 * GEOMS / 2
        assert 0 < without_reflections < 24
