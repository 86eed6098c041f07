"""The plan: keyed samples, quotas with replacements in plan order, and every row accounted for."""

import re
from collections import Counter
from itertools import chain, islice
from pathlib import Path

import pytest
import yaml
from checkout import REPOSITORY
from faults import read_with_flipped_bits
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from pipeline.axes import Axes, from_json, to_json
from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import LEVELS
from pipeline.axes.camera import CameraAxis
from pipeline.axes.language import LanguageAxis, LanguagePerturbation, list_rewrites
from pipeline.axes.layout import LayoutAxis, LayoutPerturbation
from pipeline.axes.noise import NoiseAxis
from pipeline.axes.pose import PoseAxis
from pipeline.config import PlanConfig, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero.demonstrations import DemoEntry
from pipeline.libero.tasks import find_task, tasks
from pipeline.planning import plan, selection
from pipeline.planning.apportion import apportion
from pipeline.planning.sampler import Sampler
from pipeline.seeding import rng
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Verdict

REPLAY = ReplayConfig()
NO_TESTS = TestSet(())
TASKS = tasks("libero_goal")[:3]
STILL = {"open_the_middle_drawer_of_the_cabinet", "turn_on_the_stove"}
"""Tasks that put nothing anywhere."""
ALL = Axes(camera=CameraAxis(), noise=NoiseAxis(), language=LanguageAxis())


def entries(per_task: int = 4) -> list[DemoEntry]:
    return [
        DemoEntry(task, f"demo_{n}", "test", "human", f"{task.name}/{n}", steps=100)
        for task in TASKS
        for n in range(per_task)
    ]


def config(**changes: object) -> PlanConfig:
    fields = {"seed": 3, "axes": ALL, "episodes": {"camera": 9, "noise": 10, "language": 6}, "reserve": 0.5}
    return PlanConfig.model_validate(fields | changes)


def test_a_row_depends_on_its_key_alone() -> None:
    """Order of the demonstrations, other axes and other demonstrations leave a perturbation as it is."""
    whole = {row.episode_id: row for row in plan.make(entries(), config(), REPLAY, NO_TESTS)}
    backwards = plan.make(entries()[::-1], config(), REPLAY, NO_TESTS)
    perturbations = {(r.demo_id, r.axis, r.variant): r.perturbations for r in whole.values()}
    again = {(r.demo_id, r.axis, r.variant): r.perturbations for r in backwards}
    common = perturbations.keys() & again.keys()
    assert len(common) > 20
    assert all(perturbations[key] == again[key] for key in common)
    camera_only = plan.make(entries(), config(axes=Axes(camera=CameraAxis()), episodes={"camera": 9}), REPLAY, NO_TESTS)
    assert {row.episode_id for row in camera_only} <= whole.keys()
    other_seed = plan.make(entries(), config(seed=4), REPLAY, NO_TESTS)
    assert not {r.perturbations for r in other_seed if r.axis == "camera"} & set(perturbations.values())


def test_quotas_are_spread_evenly_and_twins_complete() -> None:
    rows = plan.make(entries(), config(), REPLAY, NO_TESTS)
    assert len({row.episode_id for row in rows}) == len(rows)
    wanted = {axis: [r for r in rows if r.axis == axis and r.wanted] for axis in ("camera", "noise", "language")}
    assert {axis: len(of_axis) for axis, of_axis in wanted.items()} == {"camera": 9, "noise": 10, "language": 6}
    by_task = [sum(row.task == task.name for row in wanted["noise"]) for task in TASKS]
    assert sorted(by_task) == [3, 3, 4]
    twins = {row.demo_id: row for row in rows if row.role == "twin"}
    assert twins.keys() == {entry.demo_id for entry in entries()}
    for row in rows:
        twin = twins[row.demo_id]
        assert row.twin_id == twin.episode_id
        # Camera, noise and language need no physics of their own.
        assert row.trajectory_id == twin.trajectory_id
        if row.axis != "language":
            assert row.instruction == twin.instruction
        else:
            assert row.instruction != twin.instruction


