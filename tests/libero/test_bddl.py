"""BDDL files: what the reader says of LIBERO's own, and that it refuses what defines no task."""

import re
from pathlib import Path

import pytest
from conftest import MILK, STOVE

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


def test_a_scene_of_no_known_arena_is_refused() -> None:
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
def test_what_defines_no_task_is_refused_by_name(text: str, fault: str, tmp_path: Path) -> None:
    file = tmp_path / "task.bddl"
    file.write_text(text)
    with pytest.raises(PipelineError, match=fault) as caught:
        bddl.read(file)
    assert str(file) in str(caught.value)
    assert "expected: a BDDL problem with" in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match=r"gone\.bddl: cannot be read"):
        bddl.read(tmp_path / "gone.bddl")
