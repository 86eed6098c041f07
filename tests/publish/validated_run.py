"""Validated run folder with the datasets of six episodes and their cards, for uploads."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from short_runs import run_in
from synthetic import write_lerobot, write_lerobot_v21, write_rlds

from pipeline.config import Config
from pipeline.export_config import ExportConfig
from pipeline.files import checksum
from pipeline.formats.lerobot import LeRobotConfig, LeRobotV21Config
from pipeline.formats.rlds import RldsConfig
from pipeline.generated import generated
from pipeline.publish import push
from pipeline.publish.push import Upload
from pipeline.run.inputs import published_settings
from pipeline.run.layout import REPORTS

NAME = "tiny"
RUN = "tiny_run"


def prepare(data: Path, kind: str, **sections: Any) -> Upload:
    """Gather the files of a dataset, with other ``sections`` of the configuration."""
    options = ExportConfig.model_validate(
        {
            "rlds": RldsConfig(name="synthetic", shards=3),
            "lerobot": LeRobotConfig(name=NAME, shards=3),
            "lerobot_v21": LeRobotV21Config(name="synthetic", convention="ipec"),
        }
    )
    return push.prepare(
        next(target for target in options.datasets(data) if target.name == kind), run_in(data, **sections)
    )


def write_run(data: Path) -> None:
    """Write the files of a run in the order in which the stages write them."""
    write_rlds(data)
    write_lerobot(data, name=NAME)
    write_lerobot_v21(data)
    pq.write_table(pa.Table.from_pylist([{"kept": True}, {"kept": False}]), data / "manifest.parquet")
    with generated(data / "finetune") as finetune:
        (finetune / "finetune.yaml").write_text("recipe: {}\n")
    (data / "finetune" / "__pycache__").mkdir()
    (data / "finetune" / "__pycache__" / "run.pyc").write_bytes(b"compiled")
    for name in REPORTS:
        (data / name).write_text(json.dumps({"counts": {"checked": 6, "findings": []}}))
    write_card(data)


def write_card(data: Path, *, checksums: bool = False, config: Config | None = None) -> None:
    made_from = {name: checksum(data / name) for name in ("manifest.parquet", *REPORTS)}
    with generated(data / "card", made_from, published_settings(config or run_in(data).config)) as card:
        for kind in ("rlds", "lerobot", "lerobot_v21"):
            (card / kind / "pictures").mkdir(parents=True)
            (card / kind / "README.md").write_text(f"---\nlicense: mit\n---\n{kind}: hf download OWNER/NAME\n")
            (card / kind / "pictures" / "camera.png").write_bytes(b"picture")
            if checksums:
                files = json.loads((data / f"{kind}.json").read_text())["files"]
                lines = [f"{sha256}  {path.removeprefix(f'{NAME}/')}\n" for path, sha256 in files.items()]
                (card / kind / "SHA256SUMS").write_text("".join(lines))