@given(wanted=st.integers(1, 500), number=st.integers(1, 60))
def test_equal_weights_spread_evenly_with_the_first_ahead(wanted: int, number: int) -> None:
    """As plans before weights were spread: quotient for every task, and one more for as many as the remainder."""
    quotient, remainder = divmod(wanted, number)
    assert apportion(wanted, [1.0] * number) == [quotient + (place < remainder) for place in range(number)]


@pytest.mark.parametrize(("wanted", "reserve", "candidates"), [(1, 0.3, 2), (4, 0.3, 6), (2, 0.5, 3), (3, 0.0, 3)])
def test_a_reserve_is_rounded_up(wanted: int, reserve: float, candidates: int) -> None:
    demos = [demo for demo in entries(2) if demo.task == TASKS[0]]
    one = config(axes=Axes(noise=NoiseAxis()), episodes={"noise": wanted}, reserve=reserve)
    perturbed = [row for row in plan.make(demos, one, REPLAY, NO_TESTS) if row.role == "perturbed"]
    assert (len(perturbed), sum(row.wanted for row in perturbed)) == (candidates, wanted)
    from_resets = [row for row in plan.resets(demos, wanted, reserve, 0, REPLAY) if row.role == "perturbed"]
    assert (len(from_resets), sum(row.wanted for row in from_resets)) == (candidates, wanted)


def test_demonstrations_are_counted_for_the_task_with_most() -> None:
    rows_of_tasks: list[list[plan.Row]] = []
    for task, number in ((TASKS[0], 2), (TASKS[1], 5), (tasks("libero_object")[0], 3)):
        demos = [DemoEntry(task, f"demo_{n}", "test", "human", f"{task.name}/{n}", steps=100) for n in range(number)]
        rows_of_tasks.append(plan.twins(demos, 0, REPLAY))
    for listed in (rows_of_tasks, rows_of_tasks[::-1]):
        assert plan.count_demonstrations([*chain(*listed)]) == {"libero_goal": 5, "libero_object": 3}


def test_round_trip(tmp_path: Path) -> None:
    rows = plan.make(entries(), config(), REPLAY, NO_TESTS)
    plan.write(rows, tmp_path / "plan.parquet")
    assert plan.read(tmp_path / "plan.parquet") == rows
    plan.write(rows, tmp_path / "again.parquet")
    assert (tmp_path / "plan.parquet").read_bytes() == (tmp_path / "again.parquet").read_bytes()
    (tmp_path / "plan.parquet").write_bytes(b"PAR1 cut short")
    with pytest.raises(PipelineError, match=r"plan\.parquet: the file is damaged"):
        plan.read(tmp_path / "plan.parquet")


def test_no_flipped_bit_is_read(tmp_path: Path) -> None:
    """Either the plan is rejected, or it is the one that was written."""
    rows, file = plan.make(entries(), config(), REPLAY, NO_TESTS), tmp_path / "plan.parquet"
    plan.write(rows, file)
    content = file.read_bytes()
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    places = rng("test_plan").integers([0, footer], len(content), size=(100, 2)).ravel()
    results = read_with_flipped_bits(file, places, lambda: plan.read(file))
    assert all(read == rows for read in results)
    assert len(places) - len(results) > 100


def test_a_replay_setting_is_part_of_the_identity() -> None:
    kept = {row.episode_id for row in plan.make(entries(), config(), ReplayConfig(noops="keep"), NO_TESTS)}
    assert not kept & {row.episode_id for row in plan.make(entries(), config(), REPLAY, NO_TESTS)}


@pytest.mark.slow
@given(st.lists(st.booleans(), min_size=12, max_size=12))
def test_replacements_until_full_or_exhausted(succeeds: list[bool]) -> None:
    rows = plan.make(entries(), config(), REPLAY, NO_TESTS)
    truth = {
        row.trajectory_id: Verdict(True, "kept") if good else Verdict(False, "goal_not_reached")
        for row, good in zip((r for r in rows if r.role == "twin"), succeeds, strict=True)
    }
    known: dict[str, Verdict] = {}
    rounds = 0
    while needed := selection.pending(rows, known):
        assert not set(needed) & known.keys()
        known |= {trajectory_id: truth[trajectory_id] for trajectory_id in needed}
        rounds += 1
        assert rounds < 10
    outcome = selection.select(rows, known)
    assert outcome.keys() == {row.episode_id for row in rows}
    for axis in ("camera", "noise", "language"):
        for task in TASKS:
            group = sorted((r for r in rows if (r.axis, r.task) == (axis, task.name)), key=lambda r: r.rank)
            wanted = sum(row.wanted for row in group)
            good = [row for row in group if truth[row.trajectory_id].kept]
            kept = [row for row in group if outcome[row.episode_id].kept]
            assert len(kept) == min(wanted, len(good)), "no more than wanted"
            assert {row.rank for row in good if row.wanted} <= {row.rank for row in kept}
            for row in group:
                reason, good_row = outcome[row.episode_id].reason, truth[row.trajectory_id].kept
                possible = {"kept" if good_row else "goal_not_reached"}
                if not row.wanted and len(kept) == wanted:
                    possible.add("reserve_not_needed")
                assert reason in possible


