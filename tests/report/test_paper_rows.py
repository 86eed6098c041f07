"""The paper's table has plainly counted figures in Markdown, CSV and LaTeX, from the files of three programs."""

import csv
import json
import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import checkpoints
import gymnasium as gym
import numpy as np
import pytest
import torch
from episode_results import analyze, result
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import eval_policy_all
from markdown_it import MarkdownIt
from scipy.stats import binomtest
from vla_eval.recording import EpisodeRecorder, RecordingStore, db_path_for_eval, serializable_task_kwargs
from vla_eval.results.export import export_eval

from pipeline.axes import level_of_test
from pipeline.commands.command_line import run as command
from pipeline.errors import PipelineError
from pipeline.evaluation.analyses.other_programs import read_tested
from pipeline.evaluation.analyses.tested import Outcome, TestedPolicy
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import STEP_LIMITS
from pipeline.report.paper_rows import HEADINGS, csv_text, latex, markdown
from pipeline.report.paper_table import table_of
from pipeline.seeding import rng
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TESTED_SUITES, TestTask

SEVEN = ("camera", "robot", "language", "light", "background", "noise", "layout")
CELL_LEVEL = 4
"""Level of a cell's text in the tokens of a Markdown table."""

THEIR_CLASS = "vla_eval.benchmarks.libero_plus.benchmark:LIBEROPlusBenchmark"
CATEGORY = {"camera": "Camera Viewpoints", "robot": "Robot Initial States", "pose": "Objects Layout"}
POLICY = TestedPolicy("mine", (), "evaluate", "clean", {"libero_goal": (300,), "libero_10": (520,)}, 0)


def column_of(test: TestTask) -> str:
    """The paper's column of a test task: moved targets belong to the layout."""
    return "layout" if test.axis == "pose" else test.axis


def numbered(test: TestTask) -> int:
    """The number of a test task in LIBERO-Plus's list of its suite."""
    return [one.name for one in benchmark.load().tasks if one.suite == test.suite].index(test.name)


def first_of(suite: str, axis: str, count: int = 1) -> list[TestTask]:
    return [test for test in benchmark.load().on_axis(axis) if test.suite == suite][:count]


def counted(outcomes: Iterable[Outcome]) -> dict[str, str]:
    """Success rates in percent, by plain counting over all test tasks."""
    of_column: dict[str, list[bool]] = defaultdict(list)
    for outcome in outcomes:
        of_column[column_of(benchmark.load().find(outcome.suite, outcome.name))].append(outcome.success)
    rates = {column: 100 * sum(of_column[column]) / len(of_column[column]) for column in SEVEN}
    every = [success for successes in of_column.values() for success in successes]
    rates |= {"total": 100 * sum(every) / len(every), "mean of seven": sum(rates.values()) / 7}
    return {name: f"{rate:.1f}" for name, rate in rates.items()}


def wilson_bounds(outcomes: Iterable[Outcome]) -> dict[str, tuple[str, str]]:
    """SciPy's intervals in percent, of each column and of all test tasks."""
    of_column: dict[str, list[bool]] = defaultdict(list)
    for outcome in outcomes:
        for name in (column_of(benchmark.load().find(outcome.suite, outcome.name)), "total"):
            of_column[name].append(outcome.success)
    bounds = {}
    for name, successes in of_column.items():
        found = binomtest(sum(successes), len(successes)).proportion_ci(method="wilson")
        bounds[name] = (f"{100 * found.low:.1f}", f"{100 * found.high:.1f}")
    return bounds


def of_markdown(text: str) -> dict[str, list[str]]:
    """First cell to the other cells of each line of a Markdown table, as a program for Markdown prints them."""
    rows: list[list[str]] = []
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        if token.type == "tr_open":
            rows.append([])
        elif token.type == "inline" and rows and token.level == CELL_LEVEL:
            assert {part.type for part in token.children or ()} <= {"text"}, f"no markup: {token.content}"
            rows[-1].append("".join(part.content for part in token.children or ()))
    return {cells[0]: cells[1:] for cells in rows}


