"""Pose: the right object moves, as far as its level says, and stays where the instruction says it is."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from short_demonstrations import MILK, PLATE, STOVE, starter_demo

from pipeline.axes import from_json, to_json
from pipeline.axes.base import Level
from pipeline.axes.pose import BASE_M, Move, PoseAxis, PosePerturbation, ScenePerturbation, sample_scene
from pipeline.config import ReplayConfig
from pipeline.errors import RejectedError
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task, select_tasks
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay, roll_out
from pipeline.scenes.compiled import CompiledScene
from pipeline.seeding import rng
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Floats, Scene, Task, Trajectory

COOKIES = find_task("libero_spatial", "pick_up_the_black_bowl_on_the_cookie_box_and_place_it_on_the_plate")
NEXT_TO = find_task("libero_spatial", "pick_up_the_black_bowl_next_to_the_plate_and_place_it_on_the_plate")
BETWEEN = find_task(
    "libero_spatial", "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
)
POTS = find_task("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove")
BUTTER_AT_THE_BACK = find_task(
    "libero_90", "KITCHEN_SCENE10_put_the_butter_at_the_back_in_the_top_drawer_of_the_cabinet_and_close_it"
)
BOOK_IN_THE_MIDDLE = find_task(
    "libero_90", "STUDY_SCENE4_pick_up_the_book_in_the_middle_and_place_it_on_the_cabinet_shelf"
)
ON_STOVE = find_task("libero_spatial", "pick_up_the_black_bowl_on_the_stove_and_place_it_on_the_plate")
BOWL = "akita_black_bowl_1"
SUITES = ("libero_spatial/*", "libero_object/*", "libero_goal/*", "libero_10/*")

Scenes = Callable[[Task], Scene]


@pytest.fixture(scope="module")
def plate_environment() -> Environment:
    return Environment(PLATE)


@pytest.fixture(scope="module")
def scenes(plate_environment: Environment) -> Scenes:
    @cache
    def scene(task: Task) -> Scene:
        environment = plate_environment if task == PLATE else Environment(task)
        return Scene(environment.place_fixtures(4), starter_demo(task).init_state)

    return scene


def moved(target: str, dx_m: float = 0.0, dy_m: float = 0.0, dyaw_deg: float = 0.0) -> PosePerturbation:
    return PosePerturbation(component="target", level=1, moved=target, dx_m=dx_m, dy_m=dy_m, dyaw_deg=dyaw_deg)


TARGET = PoseAxis(components=("target",))


def sample_many(axis: PoseAxis, task: Task, count: int) -> list[PosePerturbation]:
    perturbations = [axis.sample(rng(1, "pose", "demo", variant), task, variant) for variant in range(count)]
    return [one for one in perturbations if isinstance(one, PosePerturbation)]


def sample_scenes(task: Task, count: int, level: Level) -> list[ScenePerturbation]:
    axis = PoseAxis(levels=(level,), components=("scene",))
    perturbations = [axis.sample(rng(1, "pose", "demo", variant), task, variant) for variant in range(count)]
    return [one for one in perturbations if isinstance(one, ScenePerturbation)]


def together(**moves: tuple[float, float]) -> ScenePerturbation:
    listed = tuple(Move(name=name, dx_m=dx_m, dy_m=dy_m) for name, (dx_m, dy_m) in moves.items())
    return ScenePerturbation(level=1, moves=listed)


def test_perturbations_depend_on_their_key_and_are_as_large_as_their_level() -> None:
    perturbations = sample_many(TARGET, PLATE, 500)
    assert perturbations == sample_many(TARGET, PLATE, 500)
    assert {p.level for p in perturbations} == {1, 2, 3, 4, 5}
    for p in perturbations:
        assert 0.016 * (p.level - 1) - 1e-4 <= math.hypot(p.dx_m, p.dy_m) <= 0.016 * p.level + 1e-4
        assert p.moved == "plate_1"
    assert np.abs(np.mean([(p.dx_m, p.dy_m) / np.hypot(p.dx_m, p.dy_m) for p in perturbations], axis=0)).max() < 0.1
    for level in (1, 5):
        turns_deg = np.array([p.dyaw_deg for p in perturbations if p.level == level])
        assert -20 <= turns_deg.min() < -15, "as far at level 1 as at level 5"
        assert 15 < turns_deg.max() <= 20
    assert PoseAxis().sample(rng(1), STOVE, 0).component == "scene", "every task has something to move"
    assert PosePerturbation.model_validate_json(perturbations[0].model_dump_json()) == perturbations[0]


def test_the_target_is_what_the_goal_moves() -> None:
    axis = TARGET
    suites = select_tasks(SUITES)
    still = [task for task in suites if not axis.applies(task)]
    assert [task.name for task in still] == ["open_the_middle_drawer_of_the_cabinet", "turn_on_the_stove"]
    targets = {task: {p.moved for p in sample_many(axis, task, 12)} for task in suites if task not in still}
    assert targets[MILK] == {"milk_1"}
    assert targets[COOKIES] == {BOWL}
    assert targets[POTS] == {"moka_pot_1", "moka_pot_2"}


def test_only_the_targets_pose_changes(scenes: Scenes) -> None:
    scene = scenes(PLATE)
    change = moved("plate_1", 0.02, -0.01, 15)
    after = change.apply(scene, starter_demo(PLATE), roll_out)
    assert after.model_xml == scene.model_xml
    address = 1 + CompiledScene(scene).model.joint("plate_1_joint0").qposadr[0]
    before, now = scene.state.copy(), after.state.copy()
    assert np.allclose(now[address : address + 3] - before[address : address + 3], [0.02, -0.01, 0], atol=1e-12)
    turn = Rotation.from_quat(now[address + 3 : address + 7], scalar_first=True) * (
        Rotation.from_quat(before[address + 3 : address + 7], scalar_first=True).inv()
    )
    assert np.allclose(turn.as_rotvec(degrees=True), [0, 0, 15], atol=1e-6)
    now[address : address + 7] = before[address : address + 7]
    assert np.array_equal(now, before)
    assert after.resolved["pose"]["moved"] == "plate_1"


@pytest.mark.parametrize(
    ("task", "change", "reason"),
    [
        # Off the table.
        (PLATE, moved("plate_1", 1.0), "relation_broken"),
        # Its centre is 9 mm past the table's edge: it tips.
        (PLATE, moved("plate_1", 0.0, -0.6), "object_unstable"),
        (BETWEEN, moved(BOWL, 0.06), "object_in_collision"),
        (NEXT_TO, moved(BOWL, -0.03, 0.05), "relation_broken"),
        (BETWEEN, moved(BOWL, 0.0, 0.08), "relation_broken"),
        # It becomes the butter at the front.
        (BUTTER_AT_THE_BACK, moved("butter_2", 0.13, -0.08), "relation_broken"),
        # Off the box, and let go in the air.
        (COOKIES, moved(BOWL, -0.08), "object_in_collision"),
    ],
)
def test_impossible_perturbations_are_rejected(
    task: Task, change: PosePerturbation, reason: str, scenes: Scenes
) -> None:
    with pytest.raises(RejectedError, match=reason):
        change.apply(scenes(task), starter_demo(task), roll_out)


def test_a_receptacle_moves_when_asked_for_and_the_targets_relation_still_holds(scenes: Scenes) -> None:
    axis = PoseAxis(components=("receptacle",))
    assert {(p.component, p.moved) for p in sample_many(axis, MILK, 6)} == {("receptacle", "basket_1")}
    both = PoseAxis(components=("target", "receptacle"))
    assert {p.moved for p in sample_many(both, BETWEEN, 12)} == {BOWL, "plate_1"}
    assert not axis.applies(PLATE), "the plate goes to a place on the table"
    change = moved("plate_1", 0.01, 0.01, 5)
    assert change.apply(scenes(BETWEEN), starter_demo(BETWEEN), roll_out).resolved["pose"]["moved"] == "plate_1"
    with pytest.raises(RejectedError, match="relation_broken"):
        moved("plate_1", 0.25).apply(scenes(NEXT_TO), starter_demo(NEXT_TO), roll_out)


@pytest.mark.parametrize("task", [COOKIES, NEXT_TO, BETWEEN], ids=["on", "next to", "between"])
def test_small_moves_keep_the_relation(task: Task, scenes: Scenes) -> None:
    for change in (moved(BOWL, 0.01, -0.01, 4), moved(BOWL, -0.01, 0.01, -4)):
        change.apply(scenes(task), starter_demo(task), roll_out)


@pytest.mark.parametrize(
    ("task", "axis", "ascending", "nearer"),
    [
        (BUTTER_AT_THE_BACK, 0, ("butter_2", "butter_1"), 0.05),
        (BOOK_IN_THE_MIDDLE, 1, ("yellow_book_2", "black_book_1", "yellow_book_1"), 0.05),
    ],
    ids=["back", "middle"],
)
def test_things_keep_the_side_that_the_instruction_names(
    task: Task, axis: int, ascending: tuple[str, ...], nearer: float
) -> None:
    """In a demonstration in which the first of them already stands ``nearer`` to the second by this distance in m."""
    centres_m, _ = centres_in_file(task)
    source = {ascending[0]: (nearer, 0.0) if axis == 0 else (0.0, nearer)}
    margins_m = []
    for number in range(80):
        scene = sample_scene(rng(2, number), 5, task, {}, source)
        places_m = {
            name: centres_m[name] + np.add(source.get(name, (0.0, 0.0)), scene.shifts[name]) for name in ascending
        }
        for first, second in pairwise(ascending):
            before_m = centres_m[second][axis] - centres_m[first][axis]
            margins_m.append(places_m[second][axis] - places_m[first][axis] - before_m / 4)
    assert -1e-9 <= min(margins_m) < 0.01, "some come as near as they may"


def test_a_plate_may_stand_near_the_edge_of_the_table(scenes: Scenes) -> None:
    near = moved("plate_1", 0.0, -0.56)
    after = near.apply(scenes(PLATE), starter_demo(PLATE), roll_out)
    assert CompiledScene(after).xy_m("plate_1")[1] == pytest.approx(-0.569, abs=1e-3)


def touched(compiled: CompiledScene, thing: str) -> set[tuple[int, int]]:
    """The pairs of bodies in contact of which one is of ``thing``."""
    roots, root = compiled.model.body_rootid, compiled.model.body(f"{thing}_main").id
    return {pair for pair in compiled.touching() if root in roots[[*pair]]}


def test_a_target_in_mid_air_is_still_moved(scenes: Scenes) -> None:
    """LIBERO records some first states before everything has landed; this bottle hangs 2 cm above the floor."""
    task = find_task("libero_object", "pick_up_the_salad_dressing_and_place_it_in_the_basket")
    scene = scenes(task)
    assert not touched(CompiledScene(scene), "salad_dressing_1")
    after = moved("salad_dressing_1", 0.02, 0.01, 10).apply(scene, starter_demo(task), roll_out)
    assert not np.array_equal(after.state, scene.state)


def test_nearest_compares_moves_of_the_same_object() -> None:
    def tested(task: Task, target: str, dx_m: float, dy_m: float) -> TestTask:
        found: dict[str, str | int | float] = {"level": 1, "sample": 1, "moves": f"{target}:{dx_m},{dy_m}"}
        return TestTask(task.suite, task.name, "name", "pose", "pose", found)

    test = TestSet(
        (
            tested(PLATE, "plate_1", 0.01, 0.02),
            tested(PLATE, "plate_1", -0.03, 0.0),
            tested(MILK, "milk_1", 0.02, 0.0),
            TestTask(STOVE.suite, STOVE.name, "name", "pose", "pose", {"level": 1, "sample": 1}),
        )
    )
    assert moved("plate_1", 0.01, 0.02).nearest(test, PLATE) == (0, 2)
    assert moved("plate_1", 0.01, 0.024).nearest(test, PLATE).distance < PosePerturbation.clearance
    assert moved("plate_1", 0.02, 0.0).nearest(test, PLATE).distance == pytest.approx(math.hypot(0.01, 0.02))
    assert moved(BOWL, 0.01, 0.02).nearest(test, PLATE) == (math.inf, 0)


def test_nearest_knows_each_of_several_objects_that_a_test_task_moves() -> None:
    moves = {"both": "moka_pot_1:0.01,0.02;moka_pot_2:-0.03,1e-05;flat_stove_1:0,0", "one": "moka_pot_1:0.05,0.02"}
    test = TestSet(tuple(TestTask(POTS.suite, POTS.name, k, "pose", "pose", {"moves": m}) for k, m in moves.items()))
    assert moved("moka_pot_1", 0.01, 0.02).nearest(test, POTS) == (0, 2)
    assert moved("moka_pot_1", -0.03, 0.0).nearest(test, POTS).distance > 0.04, "that is how the other one moves"
    assert moved("moka_pot_2", -0.03, 0.0).nearest(test, POTS) == pytest.approx((1e-5, 1))
    assert moved("moka_pot_2", -0.03, 0.01).nearest(test, POTS) == pytest.approx((0.00999, 1))
    assert moved("flat_stove_1", 0.0, 0.0).nearest(test, POTS) == (0, 1), "what the goal leaves standing moves too"


def test_the_replay_starts_there(plate_environment: Environment) -> None:
    demo = starter_demo(PLATE)
    short = replace(demo, actions=demo.actions[:3])
    change = moved("plate_1", 0.02, 0.0, 10)
    trajectory = replay(plate_environment, short, "t", ReplayConfig(), (change,))
    (position,) = np.flatnonzero(trajectory.scene.state == demo.init_state + 0.02)
    assert trajectory.states[-1, position] == pytest.approx(trajectory.scene.state[position], abs=1e-3), "it slides"


@pytest.mark.parametrize("task", select_tasks(SUITES), ids=lambda task: task.name[:60])
def test_a_scene_moves_everything_within_the_benchmarks_disks(task: Task) -> None:
    known = bddl.read(task.bddl_file)
    step_m = {"libero_spatial": 0.01, "libero_object": 0.03, "libero_goal": 0.02, "libero_10": 0.01}[task.suite]
    step_m = 0.02 if task.name.startswith("LIVING_ROOM_SCENE1") else step_m
    surface = {"main_table", "kitchen_table", "living_room_table", "study_table", "floor"}
    levels: tuple[Level, ...] = (1, 5)
    for level in levels:
        perturbations = sample_scenes(task, 8, level)
        assert perturbations == sample_scenes(task, 8, level)
        assert len(set(perturbations)) == 8
        for one in perturbations:
            (read,) = from_json(to_json([one]))
            assert (read, one.axis, one.component, one.level) == (one, "pose", "scene", level)
            shifts = {move.name: np.array([move.dx_m, move.dy_m]) for move in one.moves}
            assert shifts.keys() == (known.objects.keys() | known.fixtures.keys()) - surface
            at_benchmark_places = task.suite == "libero_goal" and level == 5
            assert (one.disk_level is not None) == at_benchmark_places
            for name, shift in shifts.items():
                assert np.array_equal(shift, shifts[known.carriers[name]]), "it stays on what it stands on"
                centres_m = [(0.0, 0.0)]
                if at_benchmark_places:
                    centres_m.append(BASE_M.get(name, (0.0, 0.0)))
                off_m = min(math.dist(shift, centre_m) for centre_m in centres_m)
                assert off_m <= step_m * (one.disk_level or level) + 1e-4


def test_a_scenes_moves_are_uniform_over_the_disk() -> None:
    perturbations = sample_scenes(MILK, 200, 1)
    moves_m = np.array([(move.dx_m, move.dy_m) for one in perturbations for move in one.moves if move.name == "milk_1"])
    assert np.abs(moves_m.mean(axis=0)).max() < 0.004
    assert np.mean(np.linalg.norm(moves_m, axis=1) < 0.015) == pytest.approx(1 / 4, abs=0.08), "of a radius of 0.03"


def centres_in_file(task: Task) -> tuple[dict[str, Floats], set[str]]:
    """Read the middle (2,) in m of the region of each thing on the surface, and the names of the fixtures."""
    text = task.bddl_file.read_text()
    bound = r"\s*(-?[\d.e-]+)"
    ranges = re.findall(rf"\((\w+)\s+\(:target (\w+)\)\s+\(:ranges \(\s+\({bound * 4}", text)
    middles_m = {}
    for name, surface, left, low, right, high in ranges:
        corners_m = np.array([[float(left), float(low)], [float(right), float(high)]])
        middles_m[f"{surface}_{name}"] = corners_m.mean(axis=0)
    (start,) = re.findall(r"\(:init(.*?)\(:goal", text, re.DOTALL)
    placed = re.findall(r"\(On (\w+) (\w+)\)", start)
    (fixtures,) = re.findall(r"\(:fixtures(.*?)\(:objects", text, re.DOTALL)
    centres_m = {thing: middles_m[region] for thing, region in placed if region in middles_m}
    return centres_m, set(re.findall(r"\w+_\d+", fixtures))


@pytest.mark.parametrize(
    ("task", "fixture", "share", "enough_m"),
    [(MILK, False, 0.75, 0.15), (STOVE, True, 0.9, 0.25)],
    ids=["objects", "fixtures"],
)
def test_no_two_things_come_much_closer(task: Task, fixture: bool, share: float, enough_m: float) -> None:
    centres_m, fixtures = centres_in_file(task)
    pairs = [pair for pair in combinations(centres_m, 2) if bool(fixtures & {*pair}) == fixture]
    margins_m = []
    for scene in sample_scenes(task, 60, 4):
        for first, second in pairs:
            away_m = math.dist(centres_m[first] + scene.shifts[first], centres_m[second] + scene.shifts[second])
            margins_m.append(away_m - min(enough_m, share * math.dist(centres_m[first], centres_m[second])))
    assert -1e-9 <= min(margins_m) < 0.01, "some pairs come as close as they may"


def test_the_goal_suites_bowl_goes_where_the_benchmark_has_it_unless_the_hand_needs_it() -> None:
    def median(task: Task, name: str) -> list[float]:
        moves = [move for one in sample_scenes(task, 100, 5) for move in one.moves if move.name == name]
        return list(np.median([[move.dx_m, move.dy_m] for move in moves], axis=0))

    assert median(STOVE, BOWL) == pytest.approx([0.35, 0.05], abs=0.02)
    assert median(STOVE, "cream_cheese_1") == pytest.approx([0.15, 0.10], abs=0.02)
    on_plate = find_task("libero_goal", "put_the_bowl_on_the_plate")
    assert median(on_plate, BOWL) == pytest.approx([0, 0], abs=0.02), "the hand does not reach so far"
    assert median(on_plate, "wine_bottle_1") == pytest.approx([0, 0.05], abs=0.02)


def test_a_level_bounds_how_far_things_move_also_in_the_goal_suite() -> None:
    """LIBERO-Plus's places, up to 35 cm away, are level 5; a configuration without this level has none of them."""
    goal = PoseAxis(components=("scene",))
    for level in (1, 2, 3, 4):
        for scene in sample_scenes(STOVE, 20, level):
            assert max(math.hypot(move.dx_m, move.dy_m) for move in scene.moves) <= 0.02 * level + 1e-4
    scenes = [goal.sample(rng("goal", key), STOVE, 0) for key in range(100)]
    assert {scene.level for scene in scenes} == {5}
    assert {scene.disk_level for scene in scenes if isinstance(scene, ScenePerturbation)} == {1, 2, 3, 4, 5}
    half = PoseAxis(components=("scene",), benchmark_places=0.5)
    scenes = [half.sample(rng("goal", key), STOVE, 0) for key in range(200)]
    bowls_m = [math.hypot(*scene.shifts[BOWL]) for scene in scenes]
    is_far = [distance_m > 0.2 for distance_m in bowls_m]
    assert 0.4 < np.mean(is_far) < 0.6
    assert all(scene.level == 5 for scene, far in zip(scenes, is_far, strict=True) if far)