def test_rejected_frames_are_replaced_from_the_reserve() -> None:
    rows = plan.make(entries(), config(), REPLAY, NO_TESTS)
    verdicts = {row.trajectory_id: Verdict(True, "kept") for row in rows}
    group = sorted((r for r in rows if (r.axis, r.task) == ("camera", TASKS[0].name)), key=lambda row: row.rank)
    first, reserves = group[0], [row for row in group if not row.wanted]
    before = selection.select(rows, verdicts)
    assert {before[reserve.episode_id].reason for reserve in reserves} == {"reserve_not_needed"}
    outcome = selection.select(rows, verdicts, {first.episode_id: "too_dark"})
    assert outcome[first.episode_id] == Verdict(False, "too_dark")
    assert sum(outcome[reserve.episode_id].kept for reserve in reserves) == 1


def test_a_reserve_has_the_level_and_component_of_what_it_replaces() -> None:
    """As far as a reserve of these is left; then the nearest level, then the first."""
    many = config(axes=Axes(camera=CameraAxis()), episodes={"camera": 120}, reserve=1.0)
    rows = [row for row in plan.make(entries(), many, REPLAY, NO_TESTS) if row.task == TASKS[0].name]
    wanted = [row for row in rows if row.axis == "camera" and row.wanted]
    reserves = [row for row in rows if row.axis == "camera" and not row.wanted]
    verdicts = {row.trajectory_id: Verdict(True, "kept") for row in rows}
    for failed in wanted:
        outcome = selection.select(rows, verdicts, {failed.episode_id: "too_dark"})
        (used,) = (row for row in reserves if outcome[row.episode_id].kept)
        alike = [row for row in reserves if (row.level, row.component) == (failed.level, failed.component)]
        of_level = [row for row in reserves if row.level == failed.level]
        assert used in (alike or of_level)
    strongest = {row.episode_id: "too_dark" for row in wanted if row.level == "5"}
    outcome = selection.select(rows, verdicts, strongest)
    kept = Counter(row.level for row in [*wanted, *reserves] if outcome[row.episode_id].kept)
    of_strongest = sum(row.level == "5" for row in reserves)
    assert kept["5"] == min(len(strongest), of_strongest)


def test_an_exhausted_axis_is_said_and_planned_as_far_as_it_goes() -> None:
    wanted = config(axes=Axes(language=LanguageAxis()), episodes={"language": 300})
    rows = plan.make(entries(1), wanted, REPLAY, NO_TESTS)
    texts = {(row.task, row.instruction) for row in rows if row.axis == "language"}
    bank = {(task.name, rewrite.text) for task in TASKS for rewrite in list_rewrites(task, LanguageAxis().components)}
    assert texts == bank, "every rewrite once"
    assert plan.shortage(rows, wanted) == {"language": 300 - len(bank)}
    assert plan.shortage(plan.make(entries(), config(), REPLAY, NO_TESTS), config()) == {}


