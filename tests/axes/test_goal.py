"""Tasks in the scenes of other tasks: which scenes, what LIBERO's own files and environment say of them, and plans."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from libero.libero.envs.bddl_utils import robosuite_parse_problem
from short_demonstrations import starter_demo

from pipeline.axes import Axes, from_json, task_of, to_json
from pipeline.axes.goal import GoalAxis, GoalPerturbation, held_out_pairs, level_of_pair, pairs, usable
from pipeline.axes.language import LanguageAxis, LanguagePerturbation, load_bank
from pipeline.axes.language_goal import changed_goal
from pipeline.axes.pose import PoseAxis, ScenePerturbation
from pipeline.config import Config, DemosConfig, PlanConfig, ReplayConfig
from pipeline.libero import bddl
from pipeline.libero.carried import CannotCarryError, bddl_text, carry, definition_of
from pipeline.libero.demonstrations import DemoEntry
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.physics.environment import Environment
from pipeline.planning import plan
from pipeline.run import inputs
from pipeline.run.replay_job import ReplayJob
from pipeline.seeding import rng
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TESTED_SUITES
from pipeline.types import Floats

RANGE = r"\((\w+)\s*\(:target \w+\)\s*\(:ranges \(\s*\(([-\d. ]+)\)"
"""A region of a BDDL file and its range: lowest x and y, highest x and y."""

PICK, PLATE = "pick_up_the_", "_and_place_it_on_the_plate"
BASKET = "_and_place_it_in_the_basket"

SPATIAL = {
    "next_to_the_plate": "next_to_the_ramekin",
    "between_the_plate_and_the_ramekin": "next_to_the_ramekin",
    "on_the_ramekin": "on_the_cookie_box",
    "next_to_the_ramekin": "next_to_the_cookie_box",
    "next_to_the_cookie_box": "on_the_stove",
    "from_table_center": "next_to_the_plate",
    "on_the_cookie_box": "on_the_wooden_cabinet",
    "in_the_top_drawer_of_the_wooden_cabinet": "on_the_wooden_cabinet",
}
"""Place of the bowl in a scene's own task to the place of its other bowl, by the scene's BDDL file.

The scene with bowls on the stove and on the cabinet has two tasks of LIBERO, and none of other scenes."""

ALSO = {
    ("libero_10", "LIVING_ROOM_SCENE1_put_both_the_alphabet_soup_and_the_cream_cheese_box_in_the_basket"): {
        "LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket"
    },
    ("libero_10", "LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket"): {
        "LIVING_ROOM_SCENE1_put_both_the_alphabet_soup_and_the_cream_cheese_box_in_the_basket"
    },
    ("libero_10", "KITCHEN_SCENE8_put_both_moka_pots_on_the_stove"): set(),
    ("libero_90", "KITCHEN_SCENE2_open_the_top_drawer_of_the_cabinet"): {
        "KITCHEN_SCENE1_open_the_bottom_drawer_of_the_cabinet"
    },
    ("libero_90", "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_front_compartment_of_the_caddy"): {
        "STUDY_SCENE2_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy"
    },
}
"""Task of a scene to the tasks of other scenes that it allows, read in LIBERO's files by hand."""


def test_the_other_bowl_of_a_spatial_scene_is_the_bowl_of_one_task() -> None:
    found = {(pair.scene.name, pair.task.name) for pair in usable("libero_spatial")}
    bowl = f"{PICK}black_bowl_"
    assert found == {(f"{bowl}{own}{PLATE}", f"{bowl}{other}{PLATE}") for own, other in SPATIAL.items()}


def test_the_targets_of_an_object_scene_are_the_groceries_in_its_file() -> None:
    """The declared objects are read by a pattern, without the parser."""
    expected, names = set(), {task.name for task in tasks("libero_object")}
    for scene in tasks("libero_object"):
        (declared,) = re.findall(r"\(:objects([^)]*)\)", scene.bddl_file.read_text())
        for grocery in re.findall(r"- (\w+)", declared):
            name = f"{PICK}{grocery}{BASKET}"
            if name in names - {scene.name}:
                expected.add((scene.name, name))
    assert {(pair.scene.name, pair.task.name) for pair in usable("libero_object")} == expected
    assert len(expected) == 50


