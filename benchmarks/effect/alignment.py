"""Alignment of training and evaluation: a policy must get the same observation at the step of the same action.

    python benchmarks/effect/alignment.py CONFIG

The script needs a finished run of starter demonstrations with `export: {lerobot: {frames: images}}`. It sends the
actions of each clean episode in the evaluation. It compares frame and state before each action with those of the
dataset at the same step, one step before, and one step after. Both differences must be smallest at the same step. The
last line is JSON: median differences of grey levels and of states by shift.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from pipeline.config import load
from pipeline.episode_schema import SCHEMA
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.policies import VIEWS, Wanted
from pipeline.evaluation.selection import Selection, select
from pipeline.images.jpeg import decode
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.types import Floats, Frame

KEYS = {name: SCHEMA.views[view].lerobot_key for name, view in VIEWS.items()}
SHIFTS = (-1, 0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path, help="configuration of the run, with frames: images")
    config = load(parser.parse_args().data)
    (root,) = (target.root for target in config.export.datasets(config.run_folder) if target.name == "lerobot")
    columns = ["episode_index", SCHEMA.state.lerobot_key, SCHEMA.action.lerobot_key, *KEYS.values()]
    table = pq.read_table(root / "data", columns=columns)
    environment = EpisodeEnvironment(EpisodeSettings(initial_states="demonstration"))
    measured = []
    for row in pq.read_table(root / "meta" / "provenance.parquet").to_pylist():
        if row["axis"] == "clean":
            episode = table.filter(np.array(table["episode_index"]) == row["episode_index"])
            (task,) = select(Selection(suites=(row["suite"],), tasks=(row["task"],)))
            environment.reset(task)
            measured.append(compare(environment, episode.to_pydict()) | {"task": str(task)})
    environment.close()
    print(json.dumps(measured))


def compare(environment: EpisodeEnvironment, episode: dict[str, list[object]]) -> dict[str, object]:
    """Send an episode's actions; return the median differences from the dataset by quantity and by shift."""
    frames: dict[str, list[Frame]] = {}
    for view, key in KEYS.items():
        frames[view] = [decode(frame["bytes"]) for frame in episode[key]]  # type: ignore[index]
    states: Floats = np.array(episode[SCHEMA.state.lerobot_key])
    actions: Floats = np.array(episode[SCHEMA.action.lerobot_key])
    differences: dict[str, dict[int, list[float]]] = {}
    for name in (*VIEWS, "state"):
        differences[name] = {shift: [] for shift in SHIFTS}
    for step, action in enumerate(actions):
        seen = environment.observation(Wanted())
        for shift in SHIFTS:
            shifted_step = min(max(step + shift, 0), len(actions) - 1)
            for view in VIEWS:
                apart = np.abs(seen["images"][view].astype(float) - frames[view][shifted_step])
                differences[view][shift].append(float(apart.mean()))
            differences["state"][shift].append(float(np.abs(seen["states"] - states[shifted_step]).max()))
        if environment.step(action).over:
            break
    medians: dict[str, dict[str, float]] = {}
    for name, by_shift in differences.items():
        medians[name] = {str(shift): round(float(np.median(values)), 5) for shift, values in by_shift.items()}
    largest = {name: round(max(by_shift[0]), 5) for name, by_shift in differences.items()}
    progress = environment.progress
    return {"median": medians, "largest_at_same_step": largest, "steps": progress.steps, "success": progress.success}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
