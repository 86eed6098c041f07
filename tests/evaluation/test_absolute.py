"""Absolute actions, the goals of the controller, reach the goals that the deltas reach."""

from contextlib import closing

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from short_demonstrations import STOVE, starter_demo

from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.selection import Selection, select
from pipeline.libero.starts import kept_actions
from pipeline.types import Floats

pytestmark = pytest.mark.slow


def hand_m(environment: EpisodeEnvironment) -> Floats:
    return environment.simulator.observed.state[:3].astype(float)


def test_goals_reach_what_the_deltas_reach() -> None:
    """From LIBERO's state of the demonstration, and again in the next episode, which settles by deltas."""
    recorded = starter_demo(STOVE).actions
    actions = recorded[kept_actions(recorded, "drop")]
    (task, *_) = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,), episodes=1))
    goals, path = [], []
    with closing(EpisodeEnvironment(EpisodeSettings(initial_states="demonstration"))) as by_deltas:
        by_deltas.reset(task)
        for action in actions:
            by_deltas.step(action)
            controller = by_deltas.simulator.controller
            axis_angle = Rotation.from_matrix(controller.goal_ori).as_rotvec()
            goals.append(np.hstack([controller.goal_pos, axis_angle, action[6]]).astype(np.float32))
            path.append(hand_m(by_deltas))
            if by_deltas.progress.over:
                break
        assert by_deltas.progress.success
    settings = EpisodeSettings(initial_states="demonstration", actions="absolute")
    with closing(EpisodeEnvironment(settings)) as by_goals:
        for _ in range(2):
            by_goals.reset(task)
            for step, goal in enumerate(goals):
                by_goals.step(goal)
                assert np.linalg.norm(hand_m(by_goals) - path[step]) < 0.01
            assert by_goals.progress.success
