"""Replay: the same bytes whenever and wherever, the no-op rule, and verdicts with reasons."""

import hashlib
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from short_demonstrations import BOWL, MILK, STOVE

from pipeline.axes import Axes, PhysicsPerturbation
from pipeline.compute.pool import loop
from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.starts import NOOP_NORM, kept_actions
from pipeline.physics.environment import Environment, environment_of
from pipeline.physics.replay import judge, replay
from pipeline.planning import plan
from pipeline.run.replay_job import ReplayJob
from pipeline.run.replay_stage import Replays
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset.benchmark import TestSet
from pipeline.types import Demo, Floats, RollOut, Scene, Task, Trajectory, Verdict

ENTRIES = st.sampled_from([0.0, 0.0, 5e-5, 9e-5, 1.1e-4, 0.3])
"""Movement in one of six directions, around the limit of 1e-4; two directions of 9e-5 together are above it."""

ACTIONS = st.lists(
    st.tuples(st.tuples(*[ENTRIES] * 6), st.sampled_from([-1.0, 1.0])),
    min_size=1,
    max_size=30,
)


def actions_of(sampled: list[tuple[tuple[float, ...], float]]) -> Floats:
    return np.array([[*movement, gripper] for movement, gripper in sampled])


def openvla_is_noop(action: Floats, previous: Floats | None) -> bool:
    """The rule as OpenVLA states it: `experiments/robot/libero/regenerate_libero_dataset.py`, function is_noop."""
    if np.linalg.norm(action[:-1]) >= 1e-4:
        return False
    return previous is None or bool(action[-1] == previous[-1])


@given(ACTIONS)
def test_drop_is_openvla_rule(sampled: list[tuple[tuple[float, ...], float]]) -> None:
    actions = actions_of(sampled)
    expected, previous = [], None
    for action in actions:
        expected.append(not openvla_is_noop(action, previous))
        if expected[-1]:
            previous = action
    assert kept_actions(actions, "drop").tolist() == expected


@given(ACTIONS)
def test_policies_nest(sampled: list[tuple[tuple[float, ...], float]]) -> None:
    actions = actions_of(sampled)
    drop, trim, keep = (kept_actions(actions, policy) for policy in ("drop", "trim_ends", "keep"))
    assert (drop <= trim).all()
    assert (trim <= keep).all()
    assert keep.all()
    if drop.any():
        first, last = np.flatnonzero(drop)[[0, -1]]
        assert trim[first : last + 1].all()
        assert trim.sum() == last - first + 1
    assert NOOP_NORM == 1e-4


def replayed(root: Path, task: Task, environment: Environment, key: str = "demo_0") -> Trajectory:
    demo = HDF5Source(root).load(f"{task.suite}/{task.name}/{key}")
    return replay(environment, demo, "t", ReplayConfig(settle_steps=0))


