"""Experiment on the effect of the data: success of trained policies in the benchmark's tests.

    nice -n 10 python benchmarks/effect data ours          # 1. the arm's episodes
    nice -n 10 python benchmarks/effect train ours 0       # 2. a policy from them, under a seed
    nice -n 10 python benchmarks/effect evaluate ours 0    # 3. its results, in benchmarks/effect/results
    python benchmarks/effect table                         # 4. table and plot of docs/effect.md, of all results

With `--experiment benchmarks/effect/further/axes.yaml`, the results are in `benchmarks/effect/further/results/axes`.

Each step first runs the missing steps before it. Experiments with held-out perturbations need the plan of all arms for
an evaluation. The first evaluation generates the data of all arms for it, and stores it in the folder of the results.
After a stop, the same command resumes. Policies can be trained on different machines: the results of a policy are one
file, which also states the CPU time of each part. Commit it, and the plan of all arms.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import episodes
import sentences
import yaml
from experiment import Experiment, read

from pipeline.errors import PipelineError
from pipeline.evaluation import held_out
from pipeline.evaluation.results import REJECTED, EpisodeFiles, EpisodeResult
from pipeline.evaluation.task_list import write_tasks
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import checksum, read_json, write
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.run.claim import open_run
from pipeline.seeding import digest

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))


class HeldOut(NamedTuple):
    """Tests on held-out perturbations.

    Attributes:
        tests: the tests, equal for all arms.
        config: configuration of a run whose plan has the perturbed episodes of all arms.
        plan_sha256: SHA-256 of this plan.
    """

    tests: list[EvaluationTask]
    config: Path
    plan_sha256: str


class Work:
    """Files of an experiment, and the steps that generate them.

    Args:
        experiment: the experiment.
        out: folder of all files except the demonstrations and the results.
    """

    def __init__(self, experiment: Experiment, out: Path):
        self.experiment, self.out = experiment, out
        # Faults of the settings are reported before any work.
        self.vectors = sentences.read()
        for text in sentences.used(experiment.tasks):
            sentences.vector(text, self.vectors)

    def dataset(self, arm: str) -> Path:
        return self.out / "datasets" / f"{self.experiment.dataset_name(arm)}.npz"

    def policy(self, arm: str, seed: int) -> Path:
        return self.out / "policies" / self.experiment.policy_name(arm, seed)

    def make_data(self, arm: str) -> None:
        """Generate the demonstrations of all arms, and an arm's episodes."""
        file, demos = self.dataset(arm), self.experiment.run.demos
        if file.exists():
            return
        assert demos.root is not None, "read by Experiment"
        folders = {(demos.root / task).parent for task in self.experiment.tasks}
        if not all(map(Path.is_dir, folders)) or len(demos.index().entries) < self.experiment.episodes:
            with self._timed("demonstrations"):
                words = ["demos", "expand", str(demos.root), "--starts", "reset"]
                for task in self.experiment.tasks:
                    words += ["--tasks", task]
                run("-m", "pipeline", *words, "--per-task", str(self.experiment.demonstrations + self.experiment.spare))
        with self._timed(f"data {arm}"):
            episodes.make(self.experiment, arm, demos.index().entries, self.vectors, file)

    def train(self, arm: str, seed: int) -> None:
        """Train a policy."""
        policy = self.policy(arm, seed)
        if policy.exists():
            return
        self.make_data(arm)
        import training  # lerobot takes seconds to import

        with self._timed(f"training {policy.name}"):
            training.train(self.experiment, seed, episodes.read(self.dataset(arm)), self.vectors, policy)

    def evaluate(self, arm: str, seed: int, kept: Path) -> Path:
        """Evaluate a policy; write its results into the folder ``kept``, to be committed, and return the file."""
        import evaluation
        import training
        from results import PolicyResults
        from server_process import running

        held_out_tests = self._held_out(kept) if self.experiment.evaluation.held_out else None
        self.train(arm, seed)
        policy = self.policy(arm, seed)
        weights = checksum(policy / "model.safetensors")
        # The label has the weights' hash, as an earlier policy of the same settings has different results.
        label = f"{policy.name}_{weights[:8]}"
        folder = self.out / "evaluations" / label
        tested = evaluation.tested(self.experiment)
        in_libero = [task for task in tested if task.source == "libero"]
        with (
            self._timed(f"evaluation {policy.name}"),
            running(str(HERE / "server.py"), "--args.folder", str(policy)) as address,
        ):
            server = ("--server", address, "--label", label)
            rows = run_tests(tested, folder, *server)
            seen = run_tests(in_libero, folder / "black", *server, "--black", "all")
            if held_out_tests:
                options = (*server, "--trained-on", str(held_out_tests.config))
                rows += run_tests(
                    held_out_tests.tests, folder / "held_out", *options, plan_sha256=held_out_tests.plan_sha256
                )
            reading = evaluation.run_instructed_episodes(self.experiment, address, folder / "reading")
        dataset = episodes.read(self.dataset(arm))
        losses = (policy / "training.jsonl").read_text().splitlines()
        made: dict[str, Any] = {
            "dataset_sha256": checksum(self.dataset(arm)),
            "episodes_by_axis": dataset.axes(),
            "demonstrations": len({row["demo_id"] for row in dataset.episodes}),
            "frames": int(dataset.lengths.sum()),
            "sentences_sha256": checksum(sentences.FILE),
            "policy_sha256": weights,
            "plan_of_all_arms_sha256": held_out_tests.plan_sha256 if held_out_tests else None,
            "losses": [[entry["step"], entry["loss"]] for entry in map(json.loads, losses[9::10])],
            "trained_with": read_json(policy / training.TRAINED_WITH, "train the policy again"),
            "packages": training.trained_with()["packages"],
            "seconds": self._seconds(),
            "cores": os.cpu_count(),
        }
        settings = self.experiment.model_dump(
            mode="json", exclude={"data", "decisions", "seeds"}, exclude_defaults=True
        )
        settings["run"] = self.experiment.run.model_dump(mode="json", include={"demos", "plan", "replay", "render"})
        nothing = [{"task": row.base, "state": row.number, "success": row.success} for row in seen]
        return PolicyResults(arm, seed, settings, made, rows, reading, nothing).write(kept)

    def _held_out(self, kept: Path) -> HeldOut:
        """Select the held-out perturbations.

        Args:
            kept: folder with the plan of all arms; without it, the data of all arms are generated first.
        """
        import evaluation

        names = [self.experiment.dataset_name(arm) for arm in self.experiment.every_arm]
        config = self.out / f"all_arms_{digest(names)[:8]}.yaml"
        sections = self.experiment.run.model_dump(mode="json", include={"demos", "plan"}, exclude_defaults=True)
        write(config, yaml.safe_dump({"name": config.stem, "folder": str(self.out), **sections}))
        plan_file, kept_plan = open_run(config).plan_file, kept / f"{config.stem}.parquet"
        if not kept_plan.exists():
            rows: list[plan.Row] = []
            for arm in self.experiment.every_arm:
                self.make_data(arm)
                rows += episodes.perturbed_rows(self.dataset(arm))
            plan.write(rows, kept_plan)
        write(plan_file, kept_plan.read_bytes())
        tests = evaluation.held_out_tests(self.experiment, held_out.planned(plan_file))
        return HeldOut(tests, config, held_out.sha256_of(plan_file))

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        """Add the wall and CPU seconds of the context, child processes included, to ``times.jsonl``."""
        wall, cpu = time.perf_counter(), _cpu_s()
        try:
            yield
        finally:
            taken = {"seconds": round(time.perf_counter() - wall, 1), "cpu_s": round(_cpu_s() - cpu, 1)}
            self.out.mkdir(parents=True, exist_ok=True)
            with (self.out / "times.jsonl").open("a") as file:
                file.write(json.dumps({"part": name, **taken}) + "\n")

    def _seconds(self) -> dict[str, list[float]]:
        """Return part to its wall and CPU seconds, with those of interrupted commands, but not of killed ones."""
        taken: dict[str, list[float]] = {}
        for entry in map(json.loads, (self.out / "times.jsonl").read_text().splitlines()):
            seconds, cpu_s = taken.get(entry["part"], (0.0, 0.0))
            taken[entry["part"]] = [round(seconds + entry["seconds"], 1), round(cpu_s + entry["cpu_s"], 1)]
        return taken