def sample_second(task: Task, level: Level, earlier: ScenePerturbation) -> list[dict[str, tuple[float, float]]]:
    """Displacements from LIBERO's places, both moves together, of 60 second moves."""
    shifts = []
    for number in range(60):
        change = PoseAxis(levels=(level,)).sample_after(rng("second", number), task, 0, (earlier,))
        assert change.source_moves == earlier.moves
        shifts.append(change.shifts_in_all)
    return shifts


def test_a_second_move_keeps_what_the_hand_must_grasp_in_its_reach() -> None:
    """It begins where an expansion put the cream cheese: 0.80 m from the robot, which reaches 0.82 m."""
    task, robot_m = find_task("libero_goal", "put_the_cream_cheese_in_the_bowl"), np.array([-0.66, 0.0])
    cheese_m = np.array([-0.05, 0.13])  # in LIBERO's file, from the table's centre
    dx_m, dy_m = (0.8 / math.dist(cheese_m, robot_m) - 1) * (cheese_m - robot_m)
    moves = (Move(name="cream_cheese_1", dx_m=round(dx_m, 4), dy_m=round(dy_m, 4)),)
    earlier = ScenePerturbation(level=5, moves=moves)
    away_m = [math.dist(cheese_m + shifts["cream_cheese_1"], robot_m) for shifts in sample_second(task, 4, earlier)]
    assert 0.74 < max(away_m) <= 0.8201


