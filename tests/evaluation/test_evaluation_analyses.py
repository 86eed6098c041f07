"""The paper's analyses: what they compute is worked by hand, and what they run is LIBERO's own scene and judgement."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import STOVE
from episode_results import result

from pipeline.__main__ import parser
from pipeline.axes import Perturbation, to_json
from pipeline.axes.camera import CameraAxis, SphericalRange
from pipeline.axes.noise import NoiseAxis, NoisePerturbation
from pipeline.errors import PipelineError
from pipeline.evaluation import composition, own_draws
from pipeline.evaluation.composition import Pair
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.own_draws import OWN_AXES, PlannedDraws, draw
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.results import EpisodeFiles, read, stored
from pipeline.evaluation.selection import Selection, candidates, construct, select
from pipeline.evaluation.statistics import difficulty
from pipeline.evaluation.task_list import write_tasks
from pipeline.evaluation.tasks import EvaluationTask, find_replacement, replacements
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task
from pipeline.planning import plan
from pipeline.types import Floats


def analyse(*arguments: str) -> int:
    """Run the command ``analyse``; its exit code."""
    parsed = parser().parse_args(["analyse", *arguments])
    return int(parsed.run(parsed) or 0)


def some_pairs(**fields: Any) -> list[EvaluationTask]:
    return select(Selection(source="pairs", suites=(STOVE.suite,), tasks=(STOVE.name,), **fields))


def test_the_gap_is_as_worked_by_hand() -> None:
    pair = Pair("robot", "camera", trials=100, neither=90, only_one=60, only_other=50, both=20)
    # 220 successes: the joint probability is 20 / 220, the marginal ones are 80 / 220 and 70 / 220.
    assert pair.joint == pytest.approx(1 / 11)
    assert pair.product == pytest.approx(80 * 70 / 220**2)
    assert pair.gap == pytest.approx(-3 / 121)
    # 220 (90 * 20 - 60 * 50)^2 / (140 * 80 * 150 * 70)
    assert pair.chi_square()[0] == pytest.approx(2.693878, abs=1e-6)
    assert pair.chi_square()[1] == pytest.approx(0.100735, abs=1e-6)
    indicators = np.repeat([[0, 0], [1, 0], [0, 1], [1, 1]], [90, 60, 50, 20], axis=0)
    assert pair.gap == pytest.approx(np.cov(indicators.T, bias=True)[0, 1])
    # Where each perturbation keeps its own share, whatever the other does, there is no gap.
    assert Pair("robot", "camera", 100, 80, 40, 20, 10).gap == pytest.approx(0)
    assert Pair("robot", "camera", 100, 80, 40, 20, 10).chi_square() == pytest.approx((0, 1))
    assert Pair("robot", "camera", 10, 0, 0, 0, 0).figures()["gap"] is None


def test_pairs_reuse_the_draws_and_initial_states_of_their_singles() -> None:
    tasks = some_pairs(axes=("robot", "camera", "light", "noise"), episodes=5)
    assert Counter(len(task.axis.split("+")) for task in tasks if task.axis != "clean") == {1: 5 * 4, 2: 5 * 6}
    assert sum(task.axis == "clean" for task in tasks) == 5
    assert {task.level for task in tasks if task.axis == "robot"} == {1, 2, 3, 4, 5}
    singles = {(task.axis, task.number): task for task in tasks}
    for task in tasks:
        for axis in task.axis.split("+") if task.axis != "clean" else ():
            single = singles[axis, task.number]
            assert draw(task, 0, axis=axis) == draw(single, 0)
            assert single.level == task.level
    alone = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot",)))
    assert singles["robot", 0] in alone, "results of held-out perturbations serve pairs too"
    assert some_pairs(axes=("noise", "robot"))[-1].axis == "robot+noise", "in the order in which they apply"
    both_suites = select(Selection(source="pairs", suites=("libero_object", STOVE.suite), axes=("robot", "noise")))
    assert set(some_pairs(axes=("robot", "noise"))) < set(both_suites), "levels do not depend on what else is chosen"
    with pytest.raises(PipelineError, match="combinations"):
        some_pairs(subset=10)


def test_the_gap_counts_trials_with_all_four_combinations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = some_pairs(axes=("robot", "noise"), episodes=4)
    for task in tasks:
        # The last trial lacks its pair, that before it was refused.
        if task.axis == "robot+noise" and task.number == 3:
            continue
        ended = {"reason": "refused"} if task.axis == "robot+noise" and task.number == 2 else {}
        success = task.axis == "clean" or (task.axis == "noise" and task.number == 0)
        EpisodeFiles(tmp_path).save(result(task, success, **ended))
    assert analyse("gap", str(tmp_path)) == 0
    (pair,) = composition.pairs(stored([tmp_path]))
    assert replace(pair, interval=None) == Pair("robot", "noise", 2, neither=2, only_one=0, only_other=1, both=0)
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert printed["robot+noise"]["trials"] == 2
    assert printed["robot+noise"]["bootstrap"]["resampled"] == "2 trials"
    assert printed["robot+noise"]["papers_chi_square"] == {"statistic": None, "p_value": None}
    assert json.loads((tmp_path / "gap.json").read_text()) == printed
    assert (tmp_path / "gap.png").read_bytes().startswith(b"\x89PNG")
    names, shown = composition.matrix([pair, Pair("robot", "camera", 100, 90, 60, 50, 20)])
    assert names == ["robot", "camera", "noise"]
    assert shown[0, 1] == pytest.approx(80 * 70 / 220**2), "the product stands above the diagonal"
    assert shown[1, 0] == pytest.approx(1 / 11)
    EpisodeFiles(tmp_path).save(result(tasks[0], True, "q"))
    with pytest.raises(PipelineError, match="several policies"):
        analyse("gap", str(tmp_path))


def test_the_gap_leaves_out_a_pair_of_other_draws_than_its_singles(tmp_path: Path) -> None:
    for task in some_pairs(axes=("robot", "noise"), episodes=2):
        axes = task.axis.split("+") if task.axis != "clean" else ()
        drawn = json.loads(to_json(draw(task, task.number if len(axes) == 2 else 0, axis=axis) for axis in axes))
        EpisodeFiles(tmp_path).save(result(task, perturbations=drawn))
    (pair,) = composition.pairs(stored([tmp_path]))
    assert pair.trials == 1, "the second pair was drawn under another seed"


def test_difficulty_is_the_papers_for_four_models_and_even_for_others() -> None:
    assert [difficulty(solved, 4) for solved in range(5)] == [5, 4, 3, 2, 1]
    assert [difficulty(solved, 2) for solved in range(3)] == [5, 3, 1]
    assert [difficulty(solved, 3) for solved in range(4)] == [5, 4, 2, 1]
    assert [difficulty(solved, 1) for solved in range(2)] == [5, 1]
    # 8 models: 4 solved / 8 is 0.5 at one model, and goes to the harder.
    assert [difficulty(solved, 8) for solved in range(9)] == [5, 5, 4, 4, 3, 3, 2, 2, 1]


def test_tasks_are_graded_by_the_models_that_solve_them(tmp_path: Path) -> None:
    tasks = select(Selection(suites=(STOVE.suite,)))
    for model in range(4):
        for place, task in enumerate(tasks[: 9 if model == 0 else 10]):
            EpisodeFiles(tmp_path / str(model)).save(result(task, place > 2 * model))
    graded = tmp_path / "graded.json"
    assert analyse("grade", *(str(tmp_path / str(model)) for model in range(4)), "--out", str(graded)) == 0
    content = json.loads(graded.read_text())
    expected = {task.name: 5 - sum(place > 2 * model for model in range(4)) for place, task in enumerate(tasks[:9])}
    assert {task["name"]: task["difficulty"] for task in content["tasks"]} == expected
    assert set(select(Selection(file=graded))) == set(tasks[:9])


def test_a_graded_task_keeps_its_name_where_another_component_was_drawn(tmp_path: Path) -> None:
    (task,) = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot",), levels=(3,)))
    (other,) = {"controller_posture", "initial_joints"} - {task.component}
    EpisodeFiles(tmp_path).save(result(replace(task, component=other), True))
    graded = tmp_path / "graded.json"
    assert analyse("grade", str(tmp_path), "--out", str(graded)) == 0
    assert select(Selection(file=graded)) == [task]


def test_a_task_that_was_run_twice_under_one_setting_does_not_count_twice(tmp_path: Path) -> None:
    (task,) = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))
    for episode in ("a", "b"):
        EpisodeFiles(tmp_path).save(result(task, True, episode=episode))
    with pytest.raises(PipelineError, match=r"counts twice: libero/.* by p: episode a and b"):
        read([tmp_path])


@pytest.mark.slow
def test_a_benchmark_is_drawn_filtered_balanced_and_read_back(tmp_path: Path) -> None:
    drawn = candidates(seed=3, each=20)
    assert Counter((task.suite, task.axis) for task in drawn) == {
        (suite, axis): 20 for suite in Selection().suites for axis in OWN_AXES if axis != "disturbance"
    }
    assert len(set(drawn)) == len(drawn)
    refused = [task for task in drawn if task.axis == "layout"][:5]
    chosen, counts = construct(drawn, 3, 210, [result(task, reason="refused", seed=3) for task in refused])
    assert (counts["candidates"], counts["refused"], counts["overlapping"]) == (560, 5, 0)
    assert set(Counter(task.axis for task in chosen).values()) == {30}
    assert not set(refused) & set(chosen)
    assert set(chosen) < set(drawn)
    file = tmp_path / "tasks.json"
    write_tasks(chosen, 3, file)
    assert select(Selection(file=file, seed=3)) == chosen
    lights = select(Selection(file=file, seed=3, axes=("light",), subset=10))
    assert len(lights) == 10
    assert {task.axis for task in lights} == {"light"}
    with pytest.raises(PipelineError, match="--seed 3"):
        select(Selection(file=file))
    file.write_text("[]")
    with pytest.raises(PipelineError, match="not a list of tasks"):
        select(Selection(file=file))


def test_a_list_is_of_the_draws_that_it_was_made_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("camera",)))
    file = tmp_path / "tasks.json"
    write_tasks(drawn, 0, file)
    assert select(Selection(file=file)) == drawn
    ranges = CameraAxis(spherical=SphericalRange(elevation_deg=((0.0, 1.0),)))
    monkeypatch.setattr(own_draws, "held_out", lambda _: ranges)
    with pytest.raises(PipelineError, match="this version draws other perturbations"):
        select(Selection(file=file))


def test_a_benchmark_is_filtered_by_results_of_its_own_seed() -> None:
    candidate = EvaluationTask("own", STOVE.suite, STOVE.name, "a", "robot", "initial_joints", 1, 0)
    with pytest.raises(PipelineError, match=r"a result of seed 0(?s:.*)expected: seed 3"):
        construct([candidate], 3, 1, [result(candidate, reason="refused")])
    assert construct([candidate], 3, 1, [result(candidate, reason="refused", seed=3)])[0] == []


def planned_row(task: EvaluationTask, *perturbations: Perturbation) -> plan.Row:
    """A row of a plan that a training run would make."""
    fields: dict[str, Any] = dict.fromkeys(plan.Row.__dataclass_fields__, "")
    fields |= {"suite": task.suite, "task": task.base, "episode_id": "planted", "perturbations": to_json(perturbations)}
    return plan.Row(**{**fields, "demo_steps": 1, "rank": 0, "wanted": True, "seed": 0, "variant": 0})


@pytest.mark.parametrize("axis", OWN_AXES)
def test_a_planted_copy_of_a_held_out_draw_is_found(axis: str) -> None:
    tasks = select(Selection(source="own", suites=(STOVE.suite,), tasks=("put_the_bowl_on_the_plate",), axes=(axis,)))
    base = find_task(tasks[0].suite, tasks[0].base)
    drawn = [(task.name, draw(task, 0), base) for task in tasks]
    (found,) = own_draws.compare(drawn, PlannedDraws([planned_row(tasks[2], drawn[2][1])])).values()
    assert found["overlaps"] >= 1
    assert found["smallest"] == 0
    assert found["closest"] == (tasks[2].name, "planted")
    other = own_draws.compare(drawn, PlannedDraws([planned_row(tasks[2], draw(tasks[2], 1))]))[axis]
    assert other["draws"] == 5
    assert other["planned"] == 1
    assert own_draws.compare(drawn, PlannedDraws([]))[axis]["smallest"] is None


def test_held_out_noise_keeps_clear_of_every_strength_that_plans_have() -> None:
    axis = NoiseAxis()
    effects = [effect for name in ("motion", "gaussian", "zoom", "fog", "glass") for effect in getattr(axis, name)]
    trained = [NoisePerturbation(component=effect.component, effect=effect, level=1, seed=0) for effect in effects]
    tasks = select(Selection(source="own", axes=("noise",), episodes=2))
    planned = PlannedDraws([planned_row(tasks[0], one) for one in trained])
    found = own_draws.compare(((task.name, draw(task, 0), STOVE) for task in tasks), planned)["noise"]
    assert found["overlaps"] == 0
    assert found["smallest"] is not None
    assert found["smallest"] >= found["clearance"]


def test_leakage_of_results_is_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot", "light")))
    for task in tasks:
        recorded = json.loads(to_json([draw(task, 0)]))
        EpisodeFiles(tmp_path).save(result(task, perturbations=recorded))
    config = tmp_path / "mine.yaml"
    config.write_text(f"name: mine\nfolder: {tmp_path}\nplan:\n  episodes: {{robot: 1}}\n")
    file = tmp_path / "mine" / "plan.parquet"
    file.parent.mkdir()
    plan.write([planned_row(tasks[0], draw(tasks[0], 0))], file)
    assert analyse("leakage", str(tmp_path), str(config)) == 1
    printed = json.loads(capsys.readouterr().out)
    assert (printed["robot"]["overlaps"], printed["light"]["overlaps"]) == (1, 0)
    plan.write([planned_row(tasks[0], draw(tasks[0], 1))], file)
    assert analyse("leakage", str(tmp_path), str(config)) == 0


def test_language_has_no_held_out_draws_and_says_what_else_there_is() -> None:
    with pytest.raises(PipelineError, match="language has no held-out perturbations") as caught:
        select(Selection(source="own", axes=("language",)))
    assert "--source libero_plus --axis language" in str(caught.value)


def test_goals_are_replaced_by_what_fits_and_is_named_alone() -> None:
    def asked(suite: str, name: str) -> set[str]:
        return {one.instruction for one in replacements(find_task(suite, name))}

    assert asked("libero_goal", "put_the_bowl_on_top_of_the_cabinet") == {
        "put the cream cheese on top of the cabinet",
        "put the wine bottle on top of the cabinet",
    }
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


def test_a_goal_task_changes_nothing_but_its_goal() -> None:
    for task in select(Selection(source="goals")):
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


@pytest.fixture(scope="module")
def evaluated() -> Iterator[EpisodeEnvironment]:
    environment = EpisodeEnvironment()
    yield environment
    environment.close()


@pytest.mark.slow
def test_liberos_environment_judges_the_new_goal_and_not_the_old(evaluated: EpisodeEnvironment) -> None:
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


@pytest.mark.slow
def test_a_pair_composes_what_its_singles_draw(evaluated: EpisodeEnvironment) -> None:
    tasks = {task.axis: task for task in some_pairs(axes=("layout", "robot", "camera"))}
    evaluated.reset(tasks["robot"])
    robot = evaluated.perturbations
    evaluated.reset(tasks["layout"])
    layout, placed = evaluated.perturbations, evaluated.resolved["layout"]
    evaluated.reset(tasks["layout+robot"])
    assert tuple(evaluated.perturbations) == (*layout, *robot)
    assert evaluated.resolved["layout"] == placed, "objects stand where they stand without the other axis"
    assert evaluated.resolved.keys() == {"layout", "robot"}
    evaluated.reset(tasks["robot+camera"])
    assert [one.axis for one in evaluated.perturbations] == ["robot", "camera"]


@pytest.mark.slow
def test_draws_that_a_plan_has_are_drawn_anew(tmp_path: Path) -> None:
    task = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("camera",), levels=(3,)))[0]
    file = tmp_path / "plan.parquet"
    plan.write([planned_row(task, draw(task, 0))], file)
    settings = EpisodeSettings(plan=file)
    assert settings.model_dump()["plan"] == own_draws.sha256_of(file)
    assert "plan" not in EpisodeSettings().model_dump()
    environment = EpisodeEnvironment(settings)
    environment.reset(task)
    (used,) = environment.perturbations
    assert used == draw(task, 0, attempt=1)
    plan.write([planned_row(task, draw(task, 0, attempt=attempt)) for attempt in range(20)], tmp_path / "all.parquet")
    environment.settings = EpisodeSettings(plan=tmp_path / "all.parquet")
    progress = environment.reset(task)
    assert (progress.over, progress.success, progress.reason) == (True, False, "refused")
    environment.close()
