"""A whole configuration at its full size, with stand-ins for physics and pixels: what do time and memory grow with?

    nice -n 10 python benchmarks/rehearsal.py [--config configs/full.yaml] [--episodes 1000 28000] [--workers 2]

First 50 demonstrations of eight steps are written for each task. For each size, every stage runs as `dvc repro` calls
it, with as many episodes in the configuration's proportions, and the demonstrations in proportion too. A replay is
eight steps that nothing simulates, a frame a pattern that nothing renders (``rehearsal_stand_ins.py``); plan, stores,
exports, manifest, checks and report are real. The last line is JSON: for each size and stage its seconds, the most
memory of its own process and of one worker, and how large the run's folder is after it. Stopped, the same command goes
on with the next stage.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np
import psutil
import yaml
from rehearsal_stand_ins import STEPS

from pipeline import seeding
from pipeline.config import DemosConfig, load
from pipeline.files import replaced
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import select_tasks
from pipeline.physics.environment import shared
from pipeline.types import Task
from pipeline.validation.needs import PUBLISHED

REPOSITORY = Path(__file__).resolve().parents[1]
STAND_INS = REPOSITORY / "benchmarks" / "rehearsal_stand_ins.py"
DEMOS = Path("data/rehearsal_demos")
FIGURES = Path("data/rehearsal_figures")
LOOK_S = 0.5
"""How often memory is looked at."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--config", type=Path, default=Path("configs/full.yaml"))
    parser.add_argument("--episodes", type=int, nargs="+", default=[1000, 28000], help="kept ones, without twins")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    demonstrations(load(arguments.config).demos)
    figures = {}
    for episodes in arguments.episodes:
        file = configuration(arguments.config, episodes, arguments.workers)
        figures[episodes] = {stage: measured(stage, file) for stage in stages()}
    print(json.dumps({"config": str(arguments.config), "workers": arguments.workers, "stages_by_episodes": figures}))


def demonstrations(wanted: DemosConfig) -> None:
    """Write demonstrations of every task, all different, in the scene of the starter set's one."""
    starter = StarterSource()
    for task in select_tasks(wanted.tasks):
        path = DEMOS / task.suite / f"{task.name}_demo.hdf5"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            hdf5.write(path, task, _recordings(task, starter))
            print(f"wrote {path}", file=sys.stderr)


def _recordings(task: Task, starter: StarterSource) -> Iterator[hdf5.Recording]:
    demo = starter.of(task)
    model_xml = demo.model_xml or shared(task).place_fixtures(0)
    for number in range(PUBLISHED):
        noise = seeding.rng("rehearsal", number).normal(0, [*[0.01] * 6, 0], (STEPS, 7))  # None on the gripper.
        actions = np.clip(demo.actions[:STEPS] + noise, -1, 1)
        states = np.repeat(demo.init_state[None], STEPS, axis=0)
        yield hdf5.Recording(actions, states, np.zeros((STEPS, 9)), model_xml, {})


def configuration(source: Path, episodes: int, workers: int) -> Path:
    """Write the configuration of one size."""
    content = yaml.safe_load(source.read_text())
    whole = sum(content["plan"]["episodes"].values())
    share = episodes / whole
    content["name"] = f"rehearsal_{episodes}"
    content["demos"] |= {"root": str(DEMOS), "per_task": max(1, round(PUBLISHED * share))}
    content["plan"]["episodes"] = {name: max(1, round(n * share)) for name, n in content["plan"]["episodes"].items()}
    for section in ("rlds", "lerobot"):
        content["export"][section]["shards"] = max(1, round(content["export"][section]["shards"] * share))
    content["compute"] = {"cluster": "local", "workers": workers}
    file = Path("data") / f"rehearsal_{episodes}.yaml"
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    return file


def stages() -> list[str]:
    """Names of the stages in the order in which `dvc repro` runs them."""
    return list(yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())["stages"])


def measured(stage: str, config: Path) -> dict[str, Any]:
    """Run a stage, or look up what it took where it has run."""
    record, data = FIGURES / config.stem / f"{stage}.json", Path("data") / config.stem
    if record.exists():
        return dict(json.loads(record.read_text()))
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH")))),
        "DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(STAND_INS)]),
    }
    command = [sys.executable, str(STAND_INS), str(REPOSITORY / "stages" / f"{stage}.py"), str(config)]
    start = time.perf_counter()
    with subprocess.Popen(command, env=environment, stdout=sys.stderr) as process:
        own, worker = 0, 0
        while process.poll() is None:
            first, *others = [*_memory(process.pid), 0]
            own, worker = max(own, first), max(worker, *others, 0)
            time.sleep(LOOK_S)
    if process.returncode:
        raise SystemExit(f"{stage} of {config} ended with {process.returncode}")
    figures = {
        "s": round(time.perf_counter() - start, 1),
        "own_mb": round(own / 1e6),
        "worker_mb": round(worker / 1e6),
        "data_mb": round(sum(file.stat().st_size for file in data.rglob("*") if file.is_file()) / 1e6),
    }
    print(f"{config.stem} {stage} {figures}", file=sys.stderr, flush=True)
    with replaced(record) as temporary:
        temporary.write_text(json.dumps(figures))
    return figures


def _memory(pid: int) -> Iterator[int]:
    """Resident bytes of a process, and of each below it."""
    try:
        root = psutil.Process(pid)
        for process in (root, *root.children(recursive=True)):
            try:
                yield process.memory_info().rss
            except psutil.Error:
                continue
    except psutil.Error:
        return


if __name__ == "__main__":
    main()