def test_a_second_move_reaches_the_benchmarks_places() -> None:
    earlier = ScenePerturbation(level=1, moves=(Move(name=BOWL, dx_m=0.06, dy_m=-0.05),))
    off_m = [math.dist(shifts[BOWL], BASE_M[BOWL]) for shifts in sample_second(STOVE, 5, earlier)]
    assert max(off_m) <= 0.1001, "the radius of the largest disk"


def test_a_fixture_takes_along_what_stands_on_it(scenes: Scenes) -> None:
    """And everything else goes its own way; what nobody moves stays where it is, bit for bit."""
    scene, demo = scenes(ON_STOVE), starter_demo(ON_STOVE)
    moves = {BOWL: (-0.01, 0.02), "flat_stove_1": (-0.01, 0.02), "plate_1": (0.02, 0.0)}
    after = together(**moves).apply(scene, demo, roll_out)
    before, now = CompiledScene(scene), CompiledScene(after)
    for body in range(before.model.nbody):
        name = before.model.body(body).name
        root = before.model.body(before.model.body_rootid[body]).name.removesuffix("_main")
        expected = [*moves.get(root, (0.0, 0.0)), 0.0]
        assert now.data.body(name).xpos - before.data.body(name).xpos == pytest.approx(expected, abs=1e-7), name
        assert np.array_equal(now.data.body(name).xquat, before.data.body(name).xquat)
    assert touched(now, BOWL) == touched(before, BOWL) != set()
    assert len(before.state) == len(after.state)
    placed = after.resolved["pose"]["positions_m"]
    assert placed.keys() == moves.keys()
    assert placed["flat_stove_1"] == now.data.body("flat_stove_1_main").xpos.tolist()


