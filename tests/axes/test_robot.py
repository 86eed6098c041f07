"""Robot: offsets of the stated size, clear of the benchmark's, that change the arm's start and nothing else."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from short_demonstrations import MILK, PLATE, starter_demo

from pipeline.axes.report_data import BENCHMARK, Histogram, Strips
from pipeline.axes.robot import RobotAxis, RobotPerturbation, benchmark_offsets_rad
from pipeline.config import ReplayConfig
from pipeline.errors import RejectedError
from pipeline.evaluation.tasks import libero_states
from pipeline.libero.assets import relocate
from pipeline.libero.starts import HOME_RAD, recorded_start
from pipeline.physics.control_env import seeded
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay, roll_out
from pipeline.scenes.compiled import CompiledScene
from pipeline.seeding import rng
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Floats, Scene

TEST = TestSet(
    tuple(TestTask("libero_goal", "base", f"base_{n}", "robot", "initial_joints", {"id": n}) for n in (1, 101, 450))
)
PUBLISHED_RAD = {
    1: (0.02097405, -0.16687568, 0.02734903, -2.38028663, -0.00988726, 2.21686563, 0.85208136),
    500: (-0.11827633, -0.04802337, 0.42756544, -2.2644154, -0.01062499, 2.18628575, 0.7065925),
}
"""Arm postures of the benchmark's classes MountedPanda1 and MountedPanda500."""


def turned(*offsets: float) -> RobotPerturbation:
    return RobotPerturbation.model_validate({"component": "initial_joints", "level": 1, "joint_offsets_rad": offsets})


def sample_many(axis: RobotAxis, count: int) -> list[RobotPerturbation]:
    return [axis.sample(rng(1, "robot", "demo", variant), MILK, variant) for variant in range(count)]


@pytest.fixture(scope="module")
def environment() -> Environment:
    return Environment(PLATE)


@pytest.fixture(scope="module")
def scene(environment: Environment) -> Scene:
    return Scene(environment.place_fixtures(4), starter_demo(PLATE).init_state)


def test_perturbations_depend_on_their_key_and_are_as_large_as_their_level() -> None:
    perturbations = sample_many(RobotAxis(), 500)
    assert perturbations == sample_many(RobotAxis(), 500)
    assert {p.level for p in perturbations} == {1, 2, 3, 4, 5}
    for p in perturbations:
        # The arm is put nearer than the controller pulls it: there it is at rest, and not on its way.
        norm_rad = 0.1 * p.level if p.component == "controller_posture" else 0.02 + 0.04 * p.level
        assert np.linalg.norm(p.joint_offsets_rad) == pytest.approx(norm_rad, abs=3e-6)
    assert RobotPerturbation.model_validate_json(perturbations[0].model_dump_json()) == perturbations[0]


def test_three_of_four_are_what_the_benchmark_does_and_options_choose_otherwise() -> None:
    shares = {p.component: 0.0 for p in sample_many(RobotAxis(), 2000)}
    for p in sample_many(RobotAxis(), 2000):
        shares[p.component] += 1 / 2000
    assert shares == pytest.approx({"controller_posture": 0.75, "initial_joints": 0.25}, abs=0.03)
    wider = RobotAxis(components=("initial_joints",), initial_norm_rad=(0.1, 0.2, 0.3, 0.4, 0.5), levels=(5,))
    assert {p.component for p in sample_many(wider, 20)} == {"initial_joints"}
    assert np.linalg.norm(sample_many(wider, 1)[0].joint_offsets_rad) == pytest.approx(0.5, abs=3e-6)


