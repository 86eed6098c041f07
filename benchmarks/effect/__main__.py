"""Does a policy that is trained on perturbed episodes hold up better than one that is trained on clean ones?

    nice -n 10 python benchmarks/effect benchmarks/effect/two_cores.yaml

Makes the data, trains a policy of each arm from each seed, evaluates them on the same episodes, and prints the table
and, last, one line of JSON. Stopped at any time, the same command goes on. docs/effect.md tells what it costs.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import comparison_table
from arms import chosen, provenance, write_small
from experiment import Experiment, read
from training import train

from pipeline.errors import PipelineError

REPOSITORY = Path(__file__).resolve().parents[2]
STAGES = ("inputs", "plan", "leakage", "replay", "render", "export_lerobot")
"""What a LeRobot dataset needs of `dvc repro`."""


class Shell:
    """Runs commands, each as a person would, and adds what the parts took to ``times.jsonl``."""

    def __init__(self, out: Path):
        out.mkdir(parents=True, exist_ok=True)
        self._times = out / "times.jsonl"
        self._environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH")))),
            # Nothing is fetched from the hub, and the copies that `datasets` makes stay here.
            "HF_HUB_OFFLINE": "1",
            "HF_DATASETS_CACHE": str((out / ".cache").resolve()),
            # Where other work shares the cores, PyTorch's threads would spend them on waiting for each other.
            "OMP_WAIT_POLICY": "passive",
        }

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What runs in it counts as a part's time."""
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._times.open("a") as file:
                file.write(json.dumps({"part": name, "seconds": round(time.perf_counter() - start, 1)}) + "\n")

    def __call__(self, command: list[str]) -> None:
        """Run a command to its end.

        Raises:
            PipelineError: when it fails.
        """
        print(f"$ {shlex.join(command)}", file=sys.stderr, flush=True)
        done = subprocess.run(command, env=self._environment, stdout=sys.stderr, check=False)
        if done.returncode:
            raise PipelineError(
                f"ended with {done.returncode}", where=shlex.join(command), remedy="see what it printed, and run again"
            )

    def hours(self) -> dict[str, float]:
        """Part to its hours, those of stopped commands too."""
        seconds: Counter[str] = Counter()
        for line in self._times.read_text().splitlines():
            taken = json.loads(line)
            seconds[taken["part"]] += taken["seconds"]
        return {part: round(taken / 3600, 2) for part, taken in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("experiment", type=Path, help="such as benchmarks/effect/two_cores.yaml")
    parser.add_argument("--out", type=Path, help="folder of all but the run's data (default: data/effect/<experiment>)")
    arguments = parser.parse_args()
    try:
        run(read(arguments.experiment), arguments.out or Path("data/effect") / arguments.experiment.stem)
    except PipelineError as error:
        sys.exit(f"error: {error}")


def run(experiment: Experiment, out: Path) -> None:
    """Do what is not done yet, and print the report.

    Raises:
        PipelineError: when a command fails, or the run has too few episodes.
    """
    shell = Shell(out)
    datasets = {arm: out / "datasets" / experiment.dataset_name(arm) for arm in experiment.arms}
    policies = {arm: [experiment.policy_name(arm, seed) for seed in experiment.seeds] for arm in experiment.arms}
    with shell.part("data"):
        make_data(experiment, datasets, shell)
    for seed, *names in zip(experiment.seeds, *policies.values(), strict=True):
        folders = {out / "policies" / name: dataset for name, dataset in zip(names, datasets.values(), strict=True)}
        untrained = {folder: dataset for folder, dataset in folders.items() if not folder.exists()}
        with shell.part("training"):
            train(untrained, experiment, seed, shell)
        with shell.part("evaluation"):
            evaluate(experiment, names, out, shell)
    lines, hours = comparison_table.table(comparison_table.read(out / "evaluations", policies)), shell.hours()
    contents = {arm: comparison_table.contents(dataset) for arm, dataset in datasets.items()}
    command = shlex.join(["python", "benchmarks/effect", *sys.argv[1:]])
    print(comparison_table.markdown(lines))
    print(
        f"\n{sum(contents[next(iter(contents))].values())} episodes in each arm, {experiment.training.steps} steps of "
        f"{experiment.training.batch_size} frames, seeds {', '.join(map(str, experiment.seeds))}; hours on "
        f"{os.cpu_count()} cores: {', '.join(f'{part} {taken}' for part, taken in hours.items())}; `{command}`"
    )
    print(
        json.dumps(
            {
                "experiment": experiment.model_dump(mode="json"),
                "tasks": experiment.tasks,
                "episodes_by_axis": contents,
                "table": lines,
                "hours": hours,
                "cores": os.cpu_count(),
                "command": command,
            }
        )
    )


def make_data(experiment: Experiment, datasets: dict[str, Path], shell: Shell) -> None:
    """The dataset of each arm, from one run of the pipeline."""
    missing = [arm for arm, dataset in datasets.items() if not dataset.exists()]
    if not missing:
        return
    demos = experiment.run.demos
    if experiment.demonstrations is not None:
        per_task = str(experiment.demonstrations)
        words = ["demos", "expand", str(demos.root), "--per-task", per_task, "--tasks", *experiment.tasks]
        shell([sys.executable, "-m", "pipeline", *words])
    for stage in STAGES:
        shell([sys.executable, str(REPOSITORY / "stages" / f"{stage}.py"), str(experiment.data)])
    source = experiment.lerobot
    rows = provenance(source)
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        jobs = [
            pool.submit(write_small, source, chosen(rows, experiment.arms[arm]), datasets[arm], experiment.frame_px)
            for arm in missing
        ]
        for job in jobs:
            job.result()


def evaluate(experiment: Experiment, policies: Sequence[str], out: Path, shell: Shell) -> None:
    """The same episodes for each policy."""
    wanted, tasks = experiment.evaluation, experiment.tasks
    suites, names = zip(*(task.split("/") for task in tasks), strict=True)
    each = math.ceil(wanted.episodes / len(tasks))
    selections = [["--source", "libero", "--episodes", str(min(each, 50))]]
    apart = ["--trained-on", str(experiment.data)]
    # A draw is made for each task, axis and one of five levels.
    draws = ["--episodes", str(math.ceil(each / 5))]
    for source, axes, options in (
        ("libero_plus", wanted.libero_plus, []),
        ("own", wanted.held_out, [*draws, *apart]),
        ("own", wanted.redrawn, draws),
    ):
        if axes:
            subset = str(wanted.episodes * len(axes))
            selections.append(["--source", source, *options, "--subset", subset, "--axis", *axes])
    for selection in selections:
        for policy in policies:
            shell(
                [
                    *(sys.executable, "-m", "pipeline", "evaluate", str(out / "evaluations" / policy)),
                    *("--checkpoint", str(out / "policies" / policy), "--label", policy),
                    *("--initial-states", wanted.initial_states),
                    *("--suite", *dict.fromkeys(suites), "--task", *names, *selection),
                ]
            )


if __name__ == "__main__":
    main()
