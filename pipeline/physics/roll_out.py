"""Where a demonstration's actions lead from a scene, for perturbations that must keep out of their way."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pipeline.physics.environment import shared
from pipeline.scenes.noops import kept_actions
from pipeline.types import Demo, Floats, Scene, Task


def roll_out(scene: Scene, demo: Demo, noops: str = "drop") -> Floats:
    """(K+1, S) states that the demonstration's actions lead through from ``scene``.

    Args:
        noops: which actions are left out, as in the replay that follows; see ``kept_actions``.

    Raises:
        RefusedError: ``simulation_unstable``.
    """
    return _states(demo.task, scene.model_xml, scene.state.tobytes(), demo.actions.tobytes(), noops)


@lru_cache(maxsize=4)
def _states(task: Task, model_xml: str, state: bytes, actions: bytes, noops: str) -> Floats:
    environment = shared(task)
    environment.restore(model_xml, np.frombuffer(state))
    recorded = np.frombuffer(actions).reshape(-1, 7)
    states = [environment.state]
    for action in recorded[kept_actions(recorded, noops)]:
        environment.step(action)
        states.append(environment.state)
    return np.stack(states)
