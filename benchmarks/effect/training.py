"""One policy, by lerobot's own training, from weights made here and never from the hub."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiment import TrainingConfig

from pipeline.files import put_in_place, remove, replaced

CALIBRATION_FRAMES = 64
"""Frames that the backbone's normalisation is set by."""

Command = Callable[[list[str]], None]
"""Runs a command to its end."""


def train(
    dataset: Path, out: Path, policy: dict[str, Any], training: TrainingConfig, seed: int, command: Command
) -> None:
    """Train a policy, or go on from its last checkpoint; ``out`` is there once it is trained.

    Args:
        dataset: root of a LeRobot dataset.
        out: folder of the trained policy, as lerobot saves it.
        policy: options of lerobot's policy, among them ``type``.
    """
    work = out.with_name(f".{out.name}.training")
    start, outputs = work / "start", work / "lerobot"
    if not start.exists():
        with replaced(start) as unfinished:
            initialise(dataset, unfinished, policy, seed)
    program = str(Path(sys.executable).parent / "lerobot-train")
    last = _last_checkpoint(outputs)
    if last is None:
        remove(outputs)
        options = {
            "policy.path": start,
            "dataset.repo_id": dataset.name,
            "dataset.root": dataset,
            "output_dir": outputs,
            "seed": seed,
            "steps": training.steps,
            "batch_size": training.batch_size,
            "save_freq": training.save_every,
            "log_freq": min(100, training.steps),
            "eval_freq": 0,
            # The process that trains reads frames too where there are few cores.
            "num_workers": max(0, min(4, (os.cpu_count() or 1) - 2)),
        }
        command([program, *(f"--{name}={value}" for name, value in options.items())])
    elif _step(last) < training.steps:
        config = last / "pretrained_model" / "train_config.json"
        command([program, f"--config_path={config}", "--resume=true", f"--steps={training.steps}"])
    last = _last_checkpoint(outputs)
    assert last is not None, "lerobot-train saves after the last step"
    put_in_place(last / "pretrained_model", out)
    remove(work)


def initialise(dataset: Path, out: Path, options: dict[str, Any], seed: int) -> None:
    """Save a policy with random weights and the processors of a dataset.

    lerobot freezes the batch normalisation of ACT's backbone, as it counts on weights from ImageNet. With random
    weights the frozen layers would normalise nothing, and activations would grow from block to block. So their means
    and variances are set by frames of the dataset, layer by layer (data-dependent initialisation, Kraehenbuehl et al.,
    2016, arXiv:1511.06856).
    """
    import torch
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.factory import make_dataset
    from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
    from torchvision.ops.misc import FrozenBatchNorm2d

    torch.manual_seed(seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    named = {name: value for name, value in options.items() if name != "type"}
    config = make_policy_config(options["type"], device=device, push_to_hub=False, **named)
    frames = make_dataset(TrainPipelineConfig(DatasetConfig(dataset.name, root=str(dataset)), policy=config))
    policy = make_policy(config, ds_meta=frames.meta)
    before, after = make_pre_post_processors(config, dataset_stats=frames.meta.stats)
    layers = [layer for layer in policy.modules() if isinstance(layer, FrozenBatchNorm2d)]
    if layers:
        hooks = [layer.register_forward_pre_hook(_measure) for layer in layers]
        chosen = torch.randperm(len(frames))[:CALIBRATION_FRAMES].tolist()
        batch = before(torch.utils.data.default_collate([frames[index] for index in chosen]))
        with torch.no_grad():
            policy.model.backbone(torch.cat([batch[key] for key in config.image_features]))
        for hook in hooks:
            hook.remove()
    for part in (policy, before, after):
        part.save_pretrained(out)


def _measure(layer: Any, inputs: tuple[Any, ...]) -> None:
    """Have a frozen layer normalise what it gets now."""
    (features,) = inputs
    layer.running_mean.copy_(features.mean(dim=(0, 2, 3)))
    layer.running_var.copy_(features.var(dim=(0, 2, 3)))


def _last_checkpoint(outputs: Path) -> Path | None:
    """The last that is complete: lerobot points to a checkpoint once all of it is written."""
    last = outputs / "checkpoints" / "last"
    return last if last.exists() else None


def _step(checkpoint: Path) -> int:
    return int(json.loads((checkpoint / "training_state" / "training_step.json").read_text())["step"])