def run_tests(
    tests: Sequence[EvaluationTask], folder: Path, *options: str, plan_sha256: str | None = None
) -> list[EpisodeResult]:
    """Evaluate on the tests without results in the folder; return the results of all tests whose scene was accepted.

    Args:
        plan_sha256: SHA-256 of the plan from which held-out perturbations keep their clearance.

    Raises:
        PipelineError: if a test has no result.
    """
    tasks = folder.with_name(f"{folder.name}_tasks.json")
    write_tasks(tests, 0, tasks)
    run("-m", "pipeline", "evaluate", str(folder), "--tasks-from", str(tasks), *options)
    # A result has the component of the perturbation that the scene accepted.
    of_test: dict[tuple[str, str, str, int], EpisodeResult] = {}
    for row in EpisodeFiles(folder).rows():
        if row.settings.get("plan") == plan_sha256:
            of_test[row.source, row.suite, row.name, row.number] = row
    names = [(test.source, test.suite, test.name, test.number) for test in tests]
    missing = [name for name in names if name not in of_test]
    if missing:
        raise PipelineError(f"{len(missing)} of {len(tests)} tests have no result, such as {missing[0]}", where=folder)
    return [of_test[name] for name in names if of_test[name].reason != REJECTED]


def run(*words: str) -> None:
    """Run a command of Python to its end.

    Raises:
        PipelineError: if the command fails.
    """
    print("$ python", *words, flush=True)
    folders = (str(HERE.parents[1]), os.environ.get("PYTHONPATH"))
    path = os.pathsep.join(filter(None, folders))
    done = subprocess.run([sys.executable, *words], env={**os.environ, "PYTHONPATH": path}, check=False)
    if done.returncode:
        raise PipelineError(
            f"ended with {done.returncode}",
            where=" ".join(words),
            remedy="read the output above, and run the command again",
        )