@pytest.mark.slow
def test_nine_of_ten_initial_joints_start_within_10_cm(environment: Environment) -> None:
    """Of one scene, by MuJoCo's own kinematics; docs/axes.md has the distances in all 40 tasks."""
    start = recorded_start(starter_demo(PLATE), environment.place_fixtures(4))
    environment.restore(start)
    environment.settle(10)
    unchanged_m = environment.hand[0]
    away_m: dict[int, list[float]] = {level: [] for level in (1, 2, 3, 4, 5)}
    axis = RobotAxis(components=("initial_joints",))
    for p in sample_many(axis, 40):
        with suppress(RejectedError):
            environment.restore(p.apply(start, starter_demo(PLATE), roll_out))
            environment.settle(10)
            away_m[p.level].append(float(np.linalg.norm(environment.hand[0] - unchanged_m)))
    assert sum(map(len, away_m.values())) >= 35
    assert np.mean(np.concatenate(list(away_m.values())) < 0.10) >= 0.9
    medians = [np.median(away_m[level]) for level in sorted(away_m)]
    assert medians == sorted(medians)


def test_no_direction_is_preferred() -> None:
    norms_rad = {"controller_posture": RobotAxis().norm_rad, "initial_joints": RobotAxis().initial_norm_rad}
    perturbations = sample_many(RobotAxis(), 3000)
    directions = np.array([np.array(p.joint_offsets_rad) / norms_rad[p.component][p.level - 1] for p in perturbations])
    assert np.abs(directions.mean(axis=0)).max() < 0.04
    assert np.allclose(np.cov(directions.T), np.eye(7) / 7, atol=0.02)


def test_the_benchmarks_offsets_are_reproduced() -> None:
    for number, posture in PUBLISHED_RAD.items():
        assert np.allclose(HOME_RAD + benchmark_offsets_rad()[number - 1], posture, rtol=0, atol=1e-8)


def test_every_test_offset_is_found_and_perturbations_keep_their_clearance() -> None:
    for offsets in benchmark_offsets_rad():
        near = turned(*offsets).nearest(TEST, PLATE)
        assert near.distance < 1e-12
        assert near.compared == 3
    clear = [p.nearest(TEST, PLATE).distance >= p.clearance for p in sample_many(RobotAxis(), 1000)]
    assert np.mean(clear) > 0.99
    assert turned(*[0.1] * 7).nearest(TestSet(()), PLATE) == (np.inf, 0)


def test_distances_and_plots_belong_to_the_test_with_the_offset() -> None:
    """The benchmark counts its classes from 1: test 1 has the posture of MountedPanda1."""
    published = np.array(PUBLISHED_RAD[1]) - HOME_RAD
    distances = turned(*published).distances(TEST, PLATE)
    assert (distances < 1e-7).tolist() == [True, False, False]
    norms, joints = RobotAxis.describe_coverage([], TEST).plots
    assert isinstance(norms, Histogram)
    assert isinstance(joints, Strips)
    assert norms.groups[BENCHMARK] == pytest.approx([0.1, 0.2, 0.5])
    for values, offset in zip(joints.rows.values(), published, strict=True):
        assert np.abs(values[BENCHMARK] - offset).min() < 1e-7


def test_only_the_arm_changes(scene: Scene) -> None:
    perturbation = RobotAxis(levels=(3,), components=("initial_joints",)).sample(rng("some"), PLATE, 0)
    moved = perturbation.apply(scene, starter_demo(PLATE), roll_out)
    assert moved.model_xml == scene.model_xml
    compiled = CompiledScene(scene)
    arm = [1 + compiled.model.joint(f"robot0_joint{n}").qposadr[0] for n in range(1, 8)]
    speeds = [1 + compiled.model.nq + compiled.model.joint(f"robot0_joint{n}").dofadr[0] for n in range(1, 8)]
    expected = scene.state.copy()
    expected[arm] += perturbation.joint_offsets_rad
    expected[speeds] = 0.0
    assert np.array_equal(moved.state, expected)
    assert moved.resolved == {"robot": {"joints_rad": expected[arm].tolist()}}


def recorded_rad(scene: Scene) -> Floats:
    compiled = CompiledScene(scene)
    return np.array([compiled.data.joint(f"robot0_joint{n}").qpos[0] for n in range(1, 8)])