@pytest.mark.parametrize("scene", ALSO, ids=[name for _, name in ALSO])
def test_scenes_of_the_other_suites(scene: tuple[str, str]) -> None:
    suite, name = scene
    assert {pair.task.name for pair in usable(suite) if pair.scene.name == name} == ALSO[scene]


def test_every_pair_of_the_130_tasks_is_used_or_left_out_with_a_reason() -> None:
    counts = {suite: (len(pairs(suite)), len(usable(suite)), len(held_out_pairs(suite))) for suite in SUITES}
    assert counts == {
        "libero_spatial": (80, 8, 2),
        "libero_object": (90, 50, 10),
        "libero_goal": (0, 0, 0),
        "libero_10": (80, 2, 0),
        "libero_90": (1710, 6, 1),
    }
    reasons = {(pair.task.name, pair.scene.name): pair.left_out for pair in pairs("libero_90")}
    close = "KITCHEN_SCENE4_close_the_bottom_drawer_of_the_cabinet"
    assert reasons[close, "KITCHEN_SCENE7_open_the_microwave"] == "the scene has no white cabinet"
    # The plate, the bowl and the cabinet are there, and LIBERO asks for this itself.
    on_plate = "KITCHEN_SCENE1_put_the_black_bowl_on_the_plate"
    closed = "KITCHEN_SCENE5_close_the_top_drawer_of_the_cabinet"
    assert reasons[on_plate, closed] == "LIBERO has this instruction in the scene"
    lit = "KITCHEN_SCENE8_turn_off_the_stove"
    assert reasons[lit, "KITCHEN_SCENE3_put_the_frying_pan_on_the_stove"] == (
        "the flat stove is open, closed or lit where it is not in the demonstration"
    )


def test_a_carried_task_has_the_scene_of_one_file_and_the_goal_of_the_other() -> None:
    for suite in SUITES:
        for pair in usable(suite):
            made, scene, task = map(definition_of, (pair.carried_task, pair.scene, pair.task))
            assert replace(made, language=scene.language, goal=scene.goal, of_interest=scene.of_interest) == scene
            assert (made.language, pair.carried_task.instruction) == (task.language, pair.task.instruction)
            kinds = [[made.category(made.owner(name) or name) for name in fact[1:]] for fact in made.goal]
            assert kinds == [[task.category(task.owner(name) or name) for name in fact[1:]] for fact in task.goal]
            assert bddl.parse(bddl_text(pair.carried_task), "") == made


def test_a_scene_file_of_another_spelling_is_carried_to_as_libero_reads_it(tmp_path: Path) -> None:
    """With comments that have sections and parentheses, with spaces, in upper case, and without things of interest."""
    pair = usable("libero_spatial")[0]
    text = pair.scene.bddl_file.read_text()
    odd = re.sub(r"\(:obj_of_interest[^()]*\)", "", text)
    odd = odd.replace("(:goal", "; (:goal of mine, see :)\n( :GOAL ; (").replace(
        "(:language", "; (:language\n(:Language"
    )
    scene_file, plain, carried_to = (tmp_path / f"{name}.bddl" for name in ("scene", "plain", "carried"))
    scene_file.write_text(odd)
    plain.write_text(bddl_text(pair.carried_task))
    carried_to.write_text(bddl_text(replace(pair.carried_task, bddl_file=scene_file)))
    read = robosuite_parse_problem(str(carried_to))
    assert read == robosuite_parse_problem(str(plain))
    assert " ".join(read["language_instruction"]) == definition_of(pair.task).language


def test_the_bowl_is_the_one_that_the_instruction_means() -> None:
    scene = find_task("libero_spatial", f"{PICK}black_bowl_on_the_ramekin{PLATE}")
    task = find_task("libero_spatial", f"{PICK}black_bowl_on_the_cookie_box{PLATE}")
    assert definition_of(task).goal == (("on", "akita_black_bowl_1", "plate_1"),)
    assert definition_of(carry(task, scene)).goal == (("on", "akita_black_bowl_2", "plate_1"),)
    assert ("on", "akita_black_bowl_2", "cookies_1") in definition_of(scene).start
    with pytest.raises(CannotCarryError, match="no akita black bowl stands at its place"):
        definition_of(carry(scene, task))