@pytest.mark.parametrize(
    ("task", "moves", "reason"),
    [
        # The stove is pulled away under the bowl.
        (ON_STOVE, {"flat_stove_1": (0.0, -0.15)}, "object_in_collision|relation_broken|object_unstable"),
        (ON_STOVE, {"plate_1": (-0.26, 0.0)}, "object_in_collision"),
        # Two fixtures, between which the simulator itself has no contacts.
        (STOVE, {"wine_rack_1": (0.2, 0.0)}, "object_in_collision"),
        (NEXT_TO, {"plate_1": (0.25, 0.0)}, "relation_broken"),
        (PLATE, {"plate_1": (1.0, 0.0)}, "relation_broken"),
    ],
)
def test_an_impossible_scene_is_rejected(
    task: Task, moves: dict[str, tuple[float, float]], reason: str, scenes: Scenes
) -> None:
    with pytest.raises(RejectedError, match=reason):
        together(**moves).apply(scenes(task), starter_demo(task), roll_out)


def test_the_goal_moves_with_what_names_it(plate_environment: Environment, scenes: Scenes) -> None:
    """The front of the stove goes where the stove goes, and LIBERO's own check looks for the plate there."""
    after = together(flat_stove_1=(0.03, -0.08)).apply(scenes(PLATE), starter_demo(PLATE), roll_out)
    region = "main_table_stove_front_region"
    plate_environment.restore(scenes(PLATE))
    was = plate_environment.pose(region)
    plate_environment.restore(after)
    now = plate_environment.pose(region)
    assert now - was == pytest.approx([0.03, -0.08, 0, 0, 0, 0, 0], abs=1e-7)
    address = 1 + CompiledScene(after).model.joint("plate_1_joint0").qposadr[0]
    for at, there in ((now, True), (was, False)):
        state = after.state.copy()
        state[address : address + 2] = at[:2]
        plate_environment.restore(replace(after, state=state))
        assert plate_environment.succeeded() is there


