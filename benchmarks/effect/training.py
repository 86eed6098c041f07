"""Policies, by lerobot's own training, from weights made here and never from the hub."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from experiment import Experiment, TrainingConfig

from pipeline.files import put_in_place, remove, replaced

CALIBRATION_FRAMES = 64
"""Frames that the backbone's normalisation is set by."""

WARMUP_STEPS = 200
"""Steps in which the learning rate rises, where the experiment sets one."""

Command = Callable[[list[str]], None]
"""Runs a command to its end."""


def train(datasets: Mapping[Path, Path], experiment: Experiment, seed: int, command: Command) -> None:
    """Train policies, each on a dataset of its own, or go on from their last checkpoints.

    Args:
        datasets: folder of each policy, as lerobot saves it, to the root of its LeRobot dataset. A folder is there once
            its policy is trained.
    """
    for out, dataset in datasets.items():
        start = _work(out) / "start"
        if not start.exists():
            with replaced(start) as unfinished:
                initialise(dataset, unfinished, experiment.policy, seed)
    training = experiment.training
    with ThreadPoolExecutor(training.at_once) as pool:
        jobs = [pool.submit(_train, dataset, out, training, seed, command) for out, dataset in datasets.items()]
        for job in jobs:
            job.result()


def _work(out: Path) -> Path:
    return out.with_name(f".{out.name}.training")


def _train(dataset: Path, out: Path, training: TrainingConfig, seed: int, command: Command) -> None:
    """Train one policy, which has its weights already."""
    outputs = _work(out) / "lerobot"
    environment: dict[str, str] = {"ACCELERATE_MIXED_PRECISION": training.mixed_precision}
    if training.at_once > 1:
        environment["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // training.at_once))
    program = ["env", *(f"{name}={value}" for name, value in environment.items())]
    program += [sys.executable, str(Path(__file__).with_name("lerobot_train.py"))]
    last = _last_checkpoint(outputs)
    if last is None:
        remove(outputs)
        options: dict[str, Any] = {
            "policy.path": _work(out) / "start",
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
        if training.learning_rate is not None:
            options |= _schedule(training.learning_rate, training.steps)
        command([*program, *(f"--{name}={value}" for name, value in options.items())])
    elif _step(last) < training.steps:
        config = last / "pretrained_model" / "train_config.json"
        command([*program, f"--config_path={config}", "--resume=true", f"--steps={training.steps}"])
    last = _last_checkpoint(outputs)
    assert last is not None, "lerobot saves after the last step"
    put_in_place(last / "pretrained_model", out)
    remove(_work(out))


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


def _schedule(learning_rate: float, steps: int) -> dict[str, Any]:
    return {
        "use_policy_training_preset": "false",
        "optimizer.type": "adamw",
        "optimizer.lr": learning_rate,
        "optimizer.weight_decay": 1e-4,
        "scheduler.type": "cosine_decay_with_warmup",
        "scheduler.num_warmup_steps": min(WARMUP_STEPS, steps // 10),
        "scheduler.num_decay_steps": steps,
        "scheduler.peak_lr": learning_rate,
        "scheduler.decay_lr": learning_rate / 100,
    }


def _last_checkpoint(outputs: Path) -> Path | None:
    """The last that is complete: lerobot points to a checkpoint once all of it is written."""
    last = outputs / "checkpoints" / "last"
    return last if last.exists() else None


def _step(checkpoint: Path) -> int:
    return int(json.loads((checkpoint / "training_state" / "training_step.json").read_text())["step"])
