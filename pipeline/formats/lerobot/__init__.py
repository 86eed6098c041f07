"""LeRobotDataset v3.0, written directly and checked by lerobot itself, and v2.1 for clients with a lerobot of 2025."""

import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from math import ceil
from pathlib import Path
from typing import Any, ClassVar, Literal

import pyarrow as pa
from packaging.version import Version
from pydantic import Field, field_validator

from pipeline.episode_schema import MAPS, MATRICES, STANDARD, Content, GripperSpec
from pipeline.formats.base import CardFacts, Format, FormatOptions, ManifestRow, Name, StepSizes, ValidationShare
from pipeline.formats.episodes import Episodes, Load, Piece, by_suite, number_pieces, split
from pipeline.formats.lerobot.columns import CONVENTIONS, FILE_MB, VIEW_AS_VIDEO_KB, Action, Depth, Layout
from pipeline.formats.read_back import Copy, Fault
from pipeline.grouping import grouped
from pipeline.tables import column
from pipeline.types import Count

EPISODES_OF_A_PIECE = 50
"""Largest number of episodes that are written again after a call was killed; the files do not depend on it."""


DEPTH_MAP_S = 0.010
"""CPU time of one core to encode a depth map of 256 x 256 as video, in s."""

DEPTH_MAP_KB = 17.0
"""Size of a depth map of 256 x 256 in a video of the agent view, in KB; one of the wrist view has half of it."""

MAPS_STORED_AS = "PNG as base64 text"


class LeRobotConfig(FormatOptions):
    """Options of the LeRobot dataset.

    Attributes:
        name: Name of the dataset; ``libero_`` and the name of the run by default.
        shards: Least number of files of each kind; by default as many as are needed for files of at most 200 MB.
        frames: Storage of the frames: ``video`` is H.264, ``images`` are the JPEG files of RLDS, three times as large;
            ``video`` by default.
        validation: Share of each task's demonstrations in the split ``val``, whose episodes come last, 0 or 0.001 to
            0.5; 0 by default.
        action: Content of the column ``action``, on which policies train: ``delta``, the controller's input, or
            ``absolute``, its goal; ``delta`` by default. The other one is in ``absolute_action`` or ``delta_action``.
        language: True adds rewrites, subtasks, motions and traces in lerobot's language columns; false by default.
            Versions of lerobot before 0.6 cannot read such a dataset.
        depth: Storage of the extra ``depth``: ``text`` is its PNG files in base64, ``video`` is lerobot's own depth in
            codes of 12 bits; ``text`` by default. Versions of lerobot before 0.6 cannot read ``video``.
        convention: Names of the columns, and commands of the gripper: ``libero`` as in lerobot's LIBERO datasets, with
            -1 (open) and 1 (closed), ``ipec`` as in IPEC-COMMUNITY's, with 1 (open) and 0 (closed), for lerobot's GR00T
            and VLA-JEPA and for InternVLA-A1.5; ``libero`` by default.
    """

    name: Name = ""
    # The identity of finished datasets depends on their options, which contain the field under its first name.
    shards: Count | None = Field(default=None, serialization_alias="parts")
    frames: Literal["video", "images"] = "video"
    validation: ValidationShare = 0.0
    # Excluded at their defaults, as ``lerobot_v21``.
    action: Action = Field(default="delta", exclude_if=lambda action: action == "delta")
    language: bool = Field(default=False, exclude_if=lambda language: not language)
    depth: Depth = Field(default="text", exclude_if=lambda depth: depth == "text")
    convention: Literal["libero", "ipec"] = Field(
        default="libero", exclude_if=lambda convention: convention == "libero"
    )

    @field_validator("language")
    @classmethod
    def _readable_language(cls, language: bool) -> bool:
        if language:
            _require_lerobot_06("language columns")
        return language

    @field_validator("depth")
    @classmethod
    def _readable_depth(cls, depth: Depth) -> Depth:
        if depth == "video":
            _require_lerobot_06("depth as video")
        return depth

    def reject_content(self, content: Content) -> None:
        if self.depth == "video" and "depth" not in content.extras:
            raise ValueError("export.lerobot.depth: video requires depth in render.extras, which does not list it")


