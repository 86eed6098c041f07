"""Training of an ACT policy on sentence embeddings, from random weights, in one plain loop.

The policy is lerobot's, and is saved in lerobot's format. The frames are stored in memory; a step decodes nothing. One
thread computes, as several threads wait for each other. On two cores, train both seeds at the same time.

All of it is in float32, so that any machine can continue a training and policies of several machines can be compared.
Processors without instructions for bfloat16 take two to twenty times as long in bfloat16 (benchmarks/LOG.md).
"""

import json
import math
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from episodes import VIEWS, Dataset
from experiment import Experiment, TrainingConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from numpy.typing import NDArray
from sentences import SIZE, Vectors, vector
from states import relative_by_episode
from torchvision.ops.misc import FrozenBatchNorm2d

from pipeline.errors import PipelineError
from pipeline.files import remove, replaced
from pipeline.run.machine import host
from pipeline.seeding import rng

IMAGES = {view: f"observation.images.{view}" for view in VIEWS}
STATE, SENTENCE, ACTION = "observation.state", "observation.environment_state", "action"

WARMUP_STEPS = 200
"""Steps in which the learning rate rises."""

GRADIENT_NORM, WEIGHT_DECAY = 10.0, 1e-4
"""Values of lerobot's training of ACT."""

CALIBRATION_FRAMES = 64
"""Number of frames that set the backbone's normalisation."""

LOG_EVERY = 50

PRECISION = "float32"
"""Precision of trainings; checkpoints and results before 1 December 2026 may have bfloat16."""

PROPRIOCEPTION = "proprioception.json"
"""File of a policy with the value of this setting, which its server needs."""

TRAINED_WITH = "trained_with.json"
"""File of a policy with the ``packages``, ``processors`` and ``precision`` that finished its training."""

PACKAGES = ("torch", "torchvision", "lerobot")

Batch = dict[str, torch.Tensor]


def train(experiment: Experiment, seed: int, dataset: Dataset, vectors: Vectors, out: Path) -> None:
    """Train a policy, or resume from its last checkpoint; ``out`` exists after the training is complete.

    A batch depends on seed and step alone; a stopped and resumed training therefore gives the same policy.

    Args:
        experiment: the experiment.
        seed: seed of initial weights and batches.
        dataset: the arm's episodes.
        vectors: embeddings of their instructions.
        out: folder of the policy; its ``training.jsonl`` has mean loss and time of each ``LOG_EVERY`` steps.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    config, training = experiment.training, Steps(experiment, dataset, vectors)
    work = out.with_name(f".{out.name}.training")
    policy = ACTPolicy(configuration(experiment))
    before, after = make_pre_post_processors(policy.config, dataset_stats=training.statistics())
    calibrate(policy, before(training.batch(rng("effect", "calibration", seed), CALIBRATION_FRAMES)))
    optimizer = torch.optim.AdamW(policy.parameters(), config.learning_rate, weight_decay=WEIGHT_DECAY, fused=True)
    step, log = 0, []
    if (work / "last.pt").exists():
        saved = torch.load(work / "last.pt", weights_only=True)
        policy.load_state_dict(saved["policy"])
        optimizer.load_state_dict(saved["optimizer"])
        step, log = saved["step"], saved["log"]
        if saved["precision"] != PRECISION:
            raise PipelineError(
                f"the training began in {saved['precision']}, and continues in {PRECISION}",
                where=work,
                remedy="move the folder to another place, to begin again",
            )
    policy.train()
    losses: list[float] = []
    wall, cpu = time.perf_counter(), time.process_time()
    while step < config.steps:
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, config)
        batch = before(training.batch(rng("effect", "batch", seed, step), config.batch_size))
        loss, _ = policy(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), GRADIENT_NORM)
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
        step += 1
        if step % LOG_EVERY == 0 or step == config.steps:
            taken = {"seconds": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
            wall, cpu = time.perf_counter(), time.process_time()
            entry = {"step": step, "loss": float(np.mean(losses))} | taken
            log.append({name: round(value, 4) for name, value in entry.items()})
            losses = []
            print(json.dumps(log[-1]), flush=True)
        if step % config.save_every == 0 or step == config.steps:
            with replaced(work / "last.pt") as temporary:
                parts = {"policy": policy.state_dict(), "optimizer": optimizer.state_dict()}
                torch.save({**parts, "step": step, "log": log, "precision": PRECISION}, temporary)
    with replaced(out) as folder:
        for part in (policy, before, after):
            part.save_pretrained(folder)
        (folder / PROPRIOCEPTION).write_text(json.dumps(config.proprioception))
        (folder / TRAINED_WITH).write_text(json.dumps(trained_with()))
        (folder / "training.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in log))
    remove(work)


def trained_with() -> dict[str, Any]:
    """Return the versions of ``PACKAGES``, the models of this machine's processors, and the precision of trainings."""
    _, processors = host()
    return {
        "packages": {name: version(name) for name in PACKAGES},
        "processors": processors,
        "precision": PRECISION,
    }


