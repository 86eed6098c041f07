"""States to frames: every picture comes from stored states, so one replay is rendered under many perturbations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import RenderPerturbation, of_layer
from pipeline.axes.light import exposure
from pipeline.config import RenderConfig
from pipeline.episode_schema import SCHEMA, named
from pipeline.images.jpeg import encode, to_policy
from pipeline.planning.streams import Stream
from pipeline.rendering.drawing import SideBySide
from pipeline.rendering.frames import noisy
from pipeline.rendering.geometry import see
from pipeline.rendering.instances import Instances
from pipeline.rendering.last_scene import LastScene
from pipeline.rendering.sight import CAMERA, Sight
from pipeline.scenes.compiled import proprioception
from pipeline.types import Rendered, Task, Trajectory


def render(
    trajectory: Trajectory, task: Task, streams: Sequence[Stream], config: RenderConfig, opened: LastScene
) -> Rendered:
    """Render the streams of one trajectory of a task: the frame before each executed action.

    Streams that differ in pixel noise alone share the clean frames they are made from. A perturbed scene whose first
    frame is black or blown out is not rendered any further, nor one whose agent view does not show what it should (see
    ``Sight``): a moved camera the task, any camera the objects that were added. Streams that differ in colours alone
    share their geometry. Scenes that differ in textures alone are rendered side by side where a drawing makes use of
    it (``SideBySide``).
    """
    encoded: dict[str, list[bytes]] = {stream.stream_id: [] for stream in streams}
    refused: dict[str, str] = {}
    proprioceptions: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    poses: list[NDArray[np.float32]] = []
    steps = len(trajectory.actions)
    renderer = opened.renderer(trajectory.model_xml)
    apart = not isinstance(renderer.drawing, SideBySide)
    scenes: dict[str, dict[str, list[Stream]]] = {}
    for stream in streams:
        scenes.setdefault(stream.scene(textures=apart), {}).setdefault(stream.scene(), []).append(stream)
    instances = Instances(renderer.model, trajectory, task) if named(config.extras) else None
    for step in range(steps):
        renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
        proprioceptions.append(proprioception(renderer.data))
        if instances:
            poses.append(instances.poses(renderer.data))
    hand_m = np.array([state[:3] for state, _ in proprioceptions], float)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    original = Sight.of(renderer, task, hand_m)
    for shared in scenes.values():
        variants = list(shared.values())
        changes = [of_layer(members[0].perturbations, RenderPerturbation) for members in variants]
        common = [change for change in changes[0] if not change.paints]
        moved = any(change.sees_otherwise for change in common)
        painted = [[change for change in each if change.paints] for each in changes]
        with renderer.perturbed(common), renderer.painted(painted) as shows:
            for step in range(steps):
                renderer.restore(trajectory.states[step], trajectory.site_alpha[step])
                for show, members, perturbed in zip(shows, variants, changes, strict=True):
                    if members[0].stream_id in refused:
                        continue
                    show()
                    clean = {view: renderer.frame(SCHEMA.views[view].camera) for view in {s.view for s in members}}
                    if step == 0:
                        faults = [fault for frame in clean.values() if perturbed and (fault := exposure(frame))]
                        if any(SCHEMA.views[view].camera == CAMERA for view in clean):
                            sight = Sight.of(renderer, task, hand_m) if moved else original
                            faults += sight.faults(original)
                        if faults:
                            refused |= {stream.stream_id: faults[0] for stream in members}
                            continue
                    for stream in members:
                        frame = noisy(clean[stream.view], stream.view, stream.perturbations, step)
                        encoded[stream.stream_id].append(encode(to_policy(frame), config))
    views = dict.fromkeys(stream.geometry for stream in streams if stream.stream_id not in refused)
    geometry = {view.stream_id: see(renderer, trajectory, view, instances, config.extras) for view in views}
    state, joint_state = (np.stack(column) for column in zip(*proprioceptions, strict=True))
    shown = {stream_id: frames for stream_id, frames in encoded.items() if stream_id not in refused}
    return Rendered(
        replay_mode=trajectory.mode,
        state=state,
        joint_state=joint_state,
        action=trajectory.actions.astype(np.float32),
        streams=shown,
        rejected=refused,
        geometry=geometry,
        object_poses=np.stack(poses) if "object_poses" in config.extras else None,
        instances=instances.names if instances else (),
        quality=trajectory.quality,
    )