def of_csv(text: str) -> dict[str, dict[str, str]]:
    """Model to its line of a CSV file."""
    return {line["model"]: line for line in csv.DictReader(text.splitlines())}


def of_latex(text: str) -> list[list[str]]:
    """Cells of each row, as TeX reads them: a % begins a comment, & separates cells, and a backslash protects both."""
    rows = []
    for line in text.splitlines():
        code = re.split(r"(?<!\\)%", line)[0].strip()
        if code:
            assert code.endswith(r" \\"), line
            rows.append([cell.strip() for cell in re.split(r"(?<!\\)&", code.removesuffix(r" \\"))])
    return rows


def scored(tests: Iterable[TestTask], solved: float = 0.4) -> list[Outcome]:
    generator = rng("test_paper_rows")
    return [Outcome(test.suite, test.name, bool(generator.random() < solved)) for test in tests]


def test_all_tasks_give_plainly_counted_rates_in_all_formats() -> None:
    easy, hard = benchmark.load().on_axis("light"), [one for one in benchmark.load().tasks if one.axis != "light"]
    policy = replace(POLICY, outcomes=[*scored(easy, 0.9), *scored(hard)])
    expected, table = counted(policy.outcomes), table_of([policy])
    assert float(expected["total"]) != float(expected["mean of seven"])
    assert of_markdown(markdown(table))["mine"] == [expected[heading] for heading in HEADINGS]
    line = of_csv(csv_text(table))["mine"]
    assert {heading: line[heading.replace(" ", "_")] for heading in HEADINGS} == expected
    assert (line["total_tasks_run"], line["layout_tasks_run"], line["trials_per_task"]) == ("10030", "1525", "1")
    assert (line["prompt"], line["step_limits"]) == ("clean", "goal 300, long 520")
    assert of_latex(latex(table)) == [["mine", *(expected[heading] for heading in HEADINGS)]]
    assert "10,030 of 10,030" in markdown(table)
    bounds = wilson_bounds(policy.outcomes)
    assert {name: (line[f"{name}_low"], line[f"{name}_high"]) for name in bounds} == bounds
    written = dict(zip(HEADINGS, of_markdown(markdown(table))["mine, 95 % interval"], strict=True))
    assert {name: written[name] for name in bounds} == {name: " to ".join(pair) for name, pair in bounds.items()}


def test_published_rows_are_the_papers_with_the_mean_of_their_columns() -> None:
    table = table_of([replace(POLICY, outcomes=scored(first_of("libero_goal", "robot", 3)))])
    cells = of_markdown(markdown(table))["OpenVLA-OFT (published)"]
    # 69.6 in the paper; (56.4 + 31.9 + 79.5 + 88.7 + 93.3 + 75.8 + 74.2) / 7 = 71.4.
    assert cells == ["56.4", "31.9", "79.5", "88.7", "93.3", "75.8", "74.2", "69.6", "71.4"]
    line = of_csv(csv_text(table))["OpenVLA-OFT"]
    assert [line[heading.replace(" ", "_")] for heading in HEADINGS] == cells
    assert (line["published"], line["total_tasks_run"]) == ("yes", "10030")
    assert line["prompt"].startswith("not stated")


def test_a_column_without_an_episode_is_missing_and_so_are_total_and_mean() -> None:
    tests = [test for test in benchmark.load().tasks if test.axis != "light"]
    table = table_of([replace(POLICY, outcomes=scored(tests, solved=1.0))])
    cells = dict(zip(HEADINGS, of_markdown(markdown(table))["mine"], strict=True))
    assert [name for name, cell in cells.items() if cell == "-"] == ["light", "total", "mean of seven"]
    line = of_csv(csv_text(table))["mine"]
    assert (line["light"], line["total"], line["mean_of_seven"], line["light_tasks_run"]) == ("", "", "", "0")
    (row,) = of_latex(latex(table))
    assert (row[4], row[8], row[9]) == ("--", "--", "--")
    assert "0.0" not in {*cells.values(), *row}


