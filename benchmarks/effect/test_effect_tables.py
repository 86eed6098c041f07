"""Tables of the experiment: rows as they were written, paired differences, exact p-values, and the pages."""

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import comparison
import numpy as np
import pandas as pd
import pytest
import results
from checkout import REPOSITORY
from episode_results import result
from scipy.stats import permutation_test

from pipeline.errors import PipelineError
from pipeline.evaluation.results import EpisodeResult
from pipeline.evaluation.statistics import Pair
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero import bddl
from pipeline.libero.tasks import find_task
from pipeline.types import Floats

EFFECT = Path(__file__).parent
AXES = ("clean", "robot", "language", "pose", "camera", "noise")
BUTTER, BBQ, ORANGE, TOMATO = (
    f"pick_up_the_{thing}_and_place_it_in_the_basket"
    for thing in ("butter", "bbq_sauce", "orange_juice", "tomato_sauce")
)


def row(axis: str, number: int, success: bool, policy: str) -> EpisodeResult:
    source = "libero" if axis == "clean" else "libero_plus"
    task = EvaluationTask(source, "libero_goal", "stove", f"{axis} {number}", axis, axis, 1, number)  # type: ignore[arg-type]
    return result(task, success, policy)


def reading_row(scene: str, kind: str, asked: str | None, reached: str | None) -> dict[str, Any]:
    text = (asked or "").replace("_", " ")
    return {
        **{"scene": scene, "kind": kind, "asked": asked, "state": 0},
        **{"instruction": text, "reached": reached, "steps": 9},
    }


