"""Commands about policies: ``evaluate`` and ``analyse``. Each prints one line of JSON last."""

import argparse
import json
from pathlib import Path
from typing import Any

from pipeline.commands.base import add, add_config, add_fields, add_group, argument, owned, plan_of, positive, value
from pipeline.errors import PipelineError
from pipeline.files import refuse_other_file, write_json

TITLE = "evaluate policies"
REPORT = Path("report.html")


def add_commands(commands: Any) -> None:
    add(commands, evaluate, _evaluate_arguments)
    kinds = add_group(
        commands, "analyse", "report, coverage, gap, construct, grade, leakage: what results and runs show"
    )
    results = value("results", "DIR", "folder of the results")
    add(
        kinds,
        report,
        value("folders", "DIR", "folder of results", nargs="+"),
        argument(
            "--across",
            nargs="+",
            choices=("prompt", "step_limit", "black"),
            default=(),
            help="compare results that differ in this, which is refused otherwise",
        ),
        value("--out", "FILE", f"page to write, with a JSON file beside it (default: {REPORT})", default=REPORT),
    )
    add(kinds, coverage, add_config)
    add(kinds, gap, results)
    add(
        kinds,
        construct,
        value("--out", "FILE", "list of tasks to write", required=True),
        value("--size", "N", "tasks of the benchmark (default: 10,000)", int),
        value("--results", "DIR", "results of candidates", nargs="+", default=()),
        value("--trained-on", "CONFIG", "leave out what overlaps with the plan of this run", plan_of, dest="plan"),
        argument("--seed", type=int, default=0, help="of all perturbations (default: 0)"),
    )
    graded = value("--out", "FILE", "list of tasks with their difficulty", required=True)
    add(kinds, grade, value("results", "DIR", "results of one model each", nargs="+"), graded)
    add(kinds, leakage, results, add_config)


def _evaluate_arguments(command: argparse.ArgumentParser) -> None:
    from pipeline.evaluation.environment import EpisodeSettings
    from pipeline.evaluation.rollout import PolicyConfig
    from pipeline.evaluation.selection import Selection

    command.argument_default = argparse.SUPPRESS
    command.add_argument("out", type=Path, metavar="DIR", help="folder of the results")
    acting = command.add_mutually_exclusive_group(required=True)
    acting.add_argument("--server", metavar="URL", help="address of a model server, such as ws://localhost:8000")
    acting.add_argument("--checkpoint", type=Path, metavar="DIR", help="a policy that lerobot saved")
    acting.add_argument(
        "--replay",
        nargs="?",
        choices=("open_loop", "tracked"),
        const="open_loop",
        help="the demonstrations, as a check: their own actions (open_loop, as without a value), or their paths, "
        "followed by feedback (tracked)",
    )
    named = {"suites": "--suite", "axes": "--axis", "components": "--component", "levels": "--level", "tasks": "--task"}
    add_fields(command, Selection, source="--source", file="--tasks-from", **named, subset="--subset")
    add_fields(command, Selection, episodes="--episodes", seed="--seed")
    anew = "sample held-out perturbations again that overlap with the plan of this run, the policy's training data"
    value("--trained-on", "CONFIG", anew, plan_of, dest="plan")(command)
    add_fields(command, EpisodeSettings, prompt="--prompt", step_limits="--step-limits", black="--black")
    add_fields(command, EpisodeSettings, initial_states="--initial-states", look_every="--look-every")
    add_fields(command, PolicyConfig, label="--label", timeout_s="--timeout")
    value("--assets", "DIR", "folder of LIBERO-Plus's unpacked asset archive", dest="archive")(command)
    command.add_argument("--videos", choices=("none", "failures", "all"), help="which episodes to film (default: none)")
    value("--workers", "N", "processes (default: one a core)", positive, default=0)(command)


def evaluate(arguments: argparse.Namespace) -> None:
    """run a policy on LIBERO's tasks, on LIBERO-Plus's test tasks or on held-out perturbations of the axes

    Writes one file for each episode, and summary.json with success rates and their 95 % intervals. Run again after a
    kill, it goes on. The policy is a model server of vla-eval (started by you), or a checkpoint of lerobot on disk.
    """
    from dask.system import CPU_COUNT

    from pipeline.compute.pool import runner
    from pipeline.compute_config import ComputeConfig
    from pipeline.evaluation.environment import EpisodeSettings
    from pipeline.evaluation.evaluate import evaluate
    from pipeline.evaluation.rollout import Evaluation, PolicyConfig
    from pipeline.evaluation.selection import Selection

    def given(*names: str) -> dict[str, Any]:
        return {name: value for name, value in vars(arguments).items() if name in names}

    kind, address = next(iter(given("server", "checkpoint", "replay").items()))
    policy = {"kind": address} if kind == "replay" else {"kind": kind, "address": str(address)}
    config = PolicyConfig.model_validate(policy | given("label", "timeout_s"))
    settings = EpisodeSettings.model_validate(given(*EpisodeSettings.model_fields))
    evaluation = Evaluation(settings, config, config.identity(), arguments.out, **given("videos", "archive"))
    workers = arguments.workers or CPU_COUNT
    compute = ComputeConfig(cluster="loop" if workers == 1 else "local", workers=workers)
    with runner(compute, arguments.out, renders=True) as run:
        selection = Selection.model_validate(given(*Selection.model_fields))
        summary = evaluate(evaluation, selection, run, workers)
    print(json.dumps({"all": summary["all"], "refused": summary["refused"], "by_axis": summary["by_axis"]}))


