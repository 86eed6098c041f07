"""Names of the files in a run's folder ``finetune``; every file that ``recipe.write`` generates has one of them."""

from pathlib import Path

RECIPE = "finetune.yaml"

OFT_SCRIPT = "run_openvla_oft.py"

LEROBOT_TRAIN = "lerobot_train.json"
"""File for lerobot-train with the training episodes, written if a validation split is held out.

A command line with 25,000 episodes would be too long for Linux.
"""

STARVLA_CONFIG = "starvla_data_config.py"

ROBOMIMIC_CONFIG = "robomimic.json"
"""robomimic's configuration, with the observations of the HDF5 files."""

OPENPI_ASSETS = Path("openpi_assets", "physical-intelligence", "libero", "norm_stats.json")
"""Path of the statistics below the configuration's assets folder; the configuration reads it to serve a policy."""