def test_levels_are_distances_between_what_both_tasks_take() -> None:
    """The regions of the object suite are squares of 5 cm, whose middles are read by hand."""
    soup, milk, butter = (
        find_task("libero_object", f"{PICK}{name}{BASKET}") for name in ("alphabet_soup", "milk", "butter")
    )
    # Soup at (-0.12, -0.24), milk at (0.10, -0.20), butter at (-0.20, -0.08).
    assert np.hypot(0.22, 0.04) == pytest.approx(0.224, abs=1e-3)
    assert level_of_pair(milk, soup) == 3
    assert np.hypot(0.08, 0.16) == pytest.approx(0.179, abs=1e-3)
    assert level_of_pair(butter, soup) == 2


UNCLEAR = (
    f"{PICK}black_bowl_next_to_the_ramekin{PLATE}",
    f"{PICK}black_bowl_between_the_plate_and_the_ramekin{PLATE}",
)
"""Task and scene of the only pair whose scene has two bowls in the place that the instruction names."""


def test_both_bowls_of_the_pair_that_plans_leave_out_stand_next_to_the_ramekin() -> None:
    """Their ranges are read in LIBERO's file by a pattern, without the parser."""
    text = find_task("libero_spatial", UNCLEAR[1]).bddl_file.read_text()
    middles: dict[str, Floats] = {}
    for name, numbers in re.findall(RANGE, text):
        low_x, low_y, high_x, high_y = map(float, numbers.split())
        middles[name] = np.array([low_x + high_x, low_y + high_y]) / 2
    for bowl in ("next_to_ramekin_region", "between_plate_ramekin_region"):
        assert np.linalg.norm(middles[bowl] - middles["ramekin_region"]) < 0.17, "LIBERO's own are 0.12 to 0.13 m apart"


def test_held_out_pairs_are_never_planned() -> None:
    axis = GoalAxis()
    for suite in SUITES:
        planned = set()
        for task in tasks(suite):
            planned |= {(task.name, scene) for scene in axis.entries(task)}
        held = {(task.name, scene.name) for task, scene in held_out_pairs(suite)}
        assert not planned & held
        unclear = {UNCLEAR} if suite == "libero_spatial" else set()
        assert planned | held == {(pair.task.name, pair.scene.name) for pair in usable(suite)} - unclear


def test_starts_are_shared_by_all_tasks_of_a_scene() -> None:
    one, other = (GoalPerturbation(scene="a", start=3, level=each) for each in (1, 5))
    assert one.reset_seed == other.reset_seed
    seeds = {GoalPerturbation(scene=scene, start=start, level=1).reset_seed for scene in "ab" for start in range(50)}
    assert len(seeds) == 100


@pytest.mark.slow
def test_tasks_that_share_a_start_begin_in_the_same_state() -> None:
    scene = find_task("libero_object", f"{PICK}alphabet_soup{BASKET}")
    seed = GoalPerturbation(scene=scene.name, start=0, level=1).reset_seed
    starts = []
    for grocery in ("milk", "butter"):
        environment = Environment(carry(find_task("libero_object", f"{PICK}{grocery}{BASKET}"), scene))
        starts.append((environment.reset(seed), environment.state.tolist()))
        environment.close()
    assert starts[0] == starts[1]


def test_perturbations_depend_on_their_key_and_keep_to_the_configured_levels() -> None:
    milk = find_task("libero_object", f"{PICK}milk{BASKET}")
    axis = GoalAxis(levels=(2, 3), starts=4)
    perturbations = [
        axis.sample(rng(0, "goal", number), milk, number % len(axis.entries(milk))) for number in range(100)
    ]
    assert perturbations == [
        axis.sample(rng(0, "goal", number), milk, number % len(axis.entries(milk))) for number in range(100)
    ]
    assert {one.level for one in perturbations} <= {2, 3}
    assert {one.start for one in perturbations} == {0, 1, 2, 3}
    assert {one.scene for one in perturbations} == set(axis.entries(milk))
    assert not GoalAxis().applies(tasks("libero_goal")[0])


