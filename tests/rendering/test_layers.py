"""What stands still is rendered once, and every picture is the one that MuJoCo renders at once."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import pytest
from arenas import both_ways
from numpy.typing import NDArray

from pipeline import seeding
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.software_renderer import Shot, SoftwareRenderer

BODIES = 12
CAMERAS = ("fixed", "moving")

SITES = "".join(
    f'<site name="opacity {opacity}" pos="0.1 {y} 0.5" size="0.08" rgba="0.9 0.2 0.2 {opacity}"/>'
    for y, opacity in ((-0.3, 0), (0, -0.5), (0.3, 1))
)


def scene(shadows: bool) -> str:
    """Bodies above a floor, a mirror on a table, a pane of glass before some of them, and sites, seen or not.

    Args:
        shadows: whether the second lamp casts them.
    """
    rng = seeding.rng("test_layers")
    bodies = "".join(
        f'<body mocap="true" pos="{" ".join(f"{x:.3f}" for x in rng.uniform(-0.5, 0.5, 3))}">'
        f'<geom type="box" size="0.08 0.05 0.1" group="1" material="paint" rgba="{rng.random():.2f} 0.5 0.4 1"/></body>'
        for _ in range(BODIES)
    )
    return f"""
    <mujoco>
      <asset><material name="mirror" reflectance="0.5"/><material name="paint" specular="0.8"/></asset>
      <worldbody>
        <light pos="0.5 0 3" dir="0 0 -1" castshadow="false"/>
        <light pos="-1 1 3" dir="0.3 -0.3 -1" diffuse="0.3 0.3 0.4" castshadow="{str(shadows).lower()}"/>
        <geom type="plane" size="3 3 0.1" pos="0 0 -0.7" group="1" rgba="0.5 0.5 0.5 1"/>
        <geom type="box" size="0.3 0.3 0.01" pos="0.2 0.5 -0.5" group="1" material="mirror"/>
        <geom type="box" size="0.4 0.4 0.01" pos="0.2 0.5 -0.53" group="1" rgba="0.9 0.8 0.7 1"/>
        <geom type="box" size="0.01 0.2 0.2" pos="0.7 -0.6 0" group="1" rgba="0.2 0.4 0.9 0.3"/>
        {SITES}
        {bodies}
        <camera name="fixed" pos="2 0 0.4" xyaxes="0 1 0 -0.2 0 1"/>
        <body mocap="true" pos="0 2 0.5"><camera name="moving" xyaxes="-1 0 0 0 -0.2 1"/></body>
      </worldbody>
    </mujoco>"""


@dataclass
class Pair:
    """A scene rendered with savings and plainly.

    Attributes:
        rendered: how many bodies' geoms each call to OpenGL had to render.
    """

    opened: Renderer
    ours: SoftwareRenderer
    plain: PlainRenderer
    rendered: list[int]

    def same(self, *cameras: str) -> bool:
        mujoco.mj_forward(self.opened.model, self.opened.data)
        return all(
            np.array_equal(self.opened.frame(camera), self.plain.frame(self.opened.data, camera)) for camera in cameras
        )


@pytest.fixture
def pair(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    opened = Renderer(scene(shadows=getattr(request, "param", False)))
    with both_ways(opened) as (ours, plain):
        render_geoms, made = ours._render_geoms, Pair(opened, ours, plain, [])

        def counted(shot: Shot, opaque: NDArray[np.bool_], *how: Any, **more: Any) -> None:
            made.rendered.append(int(opaque[-BODIES:].sum()))
            render_geoms(shot, opaque, *how, **more)

        monkeypatch.setattr(ours, "_render_geoms", counted)
        yield made


@pytest.mark.slow
@pytest.mark.parametrize("pair", [False, True], ids=["lights", "shadows"], indirect=True)
def test_the_same_pixels_whatever_moves(pair: Pair) -> None:
    rng, data = seeding.rng("test_layers", "moves"), pair.opened.data
    for step in range(40):
        # Now one of them moves, now several, now none; the last is the camera's body.
        for body in rng.choice(BODIES, rng.integers(0, 3), replace=False):
            data.mocap_pos[body] += rng.normal(0, 0.05, 3)
        if step % 10 > 5:
            data.mocap_pos[-1] += rng.normal(0, 0.05, 3)
        if step % 20 == 19:
            pair.opened.model.site_rgba[2, :3] = rng.random(3)
        assert pair.same(*CAMERAS)


def test_at_equal_depth_the_same_geom_shows() -> None:
    """The tops of all boxes, and of the site, lie in one plane. The green box moves over the others.

    MuJoCo shows the geom that it renders last: the green one over the red one, the blue one over the green one, and the
    site over the red one.
    """
    box = 'type="box" size="0.3 0.2 0.1"'
    opened = Renderer(
        f"""
        <mujoco>
          <worldbody>
            <light pos="0.5 0 3" dir="0 0 -1" castshadow="false"/>
            <geom {box} pos="-0.4 0 0" group="1" rgba="0.9 0.1 0.1 1"/>
            <body mocap="true"><geom {box} group="1" rgba="0.1 0.9 0.1 1"/></body>
            <geom {box} pos="0.4 0 0" group="1" rgba="0.1 0.1 0.9 1"/>
            <site type="box" size="0.1 0.1 0.05" pos="-0.6 0 0.05" rgba="0.9 0.9 0.1 1"/>
            <camera name="above" pos="0 0 3"/>
          </worldbody>
        </mujoco>"""
    )
    with both_ways(opened) as (ours, plain):
        pair = Pair(opened, ours, plain, [])
        for step in range(12):
            opened.data.mocap_pos[0, 1] = 0.02 * step
            assert pair.same("above"), f"step {step}"
        colours = {tuple(np.sign(colour.astype(int) - 100)) for colour in opened.frame("above").reshape(-1, 3)}
        assert len(colours) >= 4, "all four show"


def test_geoms_that_stand_still_are_rendered_once(pair: Pair) -> None:
    for step in range(30):
        pair.opened.data.mocap_pos[0, 2] = 0.01 * step
        mujoco.mj_forward(pair.opened.model, pair.opened.data)
        if step == 10:
            pair.rendered.clear()
        pair.opened.frame("fixed")
    assert len(pair.ours._underlays) == 1
    assert sum(pair.rendered) < 20 * BODIES


@pytest.mark.slow
def test_what_trembles_is_left_out_of_the_layer(pair: Pair) -> None:
    for step in range(90):
        pair.opened.data.mocap_pos[:3, 2] += 1e-5 * (step % 5 == 0)
        mujoco.mj_forward(pair.opened.model, pair.opened.data)
        if step == 40:
            pair.rendered.clear()
        pair.opened.frame("fixed")
    assert max(pair.rendered) < BODIES, "the underlay of those that stand still is as it was"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("light_diffuse", 0.2),
        ("light_pos", 1.0),
        ("cam_fovy", 60.0),
        ("mat_specular", 0.1),
        ("geom_rgba", 0.7),
        ("geom_matid", 1),
    ],
)
def test_a_changed_look_is_seen(pair: Pair, field: str, value: float) -> None:
    for _ in range(4):
        mujoco.mj_forward(pair.opened.model, pair.opened.data)
        before = pair.opened.frame("fixed")
    array = getattr(pair.opened.model, field)
    array[..., -1 if field == "geom_rgba" else slice(None)] = value
    assert pair.same("fixed")
    assert not np.array_equal(pair.opened.frame("fixed"), before)
