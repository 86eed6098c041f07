"""LIBERO's own HDF5 layout: a file for each task, for LIBERO's training code, robomimic and ``demos``."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa

from pipeline.axes import task_of
from pipeline.episode_schema import MAPS, MATRICES, STANDARD, Content
from pipeline.formats.base import CardFacts, Format, FormatOptions, ManifestRow, Name, StepSizes, ValidationShare
from pipeline.formats.episodes import EpisodeFacts, Episodes, Load, Piece, demos_for_validation
from pipeline.formats.hdf5 import layout
from pipeline.formats.read_back import Copy, Fault
from pipeline.grouping import grouped


class Hdf5Config(FormatOptions):
    """Options of the HDF5 files in LIBERO's layout.

    Attributes:
        name: Name of the dataset, which only its card states; ``libero_`` and the name of the run by default.
        validation: Share of each task's demonstrations in separate files, below ``val/``, 0 or 0.001 to 0.5; 0 by
            default.
    """

    name: Name = ""
    validation: ValidationShare = 0.0


class Hdf5(Format[Hdf5Config]):
    """Files of one task each, in which an episode is a demonstration with its states and its scene.

    Validation episodes have files of their own, because LIBERO's reader takes all demonstrations of a file.
    """

    name: ClassVar = "hdf5"
    title: ClassVar = "HDF5"
    options_type: ClassVar = Hdf5Config
    recipe: ClassVar = 1
    packages: ClassVar = ("h5py", "numpy", "opencv-python-headless")
    group: ClassVar = "hdf5"
    step_s = 0.012
    # Two frames of 256 pixels, which are decompressed and compared with decoded JPEG files, take 2.2 ms.
    validate_s = 0.0028
    # The attribute ``episode_id`` of each demonstration joins it with the manifest, which needs no columns.
    columns: ClassVar[tuple[pa.Field, ...]] = ()
    stores_replay: ClassVar = True
    card_facts = CardFacts(
        held_out_place="are in files of their own, below `hdf5/val/`.", turns_frames=False, maps_stored_as="array"
    )
    clients = ("robomimic",)

    def __init__(self, data: Path, options: Hdf5Config, content: Content = STANDARD) -> None:
        super().__init__(data, options, content)
        self.keys = {"action": "actions", "action_absolute": "action_absolute", "joint_state": "obs/joint_states"}
        self.keys |= {"state": "obs/ee_states, obs/gripper_states"}
        self.keys |= dict.fromkeys(("provenance", "labels"), layout.PROVENANCE)
        for view in content.views:
            self.keys[view] = layout.frames_key(view)
            self.keys |= {f"{view}_{name}": layout.matrix_attribute(view, name) for name in MATRICES}
            self.keys |= {f"{view}_{name}": layout.maps_key(view, name) for name in (*MAPS, "boxes")}

    def step_kb(self, sizes: StepSizes) -> float:
        # Frames are decoded and compressed without loss, states are float64.
        images_kb = len(self.content.views) * (4.7 * sizes.frame_kb + sizes.maps_kb)
        return images_kb + sizes.poses_kb + 2 * sizes.motion_kb + 1.0

    def pieces(self, episodes: Episodes) -> list[Piece]:
        pieces = []
        for split_name, members in episodes.by_split(self.options.validation).items():
            by_task = grouped((episodes.facts[episode_id].task_file, episode_id) for episode_id in members)
            for task, ids in sorted(by_task.items()):
                pieces.append(Piece(f"dataset/{layout.file_of(task, split_name)}", ids, split_name))
        return pieces

    def write_piece(self, path: Path, piece: Piece, load: Load) -> None:
        from pipeline.formats.hdf5 import write

        write.write_file(path, piece, load, self.content)

    def assemble(self, work: Path, pieces: Sequence[Piece]) -> dict[str, dict[str, Any]]:
        return {}

    def open(self) -> None:
        from pipeline.formats.hdf5 import read

        read.open_all(self.folder)

    def check(self, kept: Mapping[str, ManifestRow], cache: Path) -> Iterator[tuple[str, Fault]]:
        from pipeline.formats.hdf5 import read

        return read.check(self.folder, kept, self.content, self.options.validation)

    def read(self, row: ManifestRow) -> Copy | None:
        from pipeline.formats.hdf5 import read

        return read.read(self.folder, row["episode_id"], self.content)

    def loading(self, name: str, repository: str, kept: Sequence[ManifestRow]) -> str:
        facts: list[EpisodeFacts] = []
        for row in kept:
            task = task_of(row["suite"], row["task"], row["perturbations"])
            scene = task.bddl_file.stem if task.goal_file else ""
            origin = row["demo_origin_sha256"]
            facts.append(EpisodeFacts(row["suite"], demo=row["demo_id"], origin=origin, scene=scene))
        held_out = demos_for_validation(facts, self.options.validation)
        first = min(layout.file_of(one.task_file, "train") for one in facts if one.demo not in held_out)
        return f"""\
The files `hdf5/<suite>/<task>_demo.hdf5` have the layout of LIBERO's own demonstrations:

```sh
export DATA=$PWD/{name}
hf download {repository} --repo-type dataset --local-dir $DATA
```

```python
import os

import h5py

with h5py.File(f"{{os.environ['DATA']}}/hdf5/{first}") as file:
    for episode in file["data"].values():
        image, action = episode["obs/agentview_rgb"], episode["actions"]
        text = episode.attrs["instruction"]
```

Observations precede the action of their step. In LIBERO's own files they follow it.
"""
