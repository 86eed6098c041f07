"""In what two runs of one configuration differ, such as those of two systems: arrays, files, frames, pixels.

    python benchmarks/compare_runs.py ONE/data/starter OTHER/data/starter

Compares plan, manifest, every array of trajectories and frames, and every file of RLDS and LeRobot by SHA-256. Frames
that differ are decoded, and their pixels are compared. The last line is JSON; it ends with 1 where anything differs.
"""

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np
from pythons import contents

from pipeline.images import jpeg


def frames(data: Path) -> Iterator[tuple[str, bytes]]:
    """Trajectory, stream and step of each stored frame, and its JPEG file."""
    for path in sorted((data / "frames").rglob("*.npz")):
        with np.load(path) as arrays:
            streams = sorted({name.split("/")[1] for name in arrays.files if name.startswith("streams/")})
            for stream in streams:
                packed, start = arrays[f"streams/{stream}/bytes"].tobytes(), 0
                for step, end in enumerate(arrays[f"streams/{stream}/ends"].tolist()):
                    yield f"{path.parent.name}/{stream}/{step}", packed[start:end]
                    start = end


def pixels(one: bytes, other: bytes) -> tuple[int, int]:
    """How many pixels of two JPEG files differ, and the largest difference in grey levels."""
    by = np.abs(jpeg.decode(one).astype(int) - jpeg.decode(other)).max(axis=-1)
    return int(np.count_nonzero(by)), int(by.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("one", type=Path, help="folder of a run")
    parser.add_argument("other", type=Path, help="folder of another")
    arguments = parser.parse_args()
    one, other = ({(kind, name): sha for kind, name, sha in contents(data)} for data in vars(arguments).values())
    differing = sorted(key for key in one.keys() | other.keys() if one.get(key) != other.get(key))
    for kind, name in differing:
        print("differs:", kind, name)
    stored = dict(frames(arguments.one))
    compared, changed = 0, []
    for name, file in frames(arguments.other):
        compared += name in stored
        if stored.get(name, file) != file:
            changed.append(pixels(stored[name], file))
    report = {
        "compared": Counter(kind for kind, _ in one),
        "differing": Counter(kind for kind, _ in differing),
        "frames": compared,
        "frames that differ": len(changed),
        "pixels that differ in the worst": max((number for number, _ in changed), default=0),
        "grey levels in the worst": max((by for _, by in changed), default=0),
    }
    print(json.dumps(report))
    raise SystemExit(bool(differing))


if __name__ == "__main__":
    main()
