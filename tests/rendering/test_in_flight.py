"""Renderers for GPUs give the frames of plain rendering in their order, also while several frames are in flight."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from short_demonstrations import MILK

from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.noise import NoiseAxis
from pipeline.planning.streams import Stream
from pipeline.rendering import savings
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.render import frames_of_steps
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.in_flight import BUFFERS, InFlightRenderer
from pipeline.rendering.software.layers import LayeredRenderer
from pipeline.scenes.compiled import compile_model
from pipeline.seeding import rng
from pipeline.types import Frame, Task, Trajectory

KINDS = pytest.mark.parametrize("kind", [InFlightRenderer, LayeredRenderer])


def states(model: mujoco.MjModel, count: int) -> Iterator[mujoco.MjData]:
    """Yield the same data with the mocap body in further and further poses."""
    data = mujoco.MjData(model)
    for state in range(count):
        data.mocap_pos[0, 1] = 0.05 * state
        data.mocap_quat[0] = np.cos(state), np.sin(state), 0, 0
        mujoco.mj_forward(model, data)
        yield data


@KINDS
def test_frames_are_plain_frames_with_and_without_shadows(kind: type[PlainRenderer]) -> None:
    """The mirror, the sky behind and the textures of the small scene show in its frames."""
    plain, in_flight = savings.frames(PlainRenderer), savings.frames(kind)
    assert len(plain) == 8, "four states, without and with shadows"
    np.testing.assert_array_equal(np.stack(in_flight), np.stack(plain))


@KINDS
def test_more_frames_in_flight_than_buffers_keep_their_order(kind: type[PlainRenderer]) -> None:
    model, count = mujoco.MjModel.from_xml_string(savings.SCENE), BUFFERS + 3
    with closing(PlainRenderer(model)) as plain:
        expected = [plain.frame(data, "eye") for data in states(model, count)]
    with closing(kind(model)) as renderer:
        started = [renderer.start_frame(data, "eye") for data in states(model, count)]
        last_first = [wait() for wait in reversed(started)]
    np.testing.assert_array_equal(np.stack(last_first[::-1]), np.stack(expected))
    assert not any(np.array_equal(frame, following) for frame, following in pairwise(expected))


MOVED = CameraPerturbation(component="spherical", level=3, azimuth_deg=30.0, elevation_deg=8.0)
STREAMS = [
    Stream("image", (MOVED, NoiseAxis().sample(rng("in flight"), MILK, 0))),
    Stream("wrist_image", (MOVED,)),
]


def steps_by(kind: type[PlainRenderer], trajectory: Trajectory) -> list[list[Frame]]:
    """Render the frames of ``STREAMS`` by one kind of renderer."""
    model = compile_model(trajectory.model_xml)
    with closing(Renderer(model, kind(model))) as renderer:
        return list(frames_of_steps(renderer, trajectory, STREAMS))


@pytest.fixture(scope="module")
def short(whole: dict[Task, Trajectory]) -> Trajectory:
    return replace(whole[MILK], actions=whole[MILK].actions[:6])


@pytest.fixture(scope="module")
def plain_steps(short: Trajectory) -> list[list[Frame]]:
    return steps_by(PlainRenderer, short)


@KINDS
def test_steps_in_flight_are_yielded_in_order_with_the_noise_of_their_step(
    kind: type[PlainRenderer], short: Trajectory, plain_steps: list[list[Frame]]
) -> None:
    in_flight = steps_by(kind, short)
    assert len(in_flight) == len(plain_steps) == 6
    assert all(np.array_equal(*pair) for pair in zip(in_flight, plain_steps, strict=True))
