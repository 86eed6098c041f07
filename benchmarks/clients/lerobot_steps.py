"""Optimiser steps of lerobot-train by the recipe's commands, on a CPU, with a small model of the same class.

The script runs in lerobot's environment, which has neither this project nor its packages. CLIENT is ``lerobot_smolvla``
or ``lerobot_pi05`` (lerobot 0.6). DATA is a run's data folder. OUT is a new folder, which keeps the checkpoint:

    ENV/bin/python benchmarks/clients/lerobot_steps.py CLIENT DATA OUT

The weights of SmolVLA and pi0.5 come from a hub. A checkpoint with random weights replaces them: it has their class,
their names of cameras and their chunks, few layers and a tokenizer of single bytes. ``evaluate`` can run the
trained SmolVLA, in an environment with lerobot's extra ``smolvla``.

The samples that reach the optimiser are compared with the files. The last printed line is JSON.
"""

import importlib
import json
import math
import shlex
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pyarrow.parquet as pq
import torch
import yaml
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file

STEPS = 2
BATCH = 2
SAVED = "checkpoints/last/pretrained_model"
NUMBERS = ("action", "observation.state")
VIEWS = ("observation.images.image", "observation.images.image2")


def byte_tokenizer(special: tuple[str, ...], **options: Any) -> Any:
    """Return a tokenizer with one token for each byte, and the special tokens before them."""
    tokenizers: Any = importlib.import_module("tokenizers")
    transformers: Any = importlib.import_module("transformers")
    letters = sorted(tokenizers.pre_tokenizers.ByteLevel.alphabet())
    numbers = {token: number for number, token in enumerate((*special, *letters))}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.BPE(numbers, [], unk_token=special[0]))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = tokenizers.decoders.ByteLevel()
    return transformers.PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token=special[0], **options)


def small_vlm(folder: Path) -> None:
    """Save a SmolVLM of few layers with its processor, as SmolVLA's ``vlm_model_name``."""
    transformers: Any = importlib.import_module("transformers")
    special = ("<pad>", "<image>", "<fake_token_around_image>", "<global-img>", "<end_of_utterance>")
    tokenizer = byte_tokenizer(
        special,
        eos_token="<end_of_utterance>",
        extra_special_tokens={
            "image_token": "<image>",
            "fake_image_token": "<fake_token_around_image>",
            "global_image_token": "<global-img>",
        },
    )
    text = transformers.LlamaConfig(
        vocab_size=len(tokenizer), hidden_size=64, intermediate_size=128, num_hidden_layers=4, num_attention_heads=4,
        num_key_value_heads=2, head_dim=16, pad_token_id=0,
    )  # fmt: skip
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    config = transformers.SmolVLMConfig(
        text_config=text.to_dict(), vision_config={**vision, "patch_size": 16, "image_size": 512}, scale_factor=4,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"), pad_token_id=0,
    )  # fmt: skip
    transformers.SmolVLMForConditionalGeneration(config).to(torch.bfloat16).save_pretrained(folder)
    transformers.SmolVLMProcessor(
        transformers.SmolVLMImageProcessor(), tokenizer, transformers.SmolVLMVideoProcessor(), image_seq_len=64
    ).save_pretrained(folder)


def features(cameras: list[str], state: int, action: int) -> dict[str, Any]:
    """Return the options of a configuration that name its inputs and outputs."""
    types: Any = importlib.import_module("lerobot.configs.types")
    images = {camera: types.PolicyFeature(types.FeatureType.VISUAL, (3, 256, 256)) for camera in cameras}
    return {
        "input_features": {"observation.state": types.PolicyFeature(types.FeatureType.STATE, (state,)), **images},
        "output_features": {"action": types.PolicyFeature(types.FeatureType.ACTION, (action,))},
    }


def save_smolvla(folder: Path) -> Path:
    """Save a SmolVLA with three cameras, and with a state and an action of six numbers, as an SO-100 arm."""
    module: Any = importlib.import_module("lerobot.policies.smolvla.modeling_smolvla")
    small_vlm(folder / "vlm")
    config = module.SmolVLAConfig(
        **features([f"observation.images.camera{number}" for number in (1, 2, 3)], 6, 6),
        vlm_model_name=str(folder / "vlm"), load_vlm_weights=True, num_vlm_layers=4, num_expert_layers=0,
        prefix_length=0, pad_language_to="max_length", device="cpu",
    )  # fmt: skip
    return save(module.SmolVLAPolicy(config), folder / "base")


