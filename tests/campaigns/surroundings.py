"""Campaign that runs every stage in failing surroundings: full or read-only disk, no network, a clock set back.

    sudo python tests/campaigns/surroundings.py        # mounts a small file system, and takes the network away

Two folders get the same configuration. In the first folder, every stage runs without a network. In the second folder,
the data folder is a file system of its own. It is read-only before each stage, and then grows each time that it is
full. A stage that cannot continue must report the reason and end with 1. In the end both folders must hold the same
bytes. Then all files are dated a day ahead, and no stage may generate them again. The last line is JSON.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # run as a script: with what the tests share
    sys.path[:0] = [str(Path(__file__).parents[1])]

from checkout import IN_SCRIPTS, in_a_clone
from kills import STARTER, compared
from short_runs import STAGES

from pipeline.machine_code import ensure_fixed_machine_code

FIRST_KB, MORE_KB = 64, 1500
"""Initial size of the file system, and its growth each time that it is full."""

DAY_S = 86_400

WITHOUT_NETWORK = ("unshare", "--net")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.parse_args()
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as temporary:
        undisturbed, disturbed = (Path(temporary) / name for name in ("undisturbed", "disturbed"))
        for clone in (undisturbed, disturbed):
            in_a_clone(STARTER | {"compute": {"cluster": "loop"}}, clone)
        for name in STAGES:
            done = stage(undisturbed, name, *WITHOUT_NETWORK)
            if done.returncode:
                faults.append(f"{name} needs a network: {done.stderr[-300:]}")
        rejected: Counter[str] = Counter()
        with small_disk(disturbed / "data" / "tiny") as disk:
            for name in STAGES:
                remount(disk, "ro")
                faults += unlike_a_message(name, stage(disturbed, name), "file system is read-only")
                rejected["read_only"] += 1
                remount(disk, "rw")
                while (done := stage(disturbed, name)).returncode:
                    unlike = unlike_a_message(name, done, "disk is full")
                    if unlike:
                        raise SystemExit("\n".join([*faults, *unlike]))
                    rejected[f"full_in_{name}"] += 1
                    grow(disk)
            faults += compared(undisturbed, disturbed)
            faults += remade_by_another_clock(disturbed)
    for fault in faults:
        print(fault)
    figures: dict[str, Any] = {"stages_without_network": len(STAGES), **rejected, "faults": len(faults)}
    print(json.dumps(figures))
    raise SystemExit(bool(faults))


def stage(clone: Path, name: str, *prefix: str) -> subprocess.CompletedProcess[str]:
    command = [*prefix, sys.executable, f"stages/{name}.py", "configs/tiny.yaml"]
    return subprocess.run(command, cwd=clone, env=IN_SCRIPTS, capture_output=True, text=True, check=False)


def unlike_a_message(name: str, done: subprocess.CompletedProcess[str], expected: str) -> list[str]:
    """Return the fault of a stage's ending; an empty list if the stage reported the expected reason."""
    message = done.stderr.strip()
    if done.returncode == 1 and expected in message and "Traceback" not in message and "try:" in message:
        return []
    return [f"{name} ended with {done.returncode}, and does not say that {expected!r}: {message[-600:]}"]


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={FIRST_KB}k", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def grow(disk: Path) -> None:
    status = os.statvfs(disk)
    remount(disk, f"size={status.f_blocks * status.f_frsize // 1024 + MORE_KB}k")


def remount(disk: Path, option: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{option}", str(disk)], check=True)


def remade_by_another_clock(clone: Path) -> list[str]:
    """Date all files ahead, as if the clock had been set back since, and run all stages again; return the faults."""
    files = [file for file in (clone / "data" / "tiny").rglob("*.npz") if file.is_file()]
    ahead_s = time.time() + DAY_S
    for file in files:
        os.utime(file, (ahead_s, ahead_s))
    faults = []
    for name in ("replay", "render", "exports"):
        done = stage(clone, name)
        if done.returncode:
            faults.append(f"{name} fails with files of the future: {done.stderr[-300:]}")
    return faults + [f"{file.name} was made again" for file in files if file.stat().st_mtime < time.time()]


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
