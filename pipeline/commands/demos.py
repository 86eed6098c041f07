"""Group ``demos``: commands that fetch, multiply and check demonstrations."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import click

from pipeline.commands.base import PATH, Command, LazyGroup, Listed, OneOf, example

demos = LazyGroup(
    "demos",
    help="Fetch, expand or check demonstrations (HDF5).",
    epilog=example("demos fetch data/demos libero_goal", "demos check data/demos"),
    sections={
        "Commands": {
            "fetch": Listed("demos", "Download LIBERO's demonstrations from the hub."),
            "expand": Listed("demos", "Generate many demonstrations from the starter set's."),
            "check": Listed("demos", "Check a folder of demonstrations by reading and replaying them."),
        }
    },
)

out_argument = click.argument("out", metavar="DIR", type=PATH, help="Folder to use as demos.root afterwards.")


def _suites() -> Iterable[str]:
    from pipeline.libero.tasks import SUITES

    return SUITES


@click.command(cls=Command, epilog=example("demos fetch data/demos libero_goal libero_10"))
@out_argument
@click.argument(
    "suites", metavar="SUITE...", nargs=-1, required=True, type=OneOf(_suites), help="Suites, such as libero_goal."
)
@click.option("--endpoint", metavar="URL", help="Address of a mirror of the Hugging Face hub.")
def fetch(out: Path, suites: tuple[str, ...], endpoint: str | None) -> None:
    """Download LIBERO's demonstrations (HDF5) of whole suites from the Hugging Face hub.

    Each task has a file DIR/<suite>/<task>_demo.hdf5 with 50 demonstrations, of 0.3 to 1 GB. A stopped download
    resumes when the command is called again.
    """
    from pipeline.libero import fetch

    files = fetch.fetch(out, suites, endpoint)
    print(f"downloaded {len(files)} files to {out}: write `demos: {{root: {out}}}` into a configuration")


@click.command(cls=Command, epilog=example("demos expand data/expanded --tasks 'libero_goal/*' --per-task 20"))
@out_argument
@click.option(
    "--per-task",
    metavar="N",
    type=click.IntRange(min=1),
    default=10,
    help="Number of demonstrations to generate of each task (default: 10).",
)
@click.option(
    "--tasks",
    metavar="PATTERN",
    multiple=True,
    help="Pattern of <suite>/<task>; may be given several times (default: the four suites).",
)
@click.option(
    "--starts",
    type=click.Choice(("wide", "reset")),
    default="wide",
    help="wide: the arm and the target start further away than in LIBERO's own demonstrations (default); reset: each "
    "start is a reset of LIBERO's environment.",
)
@click.option("--seed", type=int, default=0, help="Seed of all random values (default: 0).")
def expand(out: Path, per_task: int, tasks: tuple[str, ...], starts: Literal["wide", "reset"], seed: int) -> int:
    """Generate many demonstrations of each task from the starter set's single human demonstration.

    The human demonstration is replayed from other starts. Replays that reach the goal are written to
    DIR/<suite>/<task>_demo.hdf5, in LIBERO's own layout (states, actions and scenes; no images). The files and all
    datasets generated from them mark the demonstrations as expanded. The command needs no network, and resumes when it
    is called again. It stops if files have demonstrations that it would delete. The last line of the output is JSON.
    """
    from pipeline.compute.pool import runner
    from pipeline.compute_config import ComputeConfig
    from pipeline.config import DemosConfig
    from pipeline.run import expand
    from pipeline.testset import benchmark

    demos = DemosConfig(tasks=tasks) if tasks else DemosConfig()
    if starts == "reset":
        rows = expand.resets(demos, per_task, seed)
    else:
        rows = expand.candidates(demos, per_task, seed, benchmark.load())
    with runner(ComputeConfig(), out) as workers:
        made = expand.expand(out, demos, rows, per_task, workers)
    print(f"{made.written} demonstrations in {len(made.files)} files", end="")
    print(f": write `demos: {{root: {out}}}` into a configuration" if made.files else "")
    for task, missing in made.short.items():
        print(f"{task}: {missing} of {per_task} requested demonstrations are missing")
    print(json.dumps({"written": made.written, "dropped": dict(made.dropped.most_common()), "short": made.short}))
    return int(not made.files)


@click.command(cls=Command, epilog=example("demos check data/demos --replay 5"))
@click.argument("folder", metavar="DIR", type=PATH, help="Folder with files <suite>/<task>_demo.hdf5.")
@click.option(
    "--replay",
    "number",
    metavar="N",
    type=click.IntRange(min=0),
    default=2,
    help="Number of demonstrations of each file to replay (default: 2; 0 replays none).",
)
@click.option(
    "--config", metavar="CONFIG", type=PATH, help="Configuration of the intended run, whose replay settings are used."
)
def check(folder: Path, number: int, config: Path | None) -> int:
    """Check a folder of demonstrations (HDF5) by reading and replaying them.

    Every demonstration is read and checked. Two demonstrations of each file are also replayed: open-loop and, if the
    open-loop replay misses the goal, tracked. Notes and errors are printed. A missed goal is a note. If all replays of
    a file miss, each is an error, and other settings are tried. The last line is JSON. The exit status is 1 if there is
    an error.
    """
    from pipeline.compute.pool import runner
    from pipeline.compute_config import ComputeConfig
    from pipeline.config import ReplayConfig, load
    from pipeline.validation import demonstrations

    settings = load(config).replay if config else ReplayConfig()
    with runner(ComputeConfig(), folder) as workers:
        report = demonstrations.check(folder, number, workers, settings)
    missed = [f"{demo}: the replay misses the goal, while another one of the file reaches it" for demo in report.missed]
    for line in (*report.notes, *missed, *report.faults):
        print(line)
    print(json.dumps(asdict(report)))
    return int(bool(report.faults))
