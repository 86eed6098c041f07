"""The fine-tuning recipe of a run, and the files that the clients need to train on its datasets."""

import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import yaml

from pipeline import templates
from pipeline.clients.files import LEROBOT_TRAIN, OFT_SCRIPT, OPENPI_ASSETS, RECIPE, ROBOMIMIC_CONFIG, STARVLA_CONFIG
from pipeline.episode_schema import SCHEMA, STANDARD, Content
from pipeline.export_config import ExportConfig
from pipeline.files import checksum, read_json
from pipeline.formats import exact_statistics
from pipeline.formats.base import AnyFormat
from pipeline.formats.hdf5 import Hdf5
from pipeline.formats.lerobot import LeRobot, LeRobotOpenpi, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds
from pipeline.formats.rlds_layout import dataset_of, split_of
from pipeline.generated import generated
from pipeline.libero.tasks import SUITES

TEMPLATES = Path(__file__).parent / "templates"

OPENPI = "pi05_libero"
"""openpi's configuration for training and serving."""

EXPORTS: tuple[tuple[type[AnyFormat], dict[str, str]], ...] = (
    (Rlds, {}),
    (LeRobot, {}),
    (LeRobotV21, {"convention": "ipec"}),
    (LeRobotOpenpi, {}),
    (Hdf5, {}),
)
"""Formats that clients read, with the options that they need."""

MANIFEST = "manifest.parquet of this run"

HEAD = "# In the commands, $DATA is the absolute path of the run's folder, which has this file's folder.\n"


def sourced(value: Any, source: str) -> dict[str, Any]:
    """Return a field of the recipe."""
    return {"value": value, "source": source}


def build(
    manifest_file: Path,
    rows: Sequence[Mapping[str, Any]],
    export: ExportConfig,
    rewrite_probability: float = 0.0,
    content: Content = STANDARD,
) -> dict[str, Any]:
    """Return the fine-tuning recipe of a run.

    Args:
        manifest_file: the run's manifest, whose hash identifies the datasets. The manifest stores the content hash of
            every episode, its place in each format, and the versions and the device that generated it.
        export: the datasets that the run exports; its RLDS name is OpenVLA-OFT's name for all RLDS datasets.
        rewrite_probability: ``finetune.rewrite_probability``.
        content: the content of the episodes.
    """
    rlds, lerobot = export.options_for(Rlds), export.options_for(LeRobot)
    kept = [row for row in rows if row["kept"]]
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for row in kept:
        counts[row["suite"]][row["axis"]] += 1
    dataset = {
        "sha256": sourced(checksum(manifest_file), "hash of " + MANIFEST),
        "episodes": sourced(len(kept), MANIFEST),
        "steps": sourced(sum(row["steps"] for row in kept), MANIFEST),
        "episodes_by_suite_and_axis": sourced({suite: dict(axes) for suite, axes in counts.items()}, MANIFEST),
        "labels": sourced(_list_labels(kept), MANIFEST + ": the values that --where of run_openvla_oft.py accepts"),
    }
    oft_validates = False
    if rlds is not None:
        suites = {row["suite"]: dataset_of(row) for row in kept}
        dataset["suites"] = sourced(suites, MANIFEST + ": the RLDS dataset that holds each suite")
        validating = {dataset_of(row) for row in kept if split_of(Path(row["rlds_shard"])) == "val"}
        often = "about equally often, as the steps of val count too" if validating else "equally often"
        dataset["mixtures"] = sourced(
            {rlds.name: dict.fromkeys(sorted(set(suites.values())), 1.0)},
            f"OpenVLA-OFT multiplies weights by the number of steps: with 1, every step is sampled {often}",
        )
        # OFT requests the validation split from every dataset.
        oft_validates = bool(validating) and validating == {*suites.values()}
    if lerobot is not None:
        dataset["lerobot"] = sourced(lerobot.name, "the run's configuration, export.lerobot.name")
    tested: list[str] = []
    if counts.keys() - {*SUITES}:  # Without options, evaluate tests LIBERO's four suites.
        tested = [*(f"--suite {suite}" for suite in sorted(counts)), "--own-step-limit N"]
    sections = _training_and_clients(export, oft_validates, rewrite_probability, content, tested)
    return {"name": (rlds or export).name, "dataset": dataset, **sections}


