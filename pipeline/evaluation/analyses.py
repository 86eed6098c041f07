"""The command ``analyse``: what the results of evaluations say together. Each prints one line of JSON last."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from pipeline.evaluation.results import EpisodeFiles
from pipeline.files import replaced


def add_commands(commands: Any) -> None:
    """Add ``analyse`` and what it does to the commands of a parser."""
    top = commands.add_parser("analyse", help="compositional gap, difficulty, a benchmark of your own, leakage")
    kinds = top.add_subparsers(dest="analysis", required=True, metavar="ANALYSIS")

    command = kinds.add_parser(
        "gap",
        help="compositional gap of the pairs that were run with --source pairs: gap.json and gap.png in their folder",
    )
    command.add_argument("results", type=Path, metavar="DIR", help="folder of the results")
    command.set_defaults(run=_gap)

    command = kinds.add_parser(
        "construct",
        help="draw 14,000 candidates of held-out draws, filter and balance them to a benchmark",
        description="The file is for `evaluate --tasks-from`. Which scenes refuse their draw is known once candidates "
        "were run: give those results, and these tasks are left out.",
    )
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help="list of tasks to write")
    command.add_argument("--size", type=int, metavar="N", help="tasks of the benchmark (default: 10,000)")
    command.add_argument("--results", type=Path, nargs="+", default=(), metavar="DIR", help="results of candidates")
    command.add_argument("--plan", type=Path, metavar="FILE", help="leave out what overlaps with this training plan")
    command.add_argument("--seed", type=int, default=0, help="of all draws (default: 0)")
    command.set_defaults(run=_construct)

    command = kinds.add_parser("grade", help="levels of difficulty, 1 to 5, by how many of several models solve a task")
    command.add_argument("results", type=Path, nargs="+", metavar="DIR", help="results of one model each")
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help="list of tasks with their difficulty")
    command.set_defaults(run=_grade)

    command = kinds.add_parser(
        "leakage",
        help="how close the held-out draws of results come to a training plan; ends with 1 where they overlap",
    )
    command.add_argument("results", type=Path, metavar="DIR", help="folder of the results")
    command.add_argument("--plan", type=Path, required=True, metavar="FILE", help="data/<run>/plan.parquet")
    command.set_defaults(run=_leakage)


def _gap(arguments: argparse.Namespace) -> int:
    from pipeline.evaluation import composition

    measured = composition.pairs(EpisodeFiles(arguments.results).some_rows())
    composition.heatmap(measured, arguments.results / "gap.png")
    figures = {f"{pair.one}+{pair.other}": pair.figures() for pair in measured}
    with replaced(arguments.results / "gap.json") as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures))
    return 0


def _construct(arguments: argparse.Namespace) -> int:
    # The draws need LIBERO, which takes seconds to import.
    from pipeline.evaluation import construction, disjoint

    constructed = construction.construct(
        construction.candidates(arguments.seed),
        arguments.seed,
        arguments.size or construction.SIZE,
        [row for folder in arguments.results for row in EpisodeFiles(folder).some_rows()],
        disjoint.planned(arguments.plan) if arguments.plan else None,
    )
    construction.write(constructed.tasks, arguments.seed, arguments.out)
    print(json.dumps(constructed.counts()))
    return 0


def _grade(arguments: argparse.Namespace) -> int:
    from pipeline.evaluation import construction

    results = [list(EpisodeFiles(folder).some_rows()) for folder in arguments.results]
    seed, *others = sorted({row["seed"] for rows in results for row in rows})
    if others:
        raise PipelineError(f"results of seeds {[seed, *others]}", expected="one seed, and so the same draws")
    graded = construction.grade(results)
    construction.write(graded, seed, arguments.out)
    by_level = {level: sum(task["difficulty"] == level for task in graded) for level in range(1, 6)}
    print(json.dumps({"models": len(results), "tasks": len(graded), "by_difficulty": by_level}))
    return 0


def _leakage(arguments: argparse.Namespace) -> int:
    from pipeline.axes import from_json
    from pipeline.evaluation import disjoint
    from pipeline.libero.tasks import find_task

    drawn = [
        (row["name"], one, find_task(row["suite"], row["base"]))
        for row in EpisodeFiles(arguments.results).some_rows()
        if row["source"] == "own"
        for one in from_json(json.dumps(row["perturbations"]))
    ]
    if not drawn:
        raise PipelineError("there are no held-out draws", where=arguments.results, remedy="evaluate --source own")
    findings = disjoint.compare(drawn, disjoint.planned(arguments.plan))
    print(json.dumps({axis: asdict(finding) for axis, finding in findings.items()}))
    return int(any(finding.overlaps for finding in findings.values()))
