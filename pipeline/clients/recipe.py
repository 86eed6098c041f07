"""The fine-tuning recipe and, beside it, what OpenVLA-OFT, openpi and lerobot need to train on a run's datasets."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow.parquet as pq
import yaml

from pipeline.clients.templates.lerobot_v3 import trained_on
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.export_config import known_to_oft
from pipeline.files import checksum, read_json, replaced, schema_file
from pipeline.formats import motion_statistics
from pipeline.formats.rlds_layout import dataset_of

SCHEMA_FILE = schema_file("finetune.json")
TEMPLATES = Path(__file__).parent / "templates"
COPIED = ("run_openvla_oft.py", "run_openpi.py", "lerobot_v3.py")

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


def build(
    manifest_file: Path, rows: Sequence[Mapping[str, Any]], *, name: str | None, lerobot: str | None
) -> dict[str, Any]:
    """The fine-tuning recipe of a run.

    Args:
        manifest_file: the run's manifest, whose hash identifies the datasets: it has the content hash of every
            episode, its place in each format, and the versions and the device that made it.
        rows: its rows.
        name: what OpenVLA-OFT is to call all RLDS datasets together; None where there are none.
        lerobot: name of the LeRobot dataset; None where there is none.

    Raises:
        PipelineError: when nothing was kept, or OFT would take the name for another robot's.
    """
    if name is not None and not known_to_oft(name):
        raise PipelineError(
            f"{name} would be read with another robot's constants and cameras by OpenVLA-OFT, which goes by the name",
            where="export.rlds.name",
            expected="a name with libero and without aloha in it",
        )
    kept = [row for row in rows if row["kept"]]
    if not kept:
        raise PipelineError("no episode was kept", where=manifest_file, remedy="read its column reason")
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
    if lerobot is not None:
        dataset["lerobot"] = sourced(lerobot, "the run's configuration, export.lerobot.name")
    recipe = {"name": name or lerobot, "dataset": dataset, "training": TRAINING, "clients": _clients(name, lerobot)}
    check(recipe, manifest_file)
    return recipe


def write(recipe: Mapping[str, Any], lerobot: Path | None, folder: Path) -> None:
    """Write ``finetune.yaml``, the clients' scripts and openpi's statistics, replacing what is in ``folder``.

    Args:
        recipe: what ``build`` returned.
        lerobot: root of the LeRobot dataset, whose actions and states are measured, but for those held out; None where
            there is none.
        folder: where to write; the scripts look for ``rlds`` and ``lerobot`` beside it.
    """
    with replaced(folder) as unfinished:
        unfinished.mkdir()
        if lerobot is not None:
            _write_statistics(lerobot, unfinished / "openpi_assets")
        # One line for each field: a folded command could not be copied.
        text = yaml.dump(dict(recipe), Dumper=_Dumper, sort_keys=False, width=10_000)
        (unfinished / "finetune.yaml").write_text(text)
        for file in COPIED:
            shutil.copyfile(TEMPLATES / file, unfinished / file)


def _write_statistics(lerobot: Path, folder: Path) -> None:
    """What openpi normalises by."""
    columns = [SCHEMA.action.lerobot_key, SCHEMA.state.lerobot_key]
    rows = trained_on(read_json(lerobot / "meta" / "info.json"))
    table = pq.read_table(lerobot / "data", columns=columns, filters=rows)
    actions, states = (np.stack(table[column].to_numpy()) for column in columns)
    folder.mkdir()
    figures = motion_statistics.openpi(actions, states)
    (folder / "norm_stats.json").write_text(json.dumps(figures, indent=1) + "\n")


def check(recipe: Mapping[str, Any], where: object) -> None:
    """Validate a recipe.

    Raises:
        PipelineError: naming the first field that breaks ``schemas/finetune.json``.
    """
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA_FILE.read_text()))
    if error := jsonschema.exceptions.best_match(validator.iter_errors(recipe)):
        raise PipelineError(
            f"{'.'.join(map(str, error.path)) or 'top level'}: {error.message}",
            where=where,
            expected="what schemas/finetune.json says",
        )


class _Dumper(yaml.SafeDumper):
    """Leaves quotation marks as they are, so that a command can be copied."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if '"' in text else None)


_Dumper.add_representer(str, _text)


def _clients(name: str | None, lerobot: str | None) -> dict[str, dict[str, str]]:
    """Command lines; ``$DATA`` stands for the run's data folder, by its absolute path."""
    return ({} if name is None else _on_rlds()) | ({} if lerobot is None else _on_lerobot(lerobot))


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
        "openpi": {
            "where": "a checkout of github.com/Physical-Intelligence/openpi",
            "command": "uv run python $DATA/finetune/run_openpi.py scripts/train.py "
            f"pi05_{lerobot} --exp-name={lerobot}",
            "source": "openpi's configuration pi05_libero, with this dataset",
        },
        "openpi_serve": {
            "where": "the checkout of openpi, after training",
            "command": "uv run python $DATA/finetune/run_openpi.py scripts/serve_policy.py policy:checkpoint "
            f"--policy.config=pi05_{lerobot} --policy.dir=checkpoints/pi05_{lerobot}/{lerobot}/29999",
            "source": "openpi's command for serving a checkpoint; the last of pi05_libero's 30,000 steps is 29999",
        },
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
    }