def configuration(experiment: Experiment) -> ACTConfig:
    """Return the configuration of the experiment's policy."""
    picture = (3, experiment.frame_px, experiment.frame_px)
    state = {STATE: PolicyFeature(FeatureType.STATE, (8,))} if experiment.training.proprioception else {}
    return ACTConfig(
        input_features={
            **{key: PolicyFeature(FeatureType.VISUAL, picture) for key in IMAGES.values()},
            **state,
            SENTENCE: PolicyFeature(FeatureType.ENV, (SIZE,)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (7,))},
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
        **experiment.policy,
    )


def learning_rate(step: int, config: TrainingConfig) -> float:
    """Return a step's learning rate.

    It rises for ``WARMUP_STEPS``, at most a tenth of all steps, then falls along a cosine to a hundredth.
    """
    warmup = min(WARMUP_STEPS, config.steps // 10)
    if step < warmup:
        return config.learning_rate * (step + 1) / warmup
    share = (step - warmup) / max(1, config.steps - warmup)
    return config.learning_rate * (0.01 + 0.99 * (1 + math.cos(math.pi * share)) / 2)


class Steps:
    """Batches of a dataset: each frame with the following actions; an episode's end repeats its last action."""

    def __init__(self, experiment: Experiment, dataset: Dataset, vectors: Vectors):
        self._dataset = dataset
        self._chunk = np.arange(configuration(experiment).chunk_size)
        self._ends = np.repeat(np.cumsum(dataset.lengths), dataset.lengths)
        is_relative = experiment.training.proprioception == "relative"
        self._state = relative_by_episode(dataset.state, dataset.lengths) if is_relative else dataset.state
        self._sentences = np.stack([vector(row["instruction"], vectors) for row in dataset.episodes])
        self._episode = np.repeat(np.arange(len(dataset.lengths)), dataset.lengths)

    def batch(self, generator: np.random.Generator, size: int) -> Batch:
        """Sample frames with replacement; return them before normalisation."""
        return self.of_frames(generator.integers(len(self._ends), size=size))

    def of_frames(self, frames: NDArray[np.int64]) -> Batch:
        """Return the frames with these numbers, counted over all episodes, before normalisation."""
        following = frames[:, None] + self._chunk
        last = self._ends[frames, None] - 1
        return {
            **{key: pixels(self._dataset.images[view][frames]) for view, key in IMAGES.items()},
            STATE: torch.from_numpy(self._state[frames]),
            SENTENCE: torch.from_numpy(self._sentences[self._episode[frames]]),
            ACTION: torch.from_numpy(self._dataset.action[np.minimum(following, last)]),
            "action_is_pad": torch.from_numpy(following > last),
        }

    def statistics(self) -> dict[str, Mapping[str, torch.Tensor]]:
        """Compute mean and standard deviation of each feature except the sentence; images by channel."""
        statistics = {key: _of_channels(self._dataset.images[view]) for view, key in IMAGES.items()}
        for key, values in ((STATE, self._state), (ACTION, self._dataset.action)):
            statistics[key] = {
                "mean": torch.from_numpy(values.mean(axis=0)),
                "std": torch.from_numpy(values.std(axis=0)),
            }
        return statistics


def pixels(frames: NDArray[np.uint8]) -> torch.Tensor:
    """Convert frames (n, P, P, 3) to (n, 3, P, P) in [0, 1]."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255


def _of_channels(frames: NDArray[np.uint8]) -> Mapping[str, torch.Tensor]:
    histograms = [np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)]
    counts = np.stack(histograms)
    levels, share = np.arange(256) / 255, counts / counts.sum(axis=1, keepdims=True)
    mean = share @ levels
    std = np.sqrt(share @ levels**2 - mean**2)
    return {"mean": _by_channel(mean), "std": _by_channel(std)}


def _by_channel(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32).reshape(3, 1, 1)


def calibrate(policy: ACTPolicy, batch: Mapping[str, Any]) -> None:
    """Set the backbone's normalisation by frames of the dataset.

    lerobot freezes the normalisation, as it expects weights from ImageNet. With random weights, the frozen layers would
    normalise nothing, and activations would grow from block to block. Therefore means and variances are set layer by
    layer (data-dependent initialisation, Kraehenbuehl et al., 2016, arXiv:1511.06856).
    """
    layers = [layer for layer in policy.modules() if isinstance(layer, FrozenBatchNorm2d)]
    hooks = [layer.register_forward_pre_hook(_measure) for layer in layers]
    with torch.no_grad():
        policy.model.backbone(torch.cat([batch[key] for key in IMAGES.values()]))
    for hook in hooks:
        hook.remove()


def _measure(layer: Any, inputs: tuple[Any, ...]) -> None:
    """Set the mean and variance of a frozen layer to those of its current input."""
    (features,) = inputs
    layer.running_mean.copy_(features.mean(dim=(0, 2, 3)))
    layer.running_var.copy_(features.var(dim=(0, 2, 3)))