def test_impossible_perturbations_are_rejected(scene: Scene) -> None:
    demo = starter_demo(PLATE)
    start = recorded_rad(scene)
    # The Panda's last joint ends at 2.8973 rad on both sides.
    for reason, offsets in (
        ("joint_limit", (0, 0, 0, 0, 0, 0, 2.8973 - 0.03 - start[6])),
        ("joint_limit", (0, 0, 0, 0, 0, 0, -2.8973 + 0.03 - start[6])),
        ("robot_in_collision", (0, 0.9, 0, 0, 0, 0, 0)),
        ("test_posture", HOME_RAD + benchmark_offsets_rad()[99] - start),
    ):
        with pytest.raises(RejectedError, match=reason):
            turned(*offsets).apply(scene, demo, roll_out)


def pulled_away(libero: Environment, posture_rad: Floats) -> tuple[Floats, Floats, Floats]:
    """What LIBERO's own environment does where its reset has another posture, an initial state is put in and settles.

    Returns:
        The posture (7,) that the reset came to with its noise, and states (S,) before and after settling.
    """
    env = libero._env
    env.env.robot_configs[0]["initial_qpos"] = posture_rad
    with seeded(3):
        env.reset()
    reached = env.sim.data.qpos[env.env.robots[0]._ref_joint_pos_indexes].copy()
    env.set_init_state(libero_states(PLATE)[0])
    before = libero.state
    for _ in range(10):
        env.step([0.0] * 6 + [-1.0])
    return reached, before, libero.state


@pytest.mark.slow
def test_a_controllers_posture_pulls_the_arm_as_in_the_benchmark() -> None:
    """The benchmark's robot tasks change the posture of LIBERO's reset, and put an initial state in after it."""
    libero = Environment(PLATE)
    offset = np.array([0.2, -0.1, 0.15, 0.2, -0.25, 0.1, 0.2])
    posture_rad, before, expected = pulled_away(libero, HOME_RAD + offset)
    model_xml = libero.sim.model.get_xml()
    start_rad = before[1:8]
    assert np.linalg.norm(start_rad - HOME_RAD) < 0.15, "the state puts the arm back"
    ours = Environment(PLATE)
    change = RobotPerturbation(
        component="controller_posture", level=5, joint_offsets_rad=tuple((posture_rad - HOME_RAD).tolist())
    )
    recorded = recorded_start(replace(starter_demo(PLATE), init_state=before), relocate(model_xml, "LIBERO"))
    without_command = replace(recorded, start=replace(recorded.start, gripper=0.0))
    scene = change.apply(without_command, starter_demo(PLATE), roll_out)
    assert np.array_equal(scene.state, before)
    ours.restore(scene)
    ours.settle(10)
    assert np.abs(expected[1:8] - start_rad).max() > 0.1, "the arm is pulled away"
    assert np.allclose(ours.state, expected, rtol=0, atol=1e-5)
    goal = ours._env.env.robots[0].controller.goal_ori
    assert np.allclose(goal, libero._env.env.robots[0].controller.goal_ori, rtol=0, atol=1e-6)
    w, *xyz = scene.resolved["robot"]["goal_wxyz"]
    assert np.allclose(goal, Rotation.from_quat([*xyz, w]).as_matrix(), rtol=0, atol=1e-8)
    assert np.allclose(scene.resolved["robot"]["posture_rad"], posture_rad, rtol=0, atol=1e-9)
    libero.close()
    ours.close()


def test_the_replay_starts_there(environment: Environment) -> None:
    """Unlike the benchmark's own offsets, which the state that is put in undoes."""
    demo = starter_demo(PLATE)
    short = replace(demo, actions=demo.actions[:3])
    perturbation = RobotAxis(levels=(5,), components=("initial_joints",)).sample(rng("another"), PLATE, 0)
    clean, moved = (replay(environment, short, "t", ReplayConfig(), changes) for changes in ((), (perturbation,)))
    starts = [recorded_rad(t.scene) for t in (clean, moved)]
    assert np.allclose(starts[1] - starts[0], perturbation.joint_offsets_rad, rtol=0, atol=1e-9)
    looks = [recorded_rad(Scene(t.model_xml, t.states[0])) for t in (clean, moved)]
    assert np.linalg.norm(looks[1] - starts[1]) < 0.02, "it stays there while the scene settles"
    assert len(moved.states) == len(clean.states)
