"""Command line: all commands by their groups; each is defined in another module of this folder."""

import sys
from collections.abc import Sequence
from pathlib import Path

import click

from pipeline.commands.base import PROGRAM, LazyGroup, Listed
from pipeline.exit_status import exit_status

DESCRIPTION = """\
Generate perturbed fine-tuning data from LIBERO demonstrations.

A run is one configuration, a file such as configs/starter.yaml. All files of a run are written into one folder, by
default data/<name>. A command about a run takes its configuration as the last argument.
"""
EXAMPLES = f"""\
\b
Examples:
  Generate about 47 episodes of eight axes, in minutes:
    {PROGRAM} run configs/starter.yaml
  Render perturbations of the camera in a task into one picture:
    {PROGRAM} preview 'libero_goal/turn_on*' camera
  Download all 50 demonstrations of each task of a suite:
    {PROGRAM} demos fetch data/demos libero_goal
  Show the arguments and options of a command:
    {PROGRAM} COMMAND --help
"""
MOVED = {
    "check": "dataset check",
    "audit": "dataset audit",
    "regenerate": "dataset regenerate",
    "push": "dataset push",
    "analyse": "analyze",
}

top = LazyGroup(
    "pipeline",
    help=DESCRIPTION,
    epilog=EXAMPLES,
    moved=MOVED,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    sections={
        "Generate datasets": {
            "run": Listed("runs", "Generate the datasets of a configuration, or their missing parts."),
            "status": Listed("runs", "Show wanted and kept episodes, stages to run, disk and time."),
            "clean": Listed("runs", "Delete files that a run can generate again."),
        },
        "Before a run": {
            "demos": Listed("demos", "Fetch, expand or check demonstrations."),
            "doctor": Listed("prepare", "Check versions, OpenGL, folder, disk, memory and demonstrations for a run."),
            "preview": Listed("prepare", "Render perturbations of a task into one picture."),
            "axes": Listed("prepare", "List the axes of perturbation and their components."),
            "tasks": Listed("prepare", "List the tasks and their instructions."),
            "sources": Listed("prepare", "Fetch the textures and objects of a configuration."),
            "rewrite": Listed("prepare", "Add rewrites of an instruction by a language model to a bank."),
        },
        "After a run": {
            "dataset": Listed("dataset", "Check, audit, regenerate or push a dataset."),
        },
        "Policies": {
            "evaluate": Listed("evaluate", "Run a policy on LIBERO's, LIBERO-Plus's or held-out tasks."),
            "analyze": Listed("analyze", "Report on results, and compare runs with the test tasks."),
            "focus": Listed("focus", "Write a configuration with more episodes for frequent failures of policies."),
        },
        "For contributors": {
            "schema": Listed("develop", "Write the files of schemas/ that follow from the code."),
        },
    },
)


def run(words: Sequence[str] | None = None) -> int:
    """Call the command that the command line names; errors end it as in ``exit_status``.

    Args:
        words: the words after the program's name; by default those of this process.

    Returns:
        Exit status.
    """
    installed = Path(sys.argv[0]).name == "perturbed-libero"
    name = "perturbed-libero" if installed else PROGRAM

    def call() -> int:
        try:
            status: int = top.main(words, name, standalone_mode=False)
        except click.ClickException as error:
            error.show()
            return error.exit_code
        except click.Abort as aborted:  # Click's own error in place of an interruption.
            raise aborted.__cause__ or KeyboardInterrupt from None
        return status

    return exit_status(call)
