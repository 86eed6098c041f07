"""One OpenGL context serves one scene after the other, with the frames that each would have alone."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import arenas
import cv2
import mujoco
import numpy as np
import pytest
from arenas import TASKS, frames

from pipeline.axes.light import LightPerturbation
from pipeline.physics.environment import Environment
from pipeline.rendering.opengl import calls
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.renderer import LastScene, Renderer
from pipeline.rendering.software.software_renderer import SoftwareRenderer
from pipeline.types import Floats, Frame

SHADOWS = LightPerturbation(component="shadows", level=5, shadows=True)


def all_frames(renderer: Renderer) -> dict[str, Frame]:
    """Of both views, as they are and with shadows, whose reach a context keeps."""
    plain = frames(renderer)
    with renderer.perturbed([SHADOWS]):
        return plain | {f"{view} with shadows": frame for view, frame in frames(renderer).items()}


def shown(renderer: Renderer, state: Floats) -> dict[str, Frame]:
    """``all_frames`` of a state."""
    renderer.restore(state, renderer.model.site_rgba[:, 3].astype(np.float32))
    return all_frames(renderer)


def elsewhere() -> tuple[str, Floats]:
    """The tabletop's scene with its fixtures in other places."""
    environment = Environment(TASKS["tabletop"])
    try:
        return environment.place_fixtures(5), arenas.scene("tabletop")[1]
    finally:
        environment.close()


@pytest.mark.slow
def test_one_context_shows_one_scene_after_the_other_as_contexts_of_their_own() -> None:
    scenes = {arena: arenas.scene(arena) for arena in ("tabletop", "kitchen", "floor")} | {"elsewhere": elsewhere()}
    expected = {}
    for name, (model_xml, state) in scenes.items():
        model = mujoco.MjModel.from_xml_string(model_xml)
        with closing(Renderer(model, PlainRenderer(model))) as alone:
            expected[name] = shown(alone, state)
    assert any((expected["elsewhere"][view] != frame).any() for view, frame in expected["tabletop"].items())

    with closing(LastScene()) as opened:
        first = opened.renderer(scenes["tabletop"][0]).model_renderer
        for turn, name in enumerate(("tabletop", "elsewhere", "kitchen", "floor", "tabletop")):
            model_xml, state = scenes[name]
            # A model has its images; of MJCF, those are read that the scene before does not have.
            renderer = opened.renderer(model_xml if turn % 3 else mujoco.MjModel.from_xml_string(model_xml))
            assert renderer.model_renderer is first
            for view, frame in shown(renderer, state).items():
                assert np.array_equal(frame, expected[name][view]), (name, view)


@pytest.mark.slow
def test_a_scene_rendered_with_other_buffers_gets_a_context_of_its_own() -> None:
    model_xml, state = arenas.scene("floor")
    with closing(LastScene()) as opened:
        first = opened.renderer(model_xml)
        before = shown(first, state)
        coarse = mujoco.MjModel.from_xml_string(model_xml)
        coarse.vis.quality.offsamples = 0
        assert not first.model_renderer.adopt(coarse)
        assert all(np.array_equal(frame, before[view]) for view, frame in shown(first, state).items())
        second = opened.renderer(coarse)
        assert isinstance(second.model_renderer, PlainRenderer)
        assert not isinstance(second.model_renderer, SoftwareRenderer)
        assert any((frame != before[view]).any() for view, frame in shown(second, state).items())


@pytest.mark.slow
def test_scenes_that_come_and_go_leave_nothing_in_the_context() -> None:
    with closing(LastScene()) as opened:

        def held() -> tuple[int, int]:
            """How many display lists and textures there are."""
            opengl = calls()
            last = opengl.glGenLists(1), int(opengl.glGenTextures(1))
            opengl.glDeleteLists(last[0], 1)
            opengl.glDeleteTextures([last[1]])
            lists = sum(bool(opengl.glIsList(number)) for number in range(last[0]))
            return lists, sum(bool(opengl.glIsTexture(number)) for number in range(last[1]))

        turns = []
        for _ in range(3):
            for arena in ("tabletop", "floor"):
                shown(opened.renderer(arenas.scene(arena)[0]), arenas.scene(arena)[1])
            turns.append(held())
        assert turns[1] == turns[2]
        assert min(turns[2]) > 10


def painted(shape: str, image: Path) -> str:
    """A shape under an image, before a camera."""
    return f"""
    <mujoco>
      <asset><texture name="image" type="2d" file="{image}"/><material name="image" texture="image"/></asset>
      <worldbody>
        <light pos="0 0 3"/>
        <camera name="agentview" pos="0 0 2"/>
        <geom type="{shape}" size="0.3 0.3 0.3" group="1" material="image"/>
      </worldbody>
    </mujoco>"""


@pytest.mark.slow
def test_a_scene_after_one_that_failed_half_way_is_shown_as_it_is(tmp_path: Path) -> None:
    image, broken = tmp_path / "image.png", tmp_path / "broken.png"
    cv2.imwrite(str(image), np.arange(192, dtype=np.uint8).reshape(8, 8, 3))
    broken.write_bytes(image.read_bytes()[:40])
    scene = painted("box", image)
    with closing(Renderer(scene)) as alone:
        mujoco.mj_forward(alone.model, alone.data)
        expected = alone.frame("agentview")
    with closing(LastScene()) as opened:
        opened.renderer(scene)
        with pytest.raises(ValueError, match=r"broken\.png"):
            opened.renderer(painted("sphere", broken))
        renderer = opened.renderer(scene)
        mujoco.mj_forward(renderer.model, renderer.data)
        assert np.array_equal(renderer.frame("agentview"), expected)


@pytest.mark.parametrize("size_px", [96, 256, 512])
def test_frames_of_every_size_share_a_context(size_px: int, tmp_path: Path) -> None:
    image = tmp_path / "image.png"
    cv2.imwrite(str(image), np.arange(192, dtype=np.uint8).reshape(8, 8, 3))
    with closing(LastScene()) as opened:
        first = opened.renderer(painted("box", image), size_px).model_renderer
        renderer = opened.renderer(painted("sphere", image), size_px)
        assert renderer.model_renderer is first
        mujoco.mj_forward(renderer.model, renderer.data)
        frame = renderer.frame("agentview")
    with closing(Renderer(painted("sphere", image), size_px=size_px)) as alone:
        mujoco.mj_forward(alone.model, alone.data)
        assert np.array_equal(frame, alone.frame("agentview"))
        assert frame.shape == (size_px, size_px, 3)


LEFT_OPEN = '''
from pipeline.rendering.renderer import LastScene

scene = """
<mujoco>
    <asset><mesh name="pyramid" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
    <worldbody><camera name="agentview"/><geom type="mesh" mesh="pyramid" group="1"/></worldbody>
</mujoco>
"""
opened = LastScene()
opened.renderer(scene).frame("agentview")
'''


@pytest.mark.slow
def test_a_process_that_leaves_its_scene_open_ends_without_a_word() -> None:
    done = subprocess.run([sys.executable, "-c", LEFT_OPEN], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
