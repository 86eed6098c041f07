"""What is left out of a picture cannot be seen in it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import arenas
import mujoco
import numpy as np
import pytest
from arenas import TASKS

from pipeline import seeding
from pipeline.episode_schema import SCHEMA
from pipeline.rendering.opengl import say_once
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.culling import Culling
from pipeline.types import Frame

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


def plain(renderer: Renderer, camera: str) -> Frame:
    """A frame for which everything is drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Culling, "picture", lambda culling, *_: culling.everything())
        return renderer.frame(camera)


def test_the_same_pixels_with_less_drawn(renderer: Renderer) -> None:
    rng = seeding.rng("test_culling", "eyes")
    left_out, reflecting = 0, []
    for _ in range(40):
        quat_wxyz = rng.normal(size=4)
        renderer.data.mocap_quat[0] = quat_wxyz / np.linalg.norm(quat_wxyz)
        mujoco.mj_forward(renderer.model, renderer.data)
        picture = renderer._culling.picture(renderer.data, "eye")
        left_out += int((~picture.opaque).sum())
        reflecting.append(bool(picture.mirror.any()))
        assert np.array_equal(renderer.frame("eye"), plain(renderer, "eye"))
    assert set(reflecting) == {False, True}
    if renderer.model.light_castshadow.any():
        assert left_out == 0, "what is not in the picture may cast a shadow into it"
    else:
        assert left_out > 40 * GEOMS / 2


@pytest.mark.slow
@pytest.mark.parametrize("arena", TASKS)
def test_the_same_pixels_in_every_arena(arena: str, caplog: pytest.LogCaptureFixture) -> None:
    say_once.cache_clear()
    opened = arenas.renderer(arena)
    rng = seeding.rng("test_culling", arena)
    left_out, boxes = [0, 0], opened._culling.boxes
    try:
        for number, camera in product(range(5), (view.camera for view in SCHEMA.views.values())):
            # The first seven are the arm's.
            opened.data.qpos[:7] += rng.uniform(-0.3, 0.3, 7)
            opened.model.light_castshadow[:] = number % 2
            mujoco.mj_forward(opened.model, opened.data)
            assert np.array_equal(opened.frame(camera), plain(opened, camera)), camera
            picture = opened._culling.picture(opened.data, camera)
            needed = picture.shadows[-1] if picture.shadows else picture.seen
            left_out[number % 2] += int((picture.opaque[boxes.geom] & ~needed).sum())
            shown = opened.geoms(camera)
            opened.frame(camera)
            assert np.array_equal(opened.geoms(camera), shown), "which pieces a frame was drawn of does not matter"
        assert min(left_out) > 30, "pieces of meshes that are in the picture, or that the last lamp lights"
        assert caplog.records == [], "OpenGL reports no error"
    finally:
        opened.close()


BEHIND = """
    <mujoco>
      <asset><mesh name="stone" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1  0.08 0.08 0.08"/></asset>
      <worldbody>
        <light pos="0.5 0 3" dir="0 0 -1" castshadow="false"/>
        <geom type="box" size="0.3 0.4 0.02" group="1" rgba="0.6 0.4 0.2 1" euler="5 10 20"/>
        <body mocap="true"><geom type="mesh" mesh="stone" group="1" rgba="0.2 0.8 0.3 1"/></body>
        <camera name="eye" pos="0.1 -0.2 1" euler="10 5 0"/>
      </worldbody>
    </mujoco>"""


def test_what_is_behind_a_table_is_not_drawn() -> None:
    rng = seeding.rng("test_culling", "behind")
    renderer = Renderer(BEHIND)
    drawn = []
    try:
        for _ in range(60):
            renderer.data.mocap_pos[0] = rng.uniform((-0.4, -0.5, -0.5), (0.4, 0.5, -0.25))
            mujoco.mj_forward(renderer.model, renderer.data)
            drawn.append(bool(renderer._culling.picture(renderer.data, "eye").opaque[1]))
            assert np.array_equal(renderer.frame("eye"), plain(renderer, "eye"))
            assert drawn[-1] or not (renderer.geoms("eye") == 1).any()
    finally:
        renderer.close()
    assert 10 < sum(drawn) < 50
