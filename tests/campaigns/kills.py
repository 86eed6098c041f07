"""Campaign that kills a run at pseudo-random moments, and compares its end with that of an undisturbed run.

    python tests/campaigns/kills.py [--kills 50] [--seed 0]

Two folders get the same configuration. In the first folder, `python -m pipeline run` runs undisturbed. In the second
folder, SIGKILL kills it repeatedly, all stages equally often and after a sampled time. The victim is everything at
once, the run's own process alone, or one of its workers; the run must survive the death of a worker. In the end both
folders must hold the same files with the same bytes. No file that was complete at a kill may be generated again. The
last line is JSON.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

if __name__ == "__main__":  # run as a script: with what the tests share
    sys.path[:0] = [str(Path(__file__).parents[1])]

import psutil
from checkout import IN_SCRIPTS, in_a_clone

from pipeline.machine_code import ensure_fixed_machine_code

SURVIVES_S = 20.0
"""Time that a run continues after the death of a worker, before it is killed as well."""
ALONE_S = 60.0
"""Time that processes may outlive their killed parent."""

Victim = Literal["everything", "run", "worker"]

BEGUN = re.compile(r"^\[\d+/\d+\] (\w+)$", re.MULTILINE)
"""Line of a run's output at the beginning of a stage that has something to do."""

COMPUTE_FILES = ("configs/tiny.yaml", "data/tiny/.finished/doctor.json", "data/tiny/settings.json")
"""Files of a clone that state how it was computed."""

STARTER: dict[str, object] = {
    "name": "tiny",
    "demos": {"source": "starter", "tasks": ["libero_goal/turn_on_the_stove"]},
    "plan": {"seed": 7, "axes": {"light": {}, "robot": {}}, "episodes": {"light": 1, "robot": 1}},
    "replay": {"mode": "auto", "settle_steps": 0},
    "render": {"jpeg_quality": 95},
    "export": {"rlds": {"name": "libero_tiny", "shards": 3}, "lerobot": {"name": "tiny", "shards": 3}},
    "compute": {"cluster": "local", "workers": 2},
}


@dataclass
class Killed:
    """Results of the kills.

    Attributes:
        kills: victim and running stage to the number of kills.
        runs: number of runs that ended and were started again, as kills were left.
        faults: descriptions of the faults.
    """

    kills: Counter[str] = field(default_factory=Counter)
    runs: int = 0
    faults: list[str] = field(default_factory=list)


def kill_and_resume(clone: Path, kills: int, seed: int, took_s: Mapping[str, float]) -> Killed:
    """Kill the run of a clone ``kills`` times, then let it end.

    Args:
        clone: the folder of the run.
        kills: number of kills.
        seed: seed of victims and moments.
        took_s: duration of each stage that is to be killed; the moment is sampled from it.
    """
    rng, result = random.Random(seed), Killed()
    whole: dict[Path, int] = {}
    due: set[str] = set()
    while (left := kills - result.kills.total()) > 0:
        due = due or set(rng.sample(sorted(took_s), min(left, len(took_s))))
        run = _started(clone)
        victim: Victim = rng.choice(("everything", "run", "worker"))
        for stage in _stages(run, clone):
            if stage in due:
                due.remove(stage)
                _wait(run, rng.uniform(0.0, took_s[stage]))
                break
        if run.poll() is not None:
            result.runs += 1
            if run.returncode:
                result.faults.append(f"the run ended with {run.returncode}")
                return result
            shutil.rmtree(clone / "data" / "tiny", ignore_errors=True)
            whole, due = {}, set()
            continue
        killed = _kill(run, victim, _stage(clone))
        result.kills[killed] += 1
        if killed.startswith("worker"):
            _wait(run, SURVIVES_S)
            if run.poll():
                result.faults.append(f"the run did not survive: {killed}")
        result.faults += _end(run)
        stamps = {file: file.stat().st_mtime_ns for file in _stored(clone)}
        result.faults += [f"{file.name} was made again" for file, stamp in whole.items() if stamps.get(file) != stamp]
        whole = stamps
    run = _started(clone)
    if run.wait() != 0:
        result.faults.append(f"the last run ended with {run.returncode}")
    remade = [file.name for file, stamp in whole.items() if not file.exists() or file.stat().st_mtime_ns != stamp]
    result.faults += [f"{name} was made again" for name in remade]
    return result


def _started(clone: Path) -> subprocess.Popen[bytes]:
    with _log(clone).open("wb") as log:
        command = [sys.executable, "-u", "-m", "pipeline", "run", "configs/tiny.yaml"]
        return subprocess.Popen(command, cwd=clone, env=IN_SCRIPTS, start_new_session=True, stdout=log, stderr=log)


def _log(clone: Path) -> Path:
    return clone.parent / f"{clone.name}.log"


