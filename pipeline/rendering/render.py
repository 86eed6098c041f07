"""Rendering of a trajectory to frames.

Each frame comes from a stored state, so one replay is rendered under many perturbations. A frame takes five steps:
perturb, restore, render, add noise, turn.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import PixelPerturbation, of_layer
from pipeline.config import RenderConfig
from pipeline.episode_schema import ALL_VIEWS
from pipeline.grouping import grouped
from pipeline.images.jpeg import encode, to_policy
from pipeline.physics.controller_goals import absolute_actions, first_posture
from pipeline.physics.subtasks import subtasks_by_contacts
from pipeline.planning.streams import Stream
from pipeline.rendering.geometry import Instances, render_geometry
from pipeline.rendering.renderer import LastScene, Renderer
from pipeline.rendering.sight import FirstFrame
from pipeline.scenes.compiled import GripPose, contacts, grip_pose, proprioception
from pipeline.types import Floats, Frame, Geometry, Jpeg, Rendered, Task, Trajectory

Started = Mapping[str, Callable[[], Frame]]
"""View to a function that waits for its clean frame."""


def render(
    trajectory: Trajectory, task: Task, streams: Sequence[Stream], render_config: RenderConfig, opened: LastScene
) -> Rendered:
    """Render the streams of one trajectory of a task: the frame before each executed action.

    Streams with equal render perturbations share a scene and its clean frames. A stream is rejected, with a reason, if
    the scene lacks its camera or the first frame of its scene is rejected (``FirstFrame``). Streams that differ only in
    colours share their geometry.
    """
    renderer = opened.renderer(trajectory.model_xml, render_config.size_px)
    has_names = render_config.content.has_names
    instances = Instances(renderer.model, task, trajectory.scene.resolved) if has_names else None
    measured = _measure_states(renderer, trajectory, instances)
    first_frame = FirstFrame(renderer, trajectory, task, measured.state[:, :3].astype(float))
    encoded: dict[str, list[Jpeg]] = {stream.stream_id: [] for stream in streams}
    rejected: dict[str, str] = {}
    for stream in streams:
        if not renderer.has_camera(ALL_VIEWS[stream.view].camera):
            rejected[stream.stream_id] = "camera_missing"
    visible = [stream for stream in streams if stream.stream_id not in rejected]
    for changes, scene in grouped((stream.changes, stream) for stream in visible).items():
        with renderer.perturbed(changes):
            fault = first_frame.fault(scene)
            if fault:
                rejected |= {stream.stream_id: fault for stream in scene}
                continue
            for frames in frames_of_steps(renderer, trajectory, scene):
                for stream, frame in zip(scene, frames, strict=True):
                    encoded[stream.stream_id].append(encode(frame, render_config.jpeg_quality))
    geometry: dict[str, Geometry] = {}
    for stream in dict.fromkeys(stream.geometry for stream in streams if stream.stream_id not in rejected):
        geometry[stream.stream_id] = render_geometry(renderer, trajectory, stream, instances, render_config.extras)
    return Rendered(
        replay_mode=trajectory.mode,
        state=measured.state,
        joint_state=measured.joint_state,
        action=trajectory.actions.astype(np.float32),
        action_absolute=absolute_actions(trajectory.actions, measured.first_grip, measured.grips).astype(np.float32),
        streams={stream_id: frames for stream_id, frames in encoded.items() if stream_id not in rejected},
        rejected=rejected,
        geometry=geometry,
        object_poses=np.stack(measured.object_poses) if "object_poses" in render_config.extras else None,
        instances=instances.names if instances else (),
        quality=trajectory.quality,
        subtasks=subtasks_by_contacts(trajectory, task, renderer.model, measured.contacts),
    )


class _Measured(NamedTuple):
    """Measurements in the stored states of a trajectory, which need no frames.

    Attributes:
        state, joint_state: as in ``Rendered``.
        first_grip: the grip's pose in ``first_posture``.
        grips: K poses of the grip, before each action.
        object_poses: K arrays of poses, before each action; empty without instances.
        contacts: pairs (C, 2) of bodies in contact in each of the K+1 states.
    """

    state: NDArray[np.float32]
    joint_state: NDArray[np.float32]
    first_grip: GripPose
    grips: Sequence[GripPose]
    object_poses: Sequence[NDArray[np.float32]]
    contacts: Sequence[NDArray[np.intp]]


def _measure_states(renderer: Renderer, trajectory: Trajectory, instances: Instances | None) -> _Measured:
    """Restore every state of a trajectory, and measure the robot, the objects and the contacts in it."""
    renderer.restore(first_posture(trajectory.scene, renderer.model), trajectory.site_alpha[0])
    first_grip = grip_pose(renderer.data)
    proprioceptions, grips, object_poses, pairs = [], [], [], []
    for step in range(len(trajectory.actions)):
        renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
        proprioceptions.append(proprioception(renderer.data))
        grips.append(grip_pose(renderer.data))
        if instances:
            object_poses.append(instances.poses(renderer.data))
        pairs.append(contacts(renderer.data))
    renderer.restore(trajectory.states[-1], trajectory.site_alpha[-1])
    pairs.append(contacts(renderer.data))
    state, joint_state = (np.stack(column) for column in zip(*proprioceptions, strict=True))
    return _Measured(state, joint_state, first_grip, grips, object_poses, pairs)


def frames_of(
    renderer: Renderer, state: Floats, site_alpha: NDArray[np.float32], streams: Sequence[Stream], step: int
) -> list[Frame]:
    """Render one frame (H, W, 3) of uint8 RGB for each stream, turned by 180 degrees as policies see it.

    Each view is rendered once: streams that differ only in noise share its clean frame. To render many steps, keep the
    scene perturbed over all of them (``Renderer.perturbed``).

    Args:
        renderer: the scene's renderer.
        state, site_alpha: (S,) and (nsite,) as ``Renderer.restore`` takes them.
        streams: at least one stream, all with equal render perturbations.
        step: the episode's step; random noise depends on it.
    """
    with renderer.perturbed(streams[0].changes):
        started = _start(renderer, state, site_alpha, streams)
    return _finished(started, streams, step)


def frames_of_steps(renderer: Renderer, trajectory: Trajectory, streams: Sequence[Stream]) -> Iterator[list[Frame]]:
    """Yield the frames of ``frames_of`` before each executed action of a trajectory.

    On a GPU, further steps are rendered while the caller encodes the yielded frames (``steps_ahead``).
    """
    waiting: deque[tuple[int, Started]] = deque()
    with renderer.perturbed(streams[0].changes):
        for step in range(len(trajectory.actions)):
            waiting.append((step, _start(renderer, trajectory.states[step], trajectory.site_alpha[step], streams)))
            if len(waiting) > renderer.model_renderer.steps_ahead:
                first_step, started = waiting.popleft()
                yield _finished(started, streams, first_step)
        for last_step, started in waiting:
            yield _finished(started, streams, last_step)


def _start(renderer: Renderer, state: Floats, site_alpha: NDArray[np.float32], streams: Sequence[Stream]) -> Started:
    """Start to render the clean frame of each view of a state."""
    renderer.restore(state, site_alpha)
    views = dict.fromkeys(stream.view for stream in streams)
    return {view: renderer.start_frame(ALL_VIEWS[view].camera) for view in views}


def _finished(started: Started, streams: Sequence[Stream], step: int) -> list[Frame]:
    """Wait for the clean frames of a step, and return the frame of each stream as policies see it."""
    clean = {view: wait() for view, wait in started.items()}
    return [to_policy(_noisy(clean[stream.view], stream, step)) for stream in streams]


def _noisy(frame: Frame, stream: Stream, step: int) -> Frame:
    """Apply the stream's pixel perturbations of its view to a raw frame."""
    for noise in of_layer(stream.perturbations, PixelPerturbation):
        if stream.view in noise.views:
            frame = noise.apply(frame, step)
    return frame
