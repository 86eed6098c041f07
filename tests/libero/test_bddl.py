"""BDDL files: what the reader says of LIBERO's own, and that it rejects what defines no task."""

import re
from pathlib import Path

import pytest
from short_demonstrations import BOWL, MILK, STOVE

from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.assets import libero_folder
from pipeline.libero.tasks import SUITES, find_task, tasks


def test_a_task_as_its_file_defines_it() -> None:
    pots = bddl.read(find_task("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove").bddl_file)
    assert pots.problem == "libero_kitchen_tabletop_manipulation"
    assert pots.language == "put both moka pots on the stove"
    assert pots.objects == {"moka_pot_1": "moka_pot", "moka_pot_2": "moka_pot"}
    assert pots.fixtures == {"kitchen_table": "kitchen_table", "flat_stove_1": "flat_stove"}
    assert pots.of_interest == ("moka_pot_1", "moka_pot_2", "flat_stove_1")
    assert pots.targets == ("moka_pot_1", "moka_pot_2")
    assert pots.goal == (
        ("on", "moka_pot_1", "flat_stove_1_cook_region"),
        ("on", "moka_pot_2", "flat_stove_1_cook_region"),
        ("turnon", "flat_stove_1"),
    )
    assert ("turnon", "flat_stove_1") in pots.start
    assert "flat_stove_1_cook_region" not in pots.regions
    assert pots.regions[pots.places["moka_pot_1"]] == pytest.approx((-0.05, 0.25))


def test_only_what_is_put_somewhere_is_a_target() -> None:
    assert bddl.read(STOVE.bddl_file).targets == ()
    assert bddl.read(MILK.bddl_file).targets == ("milk_1",)


@pytest.mark.parametrize("suite", SUITES)
def test_every_task_has_the_arena_that_libero_builds(suite: str) -> None:
    """By the source of the class that LIBERO builds the scene with."""
    for task in tasks(suite):
        read = bddl.read(task.bddl_file)
        source = (libero_folder() / "envs/problems" / f"{read.problem}.py").read_text()
        (built,) = re.findall(r'"arena_type": "(\w+)"', source)
        assert read.arena == {"table": "tabletop"}.get(built, built), task.name


def test_a_scene_of_no_known_arena_is_rejected() -> None:
    assert bddl.arena("libero_kitchen_tabletop_manipulation_kitchen_table_wood") == "kitchen"
    for problem in ("libero_coffee_table_manipulation", "LIBERO_Kitchen_Tabletop_Manipulation"):
        with pytest.raises(PipelineError, match="arena"):
            bddl.arena(problem)


@pytest.mark.parametrize("suite", SUITES)
def test_every_task_is_read(suite: str) -> None:
    for task in tasks(suite):
        read = bddl.read(task.bddl_file)
        assert bddl.heading(task.bddl_file.read_text(), task.name) == (read.problem, read.language)
        # Facts are of things, of their parts such as drawers, and of regions on them.
        things = (*read.objects, *read.fixtures)
        named = {name for _, *names in (*read.start, *read.goal) for name in names}
        assert all(name.startswith(things) for name in (*named, *read.of_interest, *read.regions))
        assert set(read.objects) <= set(read.places)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "not a BDDL file"),
        ("(define (problem X) (:language a)", "not a BDDL file"),
        ("(define (problem X) (:language a) (:objects o - k) (:init (On o t)))", "has no :goal"),
        ("(define (problem X) (:language a) (:objects o - k) (:init (On o t)) (:goal (Not (On o t))))", "plain fact"),
    ],
)
def test_files_that_define_no_task_are_rejected_by_name(text: str, fault: str, tmp_path: Path) -> None:
    file = tmp_path / "task.bddl"
    file.write_text(text)
    with pytest.raises(PipelineError, match=fault) as caught:
        bddl.read(file)
    assert str(file) in str(caught.value)
    assert "expected: a BDDL problem with" in str(caught.value)


