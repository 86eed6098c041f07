"""What stands still is drawn once, and every picture is the one that MuJoCo draws at once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import arenas
import mujoco
import numpy as np
import pytest
from arenas import TASKS
from numpy.typing import NDArray
from test_culling import plain

from pipeline import seeding
from pipeline.axes.background import BackgroundAxis
from pipeline.episode_schema import SCHEMA
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.culling import Picture

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


@pytest.fixture
def renderer(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    opened = Renderer(scene(shadows=getattr(request, "param", False)))
    yield opened
    opened.close()


@pytest.fixture
def drawn(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many bodies' geoms each call to OpenGL had to draw."""
    counts: list[int] = []
    draw = renderer._draw

    def counted(picture: Picture, opaque: NDArray[np.bool_], *how: Any, **more: Any) -> None:
        counts.append(int(opaque[-BODIES:].sum()))
        draw(picture, opaque, *how, **more)

    monkeypatch.setattr(renderer, "_draw", counted)
    return counts


def assert_as_plain(renderer: Renderer, *cameras: str) -> None:
    mujoco.mj_forward(renderer.model, renderer.data)
    for camera in cameras:
        assert np.array_equal(renderer.frame(camera), plain(renderer, camera)), camera


@pytest.mark.parametrize("renderer", [False, True], ids=["lights", "shadows"], indirect=True)
def test_the_same_pixels_whatever_moves(renderer: Renderer) -> None:
    rng = seeding.rng("test_layers", "moves")
    for step in range(80):
        # Now one of them moves, now several, now none; the last is the camera's body.
        for body in rng.choice(BODIES, rng.integers(0, 3), replace=False):
            renderer.data.mocap_pos[body] += rng.normal(0, 0.05, 3)
        if step % 10 > 5:
            renderer.data.mocap_pos[-1] += rng.normal(0, 0.05, 3)
        if step % 20 == 19:
            renderer.model.site_rgba[2, :3] = rng.random(3)
        assert_as_plain(renderer, *CAMERAS)


@pytest.mark.parametrize("renderer", [False, True], ids=["lights", "shadows"], indirect=True)
def test_what_stands_still_is_drawn_once(renderer: Renderer, drawn: list[int]) -> None:
    for step in range(30):
        renderer.data.mocap_pos[0, 2] = 0.01 * step
        mujoco.mj_forward(renderer.model, renderer.data)
        if step == 10:
            drawn.clear()
        renderer.frame("fixed")
    assert len(renderer._layers) == 1
    assert sum(drawn) < 20 * BODIES


def test_what_trembles_is_left_out_of_the_layer(renderer: Renderer, drawn: list[int]) -> None:
    for step in range(90):
        renderer.data.mocap_pos[:3, 2] += 1e-5 * (step % 5 == 0)
        mujoco.mj_forward(renderer.model, renderer.data)
        if step == 40:
            drawn.clear()
        renderer.frame("fixed")
    assert max(drawn) < BODIES, "the layer of those that stand still is as it was"


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
def test_a_changed_look_is_seen(renderer: Renderer, field: str, value: float) -> None:
    for _ in range(4):
        mujoco.mj_forward(renderer.model, renderer.data)
        before = renderer.frame("fixed")
    array = getattr(renderer.model, field)
    array[..., -1 if field == "geom_rgba" else slice(None)] = value
    assert_as_plain(renderer, "fixed")
    assert not np.array_equal(renderer.frame("fixed"), before)


@pytest.mark.slow
@pytest.mark.parametrize("arena", TASKS)
def test_textures_that_are_held_side_by_side_are_those_of_a_scene_by_itself(arena: str) -> None:
    rng = seeding.rng("test_layers", arena)
    axis = BackgroundAxis(image_share=0.0)
    choices = [[], *([axis.sample(rng, TASKS[arena], place)] for place in range(3))]
    opened = arenas.renderer(arena)
    cameras = [view.camera for view in SCHEMA.views.values()]
    states = [np.concatenate([[0.0], opened.data.qpos, opened.data.qvel]) for _ in range(4)]
    site_alpha = opened.model.site_rgba[:, 3].astype(np.float32)
    for step, state in enumerate(states):
        state[1:8] += 0.1 * step
    try:
        with opened.painted(choices) as shows:
            assert opened._painted.any()
            made = []
            for state in states:
                opened.restore(state, site_alpha)
                for show in shows:
                    show()
                    made.append([opened.frame(camera) for camera in cameras])
        for number, choice in enumerate(choices):
            with opened.perturbed(choice):
                for step, state in enumerate(states):
                    opened.restore(state, site_alpha)
                    expected = [plain(opened, camera) for camera in cameras]
                    assert np.array_equal(made[step * len(choices) + number], expected), (number, step)
    finally:
        opened.close()
