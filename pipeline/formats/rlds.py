"""RLDS for OpenVLA and OpenVLA-OFT: a TFDS folder of TFRecord shards for each suite, without TensorFlow."""

from collections.abc import Iterator, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa

from pipeline.episode_schema import MAPS, MATRICES, MOTION, STANDARD, Content
from pipeline.formats.base import CardFacts, Format, FormatOptions, ManifestRow, Name, StepSizes, ValidationShare
from pipeline.formats.episodes import Episodes, Load, Piece, by_suite, split
from pipeline.formats.read_back import Copy, Fault
from pipeline.formats.rlds_layout import VERSION, dataset_of, shard_path
from pipeline.tables import column
from pipeline.types import Count

SHARD_MB = 400
"""Target shard size in MB if ``shards`` is not set."""


class RldsConfig(FormatOptions):
    """Options of the RLDS sets.

    Attributes:
        name: First part of the names of the sets, which must contain ``libero`` for OpenVLA-OFT; ``libero_`` and the
            name of the run by default.
        shards: Approximate number of TFRecord files of all sets together; by default each file has about 400 MB.
        validation: Share of each task's demonstrations in the split ``val`` instead of ``train``, 0 or 0.001 to 0.5; 0
            by default.
    """

    name: Name = ""
    shards: Count | None = None
    validation: ValidationShare = 0.0

    def reject_name(self) -> None:
        # OpenVLA-OFT decides by the name whether it reads a set with LIBERO's constants and cameras.
        if "libero" not in self.name or "aloha" in self.name:
            raise ValueError(
                f"OpenVLA-OFT selects constants and cameras by the name, and export.rlds.name {self.name!r} would "
                "select those of another robot; expected a name with libero and without aloha in it"
            )


class Rlds(Format[RldsConfig]):
    """Sets whose shard k has the k-th slice of the episodes; the ids are shuffled, so neighbours are unrelated."""

    name: ClassVar = "rlds"
    title: ClassVar = "RLDS"
    options_type: ClassVar = RldsConfig
    by_default: ClassVar = True
    recipe: ClassVar = 10
    packages: ClassVar = ("tensorflow-datasets", "protobuf", "google-crc32c", "numpy")
    splits_each_suite: ClassVar = True  # OpenVLA-OFT, when it validates, reads the split val of each set.
    card_facts = CardFacts(held_out_place="are the split `val` of each set that has this split.")
    group: ClassVar = "rlds"
    step_s = 0.0004
    columns: ClassVar = (
        column("rlds_shard", pa.string(), "TFRecord file, null when dropped"),
        column("rlds_index", pa.int64(), "place in the shard, null when dropped"),
    )
    clients = ("openvla_oft", "vla_adapter")

    def __init__(self, data: Path, options: RldsConfig, content: Content = STANDARD) -> None:
        super().__init__(data, options, content)
        of_cameras = [f"{view}_{name}" for view in content.views for name in (*MATRICES, *MAPS, "boxes")]
        self.keys = {name: name for name in (*content.views, *MOTION, *of_cameras)}
        self.keys |= dict.fromkeys(("provenance", "labels"), "episode_metadata")

    def step_kb(self, sizes: StepSizes) -> float:
        return len(self.content.views) * (sizes.frame_kb + sizes.maps_kb) + sizes.poses_kb + sizes.motion_kb

    def pieces(self, episodes: Episodes) -> list[Piece]:
        pieces = []
        steps = sum(facts.steps for facts in episodes.facts.values())
        shards = self.options.shards or ceil(steps / self._shard_steps())
        for split_name, members in episodes.by_split(self.options.validation).items():
            suites = {episode_id: episodes.facts[episode_id].suite for episode_id in members}
            for name, ids in by_suite(suites, self.options.name).items():
                slices = split(ids, max(1, round(shards * len(ids) / len(episodes.facts))))
                for shard, slice_ids in enumerate(slices):
                    path = shard_path(name, split_name, shard, len(slices))
                    pieces.append(Piece(f"dataset/{path}", slice_ids, split_name))
        return pieces

    def _shard_steps(self) -> int:
        """Return the number of steps in a shard of ``SHARD_MB``; sizes as in ``benchmarks/disk.py``, rounded up."""
        map_kb = sum({"depth": 31.0, "segmentation": 3.0}.get(extra, 0.0) for extra in self.content.extras)
        view_kb = (20.0 + map_kb) * self.content.area
        return int(1000 * SHARD_MB / (len(self.content.views) * view_kb + 1.0))

    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        from pipeline.formats import rlds_write

        rlds_write.write_shard(path, piece.ids, load, self.content)

    def assemble(self, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
        from pipeline.formats import rlds_write

        shards = {work / piece.path: piece.ids for piece in pieces}
        for folder in dict.fromkeys(path.parent for path in shards):
            lengths = {path: len(ids) for path, ids in shards.items() if path.parent == folder}
            rlds_write.write_metadata(folder, lengths, self.content)
        places = {}
        for path, ids in shards.items():
            for index, episode_id in enumerate(ids):
                places[episode_id] = {"rlds_shard": path.name, "rlds_index": index}
        return places

    def open(self) -> None:
        from pipeline.formats import rlds_read

        rlds_read.open_all(self.folder)

    def check(self, kept: Mapping[str, ManifestRow], cache: Path) -> Iterator[tuple[str, Fault]]:
        from pipeline.formats import rlds_read

        return rlds_read.check(self.folder, kept, self.content, self.options.validation)

    def read(self, row: ManifestRow) -> Copy | None:
        from pipeline.formats import rlds_read

        return rlds_read.read(self.folder, row, self.content)

    def loading(self, name: str, repository: str, kept: Sequence[ManifestRow]) -> str:
        builders = ""
        for dataset in sorted({dataset_of(row) for row in kept}):
            builders += f"""\
builder = tfds.builder_from_directory(f"{{os.environ['DATA']}}/rlds/{dataset}/{VERSION}")
for episode in builder.as_dataset(split="train"):
    for step in episode["steps"]:
        image, action, text = step["observation"]["image"], step["action"], step["language_instruction"]
"""
        return f"""\
The repository has the layout that `finetune/` expects of the folder `$DATA`:

```sh
export DATA=$PWD/{name}
hf download {repository} --repo-type dataset --local-dir $DATA
```

tfds:

```python
import os

import tensorflow_datasets as tfds

{builders}```
"""
