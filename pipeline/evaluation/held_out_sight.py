"""The visibility rule of a run, applied to held-out perturbations: a frame must show enough for a policy to act."""

from collections.abc import Sequence

import numpy as np

from pipeline.axes import Perturbation, to_json
from pipeline.grouping import grouped
from pipeline.physics.replay import roll_out
from pipeline.planning.streams import streams_of
from pipeline.rendering.renderer import LastScene
from pipeline.rendering.sight import FirstFrame
from pipeline.scenes.compiled import proprioception
from pipeline.types import Demo, Floats, Scene, Trajectory, Verdict


def fault(scene: Scene, demo: Demo, perturbations: Sequence[Perturbation], opened: LastScene) -> str | None:
    """Return why a run would reject the first frame of a scene under render perturbations, else `None`.

    The hand's positions come from a replay of the demonstration's actions.

    Args:
        scene: scene to which the physics perturbations among ``perturbations`` have been applied.
        opened: renderer of the scene.
    """
    states = roll_out(scene, demo)
    renderer = opened.renderer(scene.model_xml)
    site_alpha = np.repeat(renderer.site_alpha[None], len(states), axis=0)
    hand_m: list[Floats] = []
    for state in states[:-1]:
        renderer.restore(state, renderer.site_alpha)
        hand_m.append(proprioception(renderer.data)[0][:3].astype(float))
    replay = Trajectory("", "open_loop", scene, states, demo.actions, site_alpha, Verdict(True, "kept"))
    first_frame = FirstFrame(renderer, replay, demo.task, np.stack(hand_m))
    streams = streams_of(to_json(perturbations)).values()
    for changes, streams_with_changes in grouped((stream.changes, stream) for stream in streams).items():
        with renderer.perturbed(changes):
            reason = first_frame.fault(streams_with_changes)
        if reason:
            return reason
    return None
