r"""Comparison of HDF5 files, as a client's own unchanged reader returns them, with their content.

The script runs in the client's environment, which has neither this project nor its packages. FILE is a file
``hdf5/<suite>/<task>_demo.hdf5`` of a run:

    uv venv -p 3.11 ENV && uv pip install --python ENV robomimic==0.3.0
    ENV/bin/python benchmarks/clients/read_hdf5.py robomimic FILE

LIBERO's reader (8f1084e) needs the same environment, and its checkout in front of other copies of LIBERO:

    PYTHONPATH=LIBERO ENV/bin/python benchmarks/clients/read_hdf5.py libero FILE
"""

import importlib
import sys
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np

IMAGES = {"rgb": "rgb", "depth": "depth", "segmentation": "depth"}
"""Last word of an observation's name to the kind that robomimic has for it; all others are ``low_dim``."""

NUMBERS = ("actions", "rewards", "dones", "action_absolute")

LENGTH = 10
"""Number of steps of a sample."""

Kinds = dict[str, list[str]]
"""Names of observations of each kind."""


def kinds_of(file: Path) -> Kinds:
    """Sort all observations of a file by robomimic's kinds."""
    kinds: Kinds = {"rgb": [], "depth": [], "low_dim": []}
    with h5py.File(file) as content:
        for name in content["data"]["demo_0"]["obs"]:
            kinds[IMAGES.get(name.rpartition("_")[2], "low_dim")].append(name)
    return kinds


def robomimic(file: Path, kinds: Kinds) -> Any:
    """Open a file with robomimic's dataset of sequences."""
    observations: Any = importlib.import_module("robomimic.utils.obs_utils")
    observations.initialize_obs_utils_with_obs_specs({"obs": kinds})
    datasets: Any = importlib.import_module("robomimic.utils.dataset")
    return datasets.SequenceDataset(
        str(file),
        obs_keys=tuple(chain(*kinds.values())),
        dataset_keys=NUMBERS,
        seq_length=LENGTH,
        hdf5_cache_mode="low_dim",
        load_next_obs=False,
    )


def libero(file: Path, kinds: Kinds) -> Any:
    """Open a file with the function by which LIBERO's training opens its demonstrations."""
    datasets: Any = importlib.import_module("libero.lifelong.datasets")
    dataset, shapes = datasets.get_dataset(str(file), kinds, seq_len=LENGTH)
    assert shapes["all_shapes"]["agentview_rgb"][0] == 3
    return dataset


def expected(file: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Read the first, a middle and the last sequence of each episode, with its number among all sequences.

    After the end of an episode, its last step is repeated.
    """
    before = 0
    with h5py.File(file) as content:
        names = sorted(content["data"], key=lambda name: int(name.removeprefix("demo_")))
        for name in names:
            demo = content["data"][name]
            length = int(demo.attrs["num_samples"])
            for step in (0, length // 2, length - 1):
                arrays = {**demo["obs"], **{key: demo[key] for key in NUMBERS}}
                steps = np.minimum(np.arange(LENGTH), length - 1 - step)
                yield before + step, {key: array[step : step + LENGTH][steps] for key, array in arrays.items()}
            before += length


def main() -> None:
    client, name = sys.argv[1:]
    readers: dict[str, Callable[[Path, Kinds], Any]] = {"robomimic": robomimic, "libero": libero}
    # HDF5 rejects a second way of opening a file that a client has open.
    sequences = list(expected(Path(name)))
    kinds = kinds_of(Path(name))
    dataset = readers[client](Path(name), kinds)
    compared: set[str] = set()
    for number, wanted in sequences:
        item = dataset[number]
        read = {**item["obs"], **item}
        for key in wanted.keys() & read.keys():
            values = np.asarray(read[key])
            if key not in (*kinds["low_dim"], *NUMBERS):
                assert values.dtype == wanted[key].dtype, f"{key} is {values.dtype}"
                assert values.shape == wanted[key].shape, f"{key} is {values.shape}"
            # robomimic reads actions in single precision.
            assert np.array_equal(values, wanted[key].astype(values.dtype)), f"{key} of sequence {number} differs"
            compared.add(key)
    print(f"{client}: {len(sequences)} sequences of {len(dataset)} are equal in {', '.join(sorted(compared))}")


if __name__ == "__main__":
    main()