def _list_labels(kept: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """List the axes, the single components and the single levels of the kept episodes."""
    axes, components, levels = set(), set(), set()
    for row in kept:
        axes.add(row["axis"])
        components.update(row["component"].split("+"))
        levels.update(row["level"].split("+"))
    return {"axis": sorted(axes), "component": sorted(components), "level": sorted(levels)}


def _training_and_clients(
    export: ExportConfig, oft_validates: bool, rewrite_probability: float, content: Content, tested: Sequence[str]
) -> dict[str, Any]:
    """Return the recipe's sections on training and clients, from the template ``recipe.yaml.j2``.

    Clients whose format is not exported are listed with the setting that exports it.

    Args:
        tested: options of ``evaluate`` with the tasks to test; empty for its default, LIBERO's four suites.
    """
    cameras = {view.lerobot_key: f"observation.images.camera{k}" for k, view in enumerate(SCHEMA.views.values(), 1)}
    values = {"images": len(SCHEMA.views), "renamed": json.dumps(cameras), "image_keys": json.dumps([*cameras])}
    values |= {"openpi": OPENPI, "openpi_assets": OPENPI_ASSETS}
    values |= {"lerobot_train": LEROBOT_TRAIN, "oft_validates": oft_validates}
    values |= {"rewrite_probability": rewrite_probability, "tested": tested}
    values |= {"inputs": _evaluated_inputs(export, content)}
    values |= {"robomimic_config": ROBOMIMIC_CONFIG}
    values |= {"ipec_set": _v21_of(export, "ipec"), "openpi_set": _v21_of(export, "openpi")}
    sections: dict[str, Any] = yaml.safe_load(_filled("recipe.yaml.j2", export=export, **values))
    missing = {client: setting for client, setting in _setting_of_client().items() if client not in sections["clients"]}
    return {**sections, "clients_of_other_formats": missing} if missing else sections


def _setting_of_client() -> dict[str, str]:
    """Map each client to the setting of a run's configuration that exports the format that it reads."""
    settings: dict[str, str] = {}
    for kind, options in EXPORTS:
        in_yaml = ", ".join(f"{name}: {value}" for name, value in options.items())
        dataset = kind(Path(), kind.options_type.model_validate(options))
        settings |= dict.fromkeys(dataset.clients, f"export: {{{kind.name}: {{{in_yaml}}}}}")
    return settings


def _evaluated_inputs(export: ExportConfig, content: Content) -> str:
    """Return the option of lerobot-train that restricts a policy's inputs to the state and LIBERO's two views.

    Otherwise lerobot passes all images to a policy: further views, which an evaluation lacks, and depth videos, which
    image encoders reject. The option is empty if the dataset has neither.
    """
    lerobot = export.options_for(LeRobot)
    has_other_images = len(content.views) > len(SCHEMA.views) or (lerobot is not None and lerobot.depth == "video")
    if not has_other_images:
        return ""
    height, width, channels = content.frame_shape
    features: dict[str, Any] = {SCHEMA.state.lerobot_key: {"type": "STATE", "shape": list(SCHEMA.state.shape)}}
    for view in SCHEMA.views.values():
        features[view.lerobot_key] = {"type": "VISUAL", "shape": [channels, height, width]}
    return f" --policy.input_features='{json.dumps(features)}'"


def _v21_of(export: ExportConfig, convention: str) -> tuple[str, str] | None:
    """Return the format of v2.1 in a convention that a run exports, and its name; ``None`` if it exports none."""
    for kind in (LeRobotV21, LeRobotOpenpi):
        options: LeRobotV21Config | None = export.options_for(kind)
        if options is not None and options.convention == convention:
            return kind.name, options.name
    return None


def _filled(template: str, **values: object) -> str:
    """Render a Jinja template of this package."""
    return templates.environment("pipeline.clients").get_template(template).render(**values)


def write(recipe: Mapping[str, Any], folder: Path, export: ExportConfig, datasets: Mapping[str, Path]) -> None:
    """Generate the folder ``finetune``: ``finetune.yaml``, the clients' scripts and the scripts' input files.

    Args:
        folder: the folder to generate; the scripts look for ``rlds`` next to it.
        datasets: name of each format of the run to the folder of its dataset.

    Raises:
        PipelineError: if edits in ``finetune`` would be lost.
    """
    lerobot = export.options_for(LeRobot)
    ipec, openpi = _v21_of(export, "ipec"), _v21_of(export, "openpi")
    with generated(folder) as unfinished:
        # One line for each field: a folded command could not be copied.
        text = yaml.dump(dict(recipe), Dumper=_Dumper, sort_keys=False, width=10_000)
        (unfinished / RECIPE).write_text(HEAD + text)
        if export.options_for(Rlds) is not None:
            shutil.copyfile(TEMPLATES / OFT_SCRIPT, unfinished / OFT_SCRIPT)
        if lerobot is not None and lerobot.validation:
            info = read_json(datasets["lerobot"] / lerobot.name / "meta" / "info.json")
            episodes = [*range(int(info["splits"]["train"].partition(":")[2]))]
            (unfinished / LEROBOT_TRAIN).write_text(json.dumps({"dataset": {"episodes": episodes}}) + "\n")
        if openpi is not None:
            format_name, name = openpi
            table = pq.read_table(datasets[format_name] / name / "data", columns=["actions", "state"])
            actions, states = (np.stack(table[column].to_numpy()) for column in table.column_names)
            (unfinished / OPENPI_ASSETS).parent.mkdir(parents=True)
            content = json.dumps(exact_statistics.openpi(actions, states), indent=1) + "\n"
            (unfinished / OPENPI_ASSETS).write_text(content)
        if ipec is not None:
            format_name, name = ipec
            roots = sorted(path.name for path in datasets[format_name].iterdir() if not path.name.endswith("_val"))
            mixture = _filled("starvla_data_config.py.j2", name=name, roots=roots)
            (unfinished / STARVLA_CONFIG).write_text(mixture)
        if export.options_for(Hdf5) is not None:
            shutil.copyfile(TEMPLATES / ROBOMIMIC_CONFIG, unfinished / ROBOMIMIC_CONFIG)


class _Dumper(yaml.SafeDumper):
    """YAML dumper that leaves quotation marks unescaped, so that commands can be copied."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
    """Represent a text, as a literal block if it contains quotation marks."""
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if '"' in text else None)


_Dumper.add_representer(str, _text)