@pytest.mark.slow
def test_a_demonstration_without_further_perturbations_leaves_the_places_to_the_others() -> None:
    """The last perturbations are found by chance: of 60, one demonstration finds more of them than another."""
    few = BackgroundAxis(components=("surface",), sources=("libero",))
    wanted = config(axes=Axes(background=few), episodes={"background": 2000}, reserve=0.0)
    demos = entries()
    sampled = {
        demo.demo_id: {
            to_json(perturbations)
            for perturbations in Sampler("background", (few,), wanted.seed, NO_TESTS).sample(demo.demo_id, demo.task)
        }
        for demo in demos
    }
    of_task = {task.name: {len(sampled[demo.demo_id]) for demo in demos if demo.task == task} for task in TASKS}
    assert any(len(numbers) > 1 for numbers in of_task.values()), "some end before others of their task"
    rows = [row for row in plan.make(demos, wanted, REPLAY, NO_TESTS) if row.role == "perturbed"]
    assert {name: {row.perturbations for row in rows if row.demo_id == name} for name in sampled} == sampled
    for task in TASKS:
        assert [row.rank for row in rows if row.task == task.name] == list(
            range(sum(r.task == task.name for r in rows))
        )
    assert plan.shortage(rows, wanted) == {"background": 2000 - sum(map(len, sampled.values()))}


def test_perturbations_that_overlap_with_a_test_task_are_sampled_again() -> None:
    """Plant what was sampled first into the test set: the plan moves away from it, and nothing else changes."""
    camera = config(axes=Axes(camera=CameraAxis()), episodes={"camera": 9})
    first = [row for row in plan.make(entries(), camera, REPLAY, NO_TESTS) if row.axis == "camera"]
    (planted,) = from_json(first[0].perturbations)
    names = ("azimuth_deg", "elevation_deg", "distance_scale", "yaw_deg", "pitch_deg")
    known = {name: getattr(planted, name) for name in names}
    test = TestSet((TestTask("libero_goal", TASKS[0].name, "planted", "camera", planted.component, known),))
    again = [row for row in plan.make(entries(), camera, REPLAY, test) if row.axis == "camera"]
    assert again[0].perturbations != first[0].perturbations
    for row in again:
        (perturbation,) = from_json(row.perturbations)
        assert perturbation.nearest(test, TASKS[0]).distance >= perturbation.clearance
    assert sum(one.perturbations == other.perturbations for one, other in zip(first, again, strict=True)) >= 5


def test_levels_near_the_test_set_are_sampled_as_often_as_others() -> None:
    """Of level 1 here one scene in seven keeps clear of the benchmark's, of level 5 nearly each."""
    study = next(task for task in tasks("libero_10") if task.name.startswith("STUDY_SCENE1"))
    samples = Sampler("pose", (PoseAxis(),), 3, benchmark.load()).sample("demo_0", study)
    levels = Counter(scene.level for (scene,) in islice(samples, 200))
    assert chisquare([levels[level] for level in LEVELS]).pvalue > 0.01


def test_a_rewrite_stays_where_its_camera_is_sampled_again() -> None:
    """So that all of a task's are sampled once before one comes again."""
    axes = (CameraAxis(), LanguageAxis())
    of = ("camera+language", axes, 3)
    number = len(list_rewrites(TASKS[0]))
    first = [*islice(Sampler(*of, NO_TESTS).sample("demo_0", TASKS[0]), number)]
    names = ("azimuth_deg", "elevation_deg", "distance_scale", "yaw_deg", "pitch_deg")
    planted = [
        TestTask(
            "libero_goal", TASKS[0].name, "planted", "camera", camera.component, {n: getattr(camera, n) for n in names}
        )
        for camera, _ in first[::5]
    ]
    again = [*islice(Sampler(*of, TestSet(tuple(planted))).sample("demo_0", TASKS[0]), number)]
    assert sum(camera != other for (camera, _), (other, _) in zip(first, again, strict=True)) >= len(planted)
    assert [text for _, text in again] == [text for _, text in first]
    assert len({text for _, text in again}) == number


def rewrites_of_demonstrations(names: list[str]) -> dict[str, str]:
    """Demonstration to its rewrite, where each of a task's has one."""
    task = TASKS[0]
    demos = [DemoEntry(task, name, "test", "human", f"{task.name}/{name}", steps=100) for name in names]
    one_each = config(axes=Axes(language=LanguageAxis()), episodes={"language": len(demos)}, reserve=0.0)
    rows = plan.make(demos, one_each, REPLAY, NO_TESTS)
    return {row.demo_id: row.instruction for row in rows if row.axis == "language"}