def test_other_axes_perturb_the_task_in_its_scene() -> None:
    """Rewrites that mean several things there are left out, and things are moved by their names there."""
    task = find_task("libero_object", f"{PICK}milk{BASKET}")
    axes = Axes(goal=GoalAxis(), pose=PoseAxis(components=("scene",)), language=LanguageAxis())
    config = PlanConfig(seed=1, episodes={"goal+pose+language": 12}, axes=axes)
    rows = plan.make(DemosConfig(tasks=(str(task),)).index().entries, config, ReplayConfig(), benchmark.load())
    planned = [row for row in rows if row.role == "perturbed" and row.wanted]
    assert len(planned) == 12
    assert len({row.trajectory_id for row in rows}) == len(rows)
    for row in planned:
        goal, pose, language = from_json(row.perturbations)
        assert isinstance(goal, GoalPerturbation)
        assert isinstance(pose, ScenePerturbation)
        assert isinstance(language, LanguagePerturbation)
        scene = find_task("libero_object", goal.scene)
        assert (row.task, row.instruction) == (task.name, language.text)
        assert {move.name for move in pose.moves} == set(bddl.read(scene.bddl_file).places)
        assert changed_goal(row.instruction, carry(task, scene), hints=True) is None
        assert row.reset_seed == goal.reset_seed


@pytest.mark.slow
def test_a_rewrite_that_means_two_things_of_the_scene_is_left_out() -> None:
    """A can is soup or tomato sauce where both stand."""
    left_out = 0
    for pair in usable("libero_object"):
        own, there = (set(LanguageAxis().entries(task)) for task in (pair.task, pair.carried_task))
        assert there <= own
        assert len(there) > 10
        left_out += len(own - there)
    assert left_out > 0


@pytest.mark.slow
def test_every_rewrite_joined_with_the_axis_goal_names_its_things() -> None:
    """A description such as this one holds in the task's own scene, which has no milk."""
    riddle, test = "find the only thing here that you would pour into a glass and drink", benchmark.load()
    juice = find_task("libero_object", f"{PICK}orange_juice{BASKET}")
    assert any(riddle in text for text in LanguageAxis().list_clear_rewrites(juice, test))
    for suite in TESTED_SUITES:
        for pair in usable(suite):
            bank = load_bank()[pair.task.suite][pair.task.name]
            named = {text for component in ("distraction", "paraphrase") for text in bank[component]}
            wordings = LanguageAxis().list_clear_rewrites(pair.carried_task, test, other_objects=True)
            assert {*wordings, *LanguageAxis().restrict_for([GoalAxis()]).entries(pair.carried_task)} <= named
            assert len(wordings) > 10


def test_an_edited_scene_of_an_own_suite_gives_other_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A region of one file grows by 5 mm, and the milk is carried there. LIBERO's scenes have no sum."""
    names = ("alphabet_soup", "cream_cheese", "milk")
    source = {name: find_task("libero_object", f"{PICK}{name}{BASKET}") for name in names}
    plan_of_run = PlanConfig.model_validate({"episodes": {"goal": 4}})
    found = []
    for folder in ("before", "after"):
        own = tmp_path / folder / "tasks" / "kitchen"
        own.mkdir(parents=True)
        for name, task in source.items():
            text = task.bddl_file.read_text()
            edited = text.replace("(-0.145 -0.265 -0.095 -0.215)", "(-0.145 -0.265 -0.095 -0.210)")
            assert edited != text
            (own / f"pack_{name}.bddl").write_text(text if folder == "before" or name == "milk" else edited)
        monkeypatch.chdir(tmp_path / folder)
        for cached in (pairs, held_out_pairs):
            cached.cache_clear()
        task = find_task("kitchen", "pack_milk")
        entry = DemoEntry(task, "demo_0", "recorded", "human", "a" * 64, 100)
        made = GoalAxis().sample(rng("own"), task, 0)
        row = plan.build_row(entry, [made], 0, ReplayConfig())
        config = {"name": "own", "demos": {"root": "demos", "tasks": [str(task)]}, "plan": plan_of_run}
        listed = inputs.listing(Config.model_validate(config))
        found.append((row.episode_id, row.trajectory_id, listed[f"tasks/kitchen/{made.scene}.bddl"]))
    for before, after in zip(*found, strict=True):
        assert before != after
    of_libero = GoalAxis().sample(rng("own"), source["milk"], 0)
    assert "scene_sha256" not in to_json([of_libero])


