"""Files of a run that its card reads, and the card that is written from them."""

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import yaml
from huggingface_hub import DatasetCard
from short_demonstrations import MILK, STOVE
from short_runs import run_in

from pipeline.axes import to_json
from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import Perturbation
from pipeline.axes.camera import CameraAxis
from pipeline.axes.layout import LayoutAxis
from pipeline.config import RenderConfig, ReplayConfig
from pipeline.export_config import ExportConfig
from pipeline.formats.lerobot import LeRobotConfig, LeRobotV21Config
from pipeline.formats.registry import FORMATS, columns
from pipeline.formats.rlds import RldsConfig
from pipeline.publish import card
from pipeline.publish_config import PublishConfig
from pipeline.run import manifest
from pipeline.seeding import rng
from pipeline.types import RenderedExtra, Task

NAME = "libero_tiny"
CAMERA = CameraAxis(levels=(4,)).sample(rng("card"), MILK, 0)
BACKGROUND = BackgroundAxis(levels=(2,)).sample(rng("card"), MILK, 0)
LAYOUT = LayoutAxis(levels=(1,)).sample(rng("card"), MILK, 0)


def row(axis: str, *changes: Perturbation, task: Task = MILK, reason: str = "kept", **other: Any) -> dict[str, Any]:
    kept = reason == "kept"
    number = f"{axis}{len(changes)}{task.name}{reason}"
    return {
        "episode_id": number,
        "role": "perturbed" if changes else "twin",
        "suite": task.suite,
        "task": task.name,
        "demo_id": f"{task.suite}/{task.name}/demo_0",
        "demo_origin": "human",
        "axis": axis,
        "component": "+".join(change.component for change in changes) or "clean",
        "level": "+".join(str(change.level) for change in changes) or "0",
        "perturbations": to_json(list(changes)),
        "kept": kept,
        "reason": reason,
        "chosen": True,
        "wanted": True,
        "replay_mode": "open_loop",
        "steps": 100,
        "actions_sha256": "tracked" if other.get("replay_mode") == "tracked" else f"recorded {task.name}",
        "gl_device": "llvmpipe" if kept else None,
        "rlds_shard": f"{NAME}-train.tfrecord-00000-of-00001" if kept else None,
        "mujoco_version": "3.2.7",
        **other,
    }


ROWS = [
    row("clean"),
    row("clean", task=STOVE),
    row("camera", CAMERA),
    row("camera", CAMERA, task=STOVE),
    row("background", BACKGROUND),
    row("layout", LAYOUT, replay_mode="tracked"),
    row("layout", LAYOUT, task=STOVE, reason="goal_not_reached"),
    row("layout", LAYOUT, task=STOVE, reason="reserve_not_needed", steps=None, wanted=False),
    row("camera+background", CAMERA, BACKGROUND),
]
COVERAGE = {"test_tasks": 313, "compared": 313, "smallest": 5.379, "median": 6.12, "p90": 7.34, "largest": 8.56}
FINDING = {"rows": 3, "test_tasks": 1599, "comparisons": 4797, "smallest": 5.379, "closest": "e", "clearance": 5.0}
FINDING |= {"not_compared": 0}
DATA_SHA256 = hashlib.sha256(b"data").hexdigest()
VALIDATION: dict[str, dict[str, Any]] = {"gripper": {"checked": 7, "findings": []}}


def write_files(data: Path) -> None:
    """Write the files that the card reads into the folder of a run."""
    write_rows(data, ROWS)
    column = list(range(1, 8))
    for name, report in {
        "leakage.json": {
            "camera": FINDING
            | {"measure": "degrees | turned", "overlaps": 0, "verdict": "disjoint", "coverage": {"distance": COVERAGE}},
            **{
                axis: FINDING | {"measure": "equal or not", "overlaps": 0, "verdict": "disjoint", "coverage": {}}
                for axis in ("background", "layout")
            },
            # An axis of the plan without kept episodes.
            "robot": FINDING | {"measure": "radians", "overlaps": 0, "verdict": "disjoint", "coverage": {}},
        },
        "validation.json": VALIDATION,
        "dataset_statistics.json": {
            NAME: {"action": dict.fromkeys(("mean", "std", "min", "max", "q01", "q99"), column)}
        },
    }.items():
        (data / name).write_text(json.dumps(report))
    for kind in FORMATS:
        record = {"identity": "", "files": {f"{NAME}/data.bin": DATA_SHA256}, "places": {}}
        (data / f"{kind.name}.json").write_text(json.dumps(record))
    (data / "datasets.json").write_text("{}")
    (data / "sheets").mkdir()
    for axis in ("camera", "camera+background"):
        (data / "sheets" / f"{axis}.png").write_bytes(axis.encode())
    (data / "finetune").mkdir()
    clients = {
        name: {"where": "there", "command": f"train --with {name}"}
        for name in ("openvla_oft", "lerobot_act", "starvla")
    }
    (data / "finetune" / "finetune.yaml").write_text(yaml.safe_dump({"clients": clients}))


def write_rows(data: Path, rows: list[dict[str, Any]], source: Literal["starter", "hdf5"] = "starter") -> None:
    settings = manifest.Settings(source=source, replay=ReplayConfig(), render=RenderConfig())
    table = pa.Table.from_pylist(rows, schema=manifest.schema(columns()))
    manifest.write(table, data / "manifest.parquet", settings)


NO_STATEMENT = PublishConfig()
OPTIONS = ExportConfig.model_validate(
    {
        "rlds": RldsConfig(name=NAME, shards=1),
        "lerobot": LeRobotConfig(name=NAME, shards=1),
        "lerobot_v21": LeRobotV21Config(name=NAME, convention="ipec"),
    }
)


def write(
    data: Path,
    options: ExportConfig = OPTIONS,
    extras: Sequence[RenderedExtra] = (),
    publish: PublishConfig = NO_STATEMENT,
) -> None:
    card.write(run_in(data, export=options, render=RenderConfig(extras=tuple(extras)), publish=publish))


def written(
    data: Path,
    kind: str,
    options: ExportConfig = OPTIONS,
    extras: Sequence[RenderedExtra] = (),
    publish: PublishConfig = NO_STATEMENT,
) -> str:
    write(data, options, extras, publish)
    return (data / "card" / kind / "README.md").read_text()


def metadata_of(text: str) -> dict[str, Any]:
    return dict(yaml.safe_load(DatasetCard(text).data.to_yaml()))


def cells(text: str, first: str, under: str) -> list[str]:
    """Return the cells of the row that begins with ``first`` in the section ``under``."""
    section = text.partition(f"## {under}\n")[2]
    row_match = re.search(rf"^\| {re.escape(first)} \|(.*)\|$", section, re.MULTILINE)
    assert row_match, f"no {first} under {under}"
    return [cell.strip() for cell in row_match[1].split(" | ")]
