"""Episodes per hour of whole commands: `vla-eval run` with its own LIBERO class, and `python -m pipeline evaluate`.

    python benchmarks/evaluation_throughput.py [--tasks libero_goal/turn_on_the_stove ...] [--states 2]

A model server replays demonstrations for all commands. Every command runs the same episodes to their end:

- the harness in one process, its default, and with one shard on each core;
- our command in one process, and with one worker on each core, its default;
- our default with answers in chunks of eight, with one observation per eight steps.

The times include imports, environments and results. The last line is the result as JSON: wall and CPU seconds, without
those of the server.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from server_process import replaying

from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code

TASKS = (
    "libero_goal/turn_on_the_stove",
    "libero_spatial/pick_up_the_black_bowl_on_the_cookie_box_and_place_it_on_the_plate",
    "libero_object/pick_up_the_salad_dressing_and_place_it_in_the_basket",
    "libero_object/pick_up_the_tomato_sauce_and_place_it_in_the_basket",
)
CHUNK = 8
CORES = len(os.sched_getaffinity(0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="SUITE/TASK")
    parser.add_argument("--states", type=int, default=2, help="initial states of each task")
    parser.add_argument("--quick", action="store_true", help="leave out the shards and the single worker")
    arguments = parser.parse_args()
    tasks = [tuple(task.split("/")) for task in arguments.tasks]
    figures: dict[str, Any] = {"cores": CORES, "tasks": arguments.tasks, "states": arguments.states}
    with tempfile.TemporaryDirectory() as folder, replaying(1) as one_by_one, replaying(CHUNK) as in_chunks:
        out = Path(folder)
        for name, commands in {
            "harness": harness(tasks, arguments.states, one_by_one, out / "harness", 1),
            f"harness_in_{CORES}_shards": harness(tasks, arguments.states, one_by_one, out / "shards", CORES),
            "ours_in_1_worker": [ours(tasks, arguments.states, one_by_one, out / "ours_in_1_worker", "--workers", "1")],
            "ours": [ours(tasks, arguments.states, one_by_one, out / "ours")],
            f"ours_look_in_{CHUNK}": [ours(tasks, arguments.states, in_chunks, out / "ours_in_chunks")],
        }.items():
            if arguments.quick and ("shards" in name or "1_worker" in name):
                continue
            figures[name] = timed(commands, len(tasks) * arguments.states)
            for kind in ("wall", "cpu"):
                ratio = figures["harness"][f"{kind}_s"] / figures[name][f"{kind}_s"]
                figures[name][f"times_faster_{kind}"] = round(ratio, 2)
            print(name, figures[name], flush=True)
        figures["harness"]["successes"] = harness_successes(out / "harness")
        for name, results in (("ours", "ours"), (f"ours_look_in_{CHUNK}", "ours_in_chunks")):
            rows = [json.loads(file.read_text()) for file in (out / results / "episodes").glob("*.json")]
            figures[name]["successes"] = sum(row["success"] for row in rows)
            figures[name]["steps"] = sum(row["steps"] for row in rows)
    print(json.dumps(figures))


def harness_successes(out: Path) -> int:
    """Count the successful episodes in the harness's result files."""
    successes = 0
    for file in out.rglob("*.json"):
        for task in json.loads(file.read_text())["tasks"]:
            successes += sum(episode["metrics"]["success"] for episode in task["episodes"])
    return successes


def harness(tasks: Sequence[tuple[str, ...]], states: int, address: str, out: Path, shards: int) -> list[list[str]]:
    """Return the harness's command for each shard; the harness names tasks by their instructions."""
    out.mkdir()
    suites = dict.fromkeys(suite for suite, _ in tasks)
    entries = []
    for suite in suites:
        instructions = [find_task(*task).instruction for task in tasks if task[0] == suite]
        entries.append(
            {
                "benchmark": "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark",
                "subname": suite,
                "episodes_per_task": states,
                "tasks": instructions,
                "params": {"suite": suite, "env_seed": 0},
            }
        )
    config = out / "run.yaml"  # YAML holds JSON.
    config.write_text(json.dumps({"server": {"url": address}, "output_dir": str(out), "benchmarks": entries}))
    program = [sys.executable, "-m", "vla_eval.cli.main", "run", "--no-docker", "--render", "cpu", "-c", str(config)]
    if shards == 1:
        return [program]
    program += ["--eval-id", "throughput", "--num-shards", str(shards)]
    return [[*program, "--shard-id", str(shard)] for shard in range(shards)]


def ours(tasks: Sequence[tuple[str, ...]], states: int, address: str, out: Path, *options: str) -> list[str]:
    suites = list(dict.fromkeys(suite for suite, _ in tasks))
    names = list(dict.fromkeys(name for _, name in tasks))
    program = [sys.executable, "-m", "pipeline", "evaluate", str(out), "--server", address, *options]
    program += ["--label", out.name, "--episodes", str(states)]
    for suite in suites:
        program += ["--suite", suite]
    for name in names:
        program += ["--task", name]
    return program


def timed(commands: Sequence[Sequence[str]], episodes: int) -> dict[str, Any]:
    """Run commands concurrently until all have ended; return their times."""
    cpu_s, start = children_s(), time.perf_counter()
    running = [subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for command in commands]
    for process in running:
        _, errors = process.communicate()
        if process.returncode:
            sys.exit(f"ended with {process.returncode}: {errors.decode()}")
    wall_s = time.perf_counter() - start
    return {
        "wall_s": round(wall_s, 1),
        "cpu_s": round(children_s() - cpu_s, 1),
        "episodes_an_hour": round(3600 * episodes / wall_s, 1),
    }


def children_s() -> float:
    """Return the CPU seconds of the child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
