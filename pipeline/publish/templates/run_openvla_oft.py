"""Fine-tune OpenVLA-OFT on the datasets beside this folder, by the recipe in ``finetune.yaml``.

Call it in a checkout of OpenVLA-OFT, which stays as it is:

    torchrun --standalone --nnodes 1 --nproc-per-node 8 DATA/finetune/run_openvla_oft.py

Further arguments go to OFT's ``vla-scripts/finetune.py`` and win over the recipe, such as
``--dataset_name libero_perturbed_spatial`` for one suite, or ``--wandb_entity NAME``.

What OFT has no flag for is done here: the datasets and their mixture are registered, AdamW gets the recipe's weight
decay (OFT leaves PyTorch's 0.01), a cosine with warm-up takes the place of OFT's step (whose own warm-up would undo
any later decay), and the statistics of a checkpoint are also named by suite, which is where OFT's evaluation looks.
"""

from __future__ import annotations

import importlib
import math
import runpy
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

HERE = Path(__file__).resolve().parent
SCRIPT = "vla-scripts/finetune.py"
DATASETS = "prismatic.vla.datasets.rlds"


def register(mixtures: Mapping[str, Mapping[str, float]]) -> None:
    """Enter every dataset, and every mixture of them, where OFT looks datasets up by name."""
    configs = importlib.import_module(f"{DATASETS}.oxe.configs")
    transforms = importlib.import_module(f"{DATASETS}.oxe.transforms")
    named = importlib.import_module(f"{DATASETS}.oxe.mixtures").OXE_NAMED_MIXTURES
    for mixture, weights in mixtures.items():
        named[mixture] = list(weights.items())
        for dataset in weights:
            named.setdefault(dataset, [(dataset, 1.0)])
            transforms.OXE_STANDARDIZATION_TRANSFORMS[dataset] = transforms.libero_dataset_transform
            configs.OXE_DATASET_CONFIGS[dataset] = {
                "image_obs_keys": {"primary": "image", "secondary": None, "wrist": "wrist_image"},
                "depth_obs_keys": {"primary": None, "secondary": None, "wrist": None},
                # Made by the transform: position and axis-angle (which OFT calls Euler), and two fingers.
                "state_obs_keys": ["EEF_state", "gripper_state"],
                "state_encoding": configs.StateEncoding.POS_EULER,
                "action_encoding": configs.ActionEncoding.EEF_POS,
            }


def name_statistics_by_suite(suites: Mapping[str, str]) -> None:
    """Store each dataset's statistics under its suite's name too: OFT's evaluation knows no other."""
    module: Any = importlib.import_module(f"{DATASETS}.utils.data_utils")
    save = module.save_dataset_statistics

    def save_with_suites(statistics: Mapping[str, Any], folder: Path) -> None:
        by_suite = {suite: statistics[name] for suite, name in suites.items() if name in statistics}
        save({**statistics, **by_suite}, folder)

    module.save_dataset_statistics = save_with_suites


def set_optimiser(weight_decay: float, steps: int, warmup_steps: int) -> None:
    """Have OFT's script find the recipe's optimiser and schedule where it looks for ``AdamW`` and ``MultiStepLR``."""
    import torch  # takes seconds, which a call in the wrong folder need not wait for

    class AdamW(torch.optim.AdamW):
        def __init__(self, params: Any, lr: float) -> None:
            super().__init__(params, lr=lr, weight_decay=weight_decay)

    def share(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        done = (step - warmup_steps) / max(steps - warmup_steps, 1)
        return (1 + math.cos(math.pi * min(done, 1.0))) / 2

    class Cosine(torch.optim.lr_scheduler.LambdaLR):
        def __init__(self, optimizer: torch.optim.Optimizer, **_: object) -> None:
            super().__init__(optimizer, share)

    optim: Any = torch.optim
    optim.AdamW, optim.lr_scheduler.MultiStepLR = AdamW, Cosine


def arguments(manifest: Mapping[str, Any]) -> list[str]:
    """The recipe as arguments of OFT's script."""
    recipe = {name: field["value"] for name, field in manifest["recipe"].items()}
    flags = {
        "vla_path": recipe["base_weights"],
        "data_root_dir": HERE.parent / "rlds",
        "dataset_name": manifest["name"],
        "batch_size": recipe["batch_size_per_gpu"],
        "learning_rate": recipe["learning_rate"],
        "lr_warmup_steps": 0,  # part of the schedule above
        "num_steps_before_decay": recipe["steps"],
        "max_steps": recipe["steps"],
        "use_l1_regression": recipe["action_head"] == "l1_regression",
        "use_diffusion": False,
        "use_film": False,
        "num_images_in_input": recipe["images"],
        "use_proprio": recipe["proprioception"],
        "image_aug": recipe["image_augmentation"],
        "lora_rank": recipe["lora_rank"],
        "shuffle_buffer_size": recipe["shuffle_buffer"],
    }
    return [word for name, value in flags.items() for word in (f"--{name}", str(value))]


def main() -> None:
    if not Path(SCRIPT).is_file():
        sys.exit(f"error: no {SCRIPT} in {Path.cwd()}\n  try: call this in a checkout of OpenVLA-OFT")
    manifest = yaml.safe_load((HERE / "finetune.yaml").read_text())
    recipe = manifest["recipe"]
    # OFT takes its constants (chunk of 8, 7 actions, 8 of proprioception) from the word "libero" among the arguments.
    sys.argv = [SCRIPT, *arguments(manifest), *sys.argv[1:]]
    register(manifest["dataset"]["mixtures"]["value"])
    name_statistics_by_suite(manifest["dataset"]["suites"]["value"])
    set_optimiser(recipe["weight_decay"]["value"], recipe["steps"]["value"], recipe["warmup_steps"]["value"])
    runpy.run_path(SCRIPT, run_name="__main__")


if __name__ == "__main__":
    main()
