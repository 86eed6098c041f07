"""Read an RLDS folder the way OpenVLA-OFT's loader does, without OFT and without TensorFlow.

Followed, in OFT's order: ``libero_dataset_transform`` (gripper to 1 open, 0 close; state split into end effector and
fingers), normalisation to [-1, 1] by the 1st and 99th percentile, trajectories without an instruction left out, and
``chunk_act_obs``, which gives a trajectory of T steps T - 7 samples of 8 actions: none starts where fewer than 8 are
left, so nothing is padded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.formats.exact_statistics import open_is_one
from pipeline.formats.tfrecord import METADATA, columns, records

CHUNK = 8
"""Actions that OFT predicts at once on LIBERO: the current one and seven to come."""

VIEWS = {"image_primary": "image", "image_wrist": "wrist_image"}
"""OFT's name of a view to its name in the dataset."""


@dataclass(frozen=True)
class Recorded:
    """An episode as it is stored.

    Attributes:
        name: its ``episode_id``.
        action: (T, 7) float32, gripper -1 open, +1 close.
        state: (T, 8) float32, end-effector pose and fingers.
        frames: view (``image``, ``wrist_image``) to T JPEG files.
        instructions: one text per step.
    """

    name: str
    action: NDArray[np.float32]
    state: NDArray[np.float32]
    frames: Mapping[str, Sequence[bytes]]
    instructions: Sequence[str]


@dataclass(frozen=True)
class Samples:
    """What OFT makes of an episode: one sample for each place at which a whole chunk begins, S = T - 7 in all.

    Attributes:
        prompt: the instruction, lower-cased as OFT prompts with it.
        actions: (S, 8, 7) float32, normalised, gripper 1 open, 0 close.
        proprio: (S, 8) float32, normalised.
        frames: ``image_primary`` and ``image_wrist`` to S JPEG files, which OFT decodes, resizes and augments.
    """

    prompt: str
    actions: NDArray[np.float32]
    proprio: NDArray[np.float32]
    frames: Mapping[str, Sequence[bytes]]

    def __len__(self) -> int:
        return len(self.actions)


def datasets(root: Path) -> list[Path]:
    """Version folders of the datasets below OFT's ``data_root_dir``.

    Raises:
        PipelineError: when there is none.
    """
    found = sorted(file.parent for file in root.glob("*/*/dataset_info.json"))
    if not found:
        raise PipelineError(
            "no RLDS dataset", where=root, expected="NAME/1.0.0/dataset_info.json", remedy="run `dvc repro`"
        )
    return found


def read(folder: Path) -> Iterator[Recorded]:
    """The episodes of a version folder, shard by shard, frames left encoded.

    Raises:
        PipelineError: naming the file and the record, when a checksum is wrong or a feature that OFT reads is missing.
    """
    features = tfds.builder_from_directory(folder).info.features
    for shard in sorted(folder.glob("*.tfrecord-*")):
        for index, record in enumerate(records(shard)):
            stored = columns(record, features)
            try:
                yield Recorded(
                    name=stored[f"{METADATA}episode_id"][0].decode(),
                    action=stored["action"],
                    state=stored["observation/state"],
                    frames={view: stored[f"observation/{view}"].tolist() for view in VIEWS.values()},
                    instructions=[text.decode() for text in stored["language_instruction"]],
                )
            except KeyError as error:
                raise PipelineError(
                    f"record {index} has no feature {error}", where=shard, expected="the feature tree of OpenVLA's sets"
                ) from error


def trajectory(episode: Recorded, statistics: Mapping[str, Any]) -> Samples | None:
    """What OFT trains on, or None where it passes the episode by: no instruction, or fewer than 8 steps."""
    if not any(episode.instructions) or len(episode.action) < CHUNK:
        return None
    action = normalise(open_is_one(episode.action), statistics["action"])
    # OFT splits the state into end effector and fingers, and joins them again.
    proprio = normalise(episode.state, statistics["proprio"])
    chunks = sliding_window_view(action, CHUNK, axis=0).swapaxes(1, 2)
    samples = len(chunks)
    return Samples(
        prompt=episode.instructions[0].lower(),
        actions=chunks,
        proprio=proprio[:samples],
        frames={name: episode.frames[view][:samples] for name, view in VIEWS.items()},
    )


def normalise(values: NDArray[np.float32], figures: Mapping[str, Any]) -> NDArray[np.float32]:
    """Columns of ``values`` (T, D) mapped from [q01, q99] to [-1, 1] and clipped; a constant column becomes 0.

    Where ``figures`` has a mask, columns that it leaves out stay as they are (the gripper).
    """
    low, high, smallest, largest = (np.asarray(figures[name]) for name in ("q01", "q99", "min", "max"))
    mask = np.asarray(figures.get("mask", [True] * values.shape[1]))
    scaled = np.clip(2 * (values - low) / (high - low + 1e-8) - 1, -1, 1)
    return np.where(smallest == largest, 0.0, np.where(mask, scaled, values)).astype(np.float32)
