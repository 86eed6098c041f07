"""Statistics of relative actions by lerobot's own tool, compared with the definition.

ROOT is a LeRobot dataset of a run with ``export.lerobot.action: absolute``; OUT is the copy that lerobot's tool wrote
by the command in ``docs/clients.md``:

    python benchmarks/clients/relative_statistics.py ROOT OUT

A relative action is an action of a chunk minus the state at the chunk's start. Here only positions are relative. The
statistics go over all chunks that end within their episode. The last line is JSON: the largest differences, and the
range of the rotations if they were relative, too.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

CHUNK = 50
POSITION = slice(0, 3)
ROTATION = slice(3, 6)


def episodes(root: Path) -> list[tuple[Any, Any]]:
    """Read the actions (T, 7) and the states (T, 8) of each episode."""
    found: list[tuple[Any, Any]] = []
    for file in sorted(root.glob("data/*/*.parquet")):
        table = pq.read_table(file, columns=["action", "observation.state", "episode_index"])
        numbers = table["episode_index"].to_numpy()
        actions, states = (np.stack(table[name].to_numpy()) for name in ("action", "observation.state"))
        for number in np.unique(numbers):
            found.append((actions[numbers == number], states[numbers == number]))
    return found


def main(root: Path, out: Path) -> None:
    chunks, rotations = [], []
    for actions, states in episodes(root):
        for start in range(len(actions) - CHUNK + 1):
            chunk = actions[start : start + CHUNK].copy()
            rotations.append(chunk[:, ROTATION] - states[start, ROTATION])
            chunk[:, POSITION] -= states[start, POSITION]
            chunks.append(chunk)
    relative = np.concatenate(chunks).astype(np.float64)
    theirs = json.loads((out / "meta" / "stats.json").read_text())["action"]
    expected = {"mean": relative.mean(axis=0), "std": relative.std(axis=0)}
    expected |= {"min": relative.min(axis=0), "max": relative.max(axis=0)}
    expected |= {f"q{share:02d}": np.quantile(relative, share / 100, axis=0) for share in (1, 10, 50, 90, 99)}
    apart = {name: float(np.abs(values - theirs[name]).max()) for name, values in expected.items()}
    turns = np.concatenate(rotations)
    figures = {"chunks": len(chunks), "largest_difference": apart}
    print(json.dumps({**figures, "rotation_rad": [float(turns.min()), float(turns.max())]}))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
