"""Differences between two runs of one configuration, for example on two systems: arrays, files, frames, pixels.

    python benchmarks/compare_runs.py ONE/data/starter OTHER/data/starter

The script compares plan, manifest, every array of trajectories and frames, and every file of RLDS and LeRobot by
SHA-256. Different frames are decoded, and their pixels are compared. The last line is JSON. The script ends with 1 if
anything differs.
"""

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pythons import contents

from pipeline.images import jpeg
from pipeline.machine_code import ensure_fixed_machine_code


def frames(data: Path) -> Iterator[tuple[str, bytes]]:
    """Return ``<trajectory>/<stream>/<step>`` of each stored frame, and its JPEG file."""
    for path in sorted((data / "frames").rglob("*.npz")):
        with np.load(path) as arrays:
            streams = sorted({name.split("/")[1] for name in arrays.files if name.startswith("streams/")})
            for stream in streams:
                packed, start = arrays[f"streams/{stream}/bytes"].tobytes(), 0
                for step, end in enumerate(arrays[f"streams/{stream}/ends"].tolist()):
                    yield f"{path.parent.name}/{stream}/{step}", packed[start:end]
                    start = end


def pixels(first: bytes, second: bytes) -> tuple[int, int]:
    """Return the number of different pixels of two JPEG files, and the largest difference in grey levels."""
    difference = np.abs(jpeg.decode(first).astype(int) - jpeg.decode(second)).max(axis=-1)
    return int(np.count_nonzero(difference)), int(difference.max())


def checksums(data: Path) -> dict[tuple[str, str], str]:
    """Return (kind, name) of a run's outputs to their SHA-256."""
    return {(kind, name): sha256 for kind, name, sha256 in contents(data)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("one", type=Path, help="folder of a run")
    parser.add_argument("other", type=Path, help="folder of another run")
    arguments = parser.parse_args()
    first, second = checksums(arguments.one), checksums(arguments.other)
    differing = sorted(key for key in first.keys() | second.keys() if first.get(key) != second.get(key))
    for kind, name in differing:
        print("differs:", kind, name)
    stored = dict(frames(arguments.one))
    compared, changed = 0, []
    for name, file in frames(arguments.other):
        compared += name in stored
        if stored.get(name, file) != file:
            changed.append(pixels(stored[name], file))
    report = {
        "compared": Counter(kind for kind, _ in first),
        "differing": Counter(kind for kind, _ in differing),
        "frames": compared,
        "frames that differ": len(changed),
        "pixels that differ in the worst": max((number for number, _ in changed), default=0),
        "grey levels in the worst": max((by for _, by in changed), default=0),
    }
    print(json.dumps(report))
    raise SystemExit(bool(differing))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
