"""Rewrites that OpenVLA-OFT's own loader samples from a run's RLDS datasets; the last printed line is JSON.

The script runs in the client's environment, in a checkout of OpenVLA-OFT, and needs neither a GPU nor weights. DATA is
the folder of a run:

    ENV/bin/python benchmarks/clients/oft_rewrites.py DATA --samples 5000
"""

import argparse
import importlib
import json
from collections import Counter
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from oft_recipe import register_run, set_statistics

SIZE_PX = 64
"""Size to which the loader resizes the frames, which are not used here."""


def labels_in(manifest: Path) -> set[tuple[str, ...]]:
    """Return the instruction and the rewrites of each kept episode."""
    rows = pq.read_table(manifest, columns=["kept", "instruction", "rewrites"]).to_pylist()
    return {(row["instruction"], *json.loads(row["rewrites"])) for row in rows if row["kept"]}


def figures(data: Any, samples: int, labels: set[tuple[str, ...]]) -> dict[str, Any]:
    """Read samples from a dataset of OFT, and count the replaced instructions.

    Raises:
        ValueError: if a sample has labels of no episode, or gets a text that its episode does not allow.
    """
    counts: Counter[str] = Counter()
    texts: set[str] = set()
    for raw in islice(data.dataset.as_numpy_iterator(), samples):
        lines = tuple(raw["task"]["language_instruction"].decode().split("\n"))
        if lines not in labels:
            raise ValueError(f"no kept episode has the labels {lines}")
        text = data.batch_transform(raw)["task"]["language_instruction"].decode()
        if text not in lines:
            raise ValueError(f"{text!r} is no rewrite of {lines[0]!r}")
        if len(lines) > 1:
            counts["own instruction" if text == lines[0] else "rewrite"] += 1
        texts.add(text)
    with_rewrites = counts.total()
    return {
        "samples": samples,
        "samples of episodes with rewrites": with_rewrites,
        "share of these with a rewrite": round(counts["rewrite"] / with_rewrites, 4),
        "distinct texts": len(texts),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, default=5000)
    parser.add_argument("--probability", type=float, default=0.8)
    options = parser.parse_args()
    script, recipe = register_run(options.data)
    set_statistics(script, recipe)
    script.sample_rewrites({*recipe["suites"]["value"].values()}, options.probability, "benchmark")
    datasets: Any = importlib.import_module("prismatic.vla.datasets")
    data = datasets.RLDSDataset(
        options.data / "rlds",
        next(iter(recipe["mixtures"]["value"])),
        lambda sample: sample,
        resize_resolution=(SIZE_PX, SIZE_PX),
        shuffle_buffer_size=options.samples,
    )
    print(json.dumps(figures(data, options.samples, labels_in(options.data / "manifest.parquet"))))


if __name__ == "__main__":
    main()
