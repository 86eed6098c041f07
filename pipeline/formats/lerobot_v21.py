"""LeRobotDataset v2.1, for clients with a lerobot of 2025: one data file and one file per video for each episode."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa

from pipeline.episode_schema import GripperSpec
from pipeline.export_config import LeRobotV21Config
from pipeline.formats.base import Format, Row, StepSizes
from pipeline.formats.episodes import Episodes, Load, Piece, by_suite, in_a_row, split
from pipeline.formats.lerobot import LeRobot
from pipeline.formats.lerobot_columns import CONVENTIONS
from pipeline.formats.read_back import Copy, Fault
from pipeline.grouping import grouped
from pipeline.identity import Step
from pipeline.types import Extra

EPISODES_OF_A_PIECE = 50
"""Largest number of episodes that are written again after a call was killed; the files do not depend on it."""


class LeRobotV21(Format[LeRobotV21Config]):
    """Sets whose episodes are numbered from 0. Validation episodes form sets of their own: no client reads splits."""

    name: ClassVar[Step] = "lerobot_v21"
    title: ClassVar = "LeRobot v2.1"
    group: ClassVar = LeRobot.group
    step_s: ClassVar = LeRobot.step_s
    # ``meta/episodes.jsonl`` contains the ids of the episodes, so the manifest needs no columns for this format.
    columns: ClassVar[tuple[pa.Field, ...]] = ()

    def __init__(self, data: Path, options: LeRobotV21Config, extras: Sequence[Extra] = ()) -> None:
        super().__init__(data, options, extras)
        self.convention = CONVENTIONS[options.convention]
        self.keys = {name: self.convention.name(key) for name, key in LeRobot.keys.items()}
        if self.convention.open_is_one:
            self.gripper = GripperSpec(open=1.0, close=0.0)
        self.clients = {"ipec": ("starvla", "gr00t"), "openpi": ("openpi", "openpi_serve")}[options.convention]

    def step_kb(self, sizes: StepSizes) -> float:
        return self.convention.step_kb(sizes)

    def pieces(self, episodes: Episodes) -> list[Piece]:
        pieces = []
        for split_name, members in episodes.by_split(self.options.validation).items():
            sets = {self.options.name: members}
            if self.options.convention == "ipec":
                suites = {episode_id: episodes.known[episode_id].suite for episode_id in members}
                sets = by_suite(suites, self.options.name)
            for name, ids in sets.items():
                folder = f"files/{name}" if split_name == "train" else f"files/{name}_{split_name}"
                parts = split(ids, -(-len(ids) // EPISODES_OF_A_PIECE))
                slices = {f"{folder}/{number:05d}": (split_name, part) for number, part in enumerate(parts)}
                pieces += in_a_row(slices, episodes.known)
        return pieces

    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        from pipeline.formats import lerobot_v21_write

        lerobot_v21_write.write_piece(path, piece, load, self.convention, self.extras)

    def assemble(self, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
        from pipeline.formats import lerobot_v21_write

        for name, members in grouped((Path(piece.path).parent.name, piece) for piece in pieces).items():
            lerobot_v21_write.finish(work, work / "dataset" / name, members, self.convention, self.extras)
        return {}

    def open(self) -> None:
        from pipeline.formats import lerobot_v21_read

        lerobot_v21_read.open_all(self.folder)

    def check(self, kept: Mapping[str, Row], cache: Path) -> Iterator[tuple[str, Fault]]:
        from pipeline.formats import lerobot_v21_read

        return lerobot_v21_read.check(self.folder, kept, self.convention, self.extras, self.options.validation)

    def read(self, row: Row, cache: Path) -> Copy | None:
        from pipeline.formats import lerobot_v21_read

        return lerobot_v21_read.read(self.folder, row["episode_id"], self.convention, self.extras)

    def loading(self, name: str, repository: str, kept: Sequence[Row]) -> str:
        actions = self.keys["action"]
        return f"""\
The repository is laid out as the folder that `finetune/` expects, here `$DATA`; below `lerobot_v21/` lies a dataset in
the convention `{self.options.convention}` for each folder, with the actions as `{actions}`:

```sh
export DATA=$PWD/{name}
hf download {repository} --repo-type dataset --local-dir $DATA
```

lerobot up to 0.3.3, which reads version 2.1:

```python
import os
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

for root in sorted(Path(os.environ["DATA"], "lerobot_v21").iterdir()):
    dataset = LeRobotDataset(root.name, root=root)
```

`meta/provenance.parquet` of each has the provenance of each `episode_index`.
"""
