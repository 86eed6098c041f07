"""Fine-tune pi-0.5 on the LeRobot dataset beside this folder with openpi, and serve it.

Call it in a checkout of openpi, which stays as it is; NAME is the dataset's:

    uv run python DATA/finetune/run_openpi.py scripts/train.py pi05_NAME --exp-name=first

It serves a checkpoint too, such as the last one of the training above:

    uv run python DATA/finetune/run_openpi.py scripts/serve_policy.py policy:checkpoint --policy.config=pi05_NAME \\
        --policy.dir=checkpoints/pi05_NAME/first/29999

It adds the configuration ``pi05_NAME`` (openpi's own ``pi05_libero`` with this dataset), reads LeRobot v3.0, which
openpi's lerobot cannot, and runs the script. Exact normalisation statistics lie in ``openpi_assets/``, so that
``scripts/compute_norm_stats.py`` need not run.
"""

from __future__ import annotations

import dataclasses
import importlib
import runpy
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
BASE = "pi05_libero"


def register(name: str) -> None:
    """Add ``pi05_<name>`` to openpi's configurations, and have its data loader read the dataset."""
    config: Any = importlib.import_module("openpi.training.config")
    loader: Any = importlib.import_module("openpi.training.data_loader")
    reader: Any = importlib.import_module("lerobot_v3")  # lies beside this file
    base = config.get_config(BASE)
    if base.data.extra_delta_transform:
        sys.exit(f"error: this openpi turns the actions of {BASE} into differences, which the statistics here are not")
    assets = config.AssetsConfig(assets_dir=str(HERE), asset_id="openpi_assets")
    data = dataclasses.replace(base.data, repo_id=name, assets=assets)
    config._CONFIGS_DICT[f"pi05_{name}"] = dataclasses.replace(base, name=f"pi05_{name}", data=data)
    create = loader.create_torch_dataset

    def create_torch_dataset(data_config: Any, action_horizon: int, model_config: Any) -> Any:
        if data_config.repo_id != name:
            return create(data_config, action_horizon, model_config)
        return reader.LeRobotV3(HERE.parent / "lerobot" / name, action_horizon)

    loader.create_torch_dataset = create_torch_dataset


def main() -> None:
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        sys.exit("error: name a script of openpi first\n  try: scripts/train.py, in a checkout of openpi")
    try:
        yaml: Any = importlib.import_module("yaml")
        register(yaml.safe_load((HERE / "finetune.yaml").read_text())["dataset"]["lerobot"]["value"])
    except ModuleNotFoundError as error:
        sys.exit(
            f"error: {sys.executable} has no module {error.name}\n"
            "  try: uv run python in place of python, in a checkout of openpi, whose environment has it"
        )
    del sys.argv[0]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
