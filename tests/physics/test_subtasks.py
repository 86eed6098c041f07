"""Subtasks by robosuite's grasps, MuJoCo's contacts and the predicates of LIBERO's goals, in LIBERO's environment."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from short_demonstrations import BOWL, MILK, PLATE, STOVE, starter_demo

from pipeline.config import ReplayConfig
from pipeline.libero import bddl
from pipeline.libero.task_goal import describe_place, describe_thing, describe_thing_at_start
from pipeline.libero.tasks import find_task, tasks
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.physics.subtasks import SHORTEST, subtasks
from pipeline.types import Task, Trajectory

DRAWER = find_task("libero_goal", "open_the_top_drawer_and_put_the_bowl_inside")
PARTS = {STOVE: ("turn on the stove", ("turnon", "flat_stove_1"))}
PARTS[DRAWER] = "open the top drawer of the cabinet", ("open", "wooden_cabinet_1_top_region")
OBJECTS = {
    BOWL: ("akita_black_bowl_1", "the black bowl", "to the plate", "on the plate"),
    MILK: ("milk_1", "the milk", "to the basket", "in the basket"),
    DRAWER: (
        "akita_black_bowl_1",
        "the black bowl",
        "to the top drawer of the cabinet",
        "in the top drawer of the cabinet",
    ),
}
PUSHED = {PLATE: ("plate_1", "push the plate to the front of the stove")}


@pytest.fixture(scope="module", params=[STOVE, BOWL, MILK, DRAWER, PLATE], ids=lambda task: task.name)
def done(request: pytest.FixtureRequest, whole: dict[Task, Trajectory]) -> Iterator[tuple[Task, Trajectory, Any]]:
    """A task, its demonstration replayed, and LIBERO's environment in that scene."""
    task = request.param
    environment = Environment(task)
    trajectory = whole.get(task) or replay(environment, starter_demo(task), "short", ReplayConfig())
    environment.restore(trajectory.scene)
    yield task, trajectory, environment._env.env
    environment.close()


def seen(env: Any, trajectory: Trajectory, question: Any) -> NDArray[np.bool_]:
    """(K+1,) what LIBERO's environment answers at each state."""
    answers = []
    for state in trajectory.states:
        env.sim.set_state_from_flattened(state)
        env.sim.forward()
        answers.append(bool(question()))
    return np.array(answers)


def geoms_in_touch(env: Any) -> list[tuple[str, str]]:
    name = env.sim.model.geom_id2name
    contacts = [env.sim.data.contact[k] for k in range(env.sim.data.ncon)]
    return [(name(c.geom1) or "", name(c.geom2) or "") for c in contacts if c.dist <= 0]


def met_by(env: Any, mine: set[str], others: Any) -> bool:
    """Whether one of these geoms touches one that ``others`` takes."""
    pairs = [pair for pair in geoms_in_touch(env) if len(mine & {*pair}) == 1]
    return any(others(*({*pair} - mine)) for pair in pairs)


def is_robots(geom: str) -> bool:
    return geom.startswith(("robot0", "gripper0", "mount0"))


def test_subtasks_begin_at_the_start_follow_each_other_and_end_before_the_end(
    done: tuple[Task, Trajectory, Any],
) -> None:
    task, trajectory, _ = done
    found = subtasks(trajectory, task)
    assert found[0].step == 0
    assert found[0].text.startswith("approach the ")
    assert min(after.step - before.step for before, after in pairwise(found)) >= SHORTEST
    assert found[-1].step < len(trajectory.actions)
    waiting = replace(trajectory, states=trajectory.states[:6], actions=trajectory.actions[:5])
    assert subtasks(waiting, task) == ()


