"""A policy can be asked for another goal, told nothing, or shown black views, and nothing else changes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from episode_results import analyze, result
from short_demonstrations import STOVE

from pipeline.axes.goal import GoalPerturbation, held_out_pairs
from pipeline.config import DemosConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.goals import (
    CARRIED,
    find_replacement,
    leave_out_trained_goals,
    list_replacements,
    resolve_goal,
)
from pipeline.evaluation.harness import PerturbedLibero
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero import bddl
from pipeline.libero.carried import carry, definition_of
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.planning import plan
from pipeline.types import Floats


def test_goals_are_replaced_by_what_fits_and_is_named_alone() -> None:
    def asked(suite: str, name: str) -> set[str]:
        return {one.instruction for one in list_replacements(find_task(suite, name))}

    # The wine bottle on top of the cabinet is a task of LIBERO.
    assert asked("libero_goal", "put_the_bowl_on_top_of_the_cabinet") == {"put the cream cheese on top of the cabinet"}
    between = "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
    assert asked("libero_spatial", between) == {
        "pick up the cookie box and place it on the plate",
        "pick up the ramekin and place it on the plate",
    }
    # The bowl stands on the ramekin, the other bowl on the cookie box.
    assert not asked("libero_spatial", "pick_up_the_black_bowl_on_the_ramekin_and_place_it_on_the_plate")
    assert not asked("libero_goal", STOVE.name)
    assert "put both the alphabet soup and the milk in the basket" in asked(
        "libero_10", "LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket"
    )
    assert not asked("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove")


def test_no_goal_is_that_of_a_task_of_libero() -> None:
    """Compared by the things, places and relations of the BDDL files, which ``carried`` does not read here."""

    def goal_and_scene(definition: bddl.Bddl) -> tuple[object, ...]:
        return definition.arena, frozenset(definition.objects.items()), frozenset(definition.goal)

    of_libero = {goal_and_scene(bddl.read(task.bddl_file)) for suite in SUITES for task in tasks(suite)}
    listed = [task for task in select(Selection(source="goals")) if CARRIED not in task.name]
    assert len(listed) == 108
    for task in listed:
        base = find_task(task.suite, task.base)
        text = find_replacement(base, task.name).bddl_text(base)
        assert goal_and_scene(bddl.parse(text, task.name)) not in of_libero, task.name


def test_a_goal_task_changes_nothing_but_its_goal() -> None:
    for task in select(Selection(source="goals")):
        if CARRIED in task.name:
            continue
        base = find_task(task.suite, task.base)
        replacement = find_replacement(base, task.name)
        ours, theirs = bddl.parse(replacement.bddl_text(base), task.name), bddl.read(base.bddl_file)
        assert replace(ours, goal=theirs.goal) == theirs
        assert not set(ours.goal) <= set(ours.start), "asks for something that does not hold at the start"
        assert [fact for fact in ours.goal if replacement.new in fact] != []
        assert not any(replacement.old in fact for fact in ours.goal)
        assert replacement.instruction != base.instruction
    with pytest.raises(PipelineError, match="no goal"):
        find_replacement(base, "put_the_moon_on_the_plate_goal_a_b_state0")


def test_held_out_pairs_are_goals_of_their_scenes() -> None:
    """The object suite's are replaced goals already, with another wording."""
    listed = select(Selection(source="goals", suites=SUITES))
    carried_to = {(task.suite, task.base, task.name) for task in listed if CARRIED in task.name}
    expected = set()
    for suite in ("libero_spatial", "libero_10", "libero_90"):
        for task, scene in held_out_pairs(suite):
            expected.add((suite, scene.name, f"{scene.name}_task_{task.name}_state0"))
    assert carried_to == expected
    assert len(expected) == 3
    replaced = {resolve_goal(task)[1] for task in listed if CARRIED not in task.name}
    assert not replaced & {resolve_goal(task)[1] for task in listed if CARRIED in task.name}
    assert {definition_of(carry(task, scene)).asked for task, scene in held_out_pairs("libero_object")} <= replaced


def test_goals_that_a_plan_trains_on_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    milk = find_task("libero_object", "pick_up_the_milk_and_place_it_in_the_basket")
    soup = find_task("libero_object", "pick_up_the_alphabet_soup_and_place_it_in_the_basket")
    (entry,) = DemosConfig(tasks=(str(milk),)).index().entries
    change = GoalPerturbation(scene=soup.name, start=0, level=3)
    config, file = tmp_path / "mine.yaml", tmp_path / "mine" / "plan.parquet"
    config.write_text(f"name: mine\nfolder: {tmp_path}\nplan:\n  episodes: {{robot: 1}}\n")
    file.parent.mkdir()
    plan.write([plan.build_row(entry, (change,), 0, ReplayConfig())], file)
    wanted = select(Selection(source="goals", suites=("libero_object",)))
    left = leave_out_trained_goals(wanted, file)
    (out,) = set(wanted) - set(left)
    assert (out.base, out.component) == (soup.name, "milk")
    assert capsys.readouterr().out == "left out, because the plan trains on them: 1 of 50 goals\n"
    assert leave_out_trained_goals(wanted, None) == wanted
    selection = {"source": "goals", "suites": ["libero_object"]}
    assert len(PerturbedLibero(selection=selection, settings={"plan": str(file)}).get_tasks()) == len(left)
    capsys.readouterr()
    for task, overlaps in ((left[0], 0), (out, 1)):
        EpisodeFiles(tmp_path / "results").save(result(task))
        assert analyze("leakage", str(tmp_path / "results"), str(config)) == overlaps
        assert json.loads(capsys.readouterr().out)["goals"]["overlaps"] == overlaps