def _require_lerobot_06(content: str) -> None:
    """Reject an option whose content lerobot reads from 0.6 on, where an older version is installed.

    Raises:
        ValueError: naming the content and the installed version.
    """
    installed = version("lerobot")
    if Version(installed) < Version("0.6"):
        raise ValueError(
            f"lerobot {installed}, which checks the set here, cannot read {content}; expected 0.6 or later, which the "
            "installation on Python 3.12 or later has"
        )


def _keys(layout: Layout, labels: str) -> dict[str, str]:
    """Return the ``keys`` of a format, with the place of its ``labels``."""
    keys = layout.views
    keys |= {name: layout.name(key) for name, key in layout.motion_keys.items()}
    for view in layout.content.views:
        keys |= {f"{view}_{name}": layout.camera_column(view, name) for name in (*MATRICES, *MAPS, "boxes")}
    return keys | {"provenance": "meta/provenance.parquet", "labels": labels}


OPEN_IS_ONE = GripperSpec(open=1.0, close=0.0)
"""The commands of the gripper in a convention with ``open_is_one``."""


CLIENTS_V30 = {
    "libero": ("lerobot_act", "lerobot_smolvla", "lerobot_pi05", "lerobot_pi0_fast", "lerobot_molmoact2"),
    "ipec": (),
}
"""Convention to the clients of ``finetune.yaml`` that read it."""


class LeRobot(Format[LeRobotConfig]):
    """Dataset in which files of one number hold the same episodes: of data, of each video and of ``meta/episodes``."""

    name: ClassVar = "lerobot"
    title: ClassVar = "LeRobot"
    options_type: ClassVar = LeRobotConfig
    by_default: ClassVar = True
    recipe: ClassVar = 16
    packages: ClassVar = ("datasets", "pandas", "av", "pyarrow", "numpy", "opencv-python-headless")
    group: ClassVar = "lerobot"
    step_s = 0.0015
    columns: ClassVar = (
        column("lerobot_episode_index", pa.int64(), "episode_index in the LeRobot dataset, null when dropped"),
    )

    def __init__(self, data: Path, options: LeRobotConfig, content: Content = STANDARD) -> None:
        super().__init__(data, options, content)
        self.layout = Layout(
            content,
            CONVENTIONS[options.convention],
            frames=options.frames,
            language=options.language,
            action=options.action,
            depth=options.depth,
        )
        self.keys = _keys(self.layout, "meta/episodes")
        if self.layout.convention.open_is_one:
            self.gripper = OPEN_IS_ONE
        self.clients = CLIENTS_V30[options.convention]
        self.card_facts = CardFacts(
            held_out_place=(
                "come last, as the split `val` of `meta/info.json`. lerobot-train trains on them too, unless "
                "`--dataset.episodes` leaves them out."
            ),
            maps_stored_as=MAPS_STORED_AS,
            flattens_matrices=True,
            has_language_column=options.language,
            has_depth_video=bool(self.layout.depth_videos),
        )
        self.step_s += DEPTH_MAP_S * content.area * len(self.layout.depth_videos)

    @property
    def root(self) -> Path:
        """Return the folder for ``LeRobotDataset(repo_id, root=root)``."""
        return self.folder / self.options.name

    def step_kb(self, sizes: StepSizes) -> float:
        return self.layout.step_kb(sizes)

    def pieces(self, episodes: Episodes) -> list[Piece]:
        """Divide the episodes into pieces, each one file of each kind.

        lerobot's splits are consecutive ranges of episodes.
        """
        slices: dict[str, tuple[str, Sequence[str]]] = {}
        for split_name, members in episodes.by_split(self.options.validation).items():
            share = ceil((self.options.shards or 0) * len(members) / len(episodes.facts))
            steps = sum(episodes.facts[episode_id].steps for episode_id in members)
            least = ceil(steps / self._steps_of_a_file())
            for ids in split(members, max(1, share, least)):
                slices[f"files/{len(slices):05d}"] = split_name, ids
        return number_pieces(slices, episodes.facts)

    def sets(self, pieces: Sequence[Piece]) -> set[str]:
        return {self.options.name}

    def _steps_of_a_file(self) -> int:
        """Return the number of steps in a file of ``FILE_MB``, of data of all views or a video of one view.

        The sizes are those of ``benchmarks/disk.py``, rounded up.
        """
        views = len(self.content.views) * self.content.area
        text_maps = self.layout.text_maps
        maps_kb = sum({"depth": 42.0, "segmentation": 4.0}.get(extra, 0.0) for extra in text_maps)
        images_kb = 40.0 if self.options.frames == "images" else 0.0
        data_kb = 0.5 + views * (maps_kb + images_kb)
        view_kb = DEPTH_MAP_KB if self.layout.depth_videos else VIEW_AS_VIDEO_KB
        return int(1000 * FILE_MB / max(data_kb, view_kb * self.content.area))

    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        from pipeline.formats.lerobot import write

        write.write_piece(path, piece, load, self.layout)

    def assemble(self, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, int]]:
        from pipeline.formats.lerobot import write

        write.finish(work, work / "dataset" / self.options.name, pieces, self.layout)
        ids = [episode_id for piece in pieces for episode_id in piece.ids]
        return {episode_id: {"lerobot_episode_index": index} for index, episode_id in enumerate(ids)}

    def open(self) -> None:
        from pipeline.formats.lerobot import read

        with read.readable(self.root):
            read.rows(self.root)

    def check(self, kept: Mapping[str, ManifestRow], cache: Path) -> Iterator[tuple[str, Fault]]:
        from pipeline.formats.lerobot import check

        return check.check(self.root, cache, kept, self.layout, self.options.validation)

    def read(self, row: ManifestRow) -> Copy | None:
        from pipeline.formats.lerobot import read

        return read.read(self.root, row["episode_id"], self.layout)

    def repository_path(self, file: str) -> str:
        # lerobot reads a dataset from the root of the repository.
        return file.removeprefix(f"{self.options.name}/")

    def repository_folders(self) -> set[str]:
        return {"data", "meta", "videos"}

    def tag(self) -> str:
        """Return the tag that lerobot's loader requires."""
        return str(json.loads((self.root / "meta" / "info.json").read_text())["codebase_version"])

    def viewer(self) -> list[dict[str, str]]:
        # lerobot's own upload contains this entry.
        return [{"config_name": "default", "data_files": "data/*/*.parquet"}]

    def loading(self, name: str, repository: str, kept: Sequence[ManifestRow]) -> str:
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


