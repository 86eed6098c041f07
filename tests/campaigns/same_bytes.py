"""Comparison of one configuration's outputs with no worker process, with 1, 2 and 4 workers, and with 2 again.

    python tests/campaigns/same_bytes.py

Each run is a `python -m pipeline run` in a separate folder, on the tests' short demonstrations. Only files that state
the section `compute` may differ. The last line is JSON.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

if __name__ == "__main__":  # run as a script: with what the tests share
    sys.path[:0] = [str(Path(__file__).parents[1])]

from checkout import in_a_clone, run_pipeline
from kills import COMPUTE_FILES, compared
from short_demonstrations import STOVE, loaded_whole, replay_whole, write_short_demos
from short_runs import tiny_config

from pipeline.machine_code import ensure_fixed_machine_code

COMPUTE: dict[str, dict[str, object]] = {
    "two": {"cluster": "local", "workers": 2},
    "two again": {"cluster": "local", "workers": 2},
    "one": {"cluster": "local", "workers": 1},
    "four": {"cluster": "local", "workers": 4},
    "none": {"cluster": "loop"},
}
"""Run to its section ``compute``; all runs are compared with the first."""

AXES = ("camera", "light", "noise", "language", "layout")


def main() -> None:
    seconds: dict[str, float] = {}
    different: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        first = Path(temporary) / next(iter(COMPUTE))
        whole, demos = Path(temporary) / "whole", Path(temporary) / "demos"
        whole.mkdir()
        replay_whole(whole)
        write_short_demos(loaded_whole(whole), demos)
        config = tiny_config(demos) | {
            "demos": {"source": "hdf5", "root": str(demos), "tasks": [f"{STOVE.suite}/{STOVE.name}"]},
            "plan": {"seed": 14, "axes": {key: {} for key in AXES}, "episodes": dict.fromkeys(AXES, 1)},
        }
        for name, compute in COMPUTE.items():
            clone = Path(temporary) / name
            in_a_clone(config | {"compute": compute}, clone)
            start = time.monotonic()
            done: subprocess.CompletedProcess[str] = run_pipeline(clone, "run", "configs/tiny.yaml")
            if done.returncode:
                raise SystemExit(done.stdout + done.stderr)
            seconds[name] = round(time.monotonic() - start, 1)
            differences = [
                line for line in compared(first, clone) if line.removesuffix(" is another") not in COMPUTE_FILES
            ]
            different[name] = differences
            print(f"{name}: {seconds[name]} s, {len(differences)} files differ", *differences, sep="\n  ")
        files = sum(1 for file in (first / "data" / "tiny").rglob("*") if file.is_file())
    faults = sum(map(len, different.values()))
    print(json.dumps({"files": files, "seconds": seconds, "files_that_differ": faults}))
    raise SystemExit(bool(faults))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
