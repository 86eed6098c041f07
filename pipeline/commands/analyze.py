"""Group ``analyze``: commands about results of policies and about runs. The last line of their output is JSON."""

import json
from pathlib import Path
from typing import Any

import click

from pipeline.commands.base import (
    FILE_TO_WRITE,
    PATH,
    Command,
    LazyGroup,
    Listed,
    config_argument,
    example,
    open_run,
    result_paths_argument,
)
from pipeline.errors import PipelineError
from pipeline.outputs import reject_other_file, write_json

analyze = LazyGroup(
    "analyze",
    help="Report on results of policies, and compare runs with the test tasks.",
    epilog=example("analyze report results/act results/pi05", "analyze observations configs/starter.yaml"),
    sections={
        "Commands": {
            "report": Listed("analyze", "Write an HTML page and a JSON file about evaluations."),
            "table": Listed("analyze", "Print the paper's table, with policies next to published models."),
            "observations": Listed("analyze", "Compare the observations of a run with those of the test tasks."),
            "gap": Listed("analyze", "Measure the compositional gap of pairs of perturbations."),
            "construct": Listed("analyze", "Sample and balance a benchmark of held-out perturbations."),
            "grade": Listed("analyze", "Grade the difficulty of tasks by the number of models that solve them."),
            "leakage": Listed("analyze", "Measure how close held-out perturbations come to a run's plan."),
        }
    },
    moved={"coverage": "analyze observations"},
)

results_argument = click.argument("results", metavar="DIR", type=PATH, help="Folder of the results.")


@click.command(cls=Command, epilog=example("analyze report results/act results/pi05 --out report.html"))
@click.argument("folders", metavar="DIR...", nargs=-1, required=True, type=PATH, help="Folders of results.")
@click.option(
    "--across",
    multiple=True,
    type=click.Choice(("prompt", "step_limit", "black")),
    help="Setting in which the compared results may differ; may be given several times (default: none).",
)
@click.option(
    "--out",
    metavar="FILE",
    type=FILE_TO_WRITE,
    default=Path("report.html"),
    help="Page to write, with a JSON file next to it (default: report.html).",
)
def report(folders: tuple[Path, ...], across: tuple[Any, ...], out: Path) -> None:
    """Write an HTML page and a JSON file about evaluations: rates, the paper's table, comparisons, failures.

    The folders are results of `evaluate`, from one or several machines, and of one or several policies. Two different
    results of one episode are an error, and so are results with different prompts, step limits, black views or starts.
    The last line of the output is JSON.
    """
    from pipeline.evaluation.results import read
    from pipeline.report import evaluation_report

    print(json.dumps(evaluation_report.write(read(folders, across), out)))


@click.command(cls=Command, epilog=example("analyze table results/act results/vla_eval --out table"))
@result_paths_argument
@click.option(
    "--out",
    metavar="NAME",
    type=PATH,
    help="Write NAME.md, NAME.csv and NAME.tex, too (default: print only).",
)
def table(results: tuple[Path, ...], out: Path | None) -> None:
    """Print the paper's table on LIBERO-Plus's test tasks as Markdown, with policies next to published models.

    The columns are the benchmark's seven dimensions, the total over tasks and the mean of the seven. Each policy states
    its tasks, prompt, step limits and trials. A policy of vla-eval or lerobot-eval has the name of its folder. The last
    line of the output is JSON.
    """
    from pipeline.evaluation.analyses.other_programs import read_tested
    from pipeline.report import paper_rows
    from pipeline.report.paper_table import table_of

    if out is not None:
        out = out.with_suffix("") if out.suffix in paper_rows.SUFFIXES else out
        paper_rows.reject_other_tables(out)
    found = table_of(read_tested(results))
    print(paper_rows.markdown(found))
    files = [] if out is None else [str(file) for file in paper_rows.write_table(found, out)]
    print(json.dumps({"files": files, "rows": {row["name"]: row for row in found["evaluated"]}}))


@click.command(cls=Command, epilog=example("analyze observations configs/starter.yaml"))
@config_argument
def observations(config: Path) -> None:
    """Compare the observations of a finished run with those of the benchmark's test tasks.

    The printed table has measures of each axis: first observations, displacements of hand and targets, places of added
    objects, changed shares of a view, grey levels and words. The last line is JSON, with the number, the tenth, the
    fiftieth and the ninetieth percentile of each measure.
    """
    from rich.console import Console
    from rich.table import Table

    from pipeline.report import seen
    from pipeline.testset import benchmark

    measures = seen.measure(open_run(config), benchmark.load())
    table = Table("axis", "visible effect: median (tenth to ninetieth percentile)", "test tasks", "this run")
    table.caption = "Each number of added objects is equally frequent in a run with the default levels."
    figures: dict[str, Any] = {}
    for measure in measures:
        cells = ["-" if spread is None else str(spread) for spread in (measure.tested, measure.ours)]
        table.add_row(measure.axis, measure.what, *cells)
        figures[f"{measure.axis}: {measure.what}"] = {"tests": measure.tested, "run": measure.ours}
    Console().print(table)
    print(json.dumps(figures))


