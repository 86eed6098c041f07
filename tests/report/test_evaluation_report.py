"""The report of evaluations says what the episodes' files say: merged, weighted, compared, next to published rows."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episode_results import analyze, result
from html_page import Page, needs_no_other_file, screenshot
from scipy.stats import binomtest

from pipeline import files, outputs
from pipeline.axes import level_of_test
from pipeline.errors import PipelineError
from pipeline.evaluation.analyses.grading import grade
from pipeline.evaluation.results import EpisodeFiles, EpisodeResult, read, stored
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.statistics import compare, mcnemar, paired
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.images.mp4 import mp4
from pipeline.report import evaluation_report
from pipeline.report.evaluation_findings import FAILURES
from pipeline.report.paper_table import paper_table
from pipeline.testset import benchmark


@pytest.fixture(scope="module")
def subset() -> list[EvaluationTask]:
    return select(Selection(source="libero_plus", subset=60))


def test_the_published_rows_are_whole_and_add_up() -> None:
    table = paper_table({})
    assert sum(table["tasks"].values()) == 10_030
    assert len(table["published"]) == 11
    for row in table["published"]:
        # Each total is the mean over tasks of the columns, all of them rounded to a tenth.
        assert row["shared"] == pytest.approx(row["total"], abs=0.1), row["name"]


def test_an_episode_counts_for_the_test_tasks_that_it_stands_for() -> None:
    robot = {task.level: task for task in select(Selection(source="libero_plus", axes=("robot",)))}
    line = paper_table({"mine": [result(robot[1], True, "mine"), result(robot[5], False, "mine")]})["evaluated"][0]
    # 156 tasks of level 1 and 371 of level 5: 156 / 527, and 527^2 / (156^2 + 371^2) episodes' worth.
    assert line["cells"]["robot"]["rate"] == pytest.approx(0.29602, abs=1e-5)
    assert line["cells"]["robot"]["effective"] == pytest.approx(1.71462, abs=1e-5)
    assert line["cells"].keys() == {"robot"}
    assert line["total"] is None
    assert line["shared"] is not None
    assert line["shared"]["rate"] == line["cells"]["robot"]["rate"]
    absent = "controller_posture level 2 and 3 and 4 (1,023 tasks), libero_goal, libero_object, libero_spatial"
    assert line["cells"]["robot"]["absent"] == absent


def test_all_tasks_of_a_column_weigh_the_same() -> None:
    rows = [result(task, task.level == 1, "mine") for task in select(Selection(source="libero_plus", axes=("camera",)))]
    (line,) = paper_table({"mine": rows})["evaluated"]
    # Of level 1: 10 by distance, 6 by orientation, 117 by spherical position.
    assert line["cells"]["camera"]["rate"] == pytest.approx(133 / 1599)
    assert line["cells"]["camera"]["effective"] == pytest.approx(1599)
    assert line["cells"]["camera"]["absent"] == ""


@pytest.mark.parametrize("number", [200, 1000])
def test_a_balanced_subset_has_the_suites_shares(number: int) -> None:
    """Of the pose tests of level 5, 185 of 291 are of the goal suite; a balanced subset has as many of each suite."""
    every = select(Selection(source="libero_plus", axes=("pose",)))
    some = select(Selection(source="libero_plus", subset=number))
    for tasks in (every, [task for task in some if task.axis == "pose"]):
        rows = [result(task, task.suite != "libero_goal", "mine") for task in tasks]
        (line,) = paper_table({"mine": rows})["evaluated"]
        assert line["cells"]["layout"]["rate"] == pytest.approx(511 / 696)


def test_a_suite_without_an_episode_at_a_level_is_represented_by_the_others() -> None:
    tests = [test for test in benchmark.load().on_axis("pose") if level_of_test(test) == 5]
    sizes = Counter(test.suite for test in tests)
    chosen = [next(test for test in tests if test.suite == suite) for suite in ("libero_goal", "libero_object")]
    tasks = [EvaluationTask("libero_plus", one.suite, one.base, one.name, "pose", "scene", 5, 0) for one in chosen]
    (line,) = paper_table({"mine": [result(task, task.suite == "libero_goal", "mine") for task in tasks]})["evaluated"]
    share = sizes["libero_goal"] / (sizes["libero_goal"] + sizes["libero_object"])
    assert line["cells"]["layout"]["rate"] == pytest.approx(share)
    assert line["cells"]["layout"]["effective"] == pytest.approx(1 / (share**2 + (1 - share) ** 2))


def test_a_total_weighs_each_column_by_its_tasks() -> None:
    """Of each kind and level one test: all with another camera are solved, and nothing else is."""
    tests = {(one.axis, one.component, level_of_test(one)): one for one in benchmark.load().tasks}.values()
    tasks = [
        EvaluationTask("libero_plus", one.suite, one.base, one.name, one.axis, one.component, level_of_test(one), 0)
        for one in tests
    ]
    (line,) = paper_table({"mine": [result(task, task.axis == "camera", "mine") for task in tasks]})["evaluated"]
    assert line["total"]["rate"] == pytest.approx(1599 / 10_030)
    assert line["total"] == line["shared"]


def test_a_column_says_what_it_does_not_rest_on() -> None:
    rows = [result(task, True, "mine") for task in select(Selection(source="libero_plus", axes=("pose",)))]
    (line,) = paper_table({"mine": rows})["evaluated"]
    assert line["cells"]["layout"]["episodes"] == 696
    assert line["cells"]["layout"]["absent"] == "confounding objects (829 tasks)"


def test_levels_that_only_other_components_were_run_at_are_absent() -> None:
    run = {"spherical": (1,), "distance": (2, 3, 4, 5), "orientation": (1,)}
    every = select(Selection(source="libero_plus", axes=("camera",)))
    rows = [result(task, True, "mine") for task in every if task.level in run[task.component]]
    (line,) = paper_table({"mine": rows})["evaluated"]
    assert line["cells"]["camera"]["absent"] == (
        "distance level 1 (10 tasks), orientation level 2 and 3 and 4 and 5 (288 tasks), "
        "spherical level 2 and 3 and 4 and 5 (875 tasks)"
    )


def test_mcnemars_test_is_exact() -> None:
    # 5 and 1 of 6: 2 (1 + 6) / 2^6.
    assert mcnemar(5, 1) == mcnemar(1, 5) == pytest.approx(14 / 64)
    assert mcnemar(0, 0) == mcnemar(3, 3) == 1


@pytest.mark.slow
def test_policies_are_compared_on_the_episodes_that_both_ran(subset: list[EvaluationTask]) -> None:
    first = [result(task, True, "first") for task in subset[:10]]
    second = [result(task, at % 2 == 0, "second") for at, task in enumerate(subset[4:])]
    pairs = paired(first, second)
    assert len(pairs) == 6
    whole = compare(pairs)["all"]
    assert (whole["both"], whole["only_first"], whole["only_second"], whole["neither"]) == (3, 3, 0, 0)
    assert whole["p_value"] == pytest.approx(0.25)
    assert sum(axis["episodes"] for axis in compare(pairs)["by_axis"].values()) == 6


def write(folder: Path, rows: list[EpisodeResult]) -> Path:
    files = EpisodeFiles(folder)
    for row in rows:
        files.save(row)
    return folder


def test_folders_of_several_machines_are_one_result(subset: list[EvaluationTask], tmp_path: Path) -> None:
    one = write(tmp_path / "one", [result(task, True, "mine") for task in subset[:30]])
    other = write(tmp_path / "other", [result(task, True, "mine") for task in subset[20:]])
    write(other, [result(subset[0], False, "mine", steps=0, episode="0", reason="refused")])
    (merged,) = read([one, other])
    assert (merged.name, len(merged.rows), merged.rejected) == ("mine", 60, 1)
    polluted = write(tmp_path / "polluted", [result(subset[0], False, "mine", "benchmark")])
    names = [policy.name for policy in read([one, polluted], across=["prompt"])]
    assert names == ["mine, prompt clean", "mine, prompt benchmark"]
    different = write(tmp_path / "different", [result(subset[0], False, "mine")])
    with pytest.raises(PipelineError, match=r"two results of libero_plus/.*: success True and False, reason"):
        read([one, different])
    with pytest.raises(PipelineError, match="no results"):
        read([one, tmp_path / "absent"])


@pytest.mark.parametrize(
    ("field", "second"),
    [("prompt", {"prompt": "benchmark"}), ("step_limit", {"step_limit": 600})],
    ids=["prompt", "step limit"],
)
def test_results_under_different_prompts_or_limits_are_not_compared(
    subset: list[EvaluationTask],
    tmp_path: Path,
    field: str,
    second: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    one, other = result(subset[0], True, "one"), result(subset[0], True, "other", **second)
    folders = [write(tmp_path / "one", [one]), write(tmp_path / "other", [other])]
    out = [*map(str, folders), "--out", str(tmp_path / "report.html")]
    for command in ("grade", "report"):
        assert analyze(command, *out) == 1
        told = capsys.readouterr().err
        assert f"cannot be compared on {subset[0].source}/{subset[0].suite}: {field} " in told
        assert f"{getattr(one, field)} and {getattr(other, field)}" in told
        for folder, row in zip(folders, (one, other), strict=True):
            assert str(EpisodeFiles(folder).path(row.episode)) in told
        assert (f"--across {field}" in told) == (command == "report"), "grade has no such option"
    analyze("report", *out, "--across", field)
    # Another suite has another limit, and another source another wording.
    elsewhere = result(EvaluationTask("libero", "libero_10", "a", "a_state0", "clean", "clean", 0, 0), policy="other")
    assert len(read([folders[0], write(tmp_path / "elsewhere", [elsewhere])])) == 2


@pytest.mark.parametrize("setting", [{"initial_states": "demonstration"}, {"fixture_seed": 7}, {"black": "all"}])
def test_results_under_different_starts_or_views_are_not_compared(tmp_path: Path, setting: dict[str, Any]) -> None:
    task = EvaluationTask("libero", "libero_10", "a", "a_state0", "clean", "clean", 0, 0)
    # What a result leaves out is as ``evaluate`` has it by default.
    first = write(tmp_path / "one", [result(task, True, "one", settings={"fixture_seed": 0})])
    others = [result(task, True, "other", settings={}), result(task, True, "third", settings=setting)]
    assert len(read([first, write(tmp_path / "other", others[:1])])) == 2
    folders = [first, write(tmp_path / "third", others[1:])]
    ((name, value),) = setting.items()
    with pytest.raises(PipelineError, match=rf"on libero/libero_10: {name} \w+ and {value}"):
        read(folders)
    with pytest.raises(PipelineError, match=rf"on libero/libero_10: {name} \w+ and {value}"):
        grade([stored([folder]) for folder in folders])
    if name == "black":
        assert len(read(folders, across=["black"])) == 2


def test_policies_are_paired_by_all_of_their_task(subset: list[EvaluationTask]) -> None:
    task = subset[0]
    first = result(task, True, "first")
    assert paired([first], [result(task, False, "second")])
    for other in ({"level": task.level + 1}, {"number": 7}, {"component": "another"}, {"base": "another"}):
        assert not paired([first], [result(replace(task, **other), False, "second")]), other
    for difference in ({"seed": 1}, {"perturbations": [{"axis": "camera"}]}):
        assert not paired([first], [result(task, False, "second", **difference)]), difference


@pytest.fixture(scope="module")
def written(subset: list[EvaluationTask], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page about two policies, one with videos."""
    folder = tmp_path_factory.mktemp("results")
    tasks = [*subset, *select(Selection(suites=("libero_goal",)))]
    better = write(folder / "better", [result(task, at % 4 > 0, "better") for at, task in enumerate(tasks)])
    worse = write(folder / "worse", [result(task, at % 4 == 0, "worse") for at, task in enumerate(tasks)])
    film = mp4([np.full((256, 256, 3), grey, np.uint8) for grey in (0, 90, 200)], [0, 8, 20])
    for path in (worse / "episodes").glob("*.json"):
        files.write(EpisodeFiles(worse).video(path.stem), film)
    evaluation_report.write(read([better, worse]), folder / "report.html")
    return folder / "report.html"


