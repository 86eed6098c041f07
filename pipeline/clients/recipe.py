"""The fine-tuning recipe and, beside it, what the clients need to train on a run's datasets."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import yaml

from pipeline.episode_schema import SCHEMA
from pipeline.export_config import ExportConfig, LeRobotV21Config
from pipeline.files import checksum, replaced
from pipeline.formats import exact_statistics
from pipeline.formats.rlds_layout import dataset_of

TEMPLATES = Path(__file__).parent / "templates"
COPIED = ("run_openvla_oft.py",)

OPENPI = "pi05_libero"
"""openpi's configuration that is trained and served."""
OPENPI_ASSETS = Path("openpi_assets", "physical-intelligence", "libero", "norm_stats.json")
"""Where that configuration looks for statistics, below the folder of its assets, when it serves what it trained."""

PI05_NORMALIZATION = {"ACTION": "MEAN_STD", "STATE": "MEAN_STD", "VISUAL": "IDENTITY"}
"""By which lerobot fine-tuned its pi0.5 for LIBERO, in place of quantiles."""

STARVLA = '''\
"""The datasets beside this folder as a mixture of starVLA, which finds this file in ``examples/`` of its checkout."""

DATASET_NAMED_MIXTURES = {{
    "{name}": [
{mixture}    ],
}}
'''
"""``libero_franka`` is the robot of its LIBERO example: names of inputs, and their normalisation."""

PAPER = "LIBERO-Plus (arXiv:2510.13626), fine-tuning details"
OFT = "OpenVLA-OFT's command for LIBERO (github.com/moojink/openvla-oft, LIBERO.md)"
BOTH = f"{PAPER}; the same in {OFT}"
MANIFEST = "manifest.parquet of this run"


def sourced(value: Any, source: str) -> dict[str, Any]:
    """A field of the recipe."""
    return {"value": value, "source": source}


TRAINING = {
    "base_weights": sourced(
        "openvla/openvla-7b",
        OFT + "; LIBERO-Plus's repository names what came of it, openvla-7b-oft-finetuned-libero-plus-mixdata",
    ),
    "gpus": sourced(8, PAPER),
    "batch_size_per_gpu": sourced(2, PAPER + "; OpenVLA-OFT's command for LIBERO has 8"),
    "effective_batch_size": sourced(16, "gpus x batch_size_per_gpu, gradients not accumulated"),
    "learning_rate": sourced(5e-4, BOTH),
    "steps": sourced(100_000, PAPER + "; OpenVLA-OFT's command for LIBERO has 150,005"),
    "optimizer": sourced("adamw", BOTH),
    "weight_decay": sourced(
        0.1, PAPER + "; OpenVLA-OFT has no flag for it and leaves PyTorch's 0.01: run_openvla_oft.py sets it"
    ),
    "schedule": sourced(
        "cosine_with_warmup",
        PAPER + "; OpenVLA-OFT has only a division by 10 after 100,000 steps: run_openvla_oft.py replaces it",
    ),
    "warmup_steps": sourced(
        1000, "this project: 1 % of the steps, also of those that --max_steps gives, for want of a published length"
    ),
    "images": sourced(len(SCHEMA.views), BOTH),
    "proprioception": sourced(True, BOTH),
    "action_head": sourced("l1_regression", BOTH),
    "chunk": sourced(8, PAPER + "; the same in OpenVLA-OFT's constants for LIBERO (prismatic/vla/constants.py)"),
    "image_augmentation": sourced(True, BOTH),
    "lora_rank": sourced(32, OFT),
    "shuffle_buffer": sourced(100_000, "OpenVLA-OFT's default, in frames; lower it where memory is short"),
}