def small_pi05() -> None:
    """Make lerobot (0.6) build pi0.5 with two layers of width 64, and with a vocabulary for single bytes."""
    module: Any = importlib.import_module("lerobot.policies.pi05.modeling_pi05")
    module.get_gemma_config = lambda _variant: module.GemmaConfig(64, 2, 128, 8, 1, 16)
    whole, expert = module.PaliGemmaForConditionalGenerationWithPiGemma, module.PiGemmaForCausalLM
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}

    def small_whole(config: Any) -> Any:
        for name, number in {**vision, "projection_dim": 64}.items():
            setattr(config.vision_config, name, number)
        config.projection_dim = 64
        config.text_config.vocab_size = 512
        return whole(config=config)

    def small_expert(config: Any) -> Any:
        config.vocab_size = 512
        return expert(config=config)

    module.PaliGemmaForConditionalGenerationWithPiGemma, module.PiGemmaForCausalLM = small_whole, small_expert


def save_pi05(folder: Path) -> Path:
    """Save a pi0.5 with the cameras and the chunk of ``pi05_libero_base``, and its tokenizer."""
    transformers: Any = importlib.import_module("transformers")
    module: Any = importlib.import_module("lerobot.policies.pi05.modeling_pi05")
    small_pi05()
    tokenizer = byte_tokenizer(("<pad>", "<eos>", "<bos>"), eos_token="<eos>", bos_token="<bos>")
    tokenizer.save_pretrained(folder / "tokenizer")
    config = module.PI05Config(
        **features([*VIEWS], 8, 7), n_action_steps=10, empty_cameras=1, dtype="bfloat16", device="cpu"
    )
    with mock.patch.object(transformers.AutoTokenizer, "from_pretrained", return_value=tokenizer):
        base = save(module.PI05Policy(config), folder / "base")
    file = base / "policy_preprocessor.json"
    file.write_text(file.read_text().replace("google/paligemma-3b-pt-224", str(folder / "tokenizer")))
    return base


def save(policy: Any, folder: Path) -> Path:
    """Save a policy and its processors, without statistics."""
    factory: Any = importlib.import_module("lerobot.policies.factory")
    policy.save_pretrained(folder)
    for processor in factory.make_pre_post_processors(policy.config):
        processor.save_pretrained(folder)
    return folder


def replaced(command: str, data: Path, words: dict[str, str]) -> list[str]:
    """Return the words of the recipe's command with the replacements, which each must occur."""
    given = shlex.split(command.replace("$DATA", str(data)))[1:]
    for former, new in words.items():
        given[given.index(former)] = new
    return given


def main(client: str, data: Path, out: Path) -> None:
    data, out = data.resolve(), out.resolve()
    recipe = yaml.safe_load((data / "finetune" / "finetune.yaml").read_text())
    command = recipe["clients"][client]["command"]
    words = {word: f"{word.partition('=')[0]}={number}" for word, number in sizes(command).items()}
    out.mkdir(parents=True)
    torch.manual_seed(0)
    word, save_base = BASES[client]
    base = save_base(out)
    words[word] = f"{word.partition('=')[0]}={base}"
    added = ["--policy.device=cpu", f"--output_dir={out / 'trained'}", "--log_freq=1", "--num_workers=0"]
    train: Any = importlib.import_module("lerobot.scripts.lerobot_train")
    samples: list[dict[str, Any]] = []
    losses: list[float] = []
    update = train.update_policy

    def recorded(tracker: Any, policy: Any, batch: dict[str, Any], *rest: Any, **options: Any) -> Any:
        samples.append(batch)
        result = update(tracker, policy, batch, *rest, **options)
        losses.append(float(tracker.loss.val))
        return result

    argv = ["lerobot-train", *replaced(command, data, words), *added]
    with mock.patch.object(train, "update_policy", recorded), mock.patch.object(sys, "argv", argv):
        train.main()
    trained, root = out / "trained" / SAVED, Path(option(argv, "--dataset.root"))
    report = {
        "lerobot": version("lerobot"),
        "client": client,
        "replaced": words,
        "added": [word for word in added if not word.startswith("--output_dir")],
        "losses": losses,
        "furthest": compared(samples, root),
        "saved": saved(trained),
        "answer": answer(trained, root),
        "tensors": changed(base, trained),
    }
    assert all(map(math.isfinite, losses)), losses
    assert len(losses) == STEPS, losses
    print(json.dumps(report))