def test_fifty_demonstrations_have_fifty_different_rewrites() -> None:
    names = [f"demo_{number}" for number in range(50)]
    dealt = rewrites_of_demonstrations(names)
    assert len(dealt) == len(set(dealt.values())) == 50
    assert rewrites_of_demonstrations(names[::-1]) == dealt
    assert len(list_rewrites(TASKS[0])) < 70
    times = Counter(rewrites_of_demonstrations([f"demo_{number}" for number in range(140)]).values())
    assert max(times.values()) - min(times.values()) == 1, "each comes twice before one comes a third time"
    assert set(times) == {card.text for card in list_rewrites(TASKS[0])}


def test_another_demonstration_changes_few_rewrites_of_the_others() -> None:
    names = [f"demo_{number}" for number in range(41)]
    whole = rewrites_of_demonstrations(names)
    changed = []
    for left_out in names[::4]:
        fewer = rewrites_of_demonstrations([name for name in names if name != left_out])
        changed.append(sum(whole[demo_id] != text for demo_id, text in fewer.items()))
    assert sum(changed) / len(changed) < 4


def test_no_object_is_added_that_the_rewrite_has_a_word_for() -> None:
    """Such as a glass where the talk around the request is of one."""
    known = [task for suite in ("libero_spatial", "libero_object", "libero_goal", "libero_10") for task in tasks(suite)]
    demos = [DemoEntry(task, f"demo_{n}", "test", "human", f"{task}/{n}", steps=100) for task in known for n in (0, 1)]
    both = Axes(layout=LayoutAxis(levels=(5,)), language=LanguageAxis())
    wanted = config(axes=both, episodes={"layout+language": 1000}, reserve=0.0)
    rows = [row for row in plan.make(demos, wanted, REPLAY, NO_TESTS) if row.role == "perturbed"]
    assert len(rows) == 1000
    confused = []
    for row in rows:
        layout = next(p for p in from_json(row.perturbations) if isinstance(p, LayoutPerturbation))
        for added in layout.objects:
            noun = added.category.split("_of_")[0].split("_")[-1]
            if re.search(rf"\b{noun}s?\b", row.instruction):
                confused.append((added.category, row.instruction))
    assert confused == []


def test_small_numbers_of_each_axis_are_of_other_demonstrations() -> None:
    few = config(episodes={"camera": 4, "noise": 4, "language": 4}, reserve=0)
    rows = [row for row in plan.make(entries(), few, REPLAY, NO_TESTS) if row.role == "perturbed"]
    by_axis = [{row.demo_id for row in rows if row.axis == axis} for axis in few.episodes]
    assert all(len(demos) == 4 for demos in by_axis)
    assert len(set.union(*by_axis)) > 6


def combined(written: str, **axes: object) -> list[plan.Row]:
    one = config(axes=Axes.model_validate(axes), episodes={written: 6})
    return [row for row in plan.make(entries(), one, REPLAY, NO_TESTS) if row.role == "perturbed"]


def test_a_combination_is_the_same_in_whatever_order_it_was_written() -> None:
    axes: dict[str, object] = {"camera": {}, "noise": {}, "language": {}}
    rows = combined("noise+language+camera", **axes)
    assert rows == combined("camera+noise+language", **axes)
    assert len(rows) == 9, "six wanted and half as many in reserve"
    assert sorted(sum(row.wanted and row.task == task.name for row in rows) for task in TASKS) == [2, 2, 2]
    for row in rows:
        perturbations = from_json(row.perturbations)
        assert row.axis == "camera+noise+language" == "+".join(p.axis for p in perturbations)
        assert row.component == "+".join(p.component for p in perturbations)
        assert row.level == "+".join(str(p.level) for p in perturbations)
        assert row.instruction in {p.text for p in perturbations if isinstance(p, LanguagePerturbation)}
    levels = {tuple(p.level for p in from_json(row.perturbations)) for row in rows}
    assert any(len(set(of_parts)) > 1 for of_parts in levels), "each part has a level of its own"