def build(manifest_file: Path, rows: Sequence[Mapping[str, Any]], export: ExportConfig) -> dict[str, Any]:
    """The fine-tuning recipe of a run.

    Args:
        manifest_file: the run's manifest, whose hash identifies the datasets: it has the content hash of every
            episode, its place in each format, and the versions and the device that made it.
        export: the datasets that the run asks for; OpenVLA-OFT calls all of RLDS by the name there.
    """
    name = export.rlds.name if export.rlds else None
    kept = [row for row in rows if row["kept"]]
    counts: dict[str, dict[str, int]] = {}
    for row in kept:
        by_axis = counts.setdefault(row["suite"], {})
        by_axis[row["axis"]] = by_axis.get(row["axis"], 0) + 1
    dataset = {
        "sha256": sourced(checksum(manifest_file), "hash of " + MANIFEST),
        "episodes": sourced(len(kept), MANIFEST),
        "steps": sourced(sum(row["steps"] for row in kept), MANIFEST),
        "episodes_by_suite_and_axis": sourced(counts, MANIFEST),
    }
    if name is not None:
        suites = {row["suite"]: dataset_of(row) for row in kept}
        dataset["suites"] = sourced(suites, MANIFEST + ": the RLDS dataset that holds each suite")
        dataset["mixtures"] = sourced(
            {name: dict.fromkeys(sorted(set(suites.values())), 1.0)},
            "OpenVLA-OFT multiplies weights by the number of steps: with 1, every step is drawn equally often",
        )
    if export.lerobot is not None:
        dataset["lerobot"] = sourced(export.lerobot.name, "the run's configuration, export.lerobot.name")
    return {"name": export.name, "dataset": dataset, "training": TRAINING, "clients": _clients(export)}


def write(recipe: Mapping[str, Any], data: Path, export: ExportConfig) -> None:
    """Write ``finetune.yaml``, the clients' scripts and openpi's statistics, replacing what is in ``finetune``.

    Args:
        data: the run's folder; the scripts look for ``rlds`` beside theirs.
    """
    wanted = export.lerobot_v21
    with replaced(data / "finetune") as unfinished:
        unfinished.mkdir()
        # One line for each field: a folded command could not be copied.
        text = yaml.dump(dict(recipe), Dumper=_Dumper, sort_keys=False, width=10_000)
        (unfinished / "finetune.yaml").write_text(text)
        for file in COPIED:
            shutil.copyfile(TEMPLATES / file, unfinished / file)
        if wanted is not None and wanted.convention == "openpi":
            table = pq.read_table(data / "lerobot_v21" / wanted.name / "data", columns=["actions", "state"])
            actions, states = (np.stack(table[column].to_numpy()) for column in table.column_names)
            (unfinished / OPENPI_ASSETS).parent.mkdir(parents=True)
            content = json.dumps(exact_statistics.openpi(actions, states), indent=1) + "\n"
            (unfinished / OPENPI_ASSETS).write_text(content)
        if wanted is not None and wanted.convention == "ipec":
            roots = sorted(path.name for path in (data / "lerobot_v21").iterdir() if not path.name.endswith("_val"))
            mixture = "".join(f'        ("{root}", 1.0, "libero_franka"),\n' for root in roots)
            (unfinished / "starvla_data_config.py").write_text(STARVLA.format(name=wanted.name, mixture=mixture))


class _Dumper(yaml.SafeDumper):
    """Leaves quotation marks as they are, so that a command can be copied."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if '"' in text else None)


_Dumper.add_representer(str, _text)


def _clients(export: ExportConfig) -> dict[str, dict[str, str]]:
    """Command lines; ``$DATA`` stands for the run's data folder, by its absolute path."""
    of_rlds = _on_rlds() if export.rlds else {}
    of_lerobot = _on_lerobot(export.lerobot.name) if export.lerobot else {}
    return of_rlds | of_lerobot | _clients_of_v21(export.lerobot_v21)


def _on_rlds() -> dict[str, dict[str, str]]:
    return {
        "openvla_oft": {
            "where": "a checkout of github.com/moojink/openvla-oft, in its environment",
            "command": "WANDB_MODE=offline torchrun --standalone --nnodes 1 --nproc-per-node 8 "
            "$DATA/finetune/run_openvla_oft.py",
            "source": "training above; --dataset_name NAME trains on one suite, see dataset.suites; with an account, "
            "--wandb_entity NAME --wandb_project NAME in place of WANDB_MODE=offline",
        },
    }