def option(argv: list[str], name: str) -> str:
    """Return the value of a command's option."""
    (value,) = (word.partition("=")[2] for word in argv if word.startswith(name + "="))
    return value


def sizes(command: str) -> dict[str, int]:
    """Return the command's words that set its length, and the small numbers that replace their values."""
    small = {"--batch_size": BATCH, "--steps": STEPS}
    return {word: small[word.partition("=")[0]] for word in shlex.split(command) if word.partition("=")[0] in small}


def compared(samples: list[dict[str, Any]], root: Path) -> dict[str, float]:
    """Return the largest differences between the samples and the files, after the normalisation by the statistics."""
    stats = json.loads((root / "meta" / "stats.json").read_text())
    rows = pq.read_table(sorted(root.glob("data/*/*.parquet")))
    episodes = np.array(rows["episode_index"])
    dataset = LeRobotDataset(root.name, root=root, video_backend="pyav")
    furthest = dict.fromkeys((*NUMBERS, *VIEWS), 0.0)
    for batch in samples:
        for sample, index in enumerate(batch["index"].tolist()):
            for name in NUMBERS:
                read = batch[name][sample].float().numpy().reshape(-1, batch[name].shape[-1])
                # A chunk that is longer than the rest of the episode repeats the last action.
                inside = int((episodes[index : index + len(read)] == episodes[index]).sum())
                written = np.stack(rows[name].slice(index, inside).to_numpy())
                mean, std = (np.array(stats[name][part]) for part in ("mean", "std"))
                furthest[name] = max(
                    furthest[name], float(np.abs(read[:inside] - (written - mean) / (std + 1e-8)).max())
                )
            item = dataset[index]
            for number, view in enumerate(VIEWS, 1):
                key = view if view in batch else f"observation.images.camera{number}"
                difference = (batch[key][sample].float() - item[view]).abs().max()
                furthest[view] = max(furthest[view], float(difference))
    return furthest


def saved(trained: Path) -> dict[str, Any]:
    """Return the cameras and the shapes that the trained checkpoint has stored."""
    config = json.loads((trained / "config.json").read_text())
    before = json.loads((trained / "policy_preprocessor.json").read_text())
    renamed = [step["config"].get("rename_map") for step in before["steps"] if "rename" in step["registry_name"]]
    return {
        "inputs": {name: feature["shape"] for name, feature in config["input_features"].items()},
        "outputs": {name: feature["shape"] for name, feature in config["output_features"].items()},
        "normalization_mapping": config["normalization_mapping"],
        "rename_map": renamed,
    }


def changed(base: Path, trained: Path) -> dict[str, int]:
    """Count the tensors that training changed."""
    before, after = (load_file(folder / "model.safetensors") for folder in (base, trained))
    same = [name for name, tensor in after.items() if name in before and torch.equal(tensor, before[name])]
    return {"all": len(after), "changed": len(after) - len(same), "values": sum(map(torch.numel, after.values()))}


def answer(trained: Path, root: Path) -> list[int]:
    """Return the shape of the chunk of actions that the trained checkpoint gives for a step of the dataset."""
    configs: Any = importlib.import_module("lerobot.configs.policies")
    factory: Any = importlib.import_module("lerobot.policies.factory")
    config = configs.PreTrainedConfig.from_pretrained(trained)
    policy = factory.get_policy_class(config.type).from_pretrained(trained, config=config)
    before, after = factory.make_pre_post_processors(config, str(trained))
    item = LeRobotDataset(root.name, root=root, video_backend="pyav")[0]
    observed = {name: item[name][None] for name in ("observation.state", *VIEWS)}
    policy.eval()
    with torch.inference_mode():
        actions = after(policy.predict_action_chunk(before({**observed, "task": [item["task"]]})))
    assert torch.isfinite(actions).all()
    return [*actions.shape]


BASES: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "lerobot_smolvla": ("--policy.path=lerobot/smolvla_base", save_smolvla),
    "lerobot_pi05": ("--policy.pretrained_path=lerobot/pi05_libero_base", save_pi05),
}
"""Client to the word of its command that names weights on the hub, and the function that saves small ones."""


if __name__ == "__main__":
    main(sys.argv[1], *map(Path, sys.argv[2:]))
