"""The command ``evaluate``: a policy on chosen tasks."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pipeline import gl
from pipeline.arguments import positive
from pipeline.compute.pool import runner
from pipeline.config import ComputeConfig
from pipeline.testset import benchmark


def add_commands(commands: Any) -> None:
    """Add ``evaluate`` to the commands of a parser."""
    command = commands.add_parser(
        "evaluate",
        help="run a policy on LIBERO's tasks, on LIBERO-Plus's test tasks or on held-out draws of the axes",
        description="Writes one file for each episode, and summary.json with success rates and their 95 % intervals. "
        "Run again after a kill, it goes on. The policy is a model server of vla-eval (started by you), or a "
        "checkpoint of lerobot on disk.",
    )
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
    command.add_argument(
        "--source",
        choices=("libero", "libero_plus", "own", "pairs", "goals"),
        default="libero",
        help="of the tasks (default: libero)",
    )
    command.add_argument(
        "--tasks-from", type=Path, metavar="FILE", help="in place of a source, a list that `analyse construct` wrote"
    )
    command.add_argument(
        "--plan", type=Path, metavar="FILE", help="draw held-out draws anew that overlap with this training plan"
    )
    command.add_argument("--suite", nargs="+", default=benchmark.SUITES, metavar="SUITE", help="of these suites only")
    command.add_argument("--axis", nargs="+", default=(), metavar="AXIS", help="of these axes only")
    command.add_argument("--component", nargs="+", default=(), metavar="NAME", help="of these components only")
    command.add_argument("--level", nargs="+", type=int, default=(), metavar="N", help="of these levels only")
    command.add_argument(
        "--task", nargs="+", default=(), metavar="PATTERN", help="named so, or perturbing one so named"
    )
    command.add_argument("--subset", type=positive, metavar="N", help="so many, spread evenly over all of these")
    command.add_argument(
        "--episodes",
        type=positive,
        default=1,
        metavar="N",
        help="initial states, of which LIBERO has 50, or draws of each task (default: 1)",
    )
    command.add_argument(
        "--prompt",
        choices=("clean", "benchmark", "blank"),
        default="clean",
        help="word test tasks by LIBERO's instruction (default), or as the benchmark's code does, by the file's name; "
        "or say nothing at all",
    )
    command.add_argument(
        "--black",
        choices=("none", "agentview", "all"),
        default="none",
        help="show the policy black frames in place of the agent view, or of all views (default: none)",
    )
    command.add_argument(
        "--initial-states",
        choices=("libero", "demonstration"),
        default="libero",
        help="LIBERO's own (default), or the first state of the starter set's demonstration",
    )
    command.add_argument("--seed", type=int, default=0, help="of the subset and of every draw (default: 0)")
    command.add_argument(
        "--label",
        default="",
        metavar="NAME",
        help="name of the policy in the results; a server must have one, another for each policy (default of a "
        "checkpoint: its folder and a part of the hash of its content)",
    )
    command.add_argument(
        "--look-every",
        type=positive,
        default=1,
        metavar="N",
        help="a server that keeps its chunk of actions to itself takes N of each: it is shown the scene once in N "
        "control steps (default: 1)",
    )
    command.add_argument(
        "--assets",
        type=Path,
        metavar="DIR",
        help="LIBERO-Plus's unpacked asset archive, which its light, layout and most of its background tasks need",
    )
    command.add_argument(
        "--timeout",
        type=positive,
        default=120,
        metavar="S",
        help="seconds that a server's answer may take (default: 120)",
    )
    command.add_argument("--workers", type=positive, metavar="N", help="processes (default: one for each core)")
    command.add_argument(
        "--videos",
        choices=("none", "failures", "all"),
        default="none",
        help="of which episodes to keep a video (default: none)",
    )
    command.set_defaults(run=_evaluate)


def _evaluate(arguments: argparse.Namespace) -> int:
    # The simulator takes seconds to import, which the other commands can do without.
    from dask.system import CPU_COUNT

    from pipeline.evaluation.evaluate import evaluate
    from pipeline.evaluation.policy_config import PolicyConfig
    from pipeline.evaluation.settings import Settings
    from pipeline.evaluation.tasks import Selection

    selection = Selection(
        source=arguments.source,
        file=arguments.tasks_from,
        suites=tuple(arguments.suite),
        axes=tuple(arguments.axis),
        components=tuple(arguments.component),
        levels=tuple(arguments.level),
        tasks=tuple(arguments.task),
        episodes=arguments.episodes,
        subset=arguments.subset,
        seed=arguments.seed,
    )
    settings = Settings(
        prompt=arguments.prompt,
        seed=arguments.seed,
        initial_states=arguments.initial_states,
        black=arguments.black,
        plan=arguments.plan,
        look_every=arguments.look_every,
    )
    policy = PolicyConfig(
        kind=arguments.replay or ("checkpoint" if arguments.checkpoint else "server"),
        address=str(arguments.checkpoint or arguments.server or ""),
        label=arguments.label,
        timeout_s=arguments.timeout,
    )
    workers = arguments.workers or CPU_COUNT
    compute = ComputeConfig(cluster="loop" if workers == 1 else "local", workers=workers)
    with runner(compute, arguments.out, gl.Shared) as run:
        found = evaluate(selection, settings, policy, arguments.out, run, arguments.videos, arguments.assets, workers)
    print(json.dumps({"all": found["all"], "refused": found["refused"], "by_axis": found["by_axis"]}))
    return 0