def test_scenes_are_as_far_apart_as_the_thing_that_differs_most() -> None:
    def tested(moves: str) -> TestTask:
        return TestTask(PLATE.suite, PLATE.name, "name", "pose", "pose", {"level": 1, "moves": moves})

    test = TestSet((tested("plate_1:0.01,0.02;flat_stove_1:0,0.03"), tested("plate_1:0.05,0;flat_stove_1:0,0.03")))
    here = together(plate_1=(0.01, 0.02), flat_stove_1=(0.004, 0.03))
    distance, compared = here.nearest(test, PLATE)
    assert distance == pytest.approx(0.004)
    assert compared == 2
    assert distance < ScenePerturbation.clearance, "the reset could have put the stove there"
    assert together(plate_1=(0.01, 0.02), flat_stove_1=(0.0, 0.05)).nearest(test, PLATE).distance == pytest.approx(0.02)
    assert together(plate_1=(0.01, 0.02)).nearest(test, MILK) == (math.inf, 0)


def test_a_moved_fixture_is_followed(whole: dict[Task, Trajectory]) -> None:
    """The knob is turned where the stove now stands, and LIBERO's own check sees the burner lit."""
    environment, change = Environment(STOVE), together(flat_stove_1=(0.05, 0.03), plate_1=(0.02, 0.01))
    twin = whole[STOVE]
    reference = Reference.of(twin.model_xml, twin.states, twin.actions)
    assert reference.met["flat_stove_1"].any()
    tracked, demo = ReplayConfig(mode="tracked"), starter_demo(STOVE)
    assert not replay(environment, demo, "t", ReplayConfig(), (change,)).verdict.kept
    kept = replay(environment, demo, "t", tracked, (change,), lambda: reference)
    assert (kept.mode, kept.verdict.reason) == ("tracked", "kept")
    again = replay(environment, demo, "t", tracked, (change,), lambda: reference)
    assert np.array_equal(again.states, kept.states)
