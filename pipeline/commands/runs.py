"""Commands that generate datasets: ``run``, ``status`` and ``clean``."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.commands.base import Command, ListCommand, NamesOption, OneOf, config_argument, example, open_run
from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pipeline.run.run import Run


@click.command(cls=Command, epilog=example("run configs/starter.yaml"))
@config_argument
def run(config: Path) -> None:
    """Generate the datasets of a configuration, or their missing parts, and list them.

    All files are written into the folder of the run: <folder>/<name> of the configuration, by default data/<name>,
    below the current folder. They are the datasets, the manifest, the report and the dataset cards, and the plan,
    trajectories and frames behind them. The stages are performed in order, and a stage whose results are up to date is
    skipped. A run can be stopped at any time, and resumes when the command is called again.
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
        **{dataset.title: dataset.root for dataset in run.datasets},
        "manifest": run.manifest_file,
        "report": run.report_file,
        "fine-tuning": run.path(FINETUNE),
        "dataset cards": run.path(CARD),
        "sheets": run.path(SHEETS),
        "previews": run.path(PREVIEWS),
    }


@click.command(cls=ListCommand, epilog=example("status configs/starter.yaml"))
@config_argument
def status(config: Path) -> None:
    """Show the wanted and kept episodes of a run, the stages that would run and the reasons, disk and time.

    Before the first plan, only the wanted numbers and the disk are shown; `doctor` checks demonstrations, folder and
    time. The command changes no file in the folder of the run. If the plan is outdated, it samples a new one without
    storing it, which may download textures or objects.
    """
    from rich.console import Console

    from pipeline.status import describe

    console = Console(soft_wrap=True, highlight=False, markup=False)
    for part in describe(open_run(config)):
        console.print(part)


def _parts() -> Iterable[str]:
    from pipeline.run import cleaning

    return cleaning.PARTS


@click.command(cls=Command, epilog=example("clean --only pictures configs/starter.yaml"))
@config_argument
@click.option(
    "--only",
    cls=NamesOption,
    multiple=True,
    type=OneOf(_parts),
    metavar="PART",
    help="Part to delete; may be given several times (default: all parts). The parts are",
)
@click.option("--yes", is_flag=True, help="Delete without a question.")
def clean(config: Path, only: tuple[str, ...], yes: bool) -> None:
    """Delete files that a run can generate again.

    The command lists the parts, their sizes and the stages that generate them again, and then asks for permission.
    Other files in the folder of the run stay, and so do demonstrations, configurations and downloads. The command stops
    if the folder has no mark of a run, or if a folder to delete contains a file that no stage generated. For the cards
    and the files for fine-tuning, the command also stops if a file was edited.
    """
    from pipeline.run import claim, cleaning

    run = open_run(config)
    claim.reject_unmarked(run.folder)
    size_of_part = cleaning.found(run, only or tuple(cleaning.PARTS))
    if not size_of_part:
        print(f"{run.folder} has no files of these parts")
        return
    for part, size_mb in size_of_part.items():
        print(f"{size_mb:10.1f} MB  {part:<13} generated again by {cleaning.PARTS[part].made_by}")
    print(f"{sum(size_of_part.values()):10.1f} MB  in all, of {run.folder}")
    cleaning.reject_foreign(run, size_of_part)
    if not yes:
        if not sys.stdin.isatty():
            raise PipelineError("nothing was deleted, because there is no terminal to ask in", remedy="add --yes")
        if not _confirmed("Delete these files? [y/N] "):
            print("nothing was deleted")
            return
    cleaning.delete(run, list(size_of_part))
    print("deleted")


def _confirmed(question: str) -> bool:
    """Ask at the terminal. The end of the input (Ctrl-D) is a no."""
    try:
        return input(question).strip().lower() in ("y", "yes")
    except EOFError:
        print()
        return False
