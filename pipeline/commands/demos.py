"""Demonstrations: ``demos fetch``, ``demos expand`` and ``demos check``."""

import argparse
import json
from dataclasses import asdict
from typing import Any

from pipeline.commands.base import add, add_group, argument, at_least_zero, positive, value

TITLE = "get demonstrations"


def add_commands(commands: Any) -> None:
    verbs = add_group(
        commands, "demos", "fetch, expand, check: get LIBERO's, make more from few, look at a folder of them"
    )
    out = value("out", "DIR", "folder to use as demos.root afterwards")
    add(verbs, fetch, out, _suites, value("--endpoint", "URL", "address of a mirror of the hub", str))
    add(
        verbs,
        expand,
        out,
        value("--per-task", "N", "demonstrations of each task (default: 10)", positive, default=10),
        value("--tasks", "PATTERN", "patterns of <suite>/<task> (default: the four suites)", str, nargs="+"),
        argument(
            "--starts",
            choices=("wide", "reset"),
            default="wide",
            help="wide: arm and target further away than in LIBERO's own (default); reset: each start is a reset of "
            "LIBERO's environment",
        ),
        argument("--seed", type=int, default=0, help="of every draw (default: 0)"),
    )
    replays = "so many demonstrations of each file are replayed (default: 2; 0 for none)"
    add(
        verbs,
        check,
        value("folder", "DIR", "folder with <suite>/<task>_demo.hdf5"),
        value("--replay", "N", replays, at_least_zero, default=2),
        value("--config", "CONFIG", "configuration of the run that they are for; its replay settings are used"),
    )


def _suites(command: argparse.ArgumentParser) -> None:
    from pipeline.libero.tasks import SUITES

    command.add_argument("suites", nargs="+", choices=SUITES, metavar="SUITE", help=f"any of {', '.join(SUITES)}")


def fetch(arguments: argparse.Namespace) -> None:
    """download LIBERO's demonstrations (HDF5) from the hub, or go on with a download that was cut short"""
    from pipeline.libero.fetch import fetch

    files = fetch(arguments.out, arguments.suites, arguments.endpoint)
    print(f"{len(files)} files are in {arguments.out}: write `demos: {{root: {arguments.out}}}` into a configuration")


def expand(arguments: argparse.Namespace) -> int:
    """make many demonstrations of each task from the starter set's one, where the hub cannot be reached

    Replays each human demonstration from other starts and writes those that reach the goal in LIBERO's own HDF5 layout
    (states, actions and scenes; no images). They are marked as expanded in the files and in every dataset made from
    them.
    """
    from pipeline.compute.pool import runner
    from pipeline.compute_config import ComputeConfig
    from pipeline.config import DemosConfig
    from pipeline.run.expand import candidates, expand, resets
    from pipeline.testset import benchmark

    demos = DemosConfig(tasks=tuple(arguments.tasks)) if arguments.tasks else DemosConfig()
    if arguments.starts == "reset":
        rows = resets(demos, arguments.per_task, arguments.seed)
    else:
        rows = candidates(demos, arguments.per_task, arguments.seed, benchmark.load())
    with runner(ComputeConfig(), arguments.out) as workers:
        made = expand(arguments.out, demos, rows, arguments.per_task, workers)
    print(f"{made.written} demonstrations in {len(made.files)} files", end="")
    print(f": write `demos: {{root: {arguments.out}}}` into a configuration" if made.files else "")
    for task, missing in made.short.items():
        print(f"{missing} fewer than asked for of {task}")
    print(json.dumps({"written": made.written, "dropped": dict(made.dropped.most_common()), "short": made.short}))
    return int(not made.files)


def check(arguments: argparse.Namespace) -> int:
    """open every file of a folder of demonstrations (HDF5), replay two of each, and name file and fault

    Every demonstration is read and checked. Of each file two are also replayed as the run of --config would, or by the
    default settings: open-loop and, where that misses the goal, tracked. A miss is listed. If all of a file miss, each
    is a fault, and other settings are tried. The last line is JSON. Ends with 1 where there is a fault.
    """
    from pipeline.compute.pool import runner
    from pipeline.compute_config import ComputeConfig
    from pipeline.config import ReplayConfig, load
    from pipeline.validation.demonstrations import check

    replay = load(arguments.config).replay if arguments.config else ReplayConfig()
    with runner(ComputeConfig(), arguments.folder) as run:
        report = check(arguments.folder, arguments.replay, run, replay)
    for line in (*report.notes, *report.faults):
        print(line)
    print(json.dumps(asdict(report)))
    return int(bool(report.faults))
