"""Figures of how well a trajectory was moved, by robosuite's own contacts and sites, and by planted faults."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from short_demonstrations import BOWL, PLATE, starter_demo

from pipeline.config import ReplayConfig
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.physics.quality import list_allowed_things, measure
from pipeline.physics.replay import replay
from pipeline.scenes.compiled import FINGERS
from pipeline.types import State, Trajectory

CABINET = find_task("libero_goal", "put_the_bowl_on_top_of_the_cabinet")
"""Its demonstration brushes the wine bottle's rack or another thing that the goal does not name."""


@pytest.fixture(scope="module", params=[CABINET, PLATE], ids=lambda task: task.name)
def replayed(request: pytest.FixtureRequest) -> Iterator[tuple[Environment, Trajectory]]:
    environment = Environment(request.param)
    yield environment, replay(environment, starter_demo(request.param), "short", ReplayConfig())
    environment.close()


@pytest.mark.slow
def test_path_and_contacts_are_robosuites(replayed: tuple[Environment, Trajectory]) -> None:
    environment, trajectory = replayed
    environment.restore(trajectory.scene)
    env = environment._env.env  # robosuite's own environment
    allowed: set[str] = set()
    for name in list_allowed_things(bddl.read(environment.task.bddl_file)):
        allowed.update(geoms_of(env, name))
    hand, touched = [], 0
    for step, state in enumerate(trajectory.states):
        env.sim.set_state_from_flattened(state)
        env.sim.forward()
        hand.append(env._eef_xpos.copy())
        robot = env.robots[0].robot_model
        met = env.get_contacts(robot) | env.get_contacts(robot.grippers["robot0_right_hand"])
        own = {*robot.contact_geoms, *robot.grippers["robot0_right_hand"].contact_geoms}
        touched += step > 0 and bool(met - own - allowed)
    found = measure(trajectory, environment.task)
    assert found.touched_steps == touched
    assert found.path_m == pytest.approx(np.linalg.norm(np.diff(hand, axis=0), axis=1).sum(), abs=1e-6)
    third = np.array([1.0, -3.0, 3.0, -1.0]) / 0.05**3
    jerk = np.array([np.convolve(along, third, "valid") for along in np.transpose(hand)])
    assert found.jerk_rms_m_s3 == pytest.approx(np.sqrt((jerk**2).sum(axis=0).mean()), rel=1e-5)
    asked = env.robots[0].controller.output_max[:3] * trajectory.actions[:, :3]
    assert found.lag_m == pytest.approx(np.linalg.norm(np.diff(hand, axis=0) - asked, axis=1).max(), rel=1e-5)
    velocity = np.gradient(np.array(hand), 0.05, axis=0)
    assert found.path_m == pytest.approx(np.linalg.norm(velocity, axis=1).sum() * 0.05, rel=0.1)


def geoms_of(env: object, name: str) -> list[str]:
    models = {**env.objects_dict, **env.fixtures_dict}  # type: ignore[attr-defined]
    return list(models[name].contact_geoms)


@pytest.mark.slow
def test_an_empty_gripper_that_closes_touches_nothing(replayed: tuple[Environment, Trajectory]) -> None:
    environment, trajectory = replayed
    states, model = trajectory.states.copy(), environment.sim.model._model
    for finger in FINGERS:
        State.of(states[2], model.nq).qpos[int(model.joint(finger).qposadr[0])] = 0.0
    shut = measure(replace(trajectory, states=states), environment.task)
    assert shut.touched_steps == measure(trajectory, environment.task).touched_steps


@pytest.mark.slow
def test_an_object_that_is_pushed_counts_and_one_of_the_goal_does_not(
    replayed: tuple[Environment, Trajectory],
) -> None:
    environment, trajectory = replayed
    named = list_allowed_things(bddl.read(environment.task.bddl_file))
    before = measure(trajectory, environment.task)
    for name in bddl.read(environment.task.bddl_file).objects:
        for step, left_m in ((len(trajectory.actions) // 2, 0.0), (-1, 0.05)):
            pushed = moved(environment, trajectory, name, (0.03, 0.04, 0.0), step)
            found = measure(pushed, environment.task)
            counted = (0.05, left_m) if name not in named else (before.non_target_moved_m, before.non_target_left_m)
            assert (found.non_target_moved_m, found.non_target_left_m) == pytest.approx(counted, abs=2e-3), name


def moved(
    environment: Environment, trajectory: Trajectory, name: str, shift_m: tuple[float, ...], step: int
) -> Trajectory:
    """The trajectory with an object elsewhere at one step, and back after it."""
    model = environment.sim.model._model
    first = int(model.joint(f"{name}_joint0").qposadr[0])
    states = trajectory.states.copy()
    State.of(states[step], model.nq).qpos[first : first + 3] += shift_m
    return replace(trajectory, states=states)


@pytest.mark.slow
def test_waiting_is_idle_and_shaking_is_jerk(replayed: tuple[Environment, Trajectory]) -> None:
    environment, trajectory = replayed
    smooth = measure(trajectory, environment.task)
    resting = [trajectory.states[-1]] * len(trajectory.actions)
    waiting = measure(
        replace(
            trajectory,
            states=np.concatenate([trajectory.states, resting]),
            actions=np.concatenate([trajectory.actions, np.zeros_like(trajectory.actions)]),
        ),
        environment.task,
    )
    assert waiting.idle_share == pytest.approx((1 + smooth.idle_share) / 2, abs=0.01)
    assert waiting.path_m == pytest.approx(smooth.path_m)
    shaken = trajectory.states.copy()
    joint = int(environment.sim.model._model.joint("robot0_joint1").qposadr[0])
    nq = environment.sim.model._model.nq
    for step in range(0, len(shaken), 2):
        State.of(shaken[step], nq).qpos[joint] += 0.01
    found = measure(replace(trajectory, states=shaken), environment.task)
    assert found.jerk_rms_m_s3 > 3 * smooth.jerk_rms_m_s3
    for side in (1, -1):
        bent = trajectory.states.copy()
        State.of(bent[3], nq).qpos[joint] = side * (2.8973 - 0.01)  # the Panda's first joint ends at 2.8973 rad
        assert measure(replace(trajectory, states=bent), environment.task).joint_margin_rad <= 0.01 + 1e-9


@pytest.mark.parametrize(
    ("suite", "name", "expected"),
    [
        ("libero_goal", BOWL.name, {"akita_black_bowl_1", "plate_1"}),
        ("libero_goal", "open_the_middle_drawer_of_the_cabinet", {"wooden_cabinet_1"}),
        ("libero_goal", "turn_on_the_stove", {"flat_stove_1"}),
        (
            "libero_10",
            "KITCHEN_SCENE4_put_the_black_bowl_in_the_bottom_drawer_of_the_cabinet_and_close_it",
            {"akita_black_bowl_1", "white_cabinet_1"},
        ),
    ],
)
def test_what_a_solution_may_move(suite: str, name: str, expected: set[str]) -> None:
    assert list_allowed_things(bddl.read(find_task(suite, name).bddl_file)) == expected


def test_an_object_in_a_drawer_moves_with_it() -> None:
    """LIBERO-90 has tasks that close a drawer with something in it."""
    task = find_task("libero_90", "KITCHEN_SCENE5_close_the_top_drawer_of_the_cabinet")
    known = bddl.read(task.bddl_file)
    inside = {name for name, place in known.places.items() if place == known.goal[0][1]}
    assert list_allowed_things(known) == {"white_cabinet_1", *inside}
