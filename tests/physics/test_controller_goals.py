"""Absolute actions are the goals that robosuite's own controller gets from the deltas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from short_demonstrations import STOVE, starter_demo

from pipeline.axes import PhysicsPerturbation
from pipeline.axes.robot import RobotAxis
from pipeline.config import ReplayConfig
from pipeline.physics.controller_goals import absolute_actions, first_posture, without_jumps
from pipeline.physics.environment import environment_of
from pipeline.physics.replay import replay
from pipeline.scenes.compiled import CompiledScene, grip_pose
from pipeline.seeding import rng


def robot_start(component: str) -> PhysicsPerturbation:
    axis = RobotAxis.model_validate({"components": [component], "levels": [3]})
    perturbation = axis.sample(rng("goals", component), STOVE, 0)
    assert isinstance(perturbation, PhysicsPerturbation)
    return perturbation


@pytest.mark.slow
@pytest.mark.parametrize("component", ["", "controller_posture", "initial_joints"])
def test_goals_are_those_of_robosuites_controller(component: str) -> None:
    """Also where the first actions do not turn the hand, and the controller keeps the posture of a changed reset."""
    environment, demo = environment_of(STOVE), starter_demo(STOVE)
    begun = replace(demo, actions=demo.actions[:60])
    changes = (robot_start(component),) if component else ()
    trajectory = replay(environment, begun, "t", ReplayConfig(mode="open_loop"), changes)
    # A few steps without a turn, at the beginning and later, as LIBERO's recordings have them.
    actions = trajectory.actions[:40].copy()
    actions[[0, 1, 2, 20, 21], 3:6] = 0.0
    environment.restore(trajectory.scene)
    environment.settle(10)
    controller = environment._env.env.robots[0].controller
    states, positions_m, rotations = [], [], []
    for action in actions:
        states.append(environment.state)
        environment.step(action)
        positions_m.append(controller.goal_pos.copy())
        rotations.append(controller.goal_ori.copy())
    compiled = CompiledScene(trajectory.scene)
    grips = []
    for state in (first_posture(trajectory.scene, compiled.model), *states):
        compiled.restore(state)
        grips.append(grip_pose(compiled.data))
    goals = absolute_actions(actions, grips[0], grips[1:])
    np.testing.assert_allclose(goals[:, :3], positions_m, atol=1e-9)
    turned_rad = (Rotation.from_rotvec(goals[:, 3:6]).inv() * Rotation.from_matrix(rotations)).magnitude()
    assert turned_rad.max() < 1e-6
    assert np.array_equal(goals[:, 6], actions[:, 6])
    held_rad = (Rotation.from_rotvec(goals[2, 3:6]).inv() * Rotation.from_rotvec(goals[0, 3:6])).magnitude()
    assert held_rad < 1e-9, "a goal stays through steps without a turn"


def test_axis_angles_have_no_jumps_and_one_sign() -> None:
    """A hand that points down, as in LIBERO, moves through the rotation by pi in both directions."""
    generator, crossed = np.random.default_rng(0), 0
    for _ in range(50):
        down = Rotation.from_rotvec(np.pi * np.array([1.0, 1.0, 0.0]) / np.sqrt(2))
        turns = np.cumsum(generator.normal(0, 0.05, (200, 3)), axis=0).clip(-0.6, 0.6)
        rotations = Rotation.from_rotvec(turns) * down
        shortest = rotations.as_rotvec()
        continuous = without_jumps(shortest)
        assert (Rotation.from_rotvec(continuous).inv() * rotations).magnitude().max() < 1e-9
        assert np.linalg.norm(np.diff(continuous, axis=0), axis=1).max() < 1.0
        assert continuous[0, 0] > 0
        crossed += int(np.linalg.norm(np.diff(shortest, axis=0), axis=1).max() > 3.0)
    assert crossed > 25, "otherwise this test tells little"


def test_rotations_near_none_keep_their_axis_angle() -> None:
    assert np.array_equal(without_jumps(np.zeros((3, 3))), np.zeros((3, 3)))