def test_the_page_needs_nothing_and_says_what_the_findings_say(written: Path) -> None:
    html = written.read_text()
    needs_no_other_file(html)
    page = Page(html)
    words = " ".join(page.text.split())
    found: dict[str, Any] = json.loads(written.with_suffix(".json").read_text())
    for row in found["paper_table"]["published"]:
        numbers = [*map(str, row["rates"].values()), str(row["total"]), f"{sum(row['rates'].values()) / 7:.1f}"]
        assert " ".join([row["name"], *numbers]) in words
    for policy in found["policies"].values():
        for one in policy["results"].values():
            assert f"{100 * one['all']['rate']:.1f} %" in words
            for group in (*one["by_axis"].values(), *one["by_level"].values(), *one["by_suite"].values()):
                assert f"), {group['successes']}/{group['episodes']}" in words
    assert "confounding objects (829 tasks)" in words
    for comparison in found["comparisons"]:
        for line in (comparison["all"], *comparison["by_axis"].values()):
            assert f"{100 * line['difference']['value']:+.1f}" in words
            assert line["difference"]["resampled"] in words
    assert "ran the same 60 episodes" in words
    assert words.count("better (first) and worse (second)") == 2
    assert words.count("a p-value from 10,000 bootstrap resamples") == 1, "explained once"
    failures = found["failures"]
    axes = {(failure["policy"], failure["source"], failure["axis"]) for failure in failures}
    assert len(failures) <= FAILURES * len(axes)
    assert len(page.of("video")) == sum(failure["policy"] == "worse" for failure in failures) > 5
    assert all(failure["episode"] in words for failure in failures)


