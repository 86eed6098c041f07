"""Where a scene and a demonstration's actions in it lead, for whoever looks before the replay."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pipeline.config import ReplayConfig
from pipeline.libero.starts import kept_actions
from pipeline.physics.environment import shared
from pipeline.types import Demo, Floats, Push, Scene, Task


def roll_out(scene: Scene, demo: Demo, config: ReplayConfig = ReplayConfig()) -> Floats:  # noqa: B008 - frozen
    """(K+1, S) states that the demonstration's actions lead through from ``scene``, once that has settled. ``config``:
    how the replay that follows settles, and which actions it leaves out. RefusedError: ``simulation_unstable``."""
    actions = demo.actions[kept_actions(demo.actions, config.noops)]
    return _states(demo.task, _start(scene), actions.tobytes(), config.settle_steps)


def first_look(scene: Scene, task: Task, config: ReplayConfig) -> Floats:
    """(S,) what the first frame of a replay shows: the state in which ``scene`` has settled. RefusedError:
    ``simulation_unstable``."""
    state: Floats = _states(task, _start(scene), b"", config.settle_steps)[0]
    return state


_Start = tuple[str, bytes, float, tuple[float, ...] | None, Push | None]


def _start(scene: Scene) -> _Start:
    """What a replay in the scene depends on; unlike the scene, it can be a key."""
    return scene.model_xml, scene.state.tobytes(), scene.gripper, scene.posture_rad, scene.push


@lru_cache(maxsize=4)
def _states(task: Task, start: _Start, actions: bytes, settle_steps: int) -> Floats:
    model_xml, state, gripper, posture_rad, push = start
    environment = shared(task)
    environment.restore(Scene(model_xml, np.frombuffer(state), gripper=gripper, posture_rad=posture_rad, push=push))
    environment.settle(settle_steps)
    states = [environment.state]
    for action in np.frombuffer(actions).reshape(-1, 7):
        environment.step(action)
        states.append(environment.state)
    return np.stack(states)