@pytest.mark.slow
def test_a_held_out_pair_begins_in_the_scene_and_asks_for_the_other_task() -> None:
    task = next(task for task in select(Selection(source="goals", suites=("libero_spatial",))) if CARRIED in task.name)
    evaluated = EpisodeEnvironment()
    clean = replace(task, source="libero", name=f"{task.base}_state0", axis="clean", component="clean", level=0)
    evaluated.reset(clean)
    usual, told = evaluated.image("agentview"), evaluated.instruction
    evaluated.reset(task)
    assert np.array_equal(evaluated.image("agentview"), usual)
    asked = task.name.partition(CARRIED)[2].removesuffix("_state0")
    assert evaluated.instruction == find_task("libero_spatial", asked).instruction != told
    bowl, plate = (evaluated.simulator.pose(name) for name in ("akita_black_bowl_2", "plate_1"))
    assert np.linalg.norm(bowl[:2] - plate[:2]) > 0.05
    assert not evaluated.progress.success


NOUNS = {
    "akita_black_bowl": "bowl",
    "black_book": "book",
    "chefmate_8_frypan": "frying pan",
    "cookies": "cookie box",
    "glazed_rim_porcelain_ramekin": "ramekin",
    "new_salad_dressing": "salad dressing",
    "porcelain_mug": "white mug",
    "red_coffee_mug": "red mug",
    "white_yellow_mug": "yellow and white mug",
    "yellow_book": "book",
}
"""What people call a category whose name is not what they call it; two share the book."""

GOALS = {"libero_spatial": 17, "libero_object": 50, "libero_goal": 12, "libero_10": 29, "libero_90": 34}


@pytest.mark.parametrize("suite", SUITES)
def test_every_prompt_is_a_plain_sentence_about_the_new_object_alone(suite: str) -> None:
    """Before, 6 of LIBERO-90's 115 were regular expressions, 4 still named the old object, 2 meant either of two kinds
    of books, and one put a mug in front of itself."""
    asked = [(task, one) for task in tasks(suite) for one in list_replacements(task)]
    assert len(asked) == GOALS[suite]
    for task, one in asked:
        known = bddl.read(task.bddl_file)
        kinds = {**known.objects, **known.fixtures}
        nouns = {name: NOUNS.get(kind, kind.replace("_", " ")) for name, kind in kinds.items()}
        assert re.fullmatch(r"[a-z]+( [a-z]+)+", one.instruction), one.instruction
        # Longest first, so that the white mug is not found in the yellow and white one.
        listed = sorted(set(nouns.values()), key=len, reverse=True)
        said = re.findall("|".join(listed), one.instruction)
        assert said.count(nouns[one.new]) == 1, one.instruction
        others = [kind for kind in set(kinds.values()) - {one.category} if NOUNS.get(kind) == nouns[one.new]]
        assert not others, one.instruction
        if list(kinds.values()).count(kinds[one.old]) == 1 or "bowl" not in nouns[one.old]:
            assert nouns[one.old] not in said, one.instruction
        assert not re.search(r"at the (back|front)|on the (left|right) and", one.instruction), one.instruction


@pytest.mark.slow
def test_liberos_environment_judges_the_new_goal_and_not_the_old() -> None:
    evaluated = EpisodeEnvironment()
    name = "put_the_bowl_on_the_plate"
    clean = select(Selection(suites=("libero_goal",), tasks=(name,)))[0]
    asked = select(Selection(source="goals", suites=("libero_goal",), tasks=(f"{name}_goal_*_cream_cheese_*",)))[0]

    starts: list[Floats] = []

    def dropped(task: EvaluationTask, thing: str) -> bool:
        """Whether the episode succeeds when ``thing`` is let go above the plate."""
        progress = evaluated.reset(task)
        assert not progress.success
        simulator = evaluated.simulator
        state = simulator.state
        starts.append(state.copy())
        joint = simulator.model.joint(f"{thing}_joint0")
        plate = simulator.pose("plate_1")
        state[1 + joint.qposadr[0] :][:3] = plate[:3] + np.array([0, 0, 0.06])
        simulator._env.sim.set_state_from_flattened(state)
        simulator._env.sim.forward()
        for _ in range(20):
            progress = evaluated.step([0, 0, 0, 0, 0, 0, -1])
            if progress.over:
                break
        return progress.success

    assert dropped(asked, "cream_cheese_1")
    assert not dropped(asked, "akita_black_bowl_1")
    assert evaluated.instruction == "put the cream cheese on the plate"
    assert dropped(clean, "akita_black_bowl_1")
    assert not dropped(clean, "cream_cheese_1")
    assert evaluated.instruction == "put the bowl on the plate"
    assert (np.array(starts) == starts[0]).all(), "the scene is LIBERO's own"
    evaluated.close()


@pytest.mark.slow
def test_nothing_is_said_and_black_views_are_not_rendered() -> None:
    task = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))[0]
    environment = EpisodeEnvironment(EpisodeSettings(prompt="blank", black="all"))
    environment.reset(task)
    seen = environment.observation(Wanted())
    assert seen["task_description"] == ""
    assert {view: (image.shape, image.any()) for view, image in seen["images"].items()} == {
        "agentview": ((256, 256, 3), np.False_),
        "wrist": ((256, 256, 3), np.False_),
    }
    assert environment._picture._opened._renderer is None
    environment.settings = EpisodeSettings(black="agentview")
    environment.reset(task)
    images = environment.observation(Wanted())["images"]
    assert not images["agentview"].any()
    assert images["wrist"].any()
    environment.close()