def test_disks_of_a_carried_task_are_those_of_its_scene() -> None:
    """LIBERO-Plus's disks are twice as wide in the first scene of the living room."""
    first, second = (next(task for task in tasks("libero_10") if f"ROOM_SCENE{k}_" in task.name) for k in (1, 2))
    for task, scene in ((first, second), (second, first)):
        farthest_m = {}
        for task_there in (scene, carry(task, scene)):
            axis = PoseAxis(components=("scene",), levels=(1,))
            sampled = [axis.sample(rng("t", k), task_there, k) for k in range(200)]
            moves = [move for one in sampled if isinstance(one, ScenePerturbation) for move in one.moves]
            farthest_m[task_there.name] = max(float(np.hypot(move.dx_m, move.dy_m)) for move in moves)
        assert farthest_m[task.name] == pytest.approx(farthest_m[scene.name], rel=0.2)
        assert farthest_m[scene.name] == pytest.approx(0.02 if scene is first else 0.01, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suite", "task", "scene", "goal"),
    [
        ("libero_object", f"{PICK}milk{BASKET}", f"{PICK}alphabet_soup{BASKET}", "(In milk_1 basket_1_contain_region)"),
        (
            "libero_spatial",
            f"{PICK}black_bowl_on_the_cookie_box{PLATE}",
            f"{PICK}black_bowl_on_the_ramekin{PLATE}",
            "(On akita_black_bowl_2 plate_1)",
        ),
    ],
)
def test_a_kept_replay_repeats_in_liberos_own_environment_of_the_scene(
    suite: str, task: str, scene: str, goal: str, tmp_path: Path
) -> None:
    """Its BDDL file is the scene's, with the goal written here."""
    from libero.libero.envs.env_wrapper import ControlEnv
    from repeat_in_libero import Done, repeated

    settings, demos = ReplayConfig(), DemosConfig(tasks=(f"{suite}/{task}",))
    demo = starter_demo(find_task(suite, task))
    (entry,) = demos.index().entries
    (twin,) = plan.twins([entry], 0, settings)
    assert ReplayJob(twin, twin.trajectory_id, demos, settings, tmp_path)().kept
    strength = level_of_pair(demo.task, find_task(suite, scene))
    change = GoalPerturbation(scene=scene, start=0, level=strength)
    row = plan.build_row(entry, (change,), 0, settings)
    assert ReplayJob(row, twin.trajectory_id, demos, settings, tmp_path)().kept
    trajectory = TrajectoryStore(tmp_path).load(row.trajectory_id)
    assert trajectory.mode == "tracked"
    assert from_json(row.perturbations) == (change,)
    assert task_of(suite, task, row.perturbations).bddl_file.stem == scene
    text = find_task(suite, scene).bddl_file.read_text()
    file = tmp_path / f"{scene}.bddl"
    file.write_text(re.sub(r"\(:goal\s+\(And [^\n]*\n\s+\)", f"(:goal (And {goal}))", text))
    env = ControlEnv(bddl_file_name=str(file), has_offscreen_renderer=False, use_camera_obs=False, ignore_done=True)
    done = Done(demo.task, "goal", row.trajectory_id, trajectory.scene, trajectory.states, trajectory.actions)
    assert repeated(env, done) is None
    own = ControlEnv(
        bddl_file_name=str(find_task(suite, scene).bddl_file),
        has_offscreen_renderer=False,
        use_camera_obs=False,
        ignore_done=True,
    )
    assert repeated(own, done) == "the goal is not reached", "the scene's own goal is another one"
