"""Recipe of a run of two suites, limited to the parts that depend on the manifest."""

from pathlib import Path
from typing import Any

from pipeline.clients.recipe import build
from pipeline.export_config import ExportConfig
from pipeline.formats.lerobot import LeRobotConfig
from pipeline.formats.rlds import RldsConfig

NAME = "libero_tiny"
SUITES = {"libero_spatial": f"{NAME}_spatial", "libero_10": f"{NAME}_10"}


def row(suite: str, axis: str, kept: bool = True) -> dict[str, Any]:
    shard = f"{SUITES[suite]}-train.tfrecord-00000-of-00002" if kept else None
    labels = {"axis": axis, "component": f"some_{axis}", "level": "3"}
    return {"suite": suite, **labels, "kept": kept, "steps": 100 if kept else None, "rlds_shard": shard}


ROWS = [
    row("libero_spatial", "clean"),
    row("libero_spatial", "camera"),
    row("libero_spatial", "camera"),
    row("libero_10", "light"),
    row("libero_10", "camera", kept=False),
]


def export_config(**further: Any) -> ExportConfig:
    return ExportConfig.model_validate(
        {"rlds": RldsConfig(name=NAME, shards=2), "lerobot": LeRobotConfig(name="tiny", shards=1), **further}
    )


def tiny_recipe(folder: Path, export: ExportConfig | None = None, rows: list[dict[str, Any]] = ROWS) -> dict[str, Any]:
    file = folder / "manifest.parquet"
    file.write_bytes(b"rows")
    return build(file, rows, export or export_config())
