"""Tracked replay: routes through moved things, actions that a policy could have sent, and goals reached from afar."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from short_demonstrations import BOWL, MILK, STOVE, starter_demo

from pipeline.axes.base import PhysicsPerturbation
from pipeline.axes.pose import PosePerturbation
from pipeline.axes.robot import RobotAxis
from pipeline.config import ReplayConfig
from pipeline.errors import RejectedError
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Mask, Reference
from pipeline.physics.replay import replay
from pipeline.physics.tracking import GAIN, PATIENCE, STRIDE, Hand, Route, follow
from pipeline.seeding import rng
from pipeline.types import Demo, Floats, Task, Trajectory

AUTO = ReplayConfig(mode="auto")


def reference_of(trajectory: Trajectory) -> Reference:
    return Reference.of(trajectory.model_xml, trajectory.states, trajectory.actions)


@pytest.fixture(scope="module")
def milk(whole: dict[Task, Trajectory]) -> Reference:
    return reference_of(whole[MILK])


def start_of(reference: Reference) -> Hand:
    return reference.positions_m[0], reference.rotations[0]


def poses_of(reference: Reference, **moved: Floats) -> dict[str, Floats]:
    return {name: poses[0] for name, poses in reference.poses.items()} | moved


def nowhere(name: str) -> Floats:
    """The pose of what is not in the hand."""
    return np.full(7, 9.0)


def displaced(pose: Floats, dx_m: float, dy_m: float, yaw_rad: float) -> Floats:
    turned = Rotation.from_euler("z", yaw_rad) * Rotation.from_quat(pose[[4, 5, 6, 3]])
    return np.concatenate([pose[:3] + np.array([dx_m, dy_m, 0.0]), turned.as_quat()[[3, 0, 1, 2]]])


def test_the_reference_tells_grasp_carrying_and_release(milk: Reference) -> None:
    """The human closes the gripper on the milk, carries it over to the basket and opens the gripper there."""
    carried = np.flatnonzero(milk.carried["milk_1"])
    closes, opens = (np.flatnonzero(np.diff(milk.actions[:, 6]) == sign * 2)[0] for sign in (1, -1))
    assert closes < carried[0] < carried[-1] <= opens + 6
    assert not milk.busy[: closes - 10].any(), "nothing is touched on the way there"
    assert np.flatnonzero(milk.met["basket_1"])[0] > carried[0], "the basket is met with the milk in hand"
    others = set(milk.poses) - {"milk_1", "basket_1"}
    assert not any(milk.held[name].any() for name in others)


def test_an_unchanged_scene_leaves_the_reference_and_its_actions_as_they_are(milk: Reference) -> None:
    route = Route.through(milk, start_of(milk), poses_of(milk))
    assert np.allclose(route.positions_m, milk.positions_m, rtol=0, atol=1e-12)
    places = iter(range(len(milk)))
    actions = np.array(list(follow(route, lambda: route.at(next(places)), nowhere)))
    assert np.allclose(actions, milk.actions, rtol=0, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.35, 0.35))
def test_the_moved_object_is_grasped_as_the_human_did_and_put_where_the_human_did(
    milk: Reference, dx_m: float, dy_m: float, yaw_rad: float
) -> None:
    pose = displaced(milk.poses["milk_1"][0], dx_m, dy_m, yaw_rad)
    route = Route.through(milk, start_of(milk), poses_of(milk, milk_1=pose))
    carried = np.flatnonzero(milk.carried["milk_1"])
    grasp, release = int(carried[0]), int(np.flatnonzero(milk.held["milk_1"])[-1])

    def in_object(position: Floats, rotation: Rotation, pose: Floats) -> tuple[Floats, Floats]:
        frame = Rotation.from_quat(pose[[4, 5, 6, 3]]).inv()
        return frame.apply(position - pose[:3]), (frame * rotation).as_matrix()

    then = in_object(milk.positions_m[grasp], milk.rotations[grasp], milk.poses["milk_1"][0])
    now = in_object(route.positions_m[grasp], route.rotations[grasp], pose)
    # A displacement of less than 0.1 mm and 1 mrad is none.
    assert np.allclose(now[0], then[0], rtol=0, atol=2e-4)
    assert np.allclose(now[1], then[1], rtol=0, atol=2e-3)
    assert np.allclose(route.positions_m[release:], milk.positions_m[release:], rtol=0, atol=1e-12)
    assert np.allclose(route.positions_m[0], milk.positions_m[0], rtol=0, atol=1e-12)


def test_a_moved_basket_is_where_the_milk_is_let_go(milk: Reference) -> None:
    shift = np.array([0.03, -0.04, 0.0])
    pose = displaced(milk.poses["basket_1"][0], shift[0], shift[1], 0.0)
    route = Route.through(milk, start_of(milk), poses_of(milk, basket_1=pose))
    grasp, release = np.flatnonzero(milk.carried["milk_1"])[0], np.flatnonzero(milk.held["milk_1"])[-1]
    assert np.allclose(route.positions_m[: grasp + 1], milk.positions_m[: grasp + 1], rtol=0, atol=1e-12)
    assert np.allclose(route.positions_m[release], milk.positions_m[release] + shift, rtol=0, atol=1e-9)


def during(*runs: tuple[int, int]) -> Mask:
    """Return a mask (101,) that is True from the first to the last step of each run."""
    return np.array([any(first <= step <= last for first, last in runs) for step in range(101)])


def one_after_the_other() -> Reference:
    """A hand that puts a mug on a plate, rests on the table, and then takes a cup to a region."""
    steps = np.arange(101)

    def carried_over(first: int, last: int) -> Floats:
        poses = np.tile([0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0], (101, 1))
        poses[:, 1] = 0.3 * np.clip((steps - first) / (last - first), 0, 1)
        return poses

    contacts, never = during((10, 11), (40, 41), (70, 71), (94, 95)), np.zeros(101, bool)
    return Reference(
        positions_m=np.zeros((101, 3)),
        rotations=Rotation.from_rotvec(np.zeros((101, 3))),
        actions=np.zeros((100, 7)),
        busy=contacts | during((60, 64)),
        engaged=contacts,
        held={"mug_1": during((10, 45)), "cup_1": during((70, 95)), "plate_1": never},
        carried={"mug_1": during((12, 39)), "cup_1": during((72, 93)), "plate_1": never},
        met={"mug_1": never, "cup_1": never, "plate_1": during((40, 45)), "region": during((94, 95))},
        poses={"mug_1": carried_over(12, 40), "cup_1": carried_over(72, 94), "plate_1": carried_over(0, 1) * 0 + 0.5},
        places={"region": np.array([0.0, 0.3, 0.5, 1.0, 0.0, 0.0, 0.0])},
    )


def bend(reference: Reference | None = None, /, **shifts: float) -> Floats:
    """(K+1,) m by which the route is moved along x when things are, by default through ``one_after_the_other``."""
    reference = reference or one_after_the_other()
    poses = {name: reference.poses[name][0].copy() for name in reference.poses} | {
        name: pose.copy() for name, pose in reference.places.items()
    }
    for name, shift in shifts.items():
        poses[name][0] += shift
    moved: Floats = Route.through(reference, start_of(reference), poses).positions_m[:, 0]
    return moved


def test_each_thing_is_followed_while_it_is_the_one_that_counts() -> None:
    assert bend(mug_1=0.04)[[0, 6, 12, 36]] == pytest.approx([0, 0.04, 0.04, 0], abs=1e-9)
    assert bend(plate_1=0.04)[[11, 36, 45]] == pytest.approx([0, 0.04, 0.04], abs=1e-9)
    # Not before the mug is let go; and that the hand rests on the table between them does not hold it up.
    cup = bend(cup_1=0.04)
    assert cup[[45, 66, 71, 91]] == pytest.approx([0, 0.04, 0.04, 0], abs=1e-9)
    assert np.abs(np.diff(cup[46:66])).max() < 0.004
    assert bend(region=0.04)[[69, 71, 95]] == pytest.approx([0, 0, 0.04], abs=1e-4)


def test_what_moves_alike_is_followed_once() -> None:
    """And where things move apart, one counts at a time."""
    both = bend(mug_1=0.04, plate_1=0.04)
    assert both[6:46] == pytest.approx(0.04, abs=0.012)
    assert both.max() <= 0.04 + 1e-9
    apart = bend(mug_1=0.04, plate_1=-0.02, cup_1=0.03, region=-0.04)
    assert apart[[6, 12, 36, 45, 66, 71, 95]] == pytest.approx([0.04, 0.04, -0.02, -0.02, 0.03, 0.03, -0.04], abs=1e-4)


def test_an_object_that_is_grasped_twice_is_followed_until_it_is_first_carried_off() -> None:
    reference = one_after_the_other()
    twice = replace(reference, carried={**reference.carried, "mug_1": during((12, 20), (32, 39))})
    assert bend(twice, mug_1=0.04)[[6, 12, 16, 32]] == pytest.approx([0.04, 0.04, 0, 0], abs=1e-9)


def test_a_place_is_no_longer_followed_shortly_before_the_next_contact() -> None:
    """The cup is touched at step 70."""
    assert bend(plate_1=0.04)[[45, 66, 71]] == pytest.approx([0.04, 0, 0], abs=1e-9)


def test_a_place_that_an_object_is_pushed_to_is_followed_from_the_start_of_the_push() -> None:
    """The cup is pushed along the table from step 20 on, and reaches the region at step 60."""
    pushed, never = during((20, 65)), during()
    pose = one_after_the_other().poses["cup_1"]
    reference = replace(
        one_after_the_other(),
        busy=pushed,
        engaged=pushed,
        held={"cup_1": pushed},
        carried={"cup_1": never},
        met={"cup_1": never, "region": during((60, 65))},
        poses={"cup_1": pose},
    )
    route = bend(reference, region=0.04)
    assert route[[20, 56, 65]] == pytest.approx([0, 0.04, 0.04], abs=1e-9)
    assert np.diff(route).max() < 0.003, "evenly over the 36 steps, and not at the end of the push"


def test_of_two_things_met_at_once_the_longer_met_is_followed() -> None:
    reference, never = one_after_the_other(), during()
    tray = {"tray_1": reference.poses["plate_1"]}
    both = replace(
        reference,
        held={"tray_1": never, **reference.held},
        carried={"tray_1": never, **reference.carried},
        met={"tray_1": during((40, 42)), **reference.met},
        poses={**tray, **reference.poses},
    )
    assert bend(both, tray_1=-0.04)[42] == pytest.approx(-0.04, abs=1e-9)
    assert bend(both, tray_1=-0.04, plate_1=0.03)[42] == pytest.approx(0.03, abs=1e-9)


def test_a_thing_that_the_hand_moves_comes_before_a_thing_that_it_meets_for_longer() -> None:
    reference = one_after_the_other()
    both = replace(reference, met={**reference.met, "plate_1": during((10, 45))})
    assert bend(both, mug_1=0.04, plate_1=-0.02)[[12, 36]] == pytest.approx([0.04, -0.02], abs=1e-9)


def tilted(pose: Floats, angle_rad: float) -> Floats:
    tilt = Rotation.from_euler("x", angle_rad)
    return np.append(pose[:3], (tilt * Rotation.from_quat(pose[3:], scalar_first=True)).as_quat(scalar_first=True))


def test_an_object_that_fell_over_is_rejected_where_the_hand_meets_it(milk: Reference) -> None:
    poses = {name: poses[0] for name, poses in milk.poses.items()}
    with pytest.raises(RejectedError, match="object_not_upright"):
        Route.through(milk, start_of(milk), poses | {"milk_1": tilted(poses["milk_1"], 0.5)})
    Route.through(milk, start_of(milk), poses | {"milk_1": tilted(poses["milk_1"], 0.1)})
    untouched = next(name for name in poses if not milk.held[name].any() and not milk.met[name].any())
    route = Route.through(milk, start_of(milk), poses | {untouched: tilted(poses[untouched], 0.5)})
    assert np.array_equal(route.positions_m, milk.positions_m)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-0.25, 0.25)] * 3), st.tuples(*[st.floats(-0.4, 0.4)] * 3))
def test_a_hand_that_starts_elsewhere_joins_the_demonstration_before_it_touches_anything(
    milk: Reference, shift_m: tuple[float, ...], turn_rad: tuple[float, ...]
) -> None:
    """With an ideal hand, which moves by one stride under an action of 1."""
    position, rotation = start_of(milk)
    been: list[Hand] = [(position + shift_m, Rotation.from_rotvec(turn_rad) * rotation)]
    route = Route.through(milk, been[0], poses_of(milk))
    actions = []
    for action in follow(route, lambda: been[-1], nowhere):
        assert (np.abs(action) <= 1).all()
        position, rotation = been[-1]
        been.append((position + STRIDE[:3] * action[:3], Rotation.from_rotvec(STRIDE[3:] * action[3:6]) * rotation))
        actions.append(action)
    assert len(milk) <= len(actions) <= len(milk) + PATIENCE + 1
    contact = int(np.flatnonzero(milk.busy)[0])
    assert np.allclose(route.positions_m[contact - 4 :], milk.positions_m[contact - 4 :], rtol=0, atol=1e-9)
    gripper = np.array(actions)[:, 6]
    assert np.diff(gripper).nonzero()[0].size == np.diff(milk.actions[:, 6]).nonzero()[0].size, "grasps once, as shown"


@pytest.mark.parametrize("slip_m", [(0.02, 0.0, 0.0), (0.0, -0.02, 0.01), (-0.02, 0.02, -0.02)])
def test_what_was_grasped_otherwise_is_carried_to_where_it_was(milk: Reference, slip_m: tuple[float, ...]) -> None:
    """With an ideal hand, and the milk fixed in it at another place than in the human's."""
    carried = np.flatnonzero(milk.carried["milk_1"])
    middle = carried[len(carried) // 2]
    lay = milk.rotations[middle].inv().apply(milk.poses["milk_1"][middle, :3] - milk.positions_m[middle])
    been: list[Hand] = [start_of(milk)]

    def pose(name: str) -> Floats:
        position, rotation = been[-1]
        return np.concatenate([position + rotation.apply(lay + slip_m), np.zeros(4)])

    for action in follow(Route.through(milk, been[0], poses_of(milk)), lambda: been[-1], pose):
        position, rotation = been[-1]
        been.append((position + STRIDE[:3] * action[:3], Rotation.from_rotvec(STRIDE[3:] * action[3:6]) * rotation))
    off = been[carried[-1]][0] + been[carried[-1]][1].apply(lay + slip_m) - milk.poses["milk_1"][carried[-1], :3]
    assert np.linalg.norm(off) < 0.3 * np.linalg.norm(slip_m)


def test_a_hand_that_is_stuck_does_not_wait_for_ever(milk: Reference) -> None:
    route = Route.through(milk, start_of(milk), poses_of(milk))
    actions = list(follow(route, lambda: start_of(milk), nowhere))
    assert len(actions) <= len(milk) + PATIENCE + 1
    assert 0 < GAIN <= 1, "beyond 1 the loop overshoots"


CHANGES: dict[Task, PhysicsPerturbation] = {
    STOVE: RobotAxis(levels=(3,), components=("initial_joints",), initial_norm_rad=(0.1, 0.2, 0.3, 0.4, 0.5)).sample(
        rng("tracking", 0), STOVE, 0
    ),
    MILK: PosePerturbation(component="target", level=3, moved="milk_1", dx_m=0.03, dy_m=-0.03, dyaw_deg=12.0),
}


@pytest.mark.parametrize("task", list(CHANGES), ids=lambda task: task.name)
def test_tracking_reaches_what_open_loop_misses(task: Task, whole: dict[Task, Trajectory]) -> None:
    """And what it executed, sent open-loop from the stored first state, gives the stored states bit for bit."""
    demo, environment, changes = starter_demo(task), Environment(task), (CHANGES[task],)
    missed = replay(environment, demo, "t", ReplayConfig(), changes)
    assert (missed.mode, missed.verdict.reason) == ("open_loop", "goal_not_reached")
    kept = replay(environment, demo, "t", AUTO, changes, lambda: reference_of(whole[task]))
    assert (kept.mode, kept.verdict.reason) == ("tracked", "kept")
    assert np.array_equal(kept.states[0], missed.states[0])
    assert len(kept.actions) < 1.3 * len(whole[task].actions)
    executed = Demo(task, "k", "s", "expanded", "0", kept.actions, kept.scene.state, None, kept.model_xml)
    again = replay(environment, executed, "t", ReplayConfig(noops="keep"))
    assert np.array_equal(again.states, kept.states)
    assert again.verdict == kept.verdict


def test_auto_leaves_a_success_alone(whole: dict[Task, Trajectory]) -> None:
    def never() -> Reference:
        raise AssertionError("the reference is not needed")

    trajectory = replay(Environment(BOWL), starter_demo(BOWL), "t", AUTO, (), never)
    assert trajectory.mode == "open_loop"
    assert np.array_equal(trajectory.states, whole[BOWL].states)


def test_recorded_states_recover_what_open_loop_loses(whole: dict[Task, Trajectory]) -> None:
    """A demonstration whose actions no longer lead where they led: here because its first third is lost."""
    recorded = whole[STOVE]
    third = len(recorded.actions) // 3
    actions = recorded.actions.copy()
    actions[:third, :3] *= 0.3
    demo = replace(starter_demo(STOVE), actions=actions, states=recorded.states[:-1], model_xml=recorded.model_xml)
    environment, keep = Environment(STOVE), ReplayConfig(mode="auto", noops="keep")
    assert not replay(environment, demo, "t", keep).verdict.kept
    recovered = replay(environment, demo, "t", keep, (), lambda: reference_of(recorded))
    assert (recovered.mode, recovered.verdict.reason) == ("tracked", "kept")
