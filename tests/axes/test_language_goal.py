"""A rewrite that changes its task's goal is rejected with the reason; one that keeps it is not, however it is put."""

import re
from collections.abc import Callable
from itertools import permutations

import pytest

from pipeline.axes.language import load_bank
from pipeline.axes.language_extra import extra_request
from pipeline.axes.language_goal import changed_goal, demands
from pipeline.axes.language_lint import CLASSES, NAMED, lint
from pipeline.libero.task_goal import Aim, StateChange, read_goal
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.types import Task

SOUP = find_task("libero_object", "pick_up_the_alphabet_soup_and_place_it_in_the_basket")
CHEESE = find_task("libero_object", "pick_up_the_cream_cheese_and_place_it_in_the_basket")
BETWEEN = find_task(
    "libero_spatial", "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
)
NEXT_TO = find_task("libero_spatial", "pick_up_the_black_bowl_next_to_the_plate_and_place_it_on_the_plate")
DRAWER = find_task("libero_goal", "open_the_middle_drawer_of_the_cabinet")
INTO_DRAWER = find_task("libero_goal", "open_the_top_drawer_and_put_the_bowl_inside")
ON_CABINET = find_task("libero_goal", "put_the_bowl_on_top_of_the_cabinet")
FRONT = find_task("libero_goal", "push_the_plate_to_the_front_of_the_stove")
STOVE = find_task("libero_goal", "turn_on_the_stove")
SHUT = find_task("libero_10", "KITCHEN_SCENE4_put_the_black_bowl_in_the_bottom_drawer_of_the_cabinet_and_close_it")
TWO = find_task("libero_10", "LIVING_ROOM_SCENE1_put_both_the_alphabet_soup_and_the_cream_cheese_box_in_the_basket")
POTS = find_task("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove")
BREW = find_task("libero_10", "KITCHEN_SCENE3_turn_on_the_stove_and_put_the_moka_pot_on_it")
MUGS = find_task(
    "libero_10",
    "LIVING_ROOM_SCENE5_put_the_white_mug_on_the_left_plate_and_put_the_yellow_and_white_mug_on_the_right_plate",
)
PUDDING = find_task(
    "libero_10",
    "LIVING_ROOM_SCENE6_put_the_white_mug_on_the_plate_and_put_the_chocolate_pudding_to_the_right_of_the_plate",
)
MICROWAVE = find_task("libero_10", "KITCHEN_SCENE6_put_the_yellow_and_white_mug_in_the_microwave_and_close_it")
CADDY = find_task("libero_10", "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy")


def test_the_goal_is_read_in_kinds_and_parts() -> None:
    assert read_goal(MUGS).aims == (
        Aim("on", "porcelain_mug", "plate", "left"),
        Aim("on", "white_yellow_mug", "plate", "right"),
    )
    assert read_goal(PUDDING).aims[1] == Aim("right", "chocolate_pudding", "plate")
    shut = read_goal(SHUT)
    assert shut.aims == (Aim("in", "akita_black_bowl", "white_cabinet", "bottom"),)
    assert shut.changes == (StateChange("close", "white_cabinet", "bottom"),)
    between = read_goal(BETWEEN)
    assert between.aims == (Aim("on", "akita_black_bowl", "plate"),)
    assert {aim.place for aim in between.starts if aim.relation == "between"} == {
        "plate",
        "glazed_rim_porcelain_ramekin",
    }
    # The stove is on at the start, so only the two pots are wanted.
    pots = read_goal(POTS)
    assert (pots.changes, pots.pairs) == ((), ("moka_pot",))


@pytest.mark.parametrize("suite", SUITES)
def test_every_task_of_libero_demands_what_its_own_wording_tells(suite: str) -> None:
    for task in tasks(suite):
        assert demands(task), task.name
        assert changed_goal(task.instruction, task, hints=False) is None
        assert changed_goal("let us have a cup of tea and talk about the weather", task, hints=True)