def test_a_combination_fills_a_quota_of_its_own() -> None:
    axes: dict[str, object] = {"camera": {}, "noise": {}}
    together = config(axes=Axes.model_validate(axes), episodes={"camera": 3, "noise+camera": 3, "noise": 3}, reserve=0)
    rows = plan.make(entries(), together, REPLAY, NO_TESTS)
    assert Counter(row.axis for row in rows) == {"clean": 12, "camera": 3, "camera+noise": 3, "noise": 3}
    kept = selection.select(rows, {row.trajectory_id: Verdict(True, "kept") for row in rows})
    assert all(verdict.kept for verdict in kept.values())
    assert plan.shortage(rows, together) == {}
    alone = plan.make(
        entries(), config(axes=Axes(camera=CameraAxis()), episodes={"camera": 3}, reserve=0), REPLAY, NO_TESTS
    )
    assert {row.episode_id for row in alone} <= {row.episode_id for row in rows}
    sampled = [
        next(Sampler(name, (CameraAxis(),), 3, NO_TESTS).sample("demo_0", TASKS[0]))
        for name in ("camera", "camera+noise")
    ]
    assert sampled[0] != sampled[1], "it has samples of its own"


def test_every_part_of_a_combination_keeps_clear_of_the_test_set() -> None:
    axes: dict[str, object] = {"noise": {}, "language": {}}
    first = combined("noise+language", **axes)
    planted = next(p for p in from_json(first[0].perturbations) if isinstance(p, LanguagePerturbation))
    test = TestSet((TestTask("libero_goal", TASKS[0].name, "planted", "language", "rewrite", {"text": planted.text}),))
    again = plan.make(entries(), config(axes=Axes.model_validate(axes), episodes={"noise+language": 6}), REPLAY, test)
    rows = [row for row in again if row.role == "perturbed"]
    assert rows[0].perturbations != first[0].perturbations
    for row in rows:
        assert all(
            p.nearest(test, find_task(row.suite, row.task)).distance >= p.clearance
            for p in from_json(row.perturbations)
        )


def test_rewrites_stay_unambiguous_among_added_objects() -> None:
    axes: dict[str, object] = {"layout": {}, "language": {}}
    rows = combined("language+layout", **axes)
    assert {row.axis for row in rows} == {"layout+language"}
    classes = {p.component for row in rows for p in from_json(row.perturbations) if p.axis == "language"}
    assert classes == {"distraction", "paraphrase"}
    assert len({row.trajectory_id for row in rows}) == len(rows), "layout has physics of its own"


def test_an_axis_is_spread_over_the_tasks_that_it_applies_to() -> None:
    demos = [DemoEntry(task, "demo_0", "test", "human", task.name, steps=100) for task in tasks("libero_goal")]
    pose = config(axes=Axes(pose=PoseAxis(components=("target",))), episodes={"pose": 16}, reserve=0)
    wanted = Counter(row.task for row in plan.make(demos, pose, REPLAY, NO_TESTS) if row.axis == "pose")
    assert wanted.keys() == {task.name for task in tasks("libero_goal")} - STILL
    assert set(wanted.values()) == {2}
    with pytest.raises(PipelineError, match=r"plan\.episodes\.pose: none of the selected tasks"):
        plan.make([demo for demo in demos if demo.task.name in STILL], pose, REPLAY, NO_TESTS)


def test_perturbations_are_readable_and_complete() -> None:
    for row in plan.make(entries(), config(), REPLAY, NO_TESTS):
        (changed,) = from_json(row.perturbations) or (None,)
        assert row.axis == (changed.axis if changed else "clean")
        assert row.component == (changed.component if changed else "clean")
        assert row.level == (str(changed.level) if changed else "0")


def test_the_ranges_of_the_documentation_can_be_planned() -> None:
    """The page has an example for each axis, and what is sampled lies in it."""
    page = (REPOSITORY / "docs" / "configuration.md").read_text()
    blocks = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)]
    ranges = next(block["axes"] for block in blocks if "axes" in block)
    assert ranges.keys() == {"camera", "light", "background", "noise", "language", "layout", "pose", "robot"}
    shown = config(axes=ranges, episodes=dict.fromkeys(ranges, 3), reserve=0)
    rows = [row for row in plan.make(entries(1), shown, REPLAY, benchmark.load()) if row.role == "perturbed"]
    assert Counter(row.axis for row in rows) == dict.fromkeys(ranges, 3)
    components = {axis: {row.component for row in rows if row.axis == axis} for axis in ranges}
    assert components["camera"] <= {"distance", "spherical"}
    assert (components["background"], components["robot"]) == ({"theme"}, {"initial_joints"})