class LeRobotV21Config(FormatOptions):
    """Options of LeRobot datasets of version 2.1.

    Attributes:
        name: Name of the dataset, or first part of the names of its sets; ``libero_`` and the name of the run by
            default.
        convention: Layout of the dataset. ``ipec``, for GR00T, starVLA and others, has a set for each suite, videos,
            and a gripper of 1 (open) and 0 (closed), like IPEC-COMMUNITY's LIBERO datasets. ``openpi`` has one set,
            as openpi's configuration of LIBERO reads it.
        validation: Share of each task's demonstrations in separate sets, named ``..._val``, 0 or 0.001 to 0.5; 0 by
            default.
    """

    name: Name = ""
    convention: Literal["ipec", "openpi"]
    validation: ValidationShare = 0.0

    def reject_name(self) -> None:
        if self.name.endswith("_val"):
            raise ValueError(
                f"names of sets for validation end in _val, and so does the name {self.name!r} of a dataset in LeRobot "
                "v2.1; expected another name"
            )


class LeRobotOpenpiConfig(LeRobotV21Config):
    """Options of the LeRobot dataset of version 2.1 for openpi.

    Attributes:
        name: Name of the dataset; ``libero_`` and the name of the run by default.
        convention: Layout of the dataset, always ``openpi``.
        validation: Share of each task's demonstrations in a separate set, named ``..._val``, 0 or 0.001 to 0.5; 0 by
            default.
    """

    convention: Literal["openpi"] = "openpi"


CLIENTS_V21 = {"ipec": ("starvla", "gr00t"), "openpi": ("openpi", "openpi_serve")}
"""Convention to the clients of ``finetune.yaml`` that read it."""


