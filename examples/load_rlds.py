"""Loading of a run's RLDS datasets with TensorFlow Datasets: python examples/load_rlds.py data/starter

TensorFlow must stay out of this environment; the records are read without it. In an environment with TensorFlow, such
as a checkout of OpenVLA, one line gives the same episodes as a ``tf.data.Dataset``:

    dataset = tfds.builder_from_directory(folder).as_dataset(split="train")
"""

import argparse
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds

from pipeline.formats.tfrecord import records


def main(run: Path) -> None:
    for folder in sorted((run / "rlds").glob("*/1.0.0")):  # one set for each suite
        info = tfds.builder_from_directory(folder).info
        print(f"{info.name}: {info.splits['train'].num_examples} episodes")
        shards = sorted(folder.glob("*.tfrecord-*"))
        record = next(chain.from_iterable(map(records, shards)))
        show(info.features.deserialize_example_np(record))


def show(episode: Mapping[str, Any]) -> None:
    """Print the contents of an episode; ``features.json`` describes its fields."""
    metadata = episode["episode_metadata"]
    episode_id, axis, level = (metadata[name].decode() for name in ("episode_id", "axis", "level"))
    steps = list(episode["steps"])
    actions = np.stack([step["action"] for step in steps])
    print(f"  first episode: {episode_id}, {axis} of level {level}")
    print(f"  instruction: {steps[0]['language_instruction'].decode()}")
    print(f"  actions: {actions.shape}")
    for start, text in zip(metadata["subtask_starts"], metadata["subtask_texts"], strict=True):
        print(f"  from step {start}: {text.decode()}")
    print(f"  rewrites: {len(metadata['rewrites'])}")
    for name, value in steps[0]["observation"].items():
        print(f"  {name}: {value.shape} {value.dtype}")
    for view in ("image", "wrist_image"):
        intrinsics = metadata[f"{view}_intrinsics"]  # of the turned frame; examples/back_project.py uses it
        print(f"  {view}: focal length {intrinsics[1, 1]:.1f} px, mirrored: {intrinsics[0, 0] < 0}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    main(parser.parse_args().run)