def test_the_overall_rate_of_each_policy_comes_first(written: Path) -> None:
    words = " ".join(Page(written.read_text()).text.split())
    top = words[words.index("Evaluation of 2 policies") : words.index("Comparison with published models")]
    # Of 70 episodes every fourth fails, or is solved; intervals as of Wilson's formula in SciPy.
    for name, solved in (("better", 52), ("worse", 18)):
        low, high = binomtest(solved, 70).proportion_ci(method="wilson")
        shown = f"{name} {100 * solved / 70:.1f} % {100 * low:.0f} to {100 * high:.0f} % (95 % interval)"
        assert f"{shown} {solved} of 70 episodes" in top
    assert "did not run the same episodes" not in top
    assert "Bars below numbers: successes failures" in top


def test_one_policy_of_few_episodes_is_not_set_next_to_published_ones_as_an_equal(
    subset: list[EvaluationTask], tmp_path: Path
) -> None:
    folder = write(tmp_path / "few", [result(subset[0], True, "alone")])
    evaluation_report.write(read([folder]), tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text()
    words = " ".join(Page(html).text.split())
    assert "Evaluation of alone Overall success" in words
    assert "1 of 1 episode " in words
    assert not re.search(r"\b1 (policies|episodes)", words)
    # Wilson's interval of 1 in 1 begins at 1 / (1 + 1.96^2).
    own = words[words.index("this evaluation alone") : words.index("published OpenVLA")]
    assert "21 to 100" in own
    assert "rate 100.0 1 episode" in own
    assert "<b>" not in html[html.index('class="own"') :].split("</tr>")[0]


def test_policies_of_different_episodes_are_said_to_be(subset: list[EvaluationTask], tmp_path: Path) -> None:
    one = write(tmp_path / "one", [result(task, True, "one") for task in subset[:20]])
    other = write(tmp_path / "other", [result(task, False, "other") for task in subset[5:20]])
    evaluation_report.write(read([one, other]), tmp_path / "report.html")
    words = " ".join(Page((tmp_path / "report.html").read_text()).text.split())
    assert "The policies did not run the same episodes" in words[: words.index("Comparison with published models")]
    assert "15 are common to all" in words


@pytest.mark.slow  # as setup.sh installs the browser for all tests only
@pytest.mark.parametrize("width_px", [360, 1200])
def test_a_browser_shows_it(written: Path, width_px: int) -> None:
    shown = screenshot(written, width_px, 3000)
    assert all(screenful.std() > 5 for screenful in np.split(shown, 5))
    assert shown[400:, -6:].std() < 25


def test_the_page_has_the_name_of_a_page(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="the report is an HTML page"):
        evaluation_report.write([], tmp_path / "report.json")


def test_the_page_leaves_an_evaluations_summary(tmp_path: Path) -> None:
    summary = tmp_path / "summary.json"
    outputs.write_json(summary, {"all": {}})
    with pytest.raises(PipelineError, match="name of an evaluation's summary"):
        evaluation_report.write([], tmp_path / "summary.html")
    assert json.loads(summary.read_text()) == {"all": {}}