def test_a_rate_that_leaves_out_a_part_has_a_star_and_the_part_is_named() -> None:
    tests = [test for test in benchmark.load().tasks if test.axis != "layout"]
    table = table_of([replace(POLICY, outcomes=scored(tests, solved=1.0))])
    cells = dict(zip(HEADINGS, of_markdown(markdown(table))["mine"], strict=True))
    assert [name for name, cell in cells.items() if cell == "100.0*"] == ["layout", "total", "mean of seven"]
    assert "mine, layout: without confounding objects (829 tasks)" in markdown(table)
    assert of_csv(csv_text(table))["mine"]["left_out_parts"] == "layout: confounding objects (829 tasks)"
    assert of_latex(latex(table))[0][7:] == ["100.0$^{*}$"] * 3
    assert "% * layout: without confounding objects (829 tasks)" in latex(table).splitlines()


def test_an_estimate_from_a_sample_of_every_part_has_a_dagger_and_its_number_of_tasks() -> None:
    one_of_each_part: dict[tuple[str, str, int, str], TestTask] = {}
    for test in benchmark.load().tasks:
        one_of_each_part.setdefault((test.axis, test.component, level_of_test(test), test.suite), test)
    camera = [test for test in benchmark.load().tasks if test.axis == "camera"]
    tests = [*camera, *(test for test in one_of_each_part.values() if test.axis != "camera")]
    table = table_of([TestedPolicy("sampled", scored(tests), "evaluate", "clean", {}, 0)])
    (cells,) = of_latex(latex(table))
    marked = {heading: cell.endswith(r"$^{\dagger}$") for heading, cell in zip(HEADINGS, cells[1:], strict=True)}
    assert marked == {heading: heading != "camera" for heading in HEADINGS}
    language = sum(test.axis == "language" for test in tests)
    assert f"language {language} of 1,537" in latex(table)
    assert f"language {language} of 1,537" in markdown(table)
    assert markdown(table).count("†") == len(HEADINGS) - 1 + 1


def test_several_trials_of_a_task_count_as_one_task() -> None:
    one, other = first_of("libero_goal", "robot", 2)
    one, other = (replace(test, suite="libero_goal") for test in (one, other))
    outcomes = [Outcome(one.suite, one.name, success) for success in (True, True, False)]
    outcomes += [Outcome(other.suite, other.name, False)]
    (row,) = table_of([replace(POLICY, outcomes=outcomes)])["evaluated"]
    assert level_of_test(one) == level_of_test(other), "equally weighted"
    assert row["cells"]["robot"]["rate"] == pytest.approx((2 / 3 + 0) / 2)
    assert (row["cells"]["robot"]["tasks"], row["cells"]["robot"]["episodes"]) == (2, 4)
    assert row["protocol"]["trials"] == [1, 3]
    assert "1 to 3 trials per task" in markdown(table_of([replace(POLICY, outcomes=outcomes)]))


def test_any_name_is_one_cell_in_each_format() -> None:
    name = "50%_a&lt;|c \\ {x} #1 $2 ^~\nsecond <b> *i* `c` _u_ [l](m) d\\|e pi_0 é"
    table = table_of([replace(POLICY, name=name, outcomes=scored(first_of("libero_goal", "robot", 3)))])
    assert name.replace("\n", " ") in of_markdown(markdown(table))
    assert name in {line[0] for line in csv.reader(csv_text(table).splitlines(keepends=True))}
    (row,) = of_latex(latex(table))
    assert len(row) == 10
    first, second = row[0].split(" second ")
    assert first == (r"50\%\_a\&lt;\textbar{}c \textbackslash{} \{x\} \#1 \$2 \textasciicircum{}\textasciitilde{}")
    assert second == (r"\textless{}b\textgreater{} *i* `c` \_u\_ [l](m) d\textbackslash{}\textbar{}e pi\_0 é")


