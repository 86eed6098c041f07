"""Read RLDS folders the way a client does, with TensorFlow, and save what was read.

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
    """One array per leaf: (T, ...) for steps (the first only of what is seen, (H, W, C)), and what metadata has."""
    steps = list(episode["steps"])
    observations = [step["observation"] for step in steps]
    leaves = {name: np.stack([step[name] for step in steps]) for name in steps[0] if name != "observation"}
    leaves |= {name: np.stack([o[name] for o in observations]) for name in ("state", "joint_state")}
    leaves |= {name: seen for name, seen in observations[0].items() if name not in leaves}
    leaves |= {f"metadata/{name}": text for name, text in episode["episode_metadata"].items()}
    return {name: _plain(np.asarray(leaf)) for name, leaf in leaves.items()}


def _plain(leaf: NDArray[Any]) -> NDArray[Any]:
    """Text as unicode instead of objects, so that it can be saved without pickle."""
    return np.char.decode(leaf.astype(np.bytes_), "utf-8") if leaf.dtype.kind in "OS" else leaf


def main(target: str, *folders: str) -> None:
    import tensorflow as tf  # type: ignore[import-untyped]

    print("tensorflow", tf.__version__, flush=True)
    datasets = [
        tfds.builder_from_directory(folder).as_dataset(
            split="train", shuffle_files=False, read_config=tfds.ReadConfig(interleave_cycle_length=1)
        )
        for folder in folders
    ]
    episodes = [columns(episode) for dataset in datasets for episode in tfds.as_numpy(dataset)]
    saved: dict[str, Any] = {
        f"{index}/{name}": leaf for index, leaves in enumerate(episodes) for name, leaf in leaves.items()
    }
    np.savez(target, **saved)
    print("episodes", len(episodes))


if __name__ == "__main__":
    main(*sys.argv[1:])
