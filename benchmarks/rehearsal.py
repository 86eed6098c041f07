"""Growth of time and memory with a configuration's size, up to its full size, with stand-ins for physics and pixels.

    nice -n 10 python benchmarks/rehearsal.py [--config configs/full.yaml] [--episodes 1000 28000] [--workers 2]

First, 50 demonstrations of eight steps are written for each task. For each size, every stage runs as `dvc repro` calls
it. Episodes and demonstrations keep the configuration's proportions. A replay has eight steps without a simulation, and
a frame is a pattern without rendering (``rehearsal_stand_ins.py``). Plan, stores, exports, manifest, checks and report
are real.

The last line is JSON, for each size and stage: seconds, the peak memory of the stage's process and of one worker, and
the size of the run's folder after the stage. After a stop, the same command resumes with the next stage.
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
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import environment_of
from pipeline.types import Task
from pipeline.validation.needs import PUBLISHED

REPOSITORY = Path(__file__).resolve().parents[1]
STAND_INS = REPOSITORY / "benchmarks" / "rehearsal_stand_ins.py"
DEMOS = Path("data/rehearsal_demos")
FIGURES = Path("data/rehearsal_figures")
LOOK_S = 0.5
"""Interval between two measurements of memory."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--config", type=Path, default=Path("configs/full.yaml"))
    parser.add_argument(
        "--episodes", type=int, nargs="+", default=[1000, 28000], help="kept episodes, without clean twins"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    demonstrations(load(arguments.config).demos)
    figures = {}
    for episodes in arguments.episodes:
        file = configuration(arguments.config, episodes, arguments.workers)
        figures[episodes] = {stage: measured(stage, file) for stage in stages()}
    print(json.dumps({"config": str(arguments.config), "workers": arguments.workers, "stages_by_episodes": figures}))


def demonstrations(wanted: DemosConfig) -> None:
    """Write different demonstrations of every task, in the scene of the starter set's demonstration."""
    starter = StarterSource()
    for task in select_tasks(wanted.tasks):
        path = DEMOS / task.suite / f"{task.name}_demo.hdf5"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            hdf5.write(path, task, _recordings(task, starter))
            print(f"wrote {path}", file=sys.stderr)


def _recordings(task: Task, starter: StarterSource) -> Iterator[hdf5.Recording]:
    demo = starter.demonstration(task)
    model_xml = demo.model_xml or environment_of(task).place_fixtures(0)
    for number in range(PUBLISHED):
        noise = seeding.rng("rehearsal", number).normal(0, [*[0.01] * 6, 0], (STEPS, 7))  # no noise on the gripper
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
    """Return the names of the stages in the order in which `dvc repro` runs them."""
    return list(yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())["stages"])


def measured(stage: str, config: Path) -> dict[str, Any]:
    """Run and measure a stage, or read its figures if it has run before."""
    record, data = FIGURES / config.stem / f"{stage}.json", Path("data") / config.stem
    if record.exists():
        return dict(json.loads(record.read_text()))
    folders = (str(REPOSITORY), os.environ.get("PYTHONPATH"))
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, folders)),
        "DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(STAND_INS)]),
    }
    command = [sys.executable, str(STAND_INS), str(REPOSITORY / "stages" / f"{stage}.py"), str(config)]
    start = time.perf_counter()
    with subprocess.Popen(command, env=environment, stdout=sys.stderr) as process:
        stage_peak, worker_peak = 0, 0
        while process.poll() is None:
            stage_bytes, *children_bytes = [*_memory(process.pid), 0]
            stage_peak = max(stage_peak, stage_bytes)
            worker_peak = max(worker_peak, *children_bytes, 0)
            time.sleep(LOOK_S)
    if process.returncode:
        raise SystemExit(f"{stage} of {config} ended with {process.returncode}")
    seconds = time.perf_counter() - start
    data_bytes = sum(file.stat().st_size for file in data.rglob("*") if file.is_file())
    figures = {
        "s": round(seconds, 1),
        "own_mb": round(stage_peak / 1e6),
        "worker_mb": round(worker_peak / 1e6),
        "data_mb": round(data_bytes / 1e6),
    }
    print(f"{config.stem} {stage} {figures}", file=sys.stderr, flush=True)
    with replaced(record) as temporary:
        temporary.write_text(json.dumps(figures))
    return figures


def _memory(pid: int) -> Iterator[int]:
    """Return the resident bytes of a process, then of each of its descendants."""
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
    ensure_fixed_machine_code()
    main()