def hashed(trajectory: Trajectory) -> str:
    parts = (trajectory.states, trajectory.actions, trajectory.site_alpha)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_same_bytes_first_or_tenth_and_in_a_fresh_process(short_demos: Path) -> None:
    environment = Environment(MILK)
    first = hashed(replayed(short_demos, MILK, environment))
    for _ in range(2):
        # The second demonstration closes the gripper and fails: what it leaves behind must not matter.
        assert replayed(short_demos, MILK, environment, "demo_1").verdict.reason == "goal_not_reached"
        assert hashed(replayed(short_demos, MILK, environment)) == first
    script = (
        "import sys; sys.path[:0] = sys.argv[1:3]\n"
        "from pathlib import Path; from test_replay import *\n"
        "print(hashed(replayed(Path(sys.argv[3]), MILK, Environment(MILK))))"
    )
    fresh = subprocess.run(
        [sys.executable, "-c", script, *map(str, Path(__file__).parents[:2]), str(short_demos)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert fresh.stdout.split()[-1] == first


def test_burner_does_not_stay_lit(short_demos: Path) -> None:
    environment = environment_of(STOVE)
    first = replayed(short_demos, STOVE, environment)
    lit = first.site_alpha[-1] != first.site_alpha[0]
    assert lit.sum() == 1, "the burner is the one site whose opacity changes"
    again = replayed(short_demos, STOVE, environment)
    assert np.array_equal(again.site_alpha, first.site_alpha)


def test_replay_starts_from_the_recorded_state_and_reaches_the_recorded_goal(
    short_demos: Path, whole: dict[Task, Trajectory]
) -> None:
    trajectory = replayed(short_demos, BOWL, Environment(BOWL))
    recorded = whole[BOWL].states[-len(trajectory.states)]
    assert np.array_equal(trajectory.states[0], recorded)
    assert trajectory.verdict.kept
    assert len(trajectory.states) == len(trajectory.actions) + 1
    control_step_s = np.diff(trajectory.states[:, 0])
    assert np.allclose(control_step_s, 1 / 20)


def test_a_demonstration_that_changed_since_the_plan_is_rejected(short_demos: Path, tmp_path: Path) -> None:
    root = tmp_path / "demos"
    shutil.copytree(short_demos / STOVE.suite, root / STOVE.suite)
    demos = DemosConfig(source="hdf5", root=root, tasks=(f"{STOVE.suite}/{STOVE.name}",))
    wanted = PlanConfig.model_validate({"seed": 7, "axes": {}, "episodes": {}})
    rows = plan.make(demos.index().entries, wanted, ReplayConfig(), TestSet(()))
    file = root / STOVE.suite / f"{STOVE.name}_demo.hdf5"
    with h5py.File(file, "r+") as opened:
        opened["data/demo_0/actions"][0, 0] += 0.01
    with pytest.raises(PipelineError, match=r"changed since the plan(?s:.*)which plans again") as caught:
        Replays(demos, ReplayConfig(), TrajectoryStore(tmp_path / "trajectories"), loop).complete(rows)
    assert f"{file} demo_0" in str(caught.value)
    assert not list(tmp_path.rglob("*.npz"))


class PathSeen(PhysicsPerturbation):
    """Changes nothing, and records the path that a perturbation is told of."""

    axis: Literal["path"] = "path"
    component: Literal["path"] = "path"

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        return replace(scene, resolved={"path": roll_out(scene, demo).tolist()})


@pytest.mark.parametrize("noops", ["drop", "trim_ends", "keep"])
def test_perturbations_keep_clear_of_the_path_that_is_replayed(
    short_demos: Path, noops: Literal["drop", "trim_ends", "keep"]
) -> None:
    demo = HDF5Source(short_demos).load(f"{STOVE.suite}/{STOVE.name}/demo_0")
    actions = demo.actions.copy()
    # Two pauses: at the start, where the gripper stays as it is, and on the way.
    actions[[0, 1, 5, 6], :6], actions[[0, 1, 5, 6], 6] = 0.0, actions[4, 6]
    demo = replace(demo, actions=actions)
    trajectory = replay(
        environment_of(STOVE), demo, "t", ReplayConfig(noops=noops, settle_steps=3), (PathSeen(level=1),)
    )
    assert len(trajectory.actions) == {"drop": 8, "trim_ends": 10, "keep": 12}[noops]
    assert np.array_equal(json.loads(trajectory.resolved)["path"], trajectory.states)


@pytest.mark.slow
def test_what_misses_once_settled_is_tracked_along_its_unsettled_replay(tmp_path: Path) -> None:
    """Of a starter demonstration no states are recorded that could be followed instead."""
    demos = DemosConfig(tasks=("libero_10/LIVING_ROOM_SCENE1_*",))
    wanted = PlanConfig(seed=0, axes=Axes(), episodes={})
    (twin,) = plan.make(demos.index().entries, wanted, ReplayConfig(), TestSet(()))
    job = ReplayJob(twin, twin.trajectory_id, demos, ReplayConfig(mode="open_loop"), tmp_path)
    assert job() == Verdict(False, "goal_not_reached")
    assert replace(job, replay_config=ReplayConfig(mode="auto"))() == Verdict(True, "kept")
    assert TrajectoryStore(tmp_path).load(twin.trajectory_id).mode == "tracked"


@pytest.mark.slow
def test_two_seeds_place_fixtures_differently_and_one_seed_always_the_same() -> None:
    environment = Environment(STOVE)
    np.random.seed(5)
    expected = np.random.random_sample(2)
    np.random.seed(5)
    assert np.random.random_sample() == expected[0]
    one, other, again = (environment.place_fixtures(seed) for seed in (1, 2, 1))
    assert one == again != other
    assert np.random.random_sample() == expected[1], "numpy's global generator is left as it was"


def test_the_state_of_another_scene_is_rejected(short_demos: Path, whole: dict[Task, Trajectory]) -> None:
    with pytest.raises(PipelineError, match="the recorded state has 79 numbers, the scene's has 110"):
        Environment(MILK).restore(Scene(whole[MILK].model_xml, whole[BOWL].states[0]))


@pytest.mark.parametrize(
    ("succeeded", "reason"),
    [
        ([False] * 10 + [True], "kept"),
        ([False] * 11, "goal_not_reached"),
        ([False] * 5 + [True] + [False] * 5, "goal_lost"),
        ([True] * 7, "too_short"),
    ],
)
def test_verdicts(succeeded: list[bool], reason: str) -> None:
    states = np.zeros((len(succeeded) + 1, 5))
    assert judge(states, np.array(succeeded)).reason == reason


def test_diverged_simulation_is_dropped() -> None:
    states = np.zeros((12, 5))
    states[5, 2] = np.nan
    assert judge(states, np.ones(11, bool)).reason == "simulation_unstable"
