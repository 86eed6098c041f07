"""Comparison of an RLDS dataset, as OpenVLA-OFT's own loader reads it, with its files.

The script runs in a checkout of OpenVLA-OFT (213c5ff), in an environment with the imports of its loader, and nothing of
this project. DLIMP is a checkout of moojink/dlimp_openvla. ROOT is a dataset such as ``rlds/libero_perturbed_goal``:

    uv venv -p 3.11 ENV && uv pip install --python ENV tensorflow-cpu==2.15.1 tensorflow-datasets==4.9.3 \
        tensorflow-graphics==2021.12.3 'protobuf<4' 'numpy<2' torch accelerate rich
    PYTHONPATH=.:DLIMP ENV/bin/python .../read_rlds.py ROOT

``prismatic/__init__.py`` and ``prismatic/vla/__init__.py`` import all models, so these two files are skipped; every
other module is the checkout's own. The loader writes a file into the dataset, so it reads a copy. Steps are read with
TFDS alone for the comparison; both views are compared at the first and the last step of each episode. The last line is
JSON.
"""

import importlib
import importlib.machinery
import json
import shutil
import sys
import tempfile
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

VIEWS = {"image_primary": "image", "image_wrist": "wrist_image"}
"""Name of each view in OFT's samples to its name in the dataset."""

sys.argv.append("libero")  # OFT takes its constants from the arguments


def without_models(name: str, folder: Path) -> None:
    """Register a package without the imports of its ``__init__.py``."""
    package = types.ModuleType(name)
    package.__path__ = [str(folder)]
    sys.modules[name] = package


def registered(name: str) -> None:
    """Register a dataset as ``run_openvla_oft.py`` does."""
    configs: Any = importlib.import_module("prismatic.vla.datasets.rlds.oxe.configs")
    transforms: Any = importlib.import_module("prismatic.vla.datasets.rlds.oxe.transforms")
    configs.OXE_DATASET_CONFIGS[name] = configs.OXE_DATASET_CONFIGS["libero_goal_no_noops"]
    transforms.OXE_STANDARDIZATION_TRANSFORMS[name] = transforms.libero_dataset_transform


def written(root: Path) -> dict[str, list[Any]]:
    """Read the columns of all steps with TFDS, one array for each episode, in the order of the files."""
    tfds: Any = importlib.import_module("tensorflow_datasets")
    builder = tfds.builder_from_directory(str(root / "1.0.0"))
    order = tfds.ReadConfig(interleave_cycle_length=1)
    names = ("action", "action_absolute", "state", "image", "wrist_image", "text")
    columns: dict[str, list[Any]] = {name: [] for name in names}
    for episode in tfds.as_numpy(builder.as_dataset(split="train", shuffle_files=False, read_config=order)):
        steps = list(episode["steps"])
        columns["action"].append(np.stack([step["action"] for step in steps]))
        columns["action_absolute"].append(np.stack([step["action_absolute"] for step in steps]))
        columns["state"].append(np.stack([step["observation"]["state"] for step in steps]))
        for view in ("image", "wrist_image"):
            columns[view].append(np.stack([step["observation"][view] for step in steps[:: len(steps) - 1]]))
        columns["text"].append(steps[0]["language_instruction"])
    return columns


def main(root: Path) -> None:
    vla = Path.cwd() / "prismatic" / "vla"
    without_models("prismatic", vla.parent)
    without_models("prismatic.vla", vla)
    without_models("prismatic.vla.datasets", vla / "datasets")
    rlds: Any = importlib.import_module("prismatic.vla.datasets.rlds.dataset")
    materialize: Any = importlib.import_module("prismatic.vla.datasets.rlds.oxe.materialize")
    registered(root.name)
    # As RLDSDataset.get_oxe_dataset_kwargs_and_weights, for one dataset and both views.
    given = materialize.make_oxe_dataset_kwargs(root.name, root.parent, ("primary", "wrist"))
    dataset, statistics = rlds.make_dataset_from_rlds(**given, train=True, shuffle=False, num_parallel_reads=1)
    steps = written(root)

    differences: dict[str, float] = {}
    columns = {"action": np.concatenate(steps["action"]), "proprio": np.concatenate(steps["state"])}
    gripper = np.clip(columns["action"][:, 6], 0, 1)
    columns["action"] = np.concatenate([columns["action"][:, :6], 1 - gripper[:, None]], axis=1)
    summaries: dict[str, Callable[..., Any]] = {"mean": np.mean, "std": np.std, "max": np.max, "min": np.min}
    for column, values in columns.items():
        for name, summary in summaries.items():
            apart = np.abs(statistics[column][name] - summary(values.astype(float), axis=0))
            differences[f"{column} {name}"] = float(apart.max())
        for name, share in (("q01", 0.01), ("q99", 0.99)):
            apart = np.abs(statistics[column][name] - np.quantile(values, share, axis=0))
            differences[f"{column} {name}"] = float(apart.max())

    differences |= dict.fromkeys(("action", "proprio", *VIEWS), 0.0)
    tensorflow: Any = importlib.import_module("tensorflow")
    for number, episode in enumerate(dataset.iterator()):
        assert (episode["task"]["language_instruction"] == steps["text"][number]).all()
        first, last = (sum(map(len, steps["action"][:end])) for end in (number, number + 1))
        for column, read in (("action", episode["action"]), ("proprio", episode["observation"]["proprio"])):
            low, high = statistics[column]["q01"], statistics[column]["q99"]
            values = columns[column][first:last]
            expected = np.clip(2 * (values - low) / (high - low + 1e-8) - 1, -1, 1)
            if column == "action":
                expected[:, 6] = values[:, 6]
            differences[column] = max(differences[column], float(np.abs(read - expected).max()))
        for view, column in VIEWS.items():
            for place, frame in zip((0, -1), steps[column][number], strict=True):
                image = tensorflow.io.decode_image(episode["observation"][view][place]).numpy().astype(float)
                differences[view] = max(differences[view], float(np.abs(image - frame).max()))
        assert set(episode["observation"]) == {*VIEWS, "proprio", "timestep"}
        assert set(episode) == {"observation", "task", "action", "dataset_name", "absolute_action_mask"}
    figures = {"root": root.name, "episodes": number + 1, "steps": len(columns["action"])}
    figures |= {"transitions": int(statistics["num_transitions"]), "largest_difference": differences}
    print(json.dumps(figures))


if __name__ == "__main__":
    given_root = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as folder:
        main(shutil.copytree(given_root, Path(folder) / given_root.name))