def _on_lerobot(lerobot: str) -> dict[str, dict[str, str]]:
    train = f"lerobot-train --dataset.repo_id={lerobot} --dataset.root=$DATA/lerobot/{lerobot}"
    local = "--policy.push_to_hub=false"
    views = {view.lerobot_key: f"observation.images.camera{k}" for k, view in enumerate(SCHEMA.views.values(), start=1)}
    return {
        "lerobot_act": {
            "where": "an environment with lerobot",
            "command": f"{train} {local} --policy.type=act --batch_size=8 --steps=100000",
            "source": "lerobot's defaults",
        },
        "lerobot_smolvla": {
            "where": "an environment with lerobot[smolvla]",
            "command": f"{train} {local} --policy.path=lerobot/smolvla_base --rename_map='{json.dumps(views)}' "
            "--batch_size=64 --steps=20000",
            "source": "lerobot's command for fine-tuning SmolVLA; the weights' cameras are camera1, camera2, camera3",
        },
        "lerobot_pi05": {
            "where": "an environment with lerobot[pi], on a GPU of 80 GB",
            "command": f"{train} {local} --policy.type=pi05 --policy.pretrained_path=lerobot/pi05_libero_base "
            f"--policy.normalization_mapping='{json.dumps(PI05_NORMALIZATION)}' --policy.n_action_steps=10 "
            "--policy.empty_cameras=1 --policy.gradient_checkpointing=true --policy.dtype=bfloat16 --batch_size=64 "
            "--steps=30000",
            "source": "lerobot's command for fine-tuning pi0.5 on LIBERO (docs/source/pi05.mdx), whose keys are these",
        },
    }


def _clients_of_v21(wanted: LeRobotV21Config | None) -> dict[str, dict[str, str]]:
    """Of the convention that is asked for; with it, the gripper has the sign that the client's evaluation expects."""
    if wanted is None:
        return {}
    name = wanted.name
    if wanted.convention == "ipec":
        folder = f"examples/{name}/train_files/data_registry"
        return {
            "starvla": {
                "where": f"a checkout of github.com/starVLA/starVLA, after `mkdir -p {folder} && "
                f"cp $DATA/finetune/starvla_data_config.py {folder}/data_config.py`",
                "command": "accelerate launch --config_file starVLA/config/deepseeds/deepspeed_zero2.yaml "
                "starVLA/training/train_starvla.py "
                "--config_yaml examples/simBenchmarks/LIBERO/train_files/starvla_cotrain_libero.yaml "
                f"--datasets.vla_data.data_root_dir $DATA/lerobot_v21 --datasets.vla_data.data_mix {name} "
                f"--run_root_dir playground/Checkpoints --run_id {name}",
                "source": "starVLA's configuration and command for LIBERO (run_libero_train.sh), with these datasets",
            },
            "gr00t": {
                "where": "a checkout of github.com/NVIDIA/Isaac-GR00T, for each folder SET of $DATA/lerobot_v21, after "
                "`cp -r $DATA/lerobot_v21/SET SET && cp examples/LIBERO/modality.json SET/meta`: its evaluation hands "
                "over two fingers",
                "command": "NUM_GPUS=8 MAX_STEPS=20000 GLOBAL_BATCH_SIZE=640 SAVE_STEPS=1000 USE_WANDB=0 "
                "uv run bash examples/finetune.sh --base-model-path nvidia/GR00T-N1.7-3B --dataset-path SET "
                "--embodiment-tag LIBERO_PANDA --output-dir SET_trained --state-dropout-prob 0.2",
                "source": "GR00T's command for LIBERO (examples/LIBERO/README.md), with a dataset of this run",
            },
        }
    return {
        "openpi": {
            "where": "a checkout of github.com/Physical-Intelligence/openpi",
            "command": f"HF_LEROBOT_HOME=$DATA/lerobot_v21 uv run scripts/train.py {OPENPI} --exp-name={name} "
            f"--data.repo-id={name} --data.assets.assets-dir=$DATA/finetune/{OPENPI_ASSETS.parts[0]} "
            f"--data.assets.asset-id={OPENPI_ASSETS.parent.relative_to(OPENPI_ASSETS.parts[0])}",
            "source": f"openpi's configuration {OPENPI}, with this dataset and its statistics",
        },
        "openpi_serve": {
            "where": "the checkout of openpi, after training",
            "command": f"uv run scripts/serve_policy.py policy:checkpoint --policy.config={OPENPI} "
            f"--policy.dir=checkpoints/{OPENPI}/{name}/29999",
            "source": f"openpi's command for serving a checkpoint; the last of {OPENPI}'s 30,000 steps is 29999",
        },
    }
