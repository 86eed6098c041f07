"""Load the RLDS sets of a run with TensorFlow Datasets: python examples/load_rlds.py data/starter

TensorFlow must stay out of this environment, so the records are read without it. Where TensorFlow is installed, as in
a checkout of OpenVLA, one line gives the same episodes as a ``tf.data.Dataset``:

    dataset = tfds.builder_from_directory(folder).as_dataset(split="train")
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds

from pipeline.formats.tfrecord import records


def main(run: Path) -> None:
    for folder in sorted((run / "rlds").glob("*/1.0.0")):  # one set for each suite
        info = tfds.builder_from_directory(folder).info
        print(f"{info.name}: {info.splits['train'].num_examples} episodes")
        record = next(record for shard in sorted(folder.glob("*.tfrecord-*")) for record in records(shard))
        show(info.features.deserialize_example_np(record))


def show(episode: Mapping[str, Any]) -> None:
    """Print what an episode holds; its fields are those of ``features.json``."""
    metadata = {name: value.decode() for name, value in episode["episode_metadata"].items()}
    steps = list(episode["steps"])
    actions = np.stack([step["action"] for step in steps])
    print(f"  first episode: {metadata['episode_id']}, {metadata['axis']} of level {metadata['level']}")
    print(f"  instruction: {steps[0]['language_instruction'].decode()}")
    print(f"  actions: {actions.shape}")
    for name, value in steps[0]["observation"].items():
        print(f"  {name}: {value.shape} {value.dtype}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