class LeRobotV21(Format[LeRobotV21Config]):
    """Sets of v2.1, in which each episode has files of its own.

    Validation episodes form sets of their own, because no client reads splits.
    """

    name: ClassVar = "lerobot_v21"
    title: ClassVar = "LeRobot v2.1"
    options_type: ClassVar[type[LeRobotV21Config]] = LeRobotV21Config
    recipe: ClassVar = 8
    packages: ClassVar = ("datasets", "av", "pyarrow", "numpy", "opencv-python-headless")
    card_facts = CardFacts(
        held_out_place="are separate sets, whose names end in `_val`.",
        maps_stored_as=MAPS_STORED_AS,
        flattens_matrices=True,
    )
    group: ClassVar = LeRobot.group
    step_s = LeRobot.step_s
    # ``meta/episodes.jsonl`` contains the ids of the episodes, so the manifest needs no columns for this format.
    columns: ClassVar[tuple[pa.Field, ...]] = ()

    def __init__(self, data: Path, options: LeRobotV21Config, content: Content = STANDARD) -> None:
        super().__init__(data, options, content)
        convention = CONVENTIONS[options.convention]
        self.layout = Layout(content, convention, frames=convention.frames)
        self.keys = _keys(self.layout, "meta/episodes.jsonl")
        if convention.open_is_one:
            self.gripper = OPEN_IS_ONE
        self.clients = CLIENTS_V21[options.convention]

    def step_kb(self, sizes: StepSizes) -> float:
        return self.layout.step_kb(sizes)

    def pieces(self, episodes: Episodes) -> list[Piece]:
        pieces = []
        for split_name, members in episodes.by_split(self.options.validation).items():
            sets = {self.options.name: members}
            if self.options.convention == "ipec":
                suites = {episode_id: episodes.facts[episode_id].suite for episode_id in members}
                sets = by_suite(suites, self.options.name)
            for name, ids in sets.items():
                folder = f"files/{name}" if split_name == "train" else f"files/{name}_{split_name}"
                parts = split(ids, ceil(len(ids) / EPISODES_OF_A_PIECE))
                slices = {f"{folder}/{number:05d}": (split_name, part) for number, part in enumerate(parts)}
                pieces += number_pieces(slices, episodes.facts)
        return pieces

    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        from pipeline.formats.lerobot import write_v21

        write_v21.write_piece(path, piece, load, self.layout)

    def assemble(self, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
        from pipeline.formats.lerobot import write_v21

        for name, members in grouped((Path(piece.path).parent.name, piece) for piece in pieces).items():
            write_v21.finish(work, work / "dataset" / name, members, self.layout)
        return {}

    def open(self) -> None:
        from pipeline.formats.lerobot import read_v21

        read_v21.open_all(self.folder)

    def check(self, kept: Mapping[str, ManifestRow], cache: Path) -> Iterator[tuple[str, Fault]]:
        from pipeline.formats.lerobot import check_v21

        return check_v21.check(self.folder, kept, self.layout, self.options.validation)

    def read(self, row: ManifestRow) -> Copy | None:
        from pipeline.formats.lerobot import read_v21

        return read_v21.read(self.folder, row["episode_id"], self.layout)

    def loading(self, name: str, repository: str, kept: Sequence[ManifestRow]) -> str:
        actions = self.keys["action"]
        return f"""\
The repository has the layout that `finetune/` expects of the folder `$DATA`. Each folder below `{self.name}/` is a
dataset in the convention `{self.options.convention}`, with the actions as `{actions}`:

```sh
export DATA=$PWD/{name}
hf download {repository} --repo-type dataset --local-dir $DATA
```

lerobot up to 0.3.3, which reads version 2.1:

```python
import os
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

for root in sorted(Path(os.environ["DATA"], "{self.name}").iterdir()):
    dataset = LeRobotDataset(root.name, root=root)
```

`meta/provenance.parquet` of each has the provenance of each `episode_index`.
"""


class LeRobotOpenpi(LeRobotV21):
    """The set of v2.1 for openpi in a folder of its own, so that a run may have both conventions."""

    name: ClassVar = "lerobot_openpi"
    title: ClassVar = "LeRobot v2.1 for openpi"
    options_type: ClassVar = LeRobotOpenpiConfig
