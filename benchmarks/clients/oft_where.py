"""Episodes that OpenVLA-OFT's own loader reads with ``--where``, compared with a run's manifest; prints JSON last.

The script runs in the client's environment, in a checkout of OpenVLA-OFT, and needs neither a GPU nor weights. DATA is
the folder of a run:

    ENV/bin/python benchmarks/clients/oft_where.py DATA axis=clean,camera level=0,1,2

It reads each dataset of the run. The number of steps of each episode, and the numbers in the loader's statistics, are
compared with the rows of the manifest that meet the conditions.
"""

import argparse
import importlib
import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from oft_recipe import register_run, set_statistics


def list_expected(manifest: Path, suite: str, conditions: dict[str, tuple[str, ...]]) -> list[int]:
    """Return the sorted numbers of steps of the suite's kept episodes whose labels meet the conditions."""
    steps = []
    for row in pq.read_table(manifest).to_pylist():
        is_chosen = True
        for label, values in conditions.items():
            parts = [row[label]] if label == "axis" else row[label].split("+")
            is_chosen = is_chosen and {*parts} <= {*values}
        if row["kept"] and row["suite"] == suite and is_chosen:
            steps.append(row["steps"])
    return sorted(steps)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("conditions", nargs="+", help="a label and its values: axis=clean,camera")
    options = parser.parse_args()
    script, recipe = register_run(options.data)
    suites = recipe["suites"]["value"]
    conditions = script.join_conditions(map(script.condition, options.conditions), recipe["labels"]["value"])
    script.choose_episodes({*suites.values()}, conditions)
    set_statistics(script, recipe, json.dumps(conditions))

    loader: Any = importlib.import_module("prismatic.vla.datasets.rlds.dataset")
    materialize: Any = importlib.import_module("prismatic.vla.datasets.rlds.oxe.materialize")
    constants: Any = importlib.import_module("prismatic.vla.constants")
    episodes = {}
    for suite, name in suites.items():
        described = materialize.make_oxe_dataset_kwargs(
            name,
            options.data / "rlds",
            load_camera_views=("primary", "wrist"),
            load_proprio=True,
            action_proprio_normalization_type=constants.ACTION_PROPRIO_NORMALIZATION_TYPE,
        )
        dataset, statistics = loader.make_dataset_from_rlds(**described, train=True)
        steps = sorted(len(trajectory["action"]) for trajectory in dataset.iterator())
        expected = list_expected(options.data / "manifest.parquet", suite, conditions)
        counted = int(statistics["num_trajectories"]), int(statistics["num_transitions"])
        if steps != expected or counted != (len(expected), sum(expected)):
            raise SystemExit(f"error: {name} has episodes of {steps} steps, expected {expected}; statistics {counted}")
        episodes[name] = len(steps)
    print(json.dumps({"conditions": options.conditions, "episodes": episodes}))


if __name__ == "__main__":
    main()
