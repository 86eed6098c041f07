"""Disk usage of a run: the largest size of each of its folders, in MB.

    nice -n 10 python benchmarks/disk.py configs/starter.yaml

The script runs the stages up to `validate` on a configuration, in its own folder, and measures the folder meanwhile.
The last line is the result as JSON, with the estimate of `doctor`.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from pipeline.config import load
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.validation.needs import needed_mb

STAGES = ("inputs", "plan", "leakage", "replay", "render", "exports", "manifest", "validate")
EVERY_S = 0.3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("config", type=Path)
    file = parser.parse_args().config
    config = load(file)
    largest: dict[str, float] = {}
    for stage in STAGES:
        running = subprocess.Popen([sys.executable, f"stages/{stage}.py", file])
        while running.poll() is None:
            for folder, mb in folders_mb(config.run_folder).items():
                largest[folder] = max(largest.get(folder, 0.0), mb)
            try:
                running.wait(EVERY_S)
            except subprocess.TimeoutExpired:
                continue
        if running.returncode:
            raise SystemExit(running.returncode)
    doctor = {folder: round(mb, 2) for folder, mb in needed_mb(config).items()}
    print(json.dumps({"largest_mb": largest, "in_the_end_mb": folders_mb(config.run_folder), "doctor_mb": doctor}))


def folders_mb(data: Path) -> dict[str, float]:
    """Return the size of each folder of a run; files that vanish meanwhile count as 0."""
    folders = [folder for folder in sorted(data.glob("*")) if folder.is_dir()]
    return {folder.name: round(size(folder) / 1e6, 2) for folder in folders}


def size(folder: Path) -> int:
    total = 0
    for file in folder.rglob("*"):
        try:
            total += file.stat().st_size if file.is_file() else 0
        except OSError:
            continue
    return total


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