def report(arguments: argparse.Namespace) -> None:
    """write one HTML page and one JSON file about evaluations: rates, the paper's table, comparisons, failures

    Reads the folders that `evaluate` wrote, on one machine or on several, and sets different policies side by side.
    Two different results of one episode are an error, and so are results under different prompts, step limits, black
    views or starts. The last line is JSON.
    """
    from pipeline.evaluation.results import read
    from pipeline.report import evaluation_report

    print(json.dumps(evaluation_report.write(read(arguments.folders, arguments.across), arguments.out)))


def coverage(arguments: argparse.Namespace) -> None:
    """set what a policy sees in a finished run beside what it sees in the benchmark's test tasks

    First looks, how far the hand and the targets are moved, where objects are added, how much of a view changes, grey
    levels and words, axis by axis. The last line is JSON: number, tenth, fiftieth and ninetieth percentile of each.
    """
    from rich.console import Console
    from rich.table import Table

    from pipeline.report import seen
    from pipeline.testset import benchmark

    measures = seen.measure(owned(arguments), benchmark.load())
    table = Table("axis", "what a policy sees: middle (tenth to ninetieth percentile)", "test tasks", "this run")
    table.caption = "A run adds each number of objects equally often, unless it is configured otherwise."
    figures: dict[str, Any] = {}
    for measure in measures:
        cells = ["-" if spread is None else str(spread) for spread in (measure.tested, measure.ours)]
        table.add_row(measure.axis, measure.what, *cells)
        figures[f"{measure.axis}: {measure.what}"] = {"tests": measure.tested, "run": measure.ours}
    Console().print(table)
    print(json.dumps(figures))


def gap(arguments: argparse.Namespace) -> None:
    """compositional gap of the pairs that were run with --source pairs: gap.json and gap.png in their folder"""
    from pipeline.evaluation import composition
    from pipeline.evaluation.results import stored

    picture, findings = arguments.results / "gap.png", arguments.results / "gap.json"
    refuse_other_file(picture, composition.TITLE)
    refuse_other_file(findings, "papers_chi_square")
    measured = composition.pairs(stored([arguments.results]))
    composition.heatmap(measured, picture)
    figures = {f"{pair.one}+{pair.other}": pair.figures() for pair in measured}
    write_json(findings, figures)
    print(json.dumps(figures))


def construct(arguments: argparse.Namespace) -> None:
    """sample 14,000 held-out perturbations as candidates, filter and balance them to a benchmark

    The file is for `evaluate --tasks-from`. Which scenes refuse theirs is known once candidates were run: give those
    results, and these tasks are left out.
    """
    from pipeline.evaluation import own_draws, selection
    from pipeline.evaluation.results import stored
    from pipeline.evaluation.task_list import refuse_other_list, write_tasks

    refuse_other_list(arguments.out)
    rows = [row for row, _ in stored(arguments.results)]
    plan = own_draws.planned(arguments.plan) if arguments.plan else None
    drawn, size = selection.candidates(arguments.seed), arguments.size or selection.SIZE
    chosen, counts = selection.construct(drawn, arguments.seed, size, rows, plan)
    write_tasks(chosen, arguments.seed, arguments.out)
    print(json.dumps(counts))


def grade(arguments: argparse.Namespace) -> None:
    """difficulty of tasks, 1 to 5, by how many of several models solve each"""
    from pipeline.evaluation.results import stored
    from pipeline.evaluation.statistics import grade
    from pipeline.evaluation.task_list import refuse_other_list, write_tasks

    refuse_other_list(arguments.out)
    results = [stored([folder]) for folder in arguments.results]
    seeds: set[int] = set()
    for results_of_model in results:
        seeds.update(row.seed for row, _ in results_of_model)
    seed, *further_seeds = sorted(seeds)
    if further_seeds:
        raise PipelineError(f"results of seeds {sorted(seeds)}", expected="one seed, and so the same draws")
    graded = grade(results)
    write_tasks(graded, seed, arguments.out)
    difficulties = [task["difficulty"] for task in graded]
    by_level = {level: difficulties.count(level) for level in range(1, 6)}
    print(json.dumps({"models": len(results), "tasks": len(graded), "by_difficulty": by_level}))


def leakage(arguments: argparse.Namespace) -> int:
    """how close the held-out perturbations of results come to the plan of a run; ends with 1 where they overlap"""
    from pipeline.axes import from_json
    from pipeline.evaluation import own_draws
    from pipeline.evaluation.results import stored
    from pipeline.libero.tasks import find_task

    perturbations = []
    for row, _ in stored([arguments.results]):
        if row.source != "own":
            continue
        for perturbation in from_json(json.dumps(row.perturbations)):
            perturbations.append((row.name, perturbation, find_task(row.suite, row.base)))
    if not perturbations:
        lacking = "there are no held-out perturbations"
        raise PipelineError(lacking, where=arguments.results, remedy="evaluate --source own")
    findings = own_draws.compare(perturbations, own_draws.planned(owned(arguments).plan_file))
    print(json.dumps(findings))
    return int(any(finding["overlaps"] for finding in findings.values()))
