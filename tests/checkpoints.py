"""Small policies in lerobot's format, with known actions."""

from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy
from lerobot.processor.rename_processor import RenameObservationsProcessorStep
from safetensors.torch import load_file, save_file

CHUNK = 2
IMAGE = "observation.images.image"
BIAS = "model.action_head.bias"


def save(folder: Path, action: float, scale: float = 1.0, image: str = IMAGE, least: float = -1.0) -> Path:
    """Save an ACT policy whose every action is ``action`` times ``scale`` in all seven numbers, taken two at a time.

    Args:
        folder: folder of the policy.
        action: output of the network: all of its weights are zero except the last bias.
        scale: factor of the processor after the network.
        image: key of the policy's image. Another key than ``IMAGE`` was renamed by ``--rename_map`` in its training.
        least: smallest action of the dataset, by its statistics.
    """
    config = ACTConfig(
        input_features={
            image: PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
            "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        **{"chunk_size": CHUNK, "n_action_steps": CHUNK, "pretrained_backbone_weights": None, "use_vae": False},
        **{"dim_model": 8, "n_heads": 1, "dim_feedforward": 8, "n_encoder_layers": 1, "n_decoder_layers": 1},
        device="cpu",
        push_to_hub=False,
    )
    policy = ACTPolicy(config)
    with torch.no_grad():
        for weights in policy.parameters():
            weights.zero_()
        policy.get_parameter(BIAS).fill_(action)
    sizes = {image: (3, 1, 1), "observation.state": (8,), "action": (7,)}
    stats = {name: {"mean": torch.zeros(size), "std": torch.ones(size)} for name, size in sizes.items()}
    stats["action"]["std"] *= scale
    stats["action"] |= {"min": torch.full((7,), least), "max": torch.ones(7)}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    if image != IMAGE:
        # As lerobot-train sets it; make_pre_post_processors takes it for saved processors only.
        (step,) = (step for step in before.steps if isinstance(step, RenameObservationsProcessorStep))
        step.rename_map = {IMAGE: image}
    for part in (policy, before, after):
        part.save_pretrained(folder)
    return folder


def save_random(folder: Path) -> Path:
    """Save a VQ-BeT policy with random weights, which samples its codes."""
    config = VQBeTConfig(
        input_features={
            "observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
            "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        **{"n_obs_steps": 2, "n_action_pred_token": 1, "action_chunk_size": 2, "crop_shape": (64, 64)},
        **{"bet_softmax_temperature": 100.0},
        **{"vqvae_embedding_dim": 8, "vqvae_enc_hidden_dim": 8, "pretrained_backbone_weights": None},
        **{"gpt_input_dim": 8, "gpt_output_dim": 8, "gpt_n_layer": 1, "gpt_n_head": 1, "gpt_hidden_dim": 8},
        device="cpu",
        push_to_hub=False,
    )
    sizes = {"observation.images.image": (3, 1, 1), "observation.state": (8,), "action": (7,)}
    bounds = {name: {"min": -torch.ones(size), "max": torch.ones(size)} for name, size in sizes.items()}
    stats: dict[str, dict[str, torch.Tensor]] = {}
    for name, limits in bounds.items():
        stats[name] = {**limits, "mean": limits["max"] * 0, "std": limits["max"]}
    for part in (VQBeTPolicy(config), *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(folder)
    return folder


def retrain(folder: Path, action: float) -> None:
    """Change the weights of a saved policy in place."""
    weights = load_file(folder / "model.safetensors")
    save_file({**weights, BIAS: torch.full_like(weights[BIAS], action)}, folder / "model.safetensors")
