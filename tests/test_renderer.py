"""One OpenGL context serves all scenes of the same meshes and textures, with the frames that each would have alone."""

from __future__ import annotations

import subprocess
import sys

import arenas
import mujoco
import numpy as np
import pytest
from arenas import TASKS, frames

from pipeline.axes.light import LightPerturbation
from pipeline.physics.environment import Environment
from pipeline.rendering.last_scene import LastScene
from pipeline.rendering.renderer import Renderer
from pipeline.types import Frame

SHADOWS = LightPerturbation(component="shadows", level=5, shadows=True)


def all_frames(renderer: Renderer) -> dict[str, Frame]:
    """Of both views, as they are and with shadows, whose reach a context keeps."""
    plain = frames(renderer)
    with renderer.perturbed([SHADOWS]):
        return plain | {f"{view} with shadows": frame for view, frame in frames(renderer).items()}


@pytest.mark.slow
def test_a_scene_with_its_fixtures_elsewhere_takes_over_the_context() -> None:
    model_xml, state = arenas.scene("tabletop")
    environment = Environment(TASKS["tabletop"])
    elsewhere = environment.place_fixtures(5)
    environment.close()
    alone = Renderer(elsewhere)
    alone.restore(state, alone.model.site_rgba[:, 3].astype(np.float32))
    expected = all_frames(alone)
    alone.close()

    opened = LastScene()
    first = opened.renderer(model_xml)
    first.restore(state, first.model.site_rgba[:, 3].astype(np.float32))
    before = all_frames(first)
    second = opened.renderer(mujoco.MjModel.from_xml_string(elsewhere))
    assert second is first
    second.restore(state, second.model.site_rgba[:, 3].astype(np.float32))
    after = all_frames(second)
    for name, frame in expected.items():
        assert np.array_equal(after[name], frame), name
    assert any((after[name] != frame).any() for name, frame in before.items()), "the fixtures are elsewhere"
    hidden = mujoco.MjModel.from_xml_string(elsewhere)
    hidden.geom_group[0] = 3
    assert not second.adopted(hidden)
    assert np.array_equal(frames(second)["agentview"], after["agentview"]), "what is refused changes nothing"
    assert opened.renderer(model_xml) is first
    opened.close()


LEFT_OPEN = '''
from pipeline.rendering.last_scene import LastScene

scene = """
<mujoco>
    <asset><mesh name="pyramid" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
    <worldbody><camera name="agentview"/><geom type="mesh" mesh="pyramid" group="1"/></worldbody>
</mujoco>
"""
opened = LastScene()
opened.renderer(scene).frame("agentview")
'''


def test_a_process_that_leaves_its_scene_open_ends_without_a_word() -> None:
    done = subprocess.run([sys.executable, "-c", LEFT_OPEN], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