@pytest.mark.parametrize(
    ("task", "text", "fault"),
    [
        # Another relation.
        (SOUP, "put the alphabet soup next to the basket", "relation 'in' to the basket"),
        (SOUP, "in a hurry today, so just leave the alphabet soup behind the basket", "relation 'in' to the basket"),
        (NEXT_TO, "move the black bowl next to the plate", "relation 'on' to the plate"),
        (
            BETWEEN,
            "take the black bowl between the plate and the ramekin and put it behind the plate",
            "relation 'on' to the plate",
        ),
        (ON_CABINET, "put the bowl in the top drawer of the cabinet", "relation 'on' to the wooden cabinet"),
        (FRONT, "push the plate onto the stove", "relation 'front' to the flat stove"),
        (
            PUDDING,
            "white mug on the plate, chocolate pudding to the left of the plate",
            "relation 'right' to the plate",
        ),
        # Another receptacle or part.
        (SOUP, "put the alphabet soup in the drawer", "no word for the basket"),
        (DRAWER, "open the top drawer of the cabinet", "part 'middle'"),
        (SHUT, "put the black bowl in the top drawer of the cabinet and close it", "part 'bottom'"),
        (CADDY, "put the book in the front compartment of the caddy", "part 'back'"),
        # Another thing, or one of two.
        (SOUP, "put the tomato sauce in the basket", "no word for the alphabet soup"),
        (TWO, "put the alphabet soup in the basket", "no word for the cream cheese"),
        (POTS, "put the moka pot on the stove", "both moka pots"),
        # Another start, of two bowls.
        (NEXT_TO, "put the black bowl on the plate", "relation 'next to' to the plate"),
        (BETWEEN, "put the black bowl beside the ramekin on the plate", "relation 'between'"),
        # The opposite, or nothing.
        (DRAWER, "close the middle drawer of the cabinet", "ask to open"),
        (DRAWER, "i would like the middle drawer of the cabinet to be closed", "ask to open"),
        (INTO_DRAWER, "close the top drawer and put the bowl inside", "ask to open"),
        (MICROWAVE, "put the yellow and white mug in the microwave and open it", "ask to close"),
        (SHUT, "put the black bowl in the bottom drawer of the cabinet", "ask to close"),
        (STOVE, "turn off the stove", "ask to turnon"),
        (STOVE, "switch the stove off, please", "ask to turnon"),
        (BREW, "turn the stove off and put the moka pot on it", "ask to turnon"),
        (BREW, "put the moka pot on the stove", "ask to turnon"),
        # Places changed.
        (MUGS, "put the white mug on the right plate and the yellow and white mug on the left plate", "change places"),
        (
            PUDDING,
            "put the chocolate pudding on the plate and the white mug to the right of the plate",
            "change places",
        ),
    ],
)
def test_a_changed_goal_is_rejected_with_the_reason(task: Task, text: str, fault: str) -> None:
    for component in NAMED:
        assert fault in str(lint(text, task, component))
    assert lint(text, task, "reasoning_chain") is not None


@pytest.mark.parametrize(
    ("task", "text"),
    [
        (SOUP, "into the woven carrier goes the only thing one spells words with"),
        (TWO, "the dairy product and the letter noodles, both into the wicker hamper"),
        (DRAWER, "neither the upper nor the lower drawer of the cabinet, but the other one has to be pulled"),
        (BETWEEN, "the dark dish flanked by the dinner dish and the souffle cup goes onto the former"),
        (MUGS, "on the left dish the plain cup, on the right dish the one with yellow on it"),
    ],
)
def test_what_one_knows_of_things_tells_them_in_two_of_the_classes(task: Task, text: str) -> None:
    assert lint(text, task, "common_sense") is None
    assert lint(text, task, "reasoning_chain") is None
    for component in NAMED:
        assert lint(text, task, component) is not None


def test_a_word_that_fits_two_things_of_the_scene_tells_neither() -> None:
    assert "no word for the cream cheese" in str(lint("the dairy product goes in the basket", CHEESE, "common_sense"))
    # Next to tomato sauce, but to no other dairy product:
    assert lint("the dairy product and the soup, both in the basket", TWO, "common_sense") is None
    assert lint("put the tin in the basket", SOUP, "common_sense") is not None


def by_scene() -> dict[str, list[Task]]:
    """LIBERO's tasks by the scene that they share, by the names of suites and scenes alone."""
    groups: dict[str, list[Task]] = {}
    for suite in SUITES:
        for task in tasks(suite):
            scene = re.match(r"[A-Z_]+SCENE\d+", task.name)
            groups.setdefault(scene[0] if scene else suite, []).append(task)
    return groups