def test_what_is_lifted_is_robosuites_grasp(done: tuple[Task, Trajectory, Any]) -> None:
    task, trajectory, env = done
    if task not in OBJECTS:
        return
    name, thing, to, at = OBJECTS[task]
    step = {text: step for step, text in subtasks(trajectory, task)}
    grasp, move, place = (step[text] for text in (f"grasp {thing}", f"move {thing} {to}", f"place {thing} {at}"))
    model = env.objects_dict[name]
    own = {*model.contact_geoms}
    grasped = seen(env, trajectory, lambda: env._check_grasp(env.robots[0].gripper, model))
    resting = seen(env, trajectory, lambda: met_by(env, own, lambda geom: not is_robots(geom)))
    reached = seen(env, trajectory, lambda: env._eval_predicate(next(iter(bddl.read(task.bddl_file).goal))))
    closing = trajectory.actions[:, 6] > 0
    assert not grasped[:grasp].any()
    assert not closing[grasp - 1], "it begins where the gripper is told to close"
    assert closing[grasp:move].all()
    assert grasped[move : move + 5].any(), "robosuite asks for contact with the pads of both fingers"
    assert grasped[move:place].mean() > 0.9
    assert resting[: move - 1].mean() > 0.95
    assert not resting[move + 5 : place].any()
    assert resting[place] or not closing[place], "it is put down, or let go"
    # LIBERO's goals hold as soon as the object is where it is to be, still in the hand.
    assert not reached[: (move + place) // 2].any()
    assert reached[-1]


def test_what_is_opened_and_turned_is_liberos_predicate(done: tuple[Task, Trajectory, Any]) -> None:
    task, trajectory, env = done
    if task not in PARTS:
        return
    text, fact = PARTS[task]
    found = subtasks(trajectory, task)
    place = [each.text for each in found].index(text)
    begin = found[place].step
    end = found[place + 1].step if place + 1 < len(found) else len(trajectory.actions)
    holds = seen(env, trajectory, lambda: env._eval_predicate(fact))
    assert not holds[: begin + 1].any()
    assert holds[end:].all()
    fixture = {*env.fixtures_dict[fact[1].replace("_top_region", "")].contact_geoms}
    touched = seen(env, trajectory, lambda: met_by(env, fixture, is_robots))
    assert not touched[: begin - 1].any()
    assert touched[begin : begin + 5].any()


def test_what_is_never_lifted_is_pushed(done: tuple[Task, Trajectory, Any]) -> None:
    task, trajectory, env = done
    if task not in PUSHED:
        return
    name, text = PUSHED[task]
    approach, push = subtasks(trajectory, task)
    assert (approach.text, push.text) == ("approach the plate", text)
    own = {*env.objects_dict[name].contact_geoms}
    touched = seen(env, trajectory, lambda: met_by(env, own, is_robots))
    assert np.flatnonzero(touched)[0] == push.step


@pytest.mark.parametrize(("backwards", "verb"), [(False, "turn on"), (True, "turn off")])
def test_a_knob_that_is_released_halfway_is_turned_one_way(
    whole: dict[Task, Trajectory], backwards: bool, verb: str
) -> None:
    """By the angle of the knob; LIBERO's stove is on beyond 0.5 rad, and off at 0."""
    trajectory = released_halfway(whole[STOVE])
    if backwards:
        trajectory = replace(trajectory, states=trajectory.states[::-1], actions=trajectory.actions[::-1])
    angles_rad = trajectory.states[:, knob(trajectory)]
    found = subtasks(trajectory, STOVE)
    turns = [step for step, text in found if not text.startswith("approach ")]
    assert len(turns) == 2, "once until the hand lets go, and once more"
    assert [text for _, text in found] == ["approach the stove", f"{verb} the stove"] * 2
    for begin, end in pairwise([*turns, len(angles_rad) - 1]):
        assert (angles_rad[end] > angles_rad[begin]) == (not backwards)


@pytest.mark.parametrize(
    "shares", [(0.0, 0.9, 0.9), (0.0, 0.07, 0.14, 0.14), (0.0, 0.5)], ids=["once", "twice", "at the end"]
)
def test_a_knob_that_turns_without_a_contact_is_turned_in_its_last_moving_step_too(
    shares: tuple[float, ...], whole: dict[Task, Trajectory]
) -> None:
    """A knock between two stored states; the hand stays where it starts."""
    at_rest = 10
    angles = at_rest * shares[:1] + shares
    trajectory = whole[STOVE]
    states = np.repeat(trajectory.states[:1], len(angles), axis=0)
    largest_rad = max(compiled(trajectory).joint("flat_stove_1_button").range, key=abs)
    states[:, knob(trajectory)] = np.array(angles) * largest_rad
    turned = replace(trajectory, states=states, actions=np.repeat(trajectory.actions[:1], len(angles) - 1, axis=0))
    expected = [(0, "approach the stove"), (at_rest, "turn on the stove")]
    assert [tuple(found) for found in subtasks(turned, STOVE)] == expected


def knob(trajectory: Trajectory) -> int:
    """Return the place of the knob's angle in a flattened state, whose first entry is the time."""
    return 1 + int(compiled(trajectory).joint("flat_stove_1_button").qposadr[0])


def compiled(trajectory: Trajectory) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(trajectory.model_xml)


def released_halfway(trajectory: Trajectory) -> Trajectory:
    """Insert 16 steps without action, in which the arm is at its start and the knob halfway."""
    model = compiled(trajectory)
    joints = [model.joint(number) for number in range(model.njnt)]
    robot = [1 + int(joint.qposadr[0]) for joint in joints if joint.name.startswith(("robot0_", "gripper0_"))]
    angles_rad = trajectory.states[:, knob(trajectory)]
    halfway = int(np.flatnonzero(angles_rad > angles_rad[-1] / 2)[0])
    waiting = np.repeat(trajectory.states[halfway : halfway + 1], 16, axis=0)
    waiting[:, robot] = trajectory.states[0, robot]
    states = np.concatenate([trajectory.states[:halfway], waiting, trajectory.states[halfway:]])
    actions = np.insert(trajectory.actions, [halfway] * len(waiting), 0.0, axis=0)
    return replace(trajectory, states=states, actions=actions)


def test_each_task_has_words_for_its_goal() -> None:
    """No name of LIBERO's is left in them, and no two things of one goal go by the same words."""
    for suite in ("libero_spatial", "libero_object", "libero_goal", "libero_10"):
        for task in tasks(suite):
            known = bddl.read(task.bddl_file)
            words = [describe_thing(known, name) for name in known.targets]
            assert len({*words}) == len(words), task.name
            words += [word for fact in known.goal if len(fact) == 3 for word in describe_place(known, fact)]
            assert all(word.replace(" ", "").isalpha() and "place" not in word for word in words), task.name


def words_of(suite: str, name: str) -> list[tuple[str, str, str, str]]:
    """Words of each goal: a thing, the thing at the start, the direction and the location of its place."""
    known = bddl.read(find_task(suite, name).bddl_file)
    return [
        (describe_thing(known, fact[1]), describe_thing_at_start(known, fact[1]), *describe_place(known, fact))
        for fact in known.goal
    ]


def test_the_levels_of_a_shelf_have_their_own_words() -> None:
    levels = {}
    for level in ("on_the_cabinet_shelf", "under_the_cabinet_shelf", "on_top_of_the_cabinet"):
        [(pan, _, *levels[level])] = words_of("libero_90", f"KITCHEN_SCENE9_put_the_frying_pan_{level}")
        assert pan == "the frying pan"
    assert levels == {
        "on_the_cabinet_shelf": ["onto the cabinet shelf", "on the cabinet shelf"],
        "under_the_cabinet_shelf": ["under the cabinet shelf", "under the cabinet shelf"],
        "on_top_of_the_cabinet": ["onto the top of the cabinet shelf", "on top of the cabinet shelf"],
    }


@pytest.mark.parametrize(
    ("name", "book"),
    [
        ("in_the_middle_and_place_it_on_the_cabinet_shelf", "the middle book"),
        ("on_the_left_and_place_it_on_top_of_the_shelf", "the left book"),
        ("on_the_right_and_place_it_under_the_cabinet_shelf", "the right book"),
    ],
)
def test_books_are_told_apart_by_their_sides(name: str, book: str) -> None:
    [(thing, at_start, _, _)] = words_of("libero_90", f"STUDY_SCENE4_pick_up_the_book_{name}")
    assert thing == at_start == book


def test_the_side_of_another_thing_is_not_that_of_the_book() -> None:
    """Of two books, one goes into the left compartment of the caddy."""
    task = find_task("libero_90", "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_left_compartment_of_the_caddy")
    original = bddl.read(task.bddl_file)
    (book,) = original.targets
    two_books = replace(original, objects={**original.objects, "black_book_2": original.objects[book]})
    assert describe_thing(two_books, book) == "the book"
    on_the_right = replace(two_books, language="pick up the book on the right and place it in the left compartment")
    assert describe_thing(on_the_right, book) == "the right book"


def test_a_bowl_among_bowls_has_its_place_at_the_start() -> None:
    """Up to the table's center and the cabinet's material, the places are those of LIBERO's instructions."""
    for task in tasks("libero_spatial"):
        place = task.instruction.removeprefix("pick up the ").removesuffix(" and place it on the plate")
        place = place.replace("from table", "at the table").replace("wooden ", "")
        assert words_of(task.suite, task.name) == [("the black bowl", f"the {place}", "to the plate", "on the plate")]
    for task in tasks("libero_goal"):
        known = bddl.read(task.bddl_file)
        assert [describe_thing_at_start(known, name) for name in known.targets] == [
            describe_thing(known, name) for name in known.targets
        ]


@pytest.mark.slow
def test_a_stack_in_the_hand_is_moved_and_placed() -> None:
    task = find_task("libero_90", "LIVING_ROOM_SCENE4_stack_the_right_bowl_on_the_left_bowl_and_place_them_in_the_tray")
    environment = Environment(task)
    trajectory = replay(environment, starter_demo(task), "short", ReplayConfig())
    environment.close()
    assert [text for _, text in subtasks(trajectory, task)] == [
        "approach the right black bowl",
        "grasp the right black bowl",
        "move the right black bowl to the left black bowl",
        "place the right black bowl on the left black bowl",
        "approach the left black bowl",
        "move the left black bowl to the tray",
        "place the left black bowl in the tray",
    ]
    # In these steps, the stack rises and does not come down.
    rising = replace(
        trajectory,
        states=trajectory.states[:191],
        actions=trajectory.actions[:190],
        site_alpha=trajectory.site_alpha[:191],
    )
    texts = {text for _, text in subtasks(rising, task)}
    assert "move the left black bowl to the tray" in texts
    assert "place the left black bowl in the tray" not in texts
