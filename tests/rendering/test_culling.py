"""What is left out of a picture cannot be seen in it."""

import mujoco
import numpy as np
import pytest
from arenas import both_ways

from pipeline import seeding
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


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [False, True], ids=["lights", "shadows"])
def test_the_same_pixels_with_fewer_geoms(shadows: bool) -> None:
    rng = seeding.rng("test_culling", "eyes")
    left_out, reflecting = 0, []
    opened = Renderer(scene(shadows))
    with both_ways(opened) as (ours, plain):
        for _ in range(20):
            quat_wxyz = rng.normal(size=4)
            opened.data.mocap_quat[0] = quat_wxyz / np.linalg.norm(quat_wxyz)
            mujoco.mj_forward(opened.model, opened.data)
            picture = ours._culling.picture(opened.data, "eye")
            left_out += int((~picture.opaque).sum())
            reflecting.append(bool(picture.mirror.any()))
            assert np.array_equal(opened.frame("eye"), plain.frame(opened.data, "eye"))
    assert set(reflecting) == {False, True}
    if shadows:
        assert left_out == 0, "what is not in the picture may cast a shadow into it"
    else:
        assert left_out > 20 * GEOMS / 2
