"""Memory of the largest process of each stage of a run, and the stage's time, for one or several clones.

    python benchmarks/worker_memory.py configs/starter.yaml --clones . ../before

The stages run one after the other, each first in one clone and then in the next. The clones share this Python and its
packages. Their data folders must have no output of the configuration. The last line is JSON: clone to stage to `rss_mb`
(resident memory of the largest process), `own_mb` (the largest anonymous memory of a process: files that are mapped,
such as libraries, do not count) and `seconds`.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
from disk import STAGES

EVERY_S = 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", help="path of the configuration in each clone")
    parser.add_argument("--clones", type=Path, nargs="+", default=[Path()], help="folders of the clones")
    arguments = parser.parse_args()
    clones: Sequence[Path] = arguments.clones
    report: dict[str, dict[str, dict[str, float]]] = {str(clone): {} for clone in clones}
    for stage in (*STAGES, "recipe", "summary", "card", "report"):
        for clone in clones:
            report[str(clone)][stage] = measured(clone, stage, arguments.config)
            print(clone, stage, report[str(clone)][stage], file=sys.stderr)
    print(json.dumps(report))


def measured(clone: Path, stage: str, config: str) -> dict[str, float]:
    """Run a stage in a clone, and return the largest memory of any of its processes.

    Raises:
        SystemExit: when the stage fails.
    """
    environment = {**os.environ, "PYTHONPATH": str(clone.resolve())}
    begin = time.perf_counter()
    running = psutil.Popen([sys.executable, f"stages/{stage}.py", config], cwd=clone, env=environment)
    rss_mb = own_mb = 0.0
    while running.poll() is None:
        for rss, own in memory_mb(running):
            rss_mb, own_mb = max(rss_mb, rss), max(own_mb, own)
        time.sleep(EVERY_S)
    if running.returncode:
        raise SystemExit(running.returncode)
    seconds = time.perf_counter() - begin
    return {"rss_mb": round(rss_mb), "own_mb": round(own_mb), "seconds": round(seconds, 1)}


def memory_mb(parent: psutil.Process) -> Iterator[tuple[float, float]]:
    """Yield the resident and the anonymous memory of a process and of each of its descendants."""
    try:
        processes = [parent, *parent.children(recursive=True)]
    except psutil.NoSuchProcess:
        return
    for process in processes:
        try:
            _, *rows = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
        except (OSError, ValueError):  # The process has ended meanwhile.
            continue
        figures = {row.split()[0]: int(row.split()[1]) / 1024 for row in rows}
        yield figures["Rss:"], figures["Anonymous:"]


if __name__ == "__main__":
    main()