def of_policy(arm: str, seed: int, solved: int) -> results.PolicyResults:
    """Return results: of each axis the first ``solved`` of ten tasks, and one of two instructions, are solved."""
    rows = [row(axis, number, number < solved, f"{arm}{seed}") for axis, number in product(AXES, range(10))]
    outcomes = [("own", "stove", "stove"), ("own", "put_the_bowl_on_the_plate", "stove"), ("nothing", None, "stove")]
    reading = [reading_row("stove", kind, asked, reached) for kind, asked, reached in outcomes]
    settings = {
        "arms": {"clean": [], "ours": ["robot"]},
        "evaluation": {},
        "run": {"demos": {"tasks": ["libero_goal/stove", "libero_goal/put_the_bowl_on_the_plate"]}},
    }
    black = [{"task": "stove", "state": number, "success": number < solved // 4} for number in range(10)]
    return results.PolicyResults(arm, seed, settings, {}, rows, reading, black)


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    written = [of_policy("clean", 0, 4), of_policy("ours", 1, 9)]
    for one in written:
        one.write(tmp_path)
    assert results.read(tmp_path) == written
    in_float32 = replace(written[0], arm="ours", made={"trained_with": {"precision": "float32"}})
    in_float32.write(tmp_path)
    with pytest.raises(PipelineError, match="ours was trained in float32, and clean in bfloat16, under the same seed"):
        results.read(tmp_path)
    (tmp_path / "ours_seed0.json").unlink()
    others: dict[str, dict[str, Any]] = {
        "settings": {"settings": {"frame_px": 32}},
        "packages": {"made": {"packages": {"torch": "1.0"}}},
        "plans of all arms": {"made": {"plan_of_all_arms_sha256": "0"}},
    }
    for what, changed in others.items():
        replace(written[0], arm="other", **changed).write(tmp_path)
        with pytest.raises(PipelineError, match=f"{what} differ from"):
            results.read(tmp_path)


def test_experiments_are_joined_if_their_arms_differ_and_their_policies_were_trained_alike(tmp_path: Path) -> None:
    clean, ours = of_policy("clean", 0, 4), of_policy("ours", 0, 9)
    assert results.join([clean], [ours], tmp_path) == [clean, ours]
    with pytest.raises(PipelineError, match="the arm clean is in both compared experiments"):
        results.join([clean], [ours, of_policy("clean", 1, 4)], tmp_path)
    in_float32 = replace(ours, made={"trained_with": {"precision": "float32"}})
    with pytest.raises(PipelineError, match="ours was trained in float32, and clean in bfloat16, under the same seed"):
        results.join([clean], [in_float32], tmp_path)
    of_another_seed = replace(in_float32, seed=1)
    assert results.join([clean], [of_another_seed], tmp_path) == [clean, of_another_seed]


def test_rewrites_are_compared_with_liberos_instruction_from_the_same_states() -> None:
    """Four states, two seeds: three solved by one instruction alone, once by the rewrite."""
    by_rewrite = {0: (True, True, False, False), 1: (True, False, False, False)}
    policies = []
    for seed, reached in by_rewrite.items():
        policy = of_policy("clean", seed, 4)
        rows = [row("clean", number, number in (0, 2), "clean") for number in range(4)]
        rewritten = [
            reading_row("stove", "rewrite", "stove", "stove" if reached[state] else None) | {"state": state}
            for state in range(4)
        ]
        policies.append(replace(policy, rows=rows, reading=[*policy.reading, *rewritten]))
    text = comparison.markdown(policies)
    assert "| clean | 4 | 38 % (50, 25) | 50 % (50, 50) | 1 | 2 | 1 |" in text
    assert text.count("rewrite") == 3, "in no other table"


def test_the_table_pairs_episodes_seed_by_seed() -> None:
    found = [of_policy("clean", 0, 4), of_policy("clean", 1, 2), of_policy("ours", 0, 9), of_policy("ours", 1, 9)]
    robot = next(one for one in comparison.differences(found) if one["line"] == "robot")
    assert robot["value"] == pytest.approx((18 - 6) / 20)
    assert robot["resampled"] == "10 trials", "both seeds act in the same ten"
    assert robot["holm"] == pytest.approx(4 * robot["p_value"]), "camera and noise have more trials"
    text = comparison.markdown(found)
    assert "| robot | 10 | 30 % (40, 20) | 90 % (90, 90) |" in text
    assert "| camera, noise | 20 | 30 % (40, 20) | 90 % (90, 90) |" in text
    assert "| LIBERO's own, views black | 10 | 5 % (10, 0) | 20 % (20, 20) |" in text
    assert "| robot | +60 (" in text
    assert "| stove | 2 of 2 | 2 of 2 |" in text
    assert "| put the bowl on the plate | 0, stove 2 of 2 | 0, stove 2 of 2 |" in text
    assert "| nothing | stove 2 of 2 | stove 2 of 2 |" in text


def test_a_task_whose_first_state_no_policy_solves_is_left_out_of_a_table() -> None:
    def of_arm(arm: str, solves_camera: bool) -> results.PolicyResults:
        stove = [row("clean", 0, True, arm), *(row("camera", number, solves_camera, arm) for number in range(2))]
        bowl = [row("clean", 0, False, arm), *(row("camera", number, False, arm) for number in range(2))]
        rows = [*stove, *(replace(one, base="bowl", name=f"{one.name} bowl") for one in bowl)]
        return replace(of_policy(arm, 0, 0), rows=rows)

    text = comparison.markdown([of_arm("clean", False), of_arm("ours", True)])
    assert "| camera, noise | 4 | 0 % | 50 % |" in text
    assert "whose first state a policy solves unperturbed" in text
    assert "| camera | 2 | 0 % | 100 % |" in text
    assert "solves unperturbed" not in comparison.markdown([of_policy("clean", 0, 4)])


def test_camera_and_noise_have_lines_of_their_own_next_to_held_out_perturbations() -> None:
    policy = of_policy("ours", 0, 4)
    light = row("light", 0, True, "ours0")
    with_light = replace(policy, settings=policy.settings | {"evaluation": {"held_out": {"light": 1}}})
    text = comparison.markdown([replace(with_light, rows=[*policy.rows, light])])
    for line in ("| camera | 10 | 40 % |", "| noise | 10 | 40 % |", "| light, held out | 1 | 100 % |"):
        assert line in text
    assert "| camera, noise |" not in text


def test_reached_goals_of_several_scenes_are_counted_by_kind() -> None:
    """In the BDDL files, the butter's scene has the tomato sauce at its own place, and the barbecue sauce elsewhere."""
    outcomes = [
        *((BUTTER, "own", BUTTER, BUTTER), (BUTTER, "own", BUTTER, BBQ), (ORANGE, "own", ORANGE, None)),
        *((BUTTER, "held out", BBQ, BUTTER), (BUTTER, "held out", BBQ, BBQ), (ORANGE, "held out", BUTTER, BUTTER)),
        *((BUTTER, "carried", TOMATO, BUTTER), (BUTTER, "carried", ORANGE, TOMATO)),
        *((BUTTER, "nothing", None, BUTTER), (BUTTER, "nothing", None, BBQ)),
    ]
    demos = {"tasks": [f"libero_object/{task}" for task in (BUTTER, BBQ, ORANGE, TOMATO)]}
    settings = {"arms": {"ours": []}, "evaluation": {}, "run": {"demos": demos}}
    reading = [reading_row(*row) for row in outcomes]
    results = [replace(of_policy("ours", seed, 9), settings=settings, reading=reading) for seed in (0, 1)]
    text = comparison.markdown(results)
    assert "| the scene's own instruction | ours | 2 | - | 2 of 6 | 2 of 6 |" in text
    assert "| another task's in the plan, elsewhere | ours | 0 | 0 | 2 of 2 | 0 of 2 |" in text
    assert "| another task's in the plan, at its own place | ours | 0 | 2 | 0 of 2 | 0 of 2 |" in text
    assert "| another task's held out, elsewhere | ours | 2 | 2 | 0 of 4 | 0 of 4 |" in text
    assert "| another task's held out, at its own place | ours | 2 | 0 | 0 of 2 | 0 of 2 |" in text
    assert "| nothing | ours | - | 2 | 2 of 4 | 0 of 4 |" in text


def test_held_out_goals_have_a_line_for_each_kind_of_place() -> None:
    task = EvaluationTask("goals", "libero_object", BUTTER, "name", "goal", "bbq_sauce", 0, 0)
    for asked, line in ((BBQ, "goal"), (TOMATO, "goal, own place")):
        row_of_goal = result(task, instruction=asked.replace("_", " "))
        assert comparison.line_of(of_policy("ours", 0, 9), row_of_goal) == line


def test_wrong_things_stand_at_the_place_that_the_instruction_had_in_training() -> None:
    """The log states it of 28 episodes; the places are those of the BDDL files."""

    def place_m(thing: str, scene: str) -> Any:
        definition = bddl.read(find_task("libero_object", scene).bddl_file)
        return np.array(definition.centres_m[thing])

    def thing_of(task: str) -> str:
        return task.removeprefix("pick_up_the_").removesuffix("_and_place_it_in_the_basket") + "_1"

    policies = results.read(EFFECT / "further" / "results" / "goals")
    wrong = 0
    for row in chain.from_iterable(policy.reading for policy in policies if policy.arm == "usual"):
        if row["kind"] in ("carried", "held out") and row["reached"] not in (None, row["asked"]):
            wrong += 1
            reached_m = place_m(thing_of(row["reached"]), row["scene"])
            assert reached_m == pytest.approx(place_m(thing_of(row["asked"]), row["asked"]), abs=0.05)
    assert wrong == 28


def test_arms_with_different_tests_are_not_compared() -> None:
    clean, ours = of_policy("clean", 0, 4), of_policy("ours", 0, 9)
    rows = list(ours.rows)
    rows.remove(next(one for one in rows if one.axis == "pose"))
    fewer = replace(ours, rows=rows)
    with pytest.raises(PipelineError, match="clean and ours have different tests on pose: 10 and 9, of which 9 are"):
        comparison.differences([clean, fewer])
    with pytest.raises(PipelineError, match="ours and clean have different tests on pose: 9 and 10, of which 9 are"):
        comparison.differences([fewer, clean])


def test_holms_correction() -> None:
    """Computed by hand: 0.01 x 4, then 0.02 x 3, then 0.03 x 2, no less than the one before; 0.9 and more stay."""
    assert comparison.holm([0.03, 0.01, 1.0, 0.02]) == pytest.approx([0.06, 0.04, 1.0, 0.06])


def solved_tests(policies: Sequence[results.PolicyResults]) -> Floats:
    """Count, for each of the first ten tests (10,), the policies that solve it."""
    counts = np.zeros(10)
    for policy in policies:
        counts += [episode.success for episode in policy.rows[:10]]
    return counts


def test_p_is_exact_where_few_tests_differ() -> None:
    """Two of the 2^5 signs are as extreme as five tests that favour one arm. SciPy permutes the arms of each test."""
    clean = [of_policy("clean", seed, 4) for seed in (0, 1)]
    found = comparison.differences([*clean, *(of_policy("ours", seed, 9) for seed in (0, 1))])
    assert next(one for one in found if one["line"] == "robot")["p_value"] == 2 / 2**5
    for first, second in ((1, 8), (9, 3), (4, 4)):
        ours = [of_policy("ours", 0, first), of_policy("ours", 1, second)]
        solved = [solved_tests(clean), solved_tests(ours)]
        exact = permutation_test(solved, lambda a, b: (a - b).sum(), permutation_type="samples", n_resamples=2**10)
        pairs: list[Pair] = []
        for first_policy, second_policy in zip(clean, ours, strict=True):
            pairs += zip(first_policy.rows[:10], second_policy.rows[:10], strict=True)
        assert comparison.sign_flip(pairs) == pytest.approx(exact.pvalue)


def test_the_page_shows_what_the_committed_rows_say(tmp_path: Path) -> None:
    docs, log = REPOSITORY / "docs", REPOSITORY / "benchmarks" / "LOG.md"
    for page in (docs / "effect.md", log):
        (tmp_path / page.name).write_text(page.read_text())
    comparison.publish(EFFECT / "results", tmp_path, tmp_path / log.name)
    for page in (docs / "effect.md", docs / "effect.svg", log):
        assert (tmp_path / page.name).read_bytes() == page.read_bytes(), "python benchmarks/effect table"


def test_the_summary_has_the_differences_of_the_committed_rows() -> None:
    """32 cells: four kinds of tests, in eight columns; computed from the files alone."""
    folders = {"`all`": "axes", "`released`": "axes", "`ours`": "no_state", "`all`, object": "object"}
    folders |= {"`robots`": "starts", "`poses`": "starts", "the same, twice the steps": "object_long"}
    folders["`all`, spatial"] = "spatial"
    arms = {"`released`": "released", "`ours`": "ours", "`robots`": "robots", "`poses`": "poses"}
    rows: list[list[str]] = []
    for line in comparison.summary().splitlines():
        rows.append([cell.strip() for cell in line.split("|")[1:-1]])
    head, _, seeds, perturbed, *lines = rows

    def successes(folder: str, arm: str) -> pd.DataFrame:
        tables: list[pd.DataFrame] = []
        for file in (EFFECT / "further" / "results" / folder).glob(f"{arm}_seed*.json"):
            content = json.loads(file.read_text())
            table = pd.DataFrame(content["rows"], columns=content["columns"])
            tables.append(table.assign(trained_with_seed=content["seed"]))
        return pd.concat(tables)

    compared = 0
    for place, column in enumerate(head[1:], 1):
        arm, folder = arms.get(column, "all"), folders[column]
        ours, clean = successes(folder, arm), successes("no_state" if folder == "starts" else folder, "clean")
        common = set(ours["trained_with_seed"]) & set(clean["trained_with_seed"])
        assert int(seeds[place]) == len(common)
        for cells in lines:
            axis = {"LIBERO's own": "clean"}.get(cells[0], cells[0])
            if axis in ("clean", "robot", "language", "pose"):
                rates: list[float] = []
                for table in (clean, ours):
                    chosen = table[(table["axis"] == axis) & table["trained_with_seed"].isin(common)]
                    rates.append(chosen["success"].mean())
                points = float(cells[place].strip("*"))
                assert points == pytest.approx(100 * (rates[1] - rates[0]), abs=0.501), (cells[0], column)
                compared += 1
    assert compared == 32
    assert perturbed[1:] == ["212", "212", "128", "128", "128", "32", "32", "32"]
    # Holm's p of these cells: 0.014 and below 0.01; 0.15, 0.12 and 0.25.
    shown = {cells[0]: dict(zip(head, cells, strict=True)) for cells in lines}
    assert (shown["noise"]["`all`"], shown["robot"]["`all`"]) == ("**+31**", "**+33**")
    assert (shown["robot"]["`ours`"], shown["LIBERO's own"]["the same, twice the steps"]) == ("+15", "-18")
    assert shown["noise"]["the same, twice the steps"] == "+28"


def test_the_plot_of_the_page_is_the_same_each_time(tmp_path: Path) -> None:
    found = [of_policy("clean", 0, 4), of_policy("ours", 0, 9)]
    for name in ("one.svg", "two.svg"):
        comparison.plot(found, tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    assert json.dumps("LIBERO's own")[1:-1] in (tmp_path / "one.svg").read_text()