@pytest.mark.parametrize("name", ["[ours] act", "*act"])
def test_a_name_is_no_option_of_the_line_before(name: str) -> None:
    """In LaTeX, a row ends with two backslashes, which take a star and an option in brackets from the next line."""
    outcomes = scored(first_of("libero_goal", "robot", 3))
    text = latex(table_of([replace(POLICY, outcomes=outcomes), replace(POLICY, name=name, outcomes=outcomes)]))
    code = "".join(line for line in text.splitlines() if not line.startswith("%"))
    assert len(code.split(r"\\")) == 3
    assert not re.search(r"\\\\\s*[\[*]", code)
    assert name in code


# Results of evaluate, and the command.


def test_black_views_are_stated(tmp_path: Path) -> None:
    (test,) = first_of("libero_goal", "robot")
    task = EvaluationTask("libero_plus", *(test.suite, test.base, test.name, test.axis, test.component), 1, 0)
    EpisodeFiles(tmp_path / "rows").save(result(task, settings={"prompt": "clean", "seed": 0, "black": "agentview"}))
    EpisodeFiles(tmp_path / "seeing").save(result(task, policy="seeing"))
    config = {"benchmark": OUR_CLASS, "params": {"settings": {"black": "all"}}}
    write_vla_eval(tmp_path / "blind", config, [(our_task(test), {"success": False})])
    table = table_of(read_tested([tmp_path / "rows", tmp_path / "seeing", tmp_path / "blind"]))
    texts = markdown(table), latex(table)
    for views in ("agentview", "all"):
        assert all(text.count(f"step limits goal 300; black views {views}; run by") == 1 for text in texts)
    lines = of_csv(csv_text(table))
    assert [lines[name]["black_views"] for name in ("p", "seeing", "blind", "pi0")] == [
        "agentview",
        "none",
        "all",
        "none",
    ]


def test_analyze_table_prints_and_writes_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = EpisodeFiles(tmp_path / "act")
    for test in first_of("libero_goal", "robot", 4):
        named = test.suite, test.base, test.name
        task = EvaluationTask("libero_plus", *named, test.axis, test.component, level_of_test(test), 0)
        for prompt, success in (("clean", True), ("benchmark", False)):
            files.save(result(task, success, "act", prompt, settings={"prompt": prompt, "seed": 0}))
    out = tmp_path / "tables" / "mine.tex"
    assert analyze("table", str(tmp_path / "act"), "--out", str(out)) == 0
    printed = capsys.readouterr().out
    cells = of_markdown(printed)
    assert cells["act, prompt clean"][1].startswith("100.0")
    assert cells["act, prompt benchmark"][1].startswith("0.0")
    assert "prompt clean; step limits goal 300; run by evaluate" in printed
    last = json.loads(printed.splitlines()[-1])
    written = [out.with_suffix(suffix) for suffix in (".md", ".csv", ".tex")]
    assert [Path(file) for file in last["files"]] == written
    assert written[0].read_text() in printed
    assert of_csv(written[1].read_text()).keys() >= {"act, prompt clean", "OpenVLA"}
    assert len(of_latex(written[2].read_text())) == 2
    for name in (".", ".."):
        assert analyze("table", str(tmp_path / "act"), "--out", name) == 1
        assert "no name for the files" in capsys.readouterr().err
    written[2].write_text("notes of a user")
    assert analyze("table", str(tmp_path / "act"), "--out", str(out)) == 1
    assert "would overwrite" in capsys.readouterr().err
    assert written[2].read_text() == "notes of a user"