@click.command(cls=Command, epilog=example("analyze gap results/pairs"))
@results_argument
def gap(results: Path) -> None:
    """Measure the compositional gap of pairs of perturbations.

    The results are those of `evaluate --source pairs`. The command writes gap.json and gap.png into their folder. The
    last line of the output is JSON.
    """
    from pipeline.evaluation.analyses import composition
    from pipeline.evaluation.results import stored

    picture, findings = results / "gap.png", results / "gap.json"
    reject_other_file(picture)
    reject_other_file(findings)
    measured = composition.pairs(stored([results]))
    composition.heatmap(measured, picture)
    figures = {f"{pair.first}+{pair.second}": pair.figures() for pair in measured}
    write_json(findings, figures)
    print(json.dumps(figures))


@click.command(cls=Command, epilog=example("analyze construct --out tasks.json --size 1000"))
@click.option("--out", metavar="FILE", type=FILE_TO_WRITE, required=True, help="File of the list of tasks to write.")
@click.option(
    "--size", metavar="N", type=click.IntRange(min=1), help="Number of tasks of the benchmark (default: 10,000)."
)
@click.option(
    "--results",
    metavar="DIR",
    multiple=True,
    type=PATH,
    help="Results of candidates, of which rejected ones are left out; may be given several times.",
)
@click.option(
    "--trained-on",
    metavar="CONFIG",
    type=PATH,
    help="Configuration of training data; perturbations that overlap with its plan are left out.",
)
@click.option("--seed", type=int, default=0, help="Seed of all perturbations (default: 0).")
def construct(out: Path, size: int | None, results: tuple[Path, ...], trained_on: Path | None, seed: int) -> None:
    """Sample 14,000 held-out perturbations as candidates, and filter and balance them to a benchmark.

    The command writes a list of tasks, which `evaluate --tasks-from` reads. Some scenes reject their perturbation, and
    only an evaluation of the candidates shows it: with --results, these tasks are left out. The last line of the output
    is JSON.
    """
    from pipeline.evaluation import held_out
    from pipeline.evaluation.analyses import construction
    from pipeline.evaluation.results import stored
    from pipeline.evaluation.task_list import write_tasks

    reject_other_file(out)
    rows = [row for row, _ in stored(results)]
    plan = held_out.planned(open_run(trained_on).plan_file) if trained_on else None
    candidates = construction.candidates(seed)
    chosen, counts = construction.construct(candidates, seed, size or construction.SIZE, rows, plan)
    write_tasks(chosen, seed, out)
    print(json.dumps(counts))


@click.command(cls=Command, epilog=example("analyze grade results/act results/pi05 --out graded.json"))
@click.argument("folders", metavar="DIR...", nargs=-1, required=True, type=PATH, help="Results of one model each.")
@click.option(
    "--out", metavar="FILE", type=FILE_TO_WRITE, required=True, help="File of the list of graded tasks to write."
)
def grade(folders: tuple[Path, ...], out: Path) -> None:
    """Grade the difficulty of tasks, 1 to 5, by the number of models that solve each task.

    The command writes a list of the tasks with their difficulty, which `evaluate --tasks-from` reads. The last line of
    the output is JSON.
    """
    from pipeline.evaluation.analyses import grading
    from pipeline.evaluation.results import stored
    from pipeline.evaluation.task_list import write_tasks

    reject_other_file(out)
    results = [stored([folder]) for folder in folders]
    seeds: set[int] = set()
    for results_of_model in results:
        seeds.update(row.seed for row, _ in results_of_model)
    seed, *further_seeds = sorted(seeds)
    if further_seeds:
        raise PipelineError(
            f"the results have the seeds {sorted(seeds)}",
            expected="one seed, and therefore the same perturbations",
            remedy="name the folders of one seed; evaluate the other models with this seed",
        )
    graded = grading.grade(results)
    write_tasks(graded, seed, out)
    difficulties = [task["difficulty"] for task in graded]
    by_level = {level: difficulties.count(level) for level in range(1, 6)}
    print(json.dumps({"models": len(results), "tasks": len(graded), "by_difficulty": by_level}))


@click.command(cls=Command, epilog=example("analyze leakage results/own configs/starter.yaml"))
@results_argument
@config_argument
def leakage(results: Path, config: Path) -> int:
    """Measure how close the held-out perturbations and goals of results come to the plan of a run.

    The results are those of `evaluate --source own` or `goals`. The output is one line of JSON. The exit status is 1 if
    a perturbation overlaps with the plan, or if the plan trains on a goal.
    """
    from pipeline.axes import from_json
    from pipeline.evaluation import held_out
    from pipeline.evaluation.goals import resolve_goal
    from pipeline.evaluation.results import stored
    from pipeline.libero.tasks import find_task

    perturbations, goals = [], []
    for row, _ in stored([results]):
        if row.source == "goals":
            task, *_ = row.trial
            goals.append(resolve_goal(task)[1])
        if row.source != "own":
            continue
        for perturbation in from_json(json.dumps(row.perturbations)):
            perturbations.append((row.name, perturbation, find_task(row.suite, row.base)))
    if not perturbations and not goals:
        raise PipelineError(
            "the results have no held-out perturbations and goals", where=results, remedy="run `evaluate --source own`"
        )
    planned = held_out.planned(open_run(config).plan_file)
    findings = held_out.compare(perturbations, planned)
    if goals:
        findings["goals"] = {"draws": len(goals), "overlaps": sum(goal in planned.goals for goal in goals)}
    print(json.dumps(findings))
    return int(any(finding["overlaps"] for finding in findings.values()))
