"""Each array of a model can be changed before a camera, and shows as MuJoCo renders it, or is rejected with words."""

import copy
import math
from collections.abc import Iterator
from contextlib import closing
from typing import ClassVar

import mujoco
import numpy as np
import pytest

from pipeline.axes.base import CAMERA_FIELDS, FIELDS, RenderPerturbation
from pipeline.images.jpeg import to_policy
from pipeline.rendering.geometry import matrices
from pipeline.rendering.renderer import Renderer
from pipeline.types import Floats, Frame

ROUND = " ".join(
    f"{math.sqrt(1 - z * z) * math.cos(turn):.4f} {math.sqrt(1 - z * z) * math.sin(turn):.4f} {z:.4f}"
    for z, turn in ((2 * (number + 0.5) / 200 - 1, 2.4 * number) for number in range(200))
)
"""Of so many corners that its mesh is rendered as a skin."""

SCENE = f"""
<mujoco>
  <visual><quality shadowsize="512"/></visual>
  <asset>
    <texture name="squares" type="2d" builtin="checker" width="32" height="32" rgb1="0.9 0.7 0.2" rgb2="0.2 0.3 0.6"/>
    <texture name="cube" type="cube" builtin="gradient" width="16" height="16" rgb1="0.9 0.3 0.2" rgb2="0.3 0.8 0.2"/>
    <material name="squares" texture="squares" texrepeat="3 2" specular="0.6" shininess="0.4"/>
    <material name="cube" texture="cube" emission="0.1" specular="0.3"/>
    <material name="mirror" reflectance="0.4" rgba="0.7 0.8 0.9 1"/>
    <mesh name="round" vertex="{ROUND}" scale="0.15 0.15 0.2"/>
  </asset>
  <worldbody>
    <light pos="0.3 0.2 2" dir="0 -0.1 -1" cutoff="35" exponent="8" attenuation="1 0.1 0.05" castshadow="false"/>
    <light pos="-1 1 3" dir="0.3 -0.3 -1" diffuse="0.3 0.3 0.4" specular="0.4 0.4 0.4" castshadow="false"/>
    <geom type="plane" size="3 3 0.1" pos="0 0 -0.5" group="1" material="squares"/>
    <geom type="box" size="0.4 0.4 0.02" pos="0 0.4 -0.4" group="1" material="mirror"/>
    <geom type="box" size="0.15 0.15 0.15" pos="0.3 0.3 -0.1" group="1" material="cube"/>
    <geom type="mesh" mesh="round" pos="-0.3 0.2 0" group="1" material="squares"/>
    <geom type="sphere" size="0.15" pos="0.1 -0.4 -0.2" group="1" rgba="0.8 0.4 0.5 1"/>
    <site pos="-0.3 -0.4 0" size="0.1" rgba="0.2 0.9 0.4 1"/>
    <body mocap="true" pos="0.5 -0.5 0"><geom type="capsule" size="0.08 0.2" group="1"/></body>
    <camera name="agentview" pos="2 0 0.6" xyaxes="0 1 0 -0.3 0 1"/>
  </worldbody>
</mujoco>"""


