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
from pathlib import Path
from typing import Any

import h5py
import numpy as np

RGB = ("agentview_rgb", "eye_in_hand_rgb")
LOW_DIM = ("ee_pos", "ee_ori", "ee_states", "gripper_states", "joint_states")
MODALITIES = {"rgb": [*RGB], "low_dim": [*LOW_DIM]}

LENGTH = 10
"""Number of steps of a sample."""


def robomimic(file: Path) -> Any:
    """Open a file with robomimic's dataset of sequences."""
    observations: Any = importlib.import_module("robomimic.utils.obs_utils")
    observations.initialize_obs_utils_with_obs_specs({"obs": MODALITIES})
    datasets: Any = importlib.import_module("robomimic.utils.dataset")
    return datasets.SequenceDataset(
        str(file),
        obs_keys=(*RGB, *LOW_DIM),
        dataset_keys=("actions", "rewards", "dones", "action_absolute"),
        seq_length=LENGTH,
        hdf5_cache_mode="low_dim",
        load_next_obs=False,
    )


def libero(file: Path) -> Any:
    """Open a file with the function by which LIBERO's training opens its demonstrations."""
    datasets: Any = importlib.import_module("libero.lifelong.datasets")
    dataset, shapes = datasets.get_dataset(str(file), MODALITIES, seq_len=LENGTH)
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
                arrays = {key: demo["obs"][key] for key in (*RGB, *LOW_DIM)}
                arrays |= {key: demo[key] for key in ("actions", "rewards", "dones", "action_absolute")}
                steps = np.minimum(np.arange(LENGTH), length - 1 - step)
                yield before + step, {key: array[step : step + LENGTH][steps] for key, array in arrays.items()}
            before += length


def main() -> None:
    client, name = sys.argv[1:]
    readers: dict[str, Callable[[Path], Any]] = {"robomimic": robomimic, "libero": libero}
    # HDF5 rejects a second way of opening a file that a client has open.
    sequences = list(expected(Path(name)))
    dataset = readers[client](Path(name))
    compared: set[str] = set()
    for number, wanted in sequences:
        item = dataset[number]
        read = {**item["obs"], **item}
        for key in wanted.keys() & read.keys():
            values = np.asarray(read[key])
            if key in RGB:
                assert values.dtype == np.uint8, f"{key} is {values.dtype}"
                assert values.shape == wanted[key].shape, f"{key} is {values.shape}"
            # robomimic reads actions in single precision.
            assert np.array_equal(values, wanted[key].astype(values.dtype)), f"{key} of sequence {number} differs"
            compared.add(key)
    print(f"{client}: {len(sequences)} sequences of {len(dataset)} are equal in {', '.join(sorted(compared))}")


if __name__ == "__main__":
    main()