def _wait(run: subprocess.Popen[bytes], seconds: float) -> None:
    end = time.monotonic() + seconds
    while run.poll() is None and time.monotonic() < end:
        time.sleep(0.02)


def _stages(run: subprocess.Popen[bytes], clone: Path) -> Iterator[str]:
    """Yield the name of each stage when it starts, until the run ends."""
    number = 0
    while True:
        ended = run.poll() is not None
        begun = BEGUN.findall(_log(clone).read_text())
        yield from begun[number:]
        number = len(begun)
        if ended:
            return
        time.sleep(0.1)


def _stage(clone: Path) -> str:
    """Return the name of the stage that began last."""
    begun: list[str] = BEGUN.findall(_log(clone).read_text())
    return begun[-1] if begun else "start"


def watched(run: subprocess.Popen[bytes], clone: Path) -> dict[str, float]:
    """Measure the seconds of each stage of an undisturbed run."""
    began = {name: time.monotonic() for name in _stages(run, clone)}
    ended = [*began.values(), time.monotonic()][1:]
    return {name: end - start for (name, start), end in zip(began.items(), ended, strict=True)}


def _kill(run: subprocess.Popen[bytes], victim: Victim, stage: str) -> str:
    """Kill the victim, or everything if there is no such process; return the killed victim and the stage."""
    workers = [process for process in psutil.Process(run.pid).children(recursive=True) if _is_worker(process)]
    if victim == "worker" and workers:
        workers[-1].kill()
    elif victim == "run":
        run.kill()
    else:
        os.killpg(run.pid, signal.SIGKILL)
        return f"everything in {stage}"
    return f"{victim} in {stage}"


def _is_worker(process: psutil.Process) -> bool:
    return any("spawn_main" in word for word in _command(process))


def _command(process: psutil.Process) -> list[str]:
    try:
        command: list[str] = process.cmdline()
        return command
    except psutil.Error:
        return []


def _end(run: subprocess.Popen[bytes]) -> list[str]:
    """Kill the run if it still runs, and wait until all of its processes have ended; return the faults."""
    if run.poll() is None and _alive(run.pid):
        os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    end = time.monotonic() + ALONE_S
    while _alive(run.pid) and time.monotonic() < end:
        time.sleep(0.05)
    left = _alive(run.pid)
    for process in left:
        process.kill()
    return [f"{len(left)} processes lived on"] if left else []


def _alive(session: int) -> list[psutil.Process]:
    processes = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                processes.append(process)
        except (ProcessLookupError, psutil.Error):
            continue
    return processes


def _stored(clone: Path) -> Iterator[Path]:
    for folder in ("trajectories", "frames"):
        yield from (clone / "data" / "tiny" / folder).rglob("*.npz")


def contents(clone: Path) -> dict[str, str]:
    """Return path to SHA-256 of every file of a clone, except DVC's own records and the machine's speed."""
    checksums: dict[str, str] = {}
    for file in clone.rglob("*"):
        if not file.is_file() or file.is_symlink() or file.name == "speed.json":
            continue
        path = file.relative_to(clone).as_posix()
        if not path.startswith((".dvc/", ".git/")) and "__pycache__" not in path:
            checksums[path] = hashlib.sha256(file.read_bytes()).hexdigest()
    return checksums


def compared(undisturbed: Path, disturbed: Path) -> list[str]:
    """List the differences between the files of two clones."""
    expected, actual = contents(undisturbed), contents(disturbed)
    differences: list[str] = []
    for path in sorted(expected.keys() | actual.keys()):
        if path not in actual:
            differences.append(f"{path} is missing")
        elif path not in expected:
            differences.append(f"{path} is left over")
        elif expected[path] != actual[path]:
            differences.append(f"{path} is another")
    return differences


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where the clones go (default: a temporary folder)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        undisturbed, disturbed = (folder / name for name in ("undisturbed", "disturbed"))
        for clone in (undisturbed, disturbed):
            in_a_clone(STARTER, clone)
        start = time.monotonic()
        alone = _started(undisturbed)
        took_s = watched(alone, undisturbed)
        if alone.wait() != 0:
            raise SystemExit((folder / "undisturbed.log").read_text())
        alone_s = time.monotonic() - start
        result = kill_and_resume(disturbed, arguments.kills, arguments.seed, took_s)
        faults = result.faults + compared(undisturbed, disturbed)
        for fault in faults:
            print(fault)
        figures: dict[str, Any] = {
            "kills": result.kills.total(),
            "by_victim_and_stage": dict(sorted(result.kills.items())),
            "runs_begun_again": result.runs,
            "undisturbed_s": round(alone_s, 1),
            "with_kills_s": round(time.monotonic() - start - alone_s, 1),
            "faults": len(faults),
        }
        print(json.dumps(figures))
        raise SystemExit(bool(faults))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
