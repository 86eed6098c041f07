"""Two optimiser steps of OpenVLA-OFT by the recipe's script, on a CPU, with a small OpenVLA.

The script runs in a checkout of OpenVLA-OFT (213c5ff) and its environment, and needs nothing of this project. DATA is a
run's data folder. OUT is a new folder, which keeps the checkpoint:

    WANDB_MODE=offline PYTHONPATH=. torchrun --standalone --nnodes 1 --nproc-per-node 1 .../oft_steps.py DATA OUT

``DATA/finetune/run_openvla_oft.py`` and OFT's ``vla-scripts/finetune.py`` run unchanged. The weights are random, in a
model of OpenVLA's class with a small Llama and two small DINOv2. Its tokenizer has Llama's 32,000 tokens, one for each
letter. ``without_cuda`` replaces the names that need a GPU. The last printed line is JSON.
"""

import importlib
import json
import math
import runpy
import sys
from itertools import chain
from pathlib import Path
from typing import Any

import torch

STEPS = 2
WORDS = 31_744
"""Number of Llama's tokens before the 256 tokens of actions."""


class State:
    """The state of the processes, with the CPU as the device of this process."""

    def __init__(self, state: Any):
        self._state = state
        self.local_process_index = "cpu"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._state, name)


class Autocast(torch.autocast):
    """Automatic precision on the CPU, in place of any device."""

    def __init__(self, device_type: str, **options: Any) -> None:
        super().__init__("cpu", **options)


def without_cuda() -> None:
    """Replace four names that OFT's script imports: the device, its selection, the data parallelism and autocast."""
    accelerate: Any = importlib.import_module("accelerate")
    library: Any = torch
    parallel = library.nn.parallel
    state, wrap = accelerate.PartialState, parallel.DistributedDataParallel

    def on_cpu(module: Any, device_ids: object = None, **options: Any) -> Any:
        return wrap(module, **options)

    accelerate.PartialState = lambda: State(state(cpu=True))
    parallel.DistributedDataParallel = on_cpu
    library.cuda.set_device = lambda _device: None
    library.autocast = Autocast


def small_tokenizer() -> Any:
    """Return a tokenizer of single letters, whose last 256 of 32,000 tokens are single letters of no instruction."""
    tokenizers: Any = importlib.import_module("tokenizers")
    transformers: Any = importlib.import_module("transformers")
    words = ["<unk>", "<s>", "</s>", "\n", *map(chr, range(32, 127))]
    words += [f"<unused{number}>" for number in range(WORDS - len(words))]
    words += [chr(0x4E00 + number) for number in range(256)]
    numbers = {word: number for number, word in enumerate(words)}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.BPE(numbers, [], unk_token="<unk>"))
    tokenizer.decoder = tokenizers.decoders.Fuse()
    tokenizer.post_processor = tokenizers.processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    return transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, unk_token="<unk>", bos_token="<s>", eos_token="</s>", pad_token="<PAD>",
        model_max_length=2048, padding_side="right",
    )  # fmt: skip


def save_openvla(folder: Path) -> None:
    """Save a small OpenVLA with random weights and its processor."""
    configuration: Any = importlib.import_module("prismatic.extern.hf.configuration_prismatic")
    modeling: Any = importlib.import_module("prismatic.extern.hf.modeling_prismatic")
    processing: Any = importlib.import_module("prismatic.extern.hf.processing_prismatic")
    llama = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2, "num_attention_heads": 4}
    dino = "vit_small_patch14_reg4_dinov2.lvd142m"
    config = configuration.OpenVLAConfig(
        vision_backbone_id="dinosiglip-vit-so-224px", llm_backbone_id="llama2-7b-pure",
        image_resize_strategy="resize-naive", text_config={**llama, "vocab_size": 32_064, "pad_token_id": 32_000},
        timm_model_ids=[dino, dino], timm_override_act_layers=[None, None],
    )  # fmt: skip
    modeling.OpenVLAForActionPrediction(config).to(torch.bfloat16).save_pretrained(folder)
    images = processing.PrismaticImageProcessor(
        use_fused_vision_backbone=True, image_resize_strategy="resize-naive", input_sizes=[(3, 224, 224)] * 2,
        interpolations=["bicubic"] * 2, means=[(0.485, 0.456, 0.406), (0.5, 0.5, 0.5)],
        stds=[(0.229, 0.224, 0.225), (0.5, 0.5, 0.5)],
    )  # fmt: skip
    processing.PrismaticProcessor(images, small_tokenizer()).save_pretrained(folder)


def changed(before: Path, after: Path) -> dict[str, int]:
    """Count the tensors of the merged checkpoint that differ from the first weights."""
    load: Any = importlib.import_module("safetensors.torch").load_file
    former, tensors = (load(folder / "model.safetensors") for folder in (before, after))
    same = [name for name in tensors if torch.equal(former[name], tensors[name])]
    numbers = sum(tensor.numel() for tensor in tensors.values())
    return {"all": len(tensors), "changed": len(tensors) - len(same), "values": numbers}


def main(data: Path, out: Path) -> None:
    data, out = data.resolve(), out.resolve()
    out.mkdir(parents=True)
    without_cuda()
    torch.manual_seed(0)
    save_openvla(out / "base")
    run: Any = importlib.import_module("wandb.sdk.wandb_run").Run
    logged: list[dict[str, float]] = []
    log = run.log

    def recorded(self: Any, values: dict[str, float], **options: Any) -> None:
        logged.append(values)
        log(self, values, **options)

    run.log = recorded
    given = {
        "--vla_path": out / "base", "--run_root_dir": out / "runs", "--max_steps": STEPS - 1, "--save_freq": 1,
        "--shuffle_buffer_size": 200, "--wandb_log_freq": 1,
    }  # fmt: skip
    script = data / "finetune" / "run_openvla_oft.py"
    sys.argv = [str(script), *map(str, chain.from_iterable(given.items()))]
    runpy.run_path(str(script), run_name="__main__")
    (checkpoint,) = (out / "runs").glob(f"*--{STEPS - 1}_chkpt")
    losses = [values["VLA Train/Loss"] for values in logged if "VLA Train/Loss" in values]
    report = {
        "replaced": {option: str(value) for option, value in given.items()},
        "losses": losses,
        "rates": [values["VLA Train/Learning Rate"] for values in logged if "VLA Train/Learning Rate" in values],
        "files": sorted(path.name for path in checkpoint.iterdir()),
        "statistics": sorted(json.loads((checkpoint / "dataset_statistics.json").read_text())),
        "tensors": changed(out / "base", checkpoint),
    }
    assert len(losses) == STEPS, losses
    assert all(map(math.isfinite, losses)), losses
    print(json.dumps(report))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
