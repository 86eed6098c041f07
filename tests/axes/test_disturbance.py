"""Disturbance: pushes of the stated size, away from grasps, from which a tracked replay comes back to its goal."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_demonstrations import BOWL, starter_demo

from pipeline.axes import Axes
from pipeline.axes.disturbance import DisturbanceAxis, DisturbancePerturbation
from pipeline.axes.robot import RobotPerturbation
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.errors import RejectedError
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.selection import Selection, select
from pipeline.libero.starts import recorded_start
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay, roll_out
from pipeline.planning import plan
from pipeline.run.replay_job import ReplayJob
from pipeline.scenes.compiled import CompiledScene
from pipeline.seeding import rng
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Scene, Task, Trajectory, Verdict

DEMO = starter_demo(BOWL)
SCENE = recorded_start(DEMO, "")


def sample_many(axis: DisturbanceAxis, count: int) -> list[DisturbancePerturbation]:
    return [axis.sample(rng(1, "disturbance", variant), BOWL, variant) for variant in range(count)]


def pushed_at(first_step: int, force_n: float = 50.0, away_steps: int = 5) -> DisturbancePerturbation:
    """To the left of the robot for 0.2 s."""
    return DisturbancePerturbation.model_validate(
        {
            "level": 3,
            "body": "robot0_right_hand",
            "wrench": (0.0, force_n, 0.0, 0.0, 0.0, 0.0),
            "first_step": first_step,
            "steps": 4,
            "away_steps": away_steps,
        }
    )


def test_perturbations_depend_on_their_key_and_are_as_strong_as_their_level() -> None:
    perturbations = sample_many(DisturbanceAxis(), 500)
    assert perturbations == sample_many(DisturbanceAxis(), 500)
    assert {one.level for one in perturbations} == {1, 2, 3, 4, 5}
    assert {one.steps for one in perturbations} == {2, 3, 4, 5, 6, 7, 8}
    for one in perturbations:
        assert np.linalg.norm(one.wrench[:3]) * one.steps * 0.05 == pytest.approx(1 + 3 * one.level, abs=1e-3)
        assert abs(one.wrench[2]) <= np.linalg.norm(one.wrench[:3]) / 2 + 1e-3
        assert DisturbancePerturbation.model_validate_json(one.model_dump_json()) == one
    pushes = np.array([one.wrench[:3] for one in perturbations])
    directions = pushes / np.linalg.norm(pushes, axis=1, keepdims=True)
    assert np.abs(directions.mean(axis=0)).max() < 0.1, "from no side more often"


def rejection(change: DisturbancePerturbation) -> str | None:
    try:
        change.apply(SCENE, DEMO, roll_out)
    except RejectedError as error:
        return error.reason
    return None


def test_a_push_at_a_grasp_or_after_the_end_is_rejected() -> None:
    # The demonstration closes the gripper in its action 32, opens it in action 76, and has 90.
    rejected = {step: reason for step in range(100) if (reason := rejection(pushed_at(step)))}
    at_grasp, after_end = [*range(24, 38), *range(68, 82)], [*range(82, 100)]
    assert rejected == dict.fromkeys(at_grasp, "push_at_grasp") | dict.fromkeys(after_end, "push_after_end")
    assert rejection(pushed_at(28, away_steps=0)) is None


def test_pushes_that_begin_at_the_same_step_are_apart_by_their_impulse() -> None:
    one, stronger, later = pushed_at(8, 20), pushed_at(8, 60), pushed_at(9, 20)
    apart = one.distances_to([one, stronger, later])
    assert apart[:2] == pytest.approx([0.0, 8.0])
    assert np.isnan(apart[2])


@pytest.fixture(scope="module")
def environment() -> Iterator[Environment]:
    opened = Environment(BOWL)
    yield opened
    opened.close()


def replayed(environment: Environment, twin: Trajectory, change: DisturbancePerturbation) -> Trajectory:
    reference = Reference.of(twin.model_xml, twin.states, twin.actions)
    return replay(environment, DEMO, "pushed", ReplayConfig(), [change], lambda: reference)


def hands_m(trajectory: Trajectory, steps: range) -> Floats:
    """(N, 3) positions of the hand before each of some steps."""
    compiled = CompiledScene(Scene(trajectory.model_xml, trajectory.states[0]))
    positions = []
    for step in steps:
        compiled.restore(trajectory.states[step])
        positions.append(compiled.data.site("gripper0_grip_site").xpos.copy())
    return np.array(positions)


@pytest.mark.slow
def test_recorded_actions_that_a_push_does_not_stop_are_dropped(tmp_path: Path) -> None:
    """They reach the goal and show nothing of how to work against it."""
    demos = DemosConfig(tasks=(f"{BOWL.suite}/{BOWL.name}",))
    weak = PlanConfig(seed=0, axes=Axes(disturbance=DisturbanceAxis(levels=(1,))), episodes={"disturbance": 1})
    rows = plan.make(demos.index().entries, weak, ReplayConfig(), TestSet(()))
    row = next(row for row in rows if row.axis == "disturbance")
    job = ReplayJob(row, row.trajectory_id, demos, ReplayConfig(mode="open_loop"), tmp_path)
    assert job() == Verdict(False, "no_reference")


@pytest.mark.parametrize("first_step", [12, 50])
def test_the_hand_is_pushed_off_and_comes_back_to_the_goal(
    first_step: int, environment: Environment, whole: dict[Task, Trajectory], tmp_path: Path
) -> None:
    twin = whole[BOWL]
    # The impulses of levels 1 and 5.
    farthest_m = []
    for force_n in (20.0, 80.0):
        kept = replayed(environment, twin, pushed_at(first_step, force_n))
        assert kept.verdict.kept
        assert kept.mode == "tracked"
        # Tracking differs from the open-loop twin by little before the push.
        steps = range(first_step, first_step + 12)
        away_m = np.linalg.norm(hands_m(kept, steps) - hands_m(twin, steps), axis=1)
        assert away_m[0] < 0.003
        farthest_m.append(away_m.max())
        changed = kept.actions[first_step + 1 : first_step + 12, 1]
        assert changed.min() < twin.actions[first_step + 1 : first_step + 12, 1].min(), "it works against the push"
    assert 0.004 < farthest_m[0] < 0.02
    assert 0.02 < farthest_m[1] < 0.1
    # What is stored is what was done.
    store = TrajectoryStore(tmp_path)
    store.save(kept)
    loaded = store.load("pushed")
    assert loaded.scene.start.push == kept.scene.start.push
    assert loaded.scene.resolved["disturbance"]["first_step"] == first_step
    assert np.array_equal(replayed(environment, twin, pushed_at(first_step, 80.0)).states, loaded.states)


def test_a_push_that_comes_at_a_grasp_because_the_replay_waited_is_dropped(
    environment: Environment, whole: dict[Task, Trajectory]
) -> None:
    """The demonstration closes the gripper in action 32. From this start the route waits, and closes it in action 35: 2
    steps lie between it and the push, which begins in step 38."""
    offsets_rad = (0.051364, -0.339128, -0.187123, -0.075247, 0.220818, 0.195144, -0.069536)
    start = RobotPerturbation(component="initial_joints", level=5, joint_offsets_rad=offsets_rad)
    twin = whole[BOWL]
    reference = Reference.of(twin.model_xml, twin.states, twin.actions)
    verdicts = {}
    for away_steps in (2, 3, 5):
        push = pushed_at(38, 20.0, away_steps)
        pushed = replay(environment, DEMO, "pushed", ReplayConfig(), [start, push], lambda: reference)
        assert np.flatnonzero(np.diff(pushed.actions[:, 6]) > 0) + 1 == 35
        verdicts[away_steps] = pushed.verdict.reason
    assert verdicts == {2: "kept", 3: "push_at_grasp", 5: "push_at_grasp"}


@pytest.mark.slow
def test_liberos_own_environment_does_the_same_under_the_same_wrench(
    environment: Environment, whole: dict[Task, Trajectory]
) -> None:
    from repeat_in_libero import opened, put_in

    kept = replayed(environment, whole[BOWL], pushed_at(12, 80.0))
    libero: Any = opened(BOWL)
    put_in(libero, kept.scene)
    for _ in range(10):
        libero.step([0.0] * 6 + [-1.0])
    hand = libero.sim.model.body_name2id("robot0_right_hand")
    for step, action in enumerate(kept.actions):
        libero.sim.data.xfrc_applied[hand] = (0.0, 80.0 if 12 <= step < 16 else 0.0, 0.0, 0.0, 0.0, 0.0)
        libero.step(action)
        assert np.array_equal(libero.get_sim_state(), kept.states[step + 1]), step
    libero.close()


@pytest.mark.slow
def test_held_out_perturbations_push_a_policy_once_and_the_result_says_how(tmp_path: Path) -> None:
    chosen = Selection(source="own", suites=(BOWL.suite,), tasks=(BOWL.name,), axes=("disturbance",), levels=(5,))
    (task, *_) = select(chosen)
    evaluated = EpisodeEnvironment()
    evaluated.reset(task)
    (push,) = evaluated.episode.perturbations
    assert isinstance(push, DisturbancePerturbation)
    positions = []
    for _ in range(push.first_step + push.steps + 5):
        evaluated.step([0.0] * 6 + [-1.0])
        positions.append(evaluated.simulator.observed.state[:3])
    policy = PolicyConfig(kind="open_loop")
    evaluation = Evaluation(evaluated.settings, policy, policy.identity(), tmp_path)
    evaluation.save(evaluated, Wanted())
    evaluated.close()
    (row,) = evaluation.files.rows()
    assert row.perturbations == [push.model_dump(mode="json")]
    away_m = np.linalg.norm(np.array(positions) - positions[push.first_step - 1], axis=1)
    assert away_m[: push.first_step].max() < 0.003, "at rest"
    assert away_m.max() > 0.02
