"""Whether a held-out perturbation shows enough to act by: the rule by which a run drops its episodes."""

from collections.abc import Sequence

import numpy as np

from pipeline.axes import Perturbation, RenderPerturbation, to_json
from pipeline.axes.layout import LayoutPerturbation
from pipeline.grouping import grouped
from pipeline.physics.replay import roll_out
from pipeline.planning.streams import streams_of
from pipeline.rendering.renderer import LastScene
from pipeline.rendering.sight import FirstFrame
from pipeline.scenes.compiled import proprioception
from pipeline.types import Demo, Floats, Scene, Trajectory, Verdict


def can_hide(perturbation: Perturbation) -> bool:
    """Return whether a perturbation can leave too little to see: it changes the picture, or adds objects."""
    return isinstance(perturbation, RenderPerturbation | LayoutPerturbation)


def fault(scene: Scene, demo: Demo, perturbations: Sequence[Perturbation], opened: LastScene) -> str | None:
    """Return why a run would reject the first frame of a scene under render perturbations, else `None`.

    The hand is where the demonstration's actions lead it.

    Args:
        scene: with the physics perturbations among ``perturbations`` applied.
        opened: renders it.
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
    for changes, of_scene in grouped((stream.changes, stream) for stream in streams).items():
        with renderer.perturbed(changes):
            if reason := first_frame.fault(of_scene):
                return reason
    return None