@pytest.mark.slow
def test_evaluate_prints_and_writes_the_table_of_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(STEP_LIMITS, "libero_goal", 2)
    out = tmp_path / "replay"
    rows: dict[str, list[str]] = {}
    for axis in ("robot", "language"):
        options = ["--source", "libero_plus", "--axis", axis, "--suite", "libero_goal", "--subset", "1"]
        assert command(["evaluate", str(out), "--replay", *options, "--workers", "1"]) == 0
        printed = capsys.readouterr().out
        rows = of_markdown(printed)
        assert rows == of_markdown((out / "paper_table.md").read_text())
        assert json.loads(printed.splitlines()[-1])["by_axis"].keys() == {axis}
    cells = dict(zip(HEADINGS, rows["replay"], strict=True))
    assert [name for name in HEADINGS if cells[name] != "-"] == ["robot", "language"], "of both calls"
    assert rows["replay, tasks run"][1:3] == ["1 of 1,550", "1 of 1,537"]
    line = of_csv((out / "paper_table.csv").read_text())["replay"]
    assert (line["total_tasks_run"], line["step_limits"], line["program"]) == ("2", "goal 2", "evaluate")
    assert of_latex((out / "paper_table.tex").read_text())[0][0] == "replay"
    (out / "paper_table.csv").write_text("a user's own file")
    assert command(["evaluate", str(out), "--replay", *options, "--workers", "1"]) == 1
    assert (out / "paper_table.csv").read_text() == "a user's own file"


def test_episodes_of_several_versions_are_stated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = []
    for version, test in zip(("3.2.7", "3.8.1"), first_of("libero_goal", "robot", 2), strict=True):
        task = EvaluationTask("libero_plus", *(test.suite, test.base, test.name, test.axis, test.component), 1, 0)
        versions = {"mujoco": version, "OpenGL": "llvmpipe", "pipeline": version, "files of the benchmark": version}
        folders.append(tmp_path / version)
        EpisodeFiles(folders[-1]).save(result(task, versions=versions))
    stated = "several versions: mujoco 3.2.7 and 3.8.1"
    for chosen in (folders, folders[:1]):
        policies = read_tested(chosen)
        table = table_of(policies)
        assert (f"run by evaluate; {stated}." in markdown(table)) == (len(chosen) == 2)
        assert (f"run by evaluate; {stated}\n" in latex(table)) == (len(chosen) == 2)
        expected = "mujoco 3.2.7 and 3.8.1" if len(chosen) == 2 else ""
        assert of_csv(csv_text(table))["p"]["mixed_versions"] == expected
        page = tmp_path / "report.html"
        assert analyze("report", *map(str, chosen), "--out", str(page)) == 0
        assert ("<b>The results have several versions of mujoco.</b>" in page.read_text()) == (len(chosen) == 2)
    capsys.readouterr()


def test_results_without_test_tasks_are_named(tmp_path: Path) -> None:
    task = EvaluationTask("libero", "libero_goal", "turn_on_the_stove", "turn_on_the_stove_state0", "clean", "", 0, 0)
    EpisodeFiles(tmp_path).save(result(task, True))
    with pytest.raises(PipelineError, match="no test task"):
        read_tested([tmp_path])


# Results of vla-eval, written by vla-eval's own recording and export.


def write_vla_eval(folder: Path, config: dict[str, Any], tasks: list[tuple[dict[str, Any], dict[str, Any]]]) -> Path:
    """Record episodes as vla-eval's orchestrator does, and export them.

    Args:
        tasks: task of each episode, and its metrics or failure.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = RecordingStore(db_path_for_eval(folder, "run"))
    metadata = {"benchmark": "name", "mode": "sync", "config": config, "metric_keys": {"success": "mean"}}
    store.upsert_eval_metadata("run-name", "name", metadata)
    for number, (task, ended) in enumerate(tasks):
        context = {**serializable_task_kwargs({**task, "episode_idx": 0}), "task_idx": number}
        recorder = EpisodeRecorder(
            store=store,
            sid="sid",
            eid=str(number),
            eval_id="run-name",
            output_dir=folder / "episodes",
            filename_stem="{task_idx}",
            context=context,
        )
        failed = {"failure_reason": ended.get("failure_reason")}
        metrics = {"success": bool(ended.get("success"))}
        recorder.close(status="fail", metrics=metrics, task_name=task["name"], episode_id=0, steps=9, **failed)
    store.close()
    export_eval(folder, "run")
    return folder / "name_aggregate.json"


def their_task(test: TestTask, name: str) -> dict[str, Any]:
    """Task of vla-eval's LIBEROPlusBenchmark: the prompt as ``name``, and an object that is not recorded."""
    return {
        "name": name,
        "suite": test.suite,
        "task_id": numbered(test),
        "task_obj": test,
        "category": CATEGORY[test.axis],
        "difficulty_level": 3,
    }


