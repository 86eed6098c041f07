"""Commands that generate datasets: ``run``, ``status`` and ``clean``."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.commands.base import Command, OneOf, config_argument, open_run
from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pipeline.run.run import Run


@click.command(cls=Command)
@config_argument
def run(config: Path) -> None:
    """Generate the datasets of a configuration, or their missing parts, and list them.

    The stages are performed in order. A stage whose results are up to date is left out. A run can be stopped at any
    time and resumes when the command is called again. The configuration may be any file. The folder of the run is
    <folder>/<name>, by default data/<name>, below the current folder.
    """
    from pipeline import stages
    from pipeline.run import counts

    finished = stages.run_all(config)
    print()
    places = {name: path for name, path in results(finished).items() if path.exists()}
    width = max(map(len, places))
    for name, path in places.items():
        print(f"{name:>{width}}  {path}")
    rows = finished.manifest
    for sentence in counts.shortfalls(counts.targets(rows, finished.config.plan.episodes)):
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


@click.command(cls=Command)
@config_argument
def status(config: Path) -> None:
    """Show wanted and kept episodes, the stages that would run and why, and their disk and time.

    Nothing is changed.
    """
    from rich.console import Console

    from pipeline import status

    console = Console(soft_wrap=True, highlight=False)
    for part in status.told(open_run(config)):
        console.print(part)


def _parts() -> Iterable[str]:
    from pipeline.run import cleaning

    return cleaning.PARTS


@click.command(cls=Command)
@config_argument
@click.option(
    "--only", multiple=True, type=OneOf(_parts), metavar="PART", help="A part to delete; may be given several times."
)
@click.option("--yes", is_flag=True, help="Do not ask.")
def clean(config: Path, only: tuple[str, ...], yes: bool) -> None:
    """Delete files that a run can generate again.

    The parts and their sizes are listed before you are asked. Other files in the folder of the run stay.
    Demonstrations, configurations and downloads are not touched. A folder that no run has marked is an error, and so
    is a foreign file inside a folder to delete.
    """
    from pipeline.generated import edits_in_words
    from pipeline.run import claim, cleaning, foreign

    run = open_run(config)
    claim.refuse_unmarked(run.folder)
    size_of_part = cleaning.found(run, only or tuple(cleaning.PARTS))
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
    if not yes:
        if not sys.stdin.isatty():
            raise PipelineError("nothing was deleted, as nobody can be asked here", remedy="add --yes")
        if input("Delete all of this? [y/N] ").strip().lower() not in ("y", "yes"):
            print("nothing was deleted")
            return
    cleaning.delete(run, list(size_of_part))
    print("deleted")
