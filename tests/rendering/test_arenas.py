"""In each of LIBERO's arenas, pictures with savings and plain ones are those that MuJoCo's own renderer gives."""

from collections.abc import Iterator
from itertools import product

import arenas
import mujoco
import numpy as np
import pytest
from arenas import TASKS, VIEWS, both_ways

from pipeline import seeding
from pipeline.episode_schema import ALL_VIEWS
from pipeline.rendering.opengl import say_once
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.software_renderer import SoftwareRenderer

pytestmark = pytest.mark.slow

Arena = tuple[str, Renderer, SoftwareRenderer, PlainRenderer]
"""Its name, and its scene rendered with savings and plainly."""

CAMERAS = [view.camera for view in ALL_VIEWS.values()]


@pytest.fixture(scope="module", params=TASKS)
def arena(request: pytest.FixtureRequest) -> Iterator[Arena]:
    opened = arenas.renderer(request.param)
    with both_ways(opened) as (ours, plain):
        yield request.param, opened, ours, plain


def test_frames_and_surfaces_are_those_of_mujocos_renderer(arena: Arena) -> None:
    """``mujoco.Renderer`` has the first row at the top."""
    _, opened, _, plain = arena
    data, option = opened.data, mujoco.MjvOption()
    option.geomgroup[0] = 0
    with mujoco.Renderer(opened.model, 256, 256, max_geom=1000) as theirs:
        for camera in CAMERAS:
            theirs.update_scene(data, camera, option)
            expected = theirs.render()[::-1]
            assert np.array_equal(opened.frame(camera), expected), camera
            assert np.array_equal(plain.frame(data, camera), expected), camera
        for camera in VIEWS:
            _, number, kind = plain.surfaces(data, camera)
            # robosuite hides sites by a negative opacity; MuJoCo segments all that are not at 0.
            opacity = opened.model.site_rgba[:, 3].copy()
            opened.model.site_rgba[:, 3] = opacity.clip(0)
            theirs.update_scene(data, camera, option)
            opened.model.site_rgba[:, 3] = opacity
            theirs.enable_segmentation_rendering()
            assert np.array_equal(np.stack([number, kind], axis=-1), theirs.render()[::-1])
            theirs.disable_segmentation_rendering()


def test_what_is_left_out_of_a_picture_cannot_be_seen(arena: Arena, caplog: pytest.LogCaptureFixture) -> None:
    say_once.cache_clear()
    name, opened, ours, plain = arena
    rng, left_out = seeding.rng("test_culling", name), 0
    for number, camera in product(range(3), VIEWS):
        opened.data.qpos[:7] += rng.uniform(-0.3, 0.3, 7)  # of the arm
        opened.model.light_castshadow[:] = number % 2
        mujoco.mj_forward(opened.model, opened.data)
        assert np.array_equal(opened.frame(camera), plain.frame(opened.data, camera)), camera
        left_out += int((ours._culling.shown & ~ours._culling.picture(opened.data, camera).seen).sum())
        shown, expected = opened.surfaces(camera), plain.surfaces(opened.data, camera)
        for ours_part, plain_part in zip(shown, expected, strict=True):
            assert np.array_equal(ours_part, plain_part), "the surfaces do not depend on the meshes of a frame"
    assert left_out > 30
    assert caplog.records == [], "OpenGL reports no error"