def test_results_of_vla_evals_own_benchmark_are_read(tmp_path: Path) -> None:
    camera, robot = first_of("libero_goal", "camera", 2), first_of("libero_goal", "robot")
    prompt = camera[0].name.replace("_", " ")
    assert prompt.endswith("initstate 0")
    episodes: list[tuple[dict[str, Any], dict[str, Any]]] = [
        (their_task(camera[0], prompt), {"success": True}),
        (their_task(camera[1], camera[1].name.replace("_", " ")), {"success": False}),
        (their_task(robot[0], robot[0].name.replace("_", " ")), {"failure_reason": "server_unreachable"}),
    ]
    config = {"benchmark": THEIR_CLASS, "max_steps": None, "params": {"suite": "libero_goal", "seed": 7}}
    file = write_vla_eval(tmp_path / "oft", config, episodes)
    for path in (tmp_path / "oft", file):
        (policy,) = read_tested([path])
        assert (policy.name, policy.program, policy.prompt, policy.left_out) == ("oft", "vla-eval", "benchmark", 1)
        assert dict(policy.step_limits) == {"libero_goal": (300,)}
        assert [*policy.outcomes] == [Outcome("libero_goal", test.name, not at) for at, test in enumerate(camera)]
    clean = [(their_task(camera[0], "open the middle drawer of the cabinet"), {"success": True})]
    assert camera[0].base == "open_the_middle_drawer_of_the_cabinet"
    write_vla_eval(tmp_path / "clean", {**config, "max_steps": 400}, clean)
    (policy,) = read_tested([tmp_path / "clean"])
    assert (policy.prompt, dict(policy.step_limits)) == ("clean", {"libero_goal": (400,)})


def test_results_of_this_projects_benchmark_in_vla_eval_are_read(tmp_path: Path) -> None:
    (test,) = first_of("libero_spatial", "noise")
    settings = {"prompt": "blank", "step_limits": "lerobot"}
    config = {"benchmark": OUR_CLASS, "params": {"settings": settings}}
    write_vla_eval(tmp_path, config, [(our_task(test), {"success": True})])
    (policy,) = read_tested([tmp_path])
    assert [*policy.outcomes] == [Outcome(test.suite, test.name, True)]
    assert (policy.prompt, dict(policy.step_limits)) == ("blank", {"libero_spatial": (280,)})


OUR_CLASS = "pipeline.evaluation.harness:PerturbedLibero"


def our_task(test: TestTask) -> dict[str, Any]:
    """Task of this project's benchmark for vla-eval."""
    named = test.suite, test.base, test.name
    return EvaluationTask("libero_plus", *named, test.axis, test.component, level_of_test(test), 0).for_harness()


@pytest.mark.parametrize(("max_steps", "limit"), [(50, 50), (9000, 300), (None, 300)])
def test_a_limit_of_vla_eval_below_the_suites_is_stated(tmp_path: Path, max_steps: int | None, limit: int) -> None:
    (test,) = first_of("libero_goal", "robot")
    config: dict[str, Any] = {"benchmark": OUR_CLASS, "max_steps": max_steps, "params": {}}
    write_vla_eval(tmp_path, config, [(our_task(test), {"success": False})])
    (policy,) = read_tested([tmp_path])
    assert dict(policy.step_limits) == {"libero_goal": (limit,)}


