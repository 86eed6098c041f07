"""A GPU's drawing gives the pixels of plain rendering, also while several frames are on their way."""

from collections.abc import Iterator
from contextlib import closing

import mujoco
import numpy as np
import pytest

from pipeline.rendering import savings
from pipeline.rendering.drawing import PlainDrawing
from pipeline.rendering.software.gpu import IN_FLIGHT, GpuDrawing


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(savings.SCENE)


@pytest.fixture
def drawing(model: mujoco.MjModel) -> Iterator[GpuDrawing]:
    with closing(GpuDrawing(model)) as drawing:
        yield drawing


def states(model: mujoco.MjModel, count: int) -> Iterator[mujoco.MjData]:
    """Yield the same data with the mocap body in further and further poses."""
    data = mujoco.MjData(model)
    for state in range(count):
        data.mocap_pos[0, 1] = 0.05 * state
        data.mocap_quat[0] = np.cos(state), np.sin(state), 0, 0
        mujoco.mj_forward(model, data)
        yield data


def test_frames_are_plain_frames_with_and_without_shadows() -> None:
    """The mirror, the sky behind and the textures of the small scene show in its frames."""
    plain, ours = savings.frames(PlainDrawing), savings.frames(GpuDrawing)
    assert all(map(np.array_equal, plain, ours))


def test_more_frames_in_flight_than_buffers_keep_their_order(model: mujoco.MjModel, drawing: GpuDrawing) -> None:
    count = IN_FLIGHT + 3
    started = [drawing.start_frame(data, "eye") for data in states(model, count)]
    waited = [wait() for wait in reversed(started)][::-1]
    expected = [drawing.frame(data, "eye") for data in states(model, count)]
    assert all(map(np.array_equal, waited, expected))
    assert not np.array_equal(waited[0], waited[-1])


def test_a_geom_behind_the_camera_is_not_rendered_and_the_model_stays(
    model: mujoco.MjModel, drawing: GpuDrawing, monkeypatch: pytest.MonkeyPatch
) -> None:
    (data,) = states(model, 1)
    camera, rendered, groups = model.camera("eye"), [], model.geom_group.copy()
    update = mujoco.mjv_updateScene

    def counted(*arguments: object) -> None:
        update(*arguments)
        rendered.append(arguments[-1].ngeom)  # type: ignore[attr-defined]

    monkeypatch.setattr(mujoco, "mjv_updateScene", counted)
    drawing.frame(data, "eye")
    camera.quat[:] = 1, 0, 0, 0
    camera.pos[:] = 0, 0, -5
    mujoco.mj_forward(model, data)
    drawing.frame(data, "eye")
    assert rendered[1] < rendered[0]
    assert np.array_equal(model.geom_group, groups)