@pytest.mark.parametrize(
    ("section", "content", "fault"),
    [
        (":goal", "(And)", "the goal is empty"),
        (":goal", "(Near akita_black_bowl_1 plate_1)", "has the fact (near akita_black_bowl_1 plate_1)"),
        (":goal", "(And (Open akita_black_bowl_1 plate_1))", "has the fact (open akita_black_bowl_1 plate_1)"),
        (
            ":goal",
            "(On akita_black_bowl_2 plate_1)",
            ":goal names 'akita_black_bowl_2', which the file",
        ),
        (
            ":init",
            "(On plate_1 table_plate_region)",
            ":init names 'table_plate_region', which the file",
        ),
        (":obj_of_interest", "akita_black_bowl plate_1", ":obj_of_interest names 'akita_black_bowl', which the file"),
    ],
)
def test_names_and_predicates_that_mean_nothing_are_named(
    section: str, content: str, fault: str, tmp_path: Path
) -> None:
    """LIBERO itself fails on them later, or ignores them."""
    file, text = tmp_path / "task.bddl", BOWL.bddl_file.read_text()
    start = text.index(f"({section}")
    end = text.index("\n  )", start) + 4
    file.write_text(f"{text[:start]}({section} {content}){text[end:]}")
    with pytest.raises(PipelineError, match=re.escape(fault)) as caught:
        bddl.read(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(
    ("section", "with_empty"),
    [
        (":obj_of_interest", "(:obj_of_interest ()"),
        (":init", "(:init ()"),
        (":regions", "(:regions ()"),
        (":fixtures", "(:fixtures ()"),
        ("the problem itself", "() (:goal"),
    ],
)
def test_empty_parentheses_are_named_with_their_section(section: str, with_empty: str, tmp_path: Path) -> None:
    file, text = tmp_path / "task.bddl", STOVE.bddl_file.read_text()
    file.write_text(text.replace(with_empty.replace(" ()", "").removeprefix("() "), with_empty, 1))
    assert file.read_text() != text
    with pytest.raises(PipelineError, match=re.escape(f"has empty parentheses `()` in {section}")) as caught:
        bddl.read(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("fields", ["{expression}", "{expression} {numbers}", "{numbers} {expression}"])
def test_a_yaw_that_libero_would_run_as_code_is_rejected(fields: str, tmp_path: Path) -> None:
    """LIBERO evaluates each token, and a token of Python needs no space. It reads every repeated field."""
    file, text = tmp_path / "task.bddl", STOVE.bddl_file.read_text()
    expression = "(:yaw_rotation ((__import__['os'] 0.0)))"
    numbers = re.search(r"\(:yaw_rotation\s+\(\s*\([^()]*\)\s*\)\s*\)", text)
    assert numbers is not None
    field = fields.format(expression=expression, numbers=numbers[0])
    file.write_text(text.replace(numbers[0], field, 1))
    with pytest.raises(PipelineError, match=r":yaw_rotation has \"__import__\['os'\]\"") as caught:
        bddl.read(file)
    assert str(file) in str(caught.value)
    assert "expected: two numbers in radians" in str(caught.value)


def test_a_byte_order_mark_is_named(tmp_path: Path) -> None:
    file = tmp_path / "task.bddl"
    file.write_bytes(b"\xef\xbb\xbf" + STOVE.bddl_file.read_bytes())
    with pytest.raises(PipelineError, match="begins with a byte order mark") as caught:
        bddl.read(file)
    assert "without BOM" in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=r"gone\.bddl: the file cannot be read"):
        bddl.read(tmp_path / "gone.bddl")


OWN = """(define (problem LIBERO_Tabletop_Manipulation) (:domain robosuite) (:language Put the bowl there)
  (:regions (bowl_region (:target main_table) (:ranges ((-0.1 -0.1 -0.08 -0.08))))
    (plate_region (:target main_table) (:ranges ((0.1 0.1 0.12 0.12))))
    (left_of_all_region (:target main_table) (:ranges ((0.2 0.1 0.22 0.12))))
    ({goal} (:target main_table) (:ranges ((0.1 0.2 0.12 0.22)))))
  (:fixtures main_table - table flat_stove_1 - flat_stove)
  (:objects bowl_1 - akita_black_bowl plate_1{more} - plate)
  (:obj_of_interest bowl_1)
  (:init (On bowl_1 main_table_bowl_region) (On plate_1 main_table_plate_region) (On flat_stove_1 main_table_{stove}))
  (:goal (And (On bowl_1 main_table_{goal}))))"""


def own(goal: str, more: str = "", stove: str = "left_of_all_region") -> bddl.Bddl:
    return bddl.parse(OWN.format(goal=goal, more=more, stove=stove).lower(), "own")


@pytest.mark.parametrize(
    ("goal", "moves_with"),
    [
        # The name, the category, and LIBERO's word for the category.
        ("plate_1_left_region", "plate_1"),
        ("plate_left_region", "plate_1"),
        ("stove_front_region", "flat_stove_1"),
        ("next_to_plate_region", "plate_1"),
        # None of these is all of a name or category; before, the first four moved with whatever starts in a region of
        # a name that begins alike, and the others ended in StopIteration.
        ("left_region", None),
        ("plat_left_region", None),
        ("left_of_region", None),
        ("bow_region", None),
        ("next_to_kettle_region", None),
        ("goal_region", None),
        ("target", None),
        ("between_plate_bowl_1_region", None),
    ],
)
def test_a_goal_region_moves_only_with_the_thing_that_its_name_says(goal: str, moves_with: str | None) -> None:
    expected = {} if moves_with is None else {f"main_table_{goal}": moves_with}
    assert own(goal).goal_regions == expected


def test_of_two_things_of_a_category_a_region_is_next_to_neither() -> None:
    two = "plate_1 plate_2"
    text = OWN.replace("plate_1{more}", two).replace(
        "(On bowl_1 main_table_bowl", "(On plate_2 main_table_goal) (On bowl_1 main_table_bowl"
    )
    for goal, moves_with in (("plate_left_region", {}), ("plate_2_left_region", "plate_2")):
        known = bddl.parse(text.format(goal=goal, stove="left_of_all_region").lower(), "own")
        assert known.goal_regions == (moves_with and {f"main_table_{goal}": moves_with})


@pytest.mark.parametrize("stove", ["table", "nowhere_region", "bowl"])
def test_a_thing_without_a_region_is_no_exception(stove: str) -> None:
    """It carries itself, and its centre is not known."""
    known = own("plate_left_region", stove=stove)
    assert known.carriers["flat_stove_1"] == "flat_stove_1"
    assert "flat_stove_1" not in known.centres_m
    assert known.goal_regions == {"main_table_plate_left_region": "plate_1"}
    assert len(known.scene_names) == 3


def test_a_scene_does_not_depend_on_names() -> None:
    """With the two bowls' names exchanged it is the same scene; with one bowl elsewhere it is not."""
    for task in tasks("libero_spatial"):
        text = task.bddl_file.read_text().lower()
        exchanged = re.sub(r"bowl_([12])", lambda number: f"bowl_{3 - int(number[1])}", text)
        one, other = bddl.parse(text, task), bddl.parse(exchanged, task)
        assert one.scene == other.scene
        assert one.scene_names["akita_black_bowl_1"] == other.scene_names["akita_black_bowl_2"]
        assert one.scene_names["akita_black_bowl_1"] != one.scene_names["akita_black_bowl_2"]
        start, goal = text.split("(:goal")
        elsewhere = re.sub(r"\((on|in) akita_black_bowl_1 \S+\)", "(on akita_black_bowl_1 plate_1)", start)
        assert bddl.parse(f"{elsewhere}(:goal{goal}", task).scene != one.scene


def test_only_two_spatial_tasks_begin_in_one_scene_and_libero_names_its_other_scenes() -> None:
    """LIBERO's task names have the scene's; the goal suite is one scene, the object suite ten."""
    scenes: dict[str, set[object]] = {}
    for suite in SUITES:
        for task in tasks(suite):
            named = re.match(r"[A-Z_]+_SCENE\d+", task.name)
            scenes.setdefault(named[0] if named else suite, set()).add(bddl.read(task.bddl_file).scene)
    several = {name: len(of_name) for name, of_name in scenes.items() if len(of_name) > 1}
    assert several == {"libero_spatial": 9, "libero_object": 10}
    assert len(set().union(*scenes.values())) == sum(map(len, scenes.values())), "no scene has two names"
