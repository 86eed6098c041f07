"""LeRobotDataset v3.0, written and read back by lerobot 0.4.4 itself."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import pyarrow as pa

from pipeline.episode_schema import SCHEMA
from pipeline.export_config import LeRobotConfig
from pipeline.formats.base import Format, Row
from pipeline.formats.episodes import Episodes, Load
from pipeline.formats.read_back import Copy, Fault
from pipeline.identity import Step
from pipeline.tables import column


class LeRobot(Format[LeRobotConfig]):
    """Parts are datasets of their own, written in parallel; lerobot merges them."""

    name: ClassVar[Step] = "lerobot"
    title: ClassVar = "LeRobot"
    columns: ClassVar = (
        column("lerobot_episode_index", pa.int64(), "episode_index in the LeRobot dataset, null when dropped"),
    )
    keys: ClassVar = {view: spec.lerobot_key for view, spec in SCHEMA.views.items()} | {
        name: getattr(SCHEMA, name).lerobot_key for name in ("state", "joint_state", "action")
    }
    clients: ClassVar = ("openpi", "lerobot_act", "lerobot_smolvla")

    @property
    def root(self) -> Path:
        """For ``LeRobotDataset(repo_id, root=root)``."""
        return self.folder / self.options.name

    def pieces(self, episodes: Episodes) -> dict[str, list[str]]:
        # lerobot's splits are ranges of episodes, so each split has parts of its own, one after the other.
        return {
            f"parts/{split_name}-{part:05d}": ids
            for split_name, members in episodes.by_split(self.options.validation).items()
            for part, ids in enumerate(episodes.slices(members, self.options.parts))
        }

    def write_piece(self, path: Path, episode_ids: Sequence[str], load: Load) -> None:
        from pipeline.formats import lerobot_write

        lerobot_write.write_part(
            path, episode_ids, load, repo_id=self.options.name, frames=self.options.frames, extras=self.extras
        )

    def assemble(self, work: Path, pieces: Mapping[str, Sequence[str]]) -> dict[str, dict[str, int]]:
        from pipeline.formats import lerobot_write

        root = work / "dataset" / self.options.name
        lerobot_write.merge([work / piece for piece in pieces], root, work / "cache", repo_id=self.options.name)
        lengths: dict[str, int] = {}
        for piece, members in pieces.items():
            split_name = Path(piece).name.partition("-")[0]
            lengths[split_name] = lengths.get(split_name, 0) + len(members)
        lerobot_write.name_splits(root, lengths)
        ids = [episode_id for piece in pieces.values() for episode_id in piece]
        return {episode_id: {"lerobot_episode_index": index} for index, episode_id in enumerate(ids)}

    def check(self, kept: Mapping[str, Row], cache: Path) -> Iterator[tuple[str, Fault]]:
        from pipeline.formats import lerobot_columns, lerobot_read

        return lerobot_read.check(self.root, cache, kept, lerobot_columns.features(self.options.frames, self.extras))

    def read(self, row: Row, cache: Path) -> Copy | None:
        from pipeline.formats import lerobot_read

        return lerobot_read.read(self.root, cache, row["episode_id"], self.extras)

    def repository_path(self, file: str) -> str:
        # lerobot looks at the root of the repository.
        return file.removeprefix(f"{self.options.name}/")

    def repository_folders(self) -> set[str]:
        return {"data", "meta", "videos"}

    def tag(self) -> str:
        """What lerobot's loader looks for."""
        return str(json.loads((self.root / "meta" / "info.json").read_text())["codebase_version"])

    def viewer(self) -> list[dict[str, str]]:
        # As lerobot's own upload has it.
        return [{"config_name": "default", "data_files": "data/*/*.parquet"}]

    def loading(self, name: str, repository: str, kept: Sequence[Row]) -> str:
        return f"""\
lerobot:

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{repository}")
```

`meta/provenance.parquet` has the provenance of each `episode_index`. For training, `$DATA` is a folder with the dataset
and its scripts:

```sh
export DATA=$PWD/{name}
hf download {repository} --repo-type dataset --local-dir $DATA/lerobot/{name} --exclude "finetune/*"
hf download {repository} --repo-type dataset --local-dir $DATA --include "finetune/*"
```
"""