def test_settings_of_another_version_are_named(tmp_path: Path) -> None:
    (test,) = first_of("libero_goal", "robot")
    config = {"benchmark": OUR_CLASS, "params": {"settings": {"colour": "red"}}}
    write_vla_eval(tmp_path, config, [(our_task(test), {"success": True})])
    with pytest.raises(PipelineError, match=r"other settings .*colour"):
        read_tested([tmp_path])


def test_an_episode_without_the_metric_success_is_left_out(tmp_path: Path) -> None:
    tests = first_of("libero_goal", "robot", 2)
    config = {"benchmark": THEIR_CLASS, "params": {"suite": "libero_goal"}}
    file = write_vla_eval(tmp_path, config, [(their_task(test, test.name), {"success": True}) for test in tests])
    content = json.loads(file.read_text())
    content["tasks"][0]["episodes"][0]["metrics"] = {}
    file.write_text(json.dumps(content))
    (policy,) = read_tested([tmp_path])
    assert (len(policy.outcomes), policy.left_out) == (1, 1)


def test_an_unfinished_evaluation_of_vla_eval_is_no_row(tmp_path: Path) -> None:
    """vla-eval runs the tasks in the benchmark's order, so the finished ones are of the first axes and tasks."""
    tests = first_of("libero_goal", "robot", 2)
    config = {"benchmark": THEIR_CLASS, "params": {"suite": "libero_goal"}}
    file = write_vla_eval(tmp_path, config, [(their_task(test, test.name), {"success": True}) for test in tests])
    file.write_text(json.dumps({**json.loads(file.read_text()), "partial": True}))
    with pytest.raises(PipelineError, match="was not finished"):
        read_tested([tmp_path])


@pytest.mark.parametrize("further", ["episodes/0.json", "eval_info.json"])
def test_results_of_two_programs_in_a_folder_are_rejected(tmp_path: Path, further: str) -> None:
    (test,) = first_of("libero_goal", "robot")
    config = {"benchmark": THEIR_CLASS, "params": {"suite": "libero_goal"}}
    file = write_vla_eval(tmp_path, config, [(their_task(test, "prompt"), {"success": True})])
    (tmp_path / further).parent.mkdir(exist_ok=True)
    (tmp_path / further).write_text("{}")
    with pytest.raises(PipelineError, match="results of several programs"):
        read_tested([tmp_path])
    assert len(read_tested([file])) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task_id": 9999}, "libero_goal has no task 9999"),
        ({"suite": "libero_90"}, "LIBERO-Plus has no suite 'libero_90'"),
        ({"category": "Sensor Noise"}, "category is 'Sensor Noise'"),
    ],
)
def test_a_task_of_vla_eval_that_does_not_exist_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    (test,) = first_of("libero_goal", "robot")
    config = {"benchmark": THEIR_CLASS, "params": {"suite": "libero_goal"}}
    write_vla_eval(tmp_path, config, [(their_task(test, "prompt") | change, {"success": True})])
    with pytest.raises(PipelineError, match=re.escape(message)) as caught:
        read_tested([tmp_path])
    assert "name_aggregate.json" in str(caught.value.where)


def test_results_of_another_benchmark_and_damaged_files_are_rejected(tmp_path: Path) -> None:
    (test,) = first_of("libero_goal", "robot")
    config = {"benchmark": "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark", "params": {}}
    file = write_vla_eval(tmp_path / "libero", config, [(their_task(test, "prompt"), {"success": True})])
    with pytest.raises(PipelineError, match="has results of 'LIBEROBenchmark'"):
        read_tested([file])
    file.write_text('{"tasks": []}')
    with pytest.raises(PipelineError, match="has other fields"):
        read_tested([file])