def arrays() -> list[str]:
    """The names of all arrays of a model."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    return [name for name in dir(model) if not name.startswith("_") and isinstance(getattr(model, name), np.ndarray)]


def writes(field: str) -> RenderPerturbation:
    """A perturbation that writes other values into a field."""

    class Written(RenderPerturbation):
        fields: ClassVar[tuple[str, ...]] = (field,)

        def apply(self, model: mujoco.MjModel) -> None:
            values = getattr(model, field)
            if field == "cam_quat":
                mujoco.mju_mulQuat(values[0], values[0].copy(), np.array([1.0, 0.05, 0.02, 0.1]) / 1.00643)
            elif values.dtype in (np.float64, np.float32):
                values[:] = 0.8 * values + 0.05
                if field.endswith("_rgba"):
                    values[-2, 3] = 0.0
            elif values.dtype == np.uint8 and field == "tex_data":
                values[:] = 255 - values
            elif values.dtype in (np.bool_, np.uint8):
                values[:] = values == 0
            else:
                values[:] = np.roll(values, 1, axis=0)

    return Written(axis="written", component=field, level=1)


class Plain:
    """MuJoCo's own renderer, in a context that is created again for each picture: it has nothing of the former one."""

    def __init__(self) -> None:
        self._option = mujoco.MjvOption()
        self._option.geomgroup[0] = 0
        self._renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string(SCENE), 256, 256)

    def frame(self, model: mujoco.MjModel, marker_m: Floats | None = None) -> Frame:
        """Of a copy of a model, by request with a ball of 1 cm at a place in the world (3,)."""
        own = copy.copy(model)
        data = mujoco.MjData(own)
        mujoco.mj_forward(own, data)
        shown = self._renderer
        shown._gl_context.make_current()
        shown._mjr_context.free()
        shown._mjr_context = mujoco.MjrContext(own, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, shown._mjr_context)
        shown._mjr_context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        shown._model = own
        shown.update_scene(data, "agentview", self._option)
        if marker_m is not None:
            scene, red = shown.scene, np.array([1, 0, 0, 1], np.float32)
            ball = mujoco.mjtGeom.mjGEOM_SPHERE
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], ball, np.full(3, 0.01), marker_m, np.eye(3).ravel(), red)
            scene.ngeom += 1
        return np.asarray(shown.render()[::-1])

    def close(self) -> None:
        self._renderer.close()


@pytest.fixture(scope="module")
def plain(renderer: Renderer) -> Iterator[Plain]:
    # After the renderer's, which chooses what OpenGL renders.
    with closing(Plain()) as made:
        yield made


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    with closing(Renderer(SCENE)) as opened:
        yield opened


def frame(renderer: Renderer) -> Frame:
    """After so many pictures that what stands still is a layer."""
    for _ in range(3):
        mujoco.mj_forward(renderer.model, renderer.data)
        shown = renderer.frame("agentview")
    return shown


@pytest.mark.parametrize("field", FIELDS)
def test_a_changed_field_shows_as_in_a_context_of_its_own(renderer: Renderer, plain: Plain, field: str) -> None:
    before, surfaces = frame(renderer), renderer.surfaces("agentview")
    change = writes(field)
    with renderer.perturbed([change]):
        changed = frame(renderer)
        other = not all(map(np.array_equal, surfaces, renderer.surfaces("agentview")))
        assert change.shows_other_surfaces or not other, "views share their geometry that see the same surfaces"
        assert np.array_equal(changed, plain.frame(renderer.model))
        assert not np.array_equal(changed, before), "the test shows nothing"
    assert np.array_equal(frame(renderer), before)


@pytest.mark.parametrize("field", CAMERA_FIELDS)
def test_the_matrices_of_a_changed_camera_lead_to_where_things_show(
    renderer: Renderer, plain: Plain, field: str
) -> None:
    with renderer.perturbed([writes(field)]):
        mujoco.mj_forward(renderer.model, renderer.data)
        intrinsics, extrinsics = matrices(renderer, "image")
        empty = to_policy(plain.frame(renderer.model))
        for marker_m in np.array([[0.9, 0.2, 0.5], [1.1, -0.15, 0.3], [1.0, 0.0, 0.4]]):
            shown = (to_policy(plain.frame(renderer.model, marker_m)) != empty).any(axis=-1)
            row_px, column_px = np.argwhere(shown).mean(axis=0)
            x, y, z = intrinsics @ (np.linalg.inv(extrinsics) @ [*marker_m, 1.0])[:3]
            assert shown.sum() > 10
            assert np.allclose([x / z, y / z], [column_px, row_px], atol=0.3)


def test_any_other_field_is_rejected() -> None:
    others = set(arrays()) - set(FIELDS)
    assert len(others) > 300
    for field in [*others, "vis", "nothing"]:
        with pytest.raises(TypeError, match=rf"writes \['{field}'\], which frames would not show"):
            writes(field)
