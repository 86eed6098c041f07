"""Commands that make datasets: ``run``, ``status`` and ``clean``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.commands.base import add, add_config, owned, value
from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pipeline.run.run import Run

TITLE = "make datasets"


def add_commands(commands: Any) -> None:
    add(commands, run, value("config", "CONFIG", "file of the run's configuration, such as configs/starter.yaml"))
    add(commands, status, add_config)
    add(commands, clean, _clean_arguments)


def run(arguments: argparse.Namespace) -> None:
    """make the datasets of a configuration, or what of them is not made yet, and say where they are

    Performs the stages in order, each only if something is to do. Stopped at any time, it resumes when it is called
    again. The configuration may be any file; the run's folder is <folder>/<name>, by default data/<name>, below the
    folder that the command is called in.
    """
    from pipeline import stages
    from pipeline.run import counts

    run = stages.run_all(arguments.config)
    print()
    places = {name: path for name, path in results(run).items() if path.exists()}
    width = max(map(len, places))
    for name, path in places.items():
        print(f"{name:>{width}}  {path}")
    rows = run.manifest
    for sentence in counts.shortfalls(counts.targets(rows, run.config.plan.episodes)):
        print(sentence)


def results(run: Run) -> dict[str, Path]:
    """Map names to the files and folders of a finished run that a person opens."""
    from pipeline.run.layout import CARD, FINETUNE, PREVIEWS, SHEETS

    return {
        **{dataset.title: dataset.root for dataset in run.formats},
        "manifest": run.manifest_file,
        "report": run.report_file,
        "fine-tuning": run.path(FINETUNE),
        "dataset cards": run.path(CARD),
        "sheets": run.path(SHEETS),
        "previews": run.path(PREVIEWS),
    }


def status(arguments: argparse.Namespace) -> None:
    """say how many episodes are wanted and kept, what would run and why, its disk and time; changes nothing"""
    from rich.console import Console

    from pipeline import status

    run = owned(arguments)
    console = Console(soft_wrap=True, highlight=False)
    for part in status.told(run):
        console.print(part)


def _clean_arguments(command: argparse.ArgumentParser) -> None:
    from pipeline.run import cleaning

    add_config(command)
    command.add_argument(
        "--only",
        action="append",
        choices=cleaning.PARTS,
        metavar="PART",
        help=f"{', '.join(cleaning.PARTS)}; may be given several times",
    )
    command.add_argument("--yes", action="store_true", help="do not ask")


def clean(arguments: argparse.Namespace) -> None:
    """delete what can be made again of a run, after it was listed with its sizes and you said yes

    Other files in the run's folder stay. Demonstrations, configurations and downloads are not touched. A folder that no
    run has marked, and a file that no stage made inside a folder to delete, are errors.
    """
    from pipeline.generated import edits_in_words
    from pipeline.run import claim, cleaning, foreign

    run = owned(arguments)
    claim.refuse_unmarked(run.folder)
    size_of_part = cleaning.found(run, arguments.only or tuple(cleaning.PARTS))
    if not size_of_part:
        print(f"{run.folder} has nothing of this")
        return
    for part, size_mb in size_of_part.items():
        print(f"{size_mb:10.1f} MB  {part:<13} made again by {cleaning.PARTS[part].made_by}")
    print(f"{sum(size_of_part.values()):10.1f} MB  in all, of {run.folder}")
    for edit in edits_in_words(run.folder) if "uploads" in size_of_part else ():
        print(edit)
    names: list[str] = []
    for part in size_of_part:
        names += cleaning.PARTS[part].names
    foreign.refuse_foreign_files(run.folder, names)
    if not arguments.yes:
        if not sys.stdin.isatty():
            raise PipelineError("nothing was deleted, as nobody can be asked here", remedy="add --yes")
        if input("Delete all of this? [y/N] ").strip().lower() not in ("y", "yes"):
            print("nothing was deleted")
            return
    cleaning.delete(run, list(size_of_part))
    print("deleted")
