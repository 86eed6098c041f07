"""Command line of all commands, whose families are the other modules of this folder."""

import argparse
import os
import sys
from pathlib import Path

from pipeline.commands import before, demos, develop, evaluate, finished, runs
from pipeline.commands.base import LazyParser
from pipeline.exit_status import exit_status

FAMILIES = (runs, demos, before, finished, evaluate, develop)

DESCRIPTION = """\
Perturbed fine-tuning data from LIBERO demonstrations. A run is one configuration, a file of configs/: every command
that is about a run takes it as its last argument, and else the one that params.yaml names.
"""
EXAMPLES = """\
examples:
  python -m pipeline run configs/starter.yaml                    about 47 episodes of eight axes, in minutes
  python -m pipeline preview 'libero_goal/turn_on*' camera       what an axis does to a task
  python -m pipeline demos fetch data/demos libero_goal          all 50 demonstrations of each task, from the hub
  python -m pipeline COMMAND --help                              what a command takes
"""


def parser() -> argparse.ArgumentParser:
    installed = Path(sys.argv[0]).name == "perturbed-demos"
    top = argparse.ArgumentParser(
        prog="perturbed-demos" if installed else "python -m pipeline",
        usage="%(prog)s COMMAND ...",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = top.add_subparsers(
        required=True, metavar="COMMAND", help=argparse.SUPPRESS, parser_class=LazyParser, prog=top.prog
    )
    families = []
    for family in FAMILIES:
        others = set(commands.choices)
        family.add_commands(commands)
        lines = [f"  {name:<11} {one.summary}" for name, one in commands.choices.items() if name not in others]
        families.append("\n".join([f"{family.TITLE}:", *lines]))
    top.epilog = "\n\n".join([*families, EXAMPLES])
    return top


def run() -> int:
    """Call the command that the command line names.

    Returns:
        Exit status.
    """

    def command() -> int:
        arguments = parser().parse_args()
        try:
            status = int(arguments.run(arguments) or 0)
            sys.stdout.flush()  # here, where a reader that is gone can be told, rather than when Python ends
            return status
        except BrokenPipeError:
            # Who reads the output, such as `head`, has enough. Nothing must be written to it when Python ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0

    return exit_status(command)