def test_files_of_two_policies_in_one_folder_are_rejected(tmp_path: Path) -> None:
    (test,) = first_of("libero_goal", "robot")
    config = {"benchmark": THEIR_CLASS, "params": {"suite": "libero_goal"}}
    file = write_vla_eval(tmp_path, config, [(their_task(test, "prompt"), {"success": True})])
    (tmp_path / "pi0_aggregate.json").write_bytes(file.read_bytes())
    with pytest.raises(PipelineError, match="two files have the task") as caught:
        read_tested([tmp_path])
    assert "name_aggregate.json and" in str(caught.value.where)


# Results of lerobot-eval, written by lerobot's own evaluation.


class Decided(gym.Env[dict[str, Any], np.ndarray[Any, Any]]):
    """Environment whose only step succeeds or fails as decided."""

    task_description = task = "decided"
    _max_episode_steps = 1
    metadata = {"render_fps": 20}  # noqa: RUF012
    observation_space = gym.spaces.Dict(
        {
            "pixels": gym.spaces.Dict({"image": gym.spaces.Box(0, 255, (32, 32, 3), np.uint8)}),
            "agent_pos": gym.spaces.Box(-1, 1, (8,), np.float64),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (7,), np.float32)

    def __init__(self, success: bool):
        self._success = success

    def reset(self, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        observation = {"pixels": {"image": np.zeros((32, 32, 3), np.uint8)}, "agent_pos": np.zeros(8)}
        return observation, {"is_success": False}

    def step(self, action: np.ndarray[Any, Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        return self.reset()[0], float(self._success), True, False, {"is_success": self._success}


def write_lerobot_eval(folder: Path, successes: dict[tuple[str, int], bool]) -> Path:
    """Evaluate a policy with lerobot's own function, and write ``eval_info.json`` as its command does."""
    checkpoint = checkpoints.save(folder / "act", 0.0)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    before, after = make_pre_post_processors(config, str(checkpoint))
    envs: dict[str, dict[int, Any]] = defaultdict(dict)
    for (suite, number), success in successes.items():
        envs[suite][number] = gym.vector.SyncVectorEnv(
            [partial(Decided, success)], autoreset_mode=gym.vector.AutoresetMode.SAME_STEP
        )
    same: Any = PolicyProcessorPipeline(steps=[])
    with torch.no_grad():
        info = eval_policy_all(envs, policy, same, same, before, after, n_episodes=1)
    file = folder / "eval_info.json"
    file.write_text(json.dumps(info, indent=2))
    return file


@pytest.mark.slow
def test_results_of_lerobots_own_environment_are_read(tmp_path: Path) -> None:
    tests = [first_of(suite, "robot", 30)[-1] for suite in TESTED_SUITES]
    outcomes = {(test.suite, numbered(test)): at % 2 == 0 for at, test in enumerate(tests)}
    file = write_lerobot_eval(tmp_path, outcomes)
    for path in (tmp_path, file):
        (policy,) = read_tested([path])
        assert (policy.name, policy.program, policy.prompt) == (tmp_path.name, "lerobot-eval", None)
        assert {*policy.outcomes} == {Outcome(test.suite, test.name, at % 2 == 0) for at, test in enumerate(tests)}
    assert "prompt not stated; step limits not stated; run by lerobot-eval" in markdown(table_of([policy]))


@pytest.mark.slow
def test_numbers_that_may_be_liberos_own_tasks_are_rejected(tmp_path: Path) -> None:
    file = write_lerobot_eval(tmp_path, {("libero_goal", 0): True, ("libero_goal", 9): True})
    with pytest.raises(PipelineError, match="may be LIBERO's own"):
        read_tested([file])


def test_two_policies_of_one_name_are_rejected(tmp_path: Path) -> None:
    (test,) = first_of("libero_goal", "robot")
    config = {"benchmark": THEIR_CLASS, "params": {"suite": "libero_goal"}}
    for parent in ("one", "other"):
        write_vla_eval(tmp_path / parent / "oft", config, [(their_task(test, "prompt"), {"success": True})])
    with pytest.raises(PipelineError, match="two policies have the name 'oft'"):
        read_tested([tmp_path / "one" / "oft", tmp_path / "other" / "oft"])
