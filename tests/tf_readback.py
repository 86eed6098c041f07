"""Reading of RLDS folders as a client does, with TensorFlow; the arrays are saved.

    uv run --no-project --isolated --with tensorflow-cpu==2.21.0 --with tensorflow-datasets==4.9.10 \
        python tests/tf_readback.py read.npz data/starter/rlds/NAME/1.0.0

TensorFlow must not live in the project's environment: it crashes processes that render with Mesa.
"""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from numpy.typing import NDArray


def columns(episode: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Return one array per leaf of steps and metadata.

    Leaves of steps have the shape (T, ...), but only the first image (H, W, C) of a view is returned.
    """
    steps = list(episode["steps"])
    observations = [step["observation"] for step in steps]
    leaves: dict[str, Any] = {}
    for name in steps[0]:
        if name != "observation":
            values = [step[name] for step in steps]
            leaves[name] = np.stack(values)
    for name in ("state", "joint_state"):
        values = [observation[name] for observation in observations]
        leaves[name] = np.stack(values)
    leaves |= {name: first for name, first in observations[0].items() if name not in leaves}
    leaves |= {f"metadata/{name}": text for name, text in episode["episode_metadata"].items()}
    return {name: _plain(np.asarray(leaf)) for name, leaf in leaves.items()}


def _plain(leaf: NDArray[Any]) -> NDArray[Any]:
    """Convert text to unicode instead of objects; NumPy saves it without pickle."""
    return np.char.decode(leaf.astype(np.bytes_), "utf-8") if leaf.dtype.kind in "OS" else leaf


def main(target: str, *folders: str) -> None:
    import tensorflow as tf  # type: ignore[import-untyped]

    print("tensorflow", tf.__version__, flush=True)
    in_order = tfds.ReadConfig(interleave_cycle_length=1)
    episodes = 0
    saved: dict[str, Any] = {}
    for folder in folders:
        builder = tfds.builder_from_directory(folder)
        dataset = builder.as_dataset(split="train", shuffle_files=False, read_config=in_order)
        for episode in tfds.as_numpy(dataset):
            saved |= {f"{episodes}/{name}": leaf for name, leaf in columns(episode).items()}
            episodes += 1
    np.savez(target, **saved)
    print("episodes", episodes)


if __name__ == "__main__":
    main(*sys.argv[1:])