def _cpu_s() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--experiment", type=Path, default=HERE / "experiment.yaml", help="another one")
    parser.add_argument("--out", type=Path, default=Path("data/effect"), help="folder of all files (data/effect)")
    parser.add_argument(
        "--results",
        type=Path,
        help="folder of each policy's results (results/ next to experiment.yaml, for another file results/<its name>)",
    )
    steps = parser.add_subparsers(dest="step", required=True)
    for name in ("data", "train", "evaluate"):
        step = steps.add_parser(name)
        step.add_argument("arm")
        if name != "data":
            step.add_argument("seed", type=int)
    steps.add_parser("table")
    arguments = parser.parse_args()
    try:
        do(arguments)
    except PipelineError as error:
        sys.exit(f"error: {error}")


def results_folder(experiment: Path) -> Path:
    """Return the folder of the results of an experiment's file, which no other file has."""
    results = experiment.parent / "results"
    return results if experiment.stem == "experiment" else results / experiment.stem


def do(arguments: argparse.Namespace) -> None:
    """Run the step that the command line names."""
    if arguments.step == "table":
        import comparison

        print(comparison.publish(arguments.results or HERE / "results"))
        return
    kept = arguments.results or results_folder(arguments.experiment)
    work = Work(read(arguments.experiment), arguments.out)
    match arguments.step:
        case "data":
            work.make_data(arguments.arm)
        case "train":
            work.train(arguments.arm, arguments.seed)
        case "evaluate":
            print(f"wrote {work.evaluate(arguments.arm, arguments.seed, kept)}: commit it")


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