def test_no_other_task_of_a_scene_is_taken_for_a_rewrite() -> None:
    """Each instruction as a rewrite of every other task that can be given in the same scene, in every class."""
    pairs = [pair for group in by_scene().values() for pair in permutations(group, 2)]
    pairs = [(task, other) for task, other in pairs if task.instruction != other.instruction]
    accepted = [
        (task.name, other.instruction, component)
        for task, other in pairs
        for component in CLASSES
        if lint(other.instruction, task, component) is None
    ]
    assert len(pairs) > 500
    assert accepted == []


@pytest.mark.slow
def test_rewrites_of_another_task_of_the_scene_are_rejected_where_things_have_their_names() -> None:
    """The shipped rewrites that call things by their names, as rewrites of the scene's other tasks."""
    groups = {task: group for group in by_scene().values() for task in group}
    checked, accepted = 0, []
    for suite, of_suite in load_bank().items():
        for name, classes in of_suite.items():
            task = find_task(suite, name)
            for other in groups[task]:
                if other.instruction == task.instruction:
                    continue
                texts = [(component, text) for component in NAMED for text in classes[component]]
                checked += len(texts)
                accepted += [(other.name, text) for component, text in texts if lint(text, other, component) is None]
    assert checked > 4000
    assert len(accepted) / checked < 0.002


@pytest.mark.parametrize("suite", SUITES)
def test_no_instruction_of_libero_asks_for_more_than_its_task(suite: str) -> None:
    assert {task.name: extra_request(task.instruction, task, hints=False) for task in tasks(suite)} == {
        task.name: None for task in tasks(suite)
    }


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("turn on the stove and put the wine bottle on the rack", "another thing too, wine bottle"),
        ("turn on the stove, then open the middle drawer of the cabinet", "open the wooden cabinet too"),
    ],
)
def test_a_second_request_is_rejected(text: str, fault: str) -> None:
    assert fault in str(lint(text, STOVE, "paraphrase"))
    assert fault in str(lint(text, STOVE, "reasoning_chain"))


def test_things_that_are_to_stay_may_be_named_where_one_reasons() -> None:
    assert (
        lint("leave the wine where it is, do not touch the plate, but turn on the stove", STOVE, "reasoning_chain")
        is None
    )


def swapped(one: str, other: str) -> Callable[[str], str]:
    return lambda text: re.sub(rf"\b({one}|{other})\b", lambda word: other if word[0] == one else one, text)


@pytest.mark.parametrize(
    ("chosen", "damage", "share"),
    [
        (
            "basket|microwave",
            lambda text: re.sub(r"\b(in|into|inside) the (basket|microw)", r"next to the \2", text),
            1,
        ),
        ("basket", lambda text: text.replace("basket", "tray"), 1),
        ("on_the_plate", lambda text: re.sub(r"\b(on|onto) the plate", "behind the plate", text), 1),
        ("on_the_plate", lambda text: re.sub(r"\bplates?\b", "tray", text), 1),
        ("SCENE5|SCENE6_put_the_white", swapped("left", "right"), 1),
        ("SCENE5", swapped("yellow and white mug", "white mug"), 1),
        ("middle_drawer", lambda text: re.sub(r"\b(middle|second)\b", "bottom", text), 1),
        ("bottom_drawer|top_drawer", swapped("bottom", "top"), 0.95),
        ("open_the|close_it", swapped("open", "close"), 0.85),
        ("turn_on", lambda text: re.sub(r"\b(turn|switch)(\w*( the \w+)?) on\b", r"\1\2 off", text), 1),
    ],
)
def test_damage_to_the_shipped_sentences_is_found(chosen: str, damage: Callable[[str], str], share: float) -> None:
    found = [
        lint(damaged, find_task(suite, name), component) is not None
        for suite, of_suite in load_bank().items()
        for name, classes in of_suite.items()
        if re.search(chosen, name)
        for component in NAMED
        for text in classes[component]
        if (damaged := damage(text)) != text
    ]
    assert len(found) > 5
    assert sum(found) / len(found) >= share
