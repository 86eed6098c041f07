"""Read an RLDS folder the way OpenVLA-OFT's loader does, without OFT and without TensorFlow, and check what it gets.

Followed, in OFT's order: ``libero_dataset_transform`` (gripper to 1 open, 0 close; state split into end effector and
fingers), normalisation to [-1, 1] by the 1st and 99th percentile, trajectories without an instruction left out, and
``chunk_act_obs``, which gives a trajectory of T steps T - 7 samples of 8 actions: none starts where fewer than 8 are
left, so nothing is padded.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.files import read_json
from pipeline.formats import exact_statistics
from pipeline.formats.rlds_layout import datasets
from pipeline.formats.tfrecord import METADATA, columns, records

CHUNK = 8
"""Actions that OFT predicts at once on LIBERO: the current one and seven to come."""

VIEWS = {"image_primary": "image", "image_wrist": "wrist_image"}
"""OFT's name of a view to its name in the dataset."""

SAME = 1e-9
"""Largest difference between statistics read back and those stored; both are computed in double precision."""

SETTLED = 5
"""Steps (a quarter of a second) after which the fingers have clearly followed a turn of the command."""


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
    action = normalise(exact_statistics.open_is_one(episode.action), statistics["action"])
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


def check(folder: Path, statistics: Mapping[str, Any]) -> dict[str, Any]:
    """Read a dataset as OFT would and say what it finds, JSON-serialisable.

    Args:
        statistics: what ``dataset_statistics.json`` has, by dataset.

    Returns:
        ``episodes``, ``steps`` and ``chunks`` (training samples), ``passed_by`` (episodes that OFT would not use),
        ``clipped_share`` (of the arm's normalised action entries that lie on a bound), ``statistics_difference``
        (largest, between what was read and ``statistics``) and ``violations``, texts.
    """
    if (stored := statistics.get(folder.parent.name)) is None:
        return {"violations": ["dataset_statistics.json has nothing on it"]}
    violations: list[str] = []
    motions: list[exact_statistics.Motion] = []
    samples: list[int] = []
    episodes = clipped = 0
    for episode in read(folder):
        episodes += 1
        faults = list(_faults(episode))
        violations += [f"{episode.name}: {fault}" for fault in faults]
        if faults:
            continue
        motions.append((episode.action, episode.state))
        if (trained := trajectory(episode, stored)) is not None:
            samples.append(len(trained))
            clipped += int((np.abs(trained.actions[:, 0, :6]) == 1).sum())
    if not samples:
        return {"episodes": episodes, "violations": [*violations, "holds nothing to train on: OFT waits for ever"]}
    if _closes_on_open(motions):
        violations.append("fingers part where the gripper is told to close: the command's sign is wrong")
    measured = exact_statistics.openvla(motions)
    difference = _difference(measured, stored)
    if not difference <= SAME:
        violations.append(f"dataset_statistics.json is off by up to {difference:g}")
    return {
        "episodes": episodes,
        "steps": measured["num_transitions"],
        "chunks": sum(samples),
        "passed_by": episodes - len(samples),
        "clipped_share": round(clipped / (6 * sum(samples)), 4),
        "statistics_difference": difference,
        "violations": violations,
    }


def check_all(rlds: Path, statistics_file: Path) -> dict[str, dict[str, Any]]:
    """Check every dataset below a folder against ``dataset_statistics.json``; keys are dataset names.

    Raises:
        PipelineError: when there is no dataset, or a file that cannot be read.
    """
    folders = datasets(rlds)
    statistics = read_json(statistics_file)
    return {folder.parent.name: check(folder, statistics) for folder in folders}


def _faults(episode: Recorded) -> Iterator[str]:
    steps = len(episode.action)
    if steps < CHUNK:
        yield f"has {steps} steps, fewer than a chunk of {CHUNK}"
    if len(set(episode.instructions)) != 1 or not episode.instructions[0].strip():
        yield "has no instruction, or not the same at every step"
    for name, values, spec in (("action", episode.action, SCHEMA.action), ("state", episode.state, SCHEMA.state)):
        if values.shape != (steps, *spec.shape) or values.dtype != np.dtype(spec.dtype):
            yield f"{name} is {values.shape} of {values.dtype}"
        elif not np.isfinite(values).all():
            yield f"{name} is not finite"
    if np.abs(episode.action).max(initial=0.0) > 1:
        yield "action leaves [-1, 1]"
    for view, frames in episode.frames.items():
        wrong = sum(not _is_frame(frame) for frame in frames)
        if wrong or len(frames) != steps:
            yield f"{view}: {wrong} of {len(frames)} frames are not {SCHEMA.frame.shape} JPEG, {steps} expected"


def _is_frame(data: bytes) -> bool:
    height, width, _ = SCHEMA.frame.shape
    try:
        with Image.open(io.BytesIO(data)) as image:  # reads the header only
            return (image.format, image.mode, image.size) == ("JPEG", "RGB", (width, height))
    except UnidentifiedImageError:
        return False


def _closes_on_open(motions: Sequence[exact_statistics.Motion]) -> bool:
    """Whether the fingers, on the whole, part after the command turns positive and close after it turns negative."""
    moved = 0.0
    for action, state in motions:
        command, gap = np.sign(action[:, -1]), state[:, 6] - state[:, 7]
        for turn in np.flatnonzero(np.diff(command)) + 1:
            moved += float(command[turn] * (gap[min(turn + SETTLED, len(gap) - 1)] - gap[turn]))
    return moved > 0


def _difference(measured: Mapping[str, Any], stored: Mapping[str, Any]) -> float:
    """Largest absolute difference between two entries of ``dataset_statistics.json``; infinite where shapes differ or
    what is stored is NaN."""
    largest = 0.0
    for name, value in measured.items():
        other = stored.get(name)
        if isinstance(value, Mapping):
            off = _difference(value, other) if isinstance(other, Mapping) else np.inf
        elif other is None or np.shape(value) != np.shape(other) or np.isnan(np.asarray(other, float)).any():
            off = np.inf
        else:
            off = float(np.abs(np.asarray(value, float) - np.asarray(other, float)).max())
        largest = max(largest, off)
    return largest
