"""Two optimiser steps of openpi's pi0.5 by the recipe's command, on a CPU, with a small model.

The script runs in a checkout of openpi (15a9616) and the environment of its ``uv.lock``, and needs nothing of this
project. DATA is the data folder of a run with the format ``lerobot_openpi``. OUT is a new folder, which keeps the
checkpoint:

    ENV/bin/python .../openpi_steps.py DATA OUT

openpi's ``scripts/train.py`` runs unchanged. Its configuration gets openpi's own variant ``dummy`` of both language
models. SigLIP has one layer, and the tokenizer is trained on the instructions; both are not options of openpi. The
weights are random. The last printed line is JSON.
"""

import importlib
import json
import os
import re
import runpy
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml

STEPS = 2
BATCH = 2


def save_tokenizer(folder: Path, dataset: Path) -> None:
    """Train a tokenizer on a dataset's instructions, and store it where openpi stores its download."""
    sentencepiece: Any = importlib.import_module("sentencepiece")
    lines = (dataset / "meta" / "tasks.jsonl").read_text().splitlines()
    file = folder / "big_vision" / "paligemma_tokenizer.model"
    file.parent.mkdir(parents=True)
    with file.open("wb") as model:
        sentencepiece.SentencePieceTrainer.train(
            sentence_iterator=iter(json.loads(line)["task"] for line in lines),
            model_writer=model,
            vocab_size=256,
            byte_fallback=False,
            hard_vocab_limit=False,
        )


def save_weights(folder: Path, name: str) -> None:
    """Save random weights of the small model as openpi's published weights are saved."""
    jax: Any = importlib.import_module("jax")
    nnx: Any = importlib.import_module("flax.nnx")
    orbax: Any = importlib.import_module("orbax.checkpoint")
    config: Any = importlib.import_module("openpi.training.config").get_config(name).model
    small = importlib.import_module("dataclasses").replace(
        config, paligemma_variant="dummy", action_expert_variant="dummy"
    )
    params = nnx.state(small.create(jax.random.key(0)), nnx.Param).to_pure_dict()
    with orbax.PyTreeCheckpointer() as saver:
        saver.save(folder, {"params": params})


def small_siglip() -> None:
    """Make openpi build SigLIP with one layer of width 32, its own variant ``mu``."""
    siglip: Any = importlib.import_module("openpi.models.siglip")
    decode = siglip.decode_variant
    siglip.decode_variant = lambda variant: decode(variant.replace("So400m", "mu"))


def changed(before: Path, after: Path) -> dict[str, int]:
    """Count the arrays of a checkpoint that differ from the first weights."""
    restore: Any = importlib.import_module("openpi.models.model").restore_params
    flatten: Any = importlib.import_module("flax.traverse_util").flatten_dict
    former, arrays = (flatten(restore(folder, restore_type=np.ndarray)) for folder in (before, after))
    different = [name for name in arrays if not np.array_equal(former[name], arrays[name])]
    numbers = sum(array.size for array in arrays.values())
    return {"all": len(arrays), "changed": len(different), "values": numbers}


def main(data: Path, out: Path) -> None:
    data, out = data.resolve(), out.resolve()
    recipe = yaml.safe_load((data / "finetune" / "finetune.yaml").read_text())
    words = shlex.split(recipe["clients"]["openpi"]["command"].replace("$DATA", str(data)))
    home, command = words[0].partition("=")[2], words[words.index("scripts/train.py") :]
    os.environ["HF_LEROBOT_HOME"], os.environ["OPENPI_DATA_HOME"] = home, str(out / "cache")
    options = dict(word.split("=", 1) for word in command if word.startswith("--"))
    dataset = Path(home, options["--data.repo-id"])
    out.mkdir(parents=True)
    save_tokenizer(out / "cache", dataset)
    small_siglip()
    save_weights(out / "base", command[1])
    added = [
        "--model.paligemma-variant=dummy", "--model.action-expert-variant=dummy",
        f"--weight-loader.params-path={out / 'base'}", f"--batch-size={BATCH}", f"--num-train-steps={STEPS}",
        "--log-interval=1", "--num-workers=0", "--no-wandb-enabled", f"--checkpoint-base-dir={out / 'checkpoints'}",
    ]  # fmt: skip
    sys.argv = [*command, *added]
    printed: list[str] = []
    bar: Any = importlib.import_module("tqdm_loggable.auto").tqdm
    write = bar.write

    def recorded(self: Any, text: str, *rest: Any, **options: Any) -> None:
        printed.append(text)
        write(text, *rest, **options)

    bar.write = recorded
    runpy.run_path("scripts/train.py", run_name="__main__")
    checkpoint = out / "checkpoints" / command[1] / options["--exp-name"] / str(STEPS - 1)
    losses = [float(match[1]) for text in printed if (match := re.search(r"loss=([\d.]+)", text))]
    stored = json.loads(next((checkpoint / "assets").rglob("norm_stats.json")).read_text())
    given = Path(options["--data.assets.assets-dir"], options["--data.assets.asset-id"], "norm_stats.json")
    report = {
        "added": added,
        "losses": losses,
        "same_statistics": stored == json.loads(given.read_text()),
        "arrays": changed(out / "base", checkpoint / "params"),
    }
    assert len(losses) == STEPS, printed
    print(json.dumps(report))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
