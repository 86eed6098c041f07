"""Reader of RLDS folders that follows OpenVLA-OFT's loader without OFT and without TensorFlow, and a check of datasets.

The reader repeats the steps of OFT in OFT's order:

* ``libero_dataset_transform`` maps the gripper to 1 open, 0 close. It splits the state into end effector and fingers.
* Normalisation maps the 1st and 99th percentile to [-1, 1].
* Trajectories without an instruction are left out.
* ``chunk_act_obs`` makes T - 7 samples of 8 actions from a trajectory of T steps. No sample starts with fewer than 8
  steps left, so nothing is padded.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from PIL import Image

from pipeline.episode_schema import SCHEMA, SIZE_PX
from pipeline.errors import PipelineError
from pipeline.files import read_json
from pipeline.formats import exact_statistics
from pipeline.formats.rlds_layout import datasets
from pipeline.formats.tfrecord import METADATA, columns, info_of, records

CHUNK = 8
"""Actions that OFT predicts at once on LIBERO: the current one and seven to come."""

VIEWS = {"image_primary": "image", "image_wrist": "wrist_image"}
"""OFT's name of a view to its name in the dataset."""

SAME = 1e-9
"""Largest difference between measured and stored statistics; both are computed in double precision."""

SETTLED = 5
"""Steps (a quarter of a second) after which the fingers have clearly followed a turn of the command."""


@dataclass(frozen=True)
class Recorded:
    """Episode as stored in the dataset.

    Attributes:
        name: the episode's ``episode_id``.
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
    """Training samples that OFT makes from an episode: one for each start of a whole chunk, S = T - 7 in total.

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
    """Yield the episodes of a version folder, shard by shard; frames stay encoded.

    Raises:
        PipelineError: if a checksum is wrong or a feature that OFT reads is missing; it names the file and the record.
    """
    features = info_of(folder).features
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
    """Return the samples that OFT trains on.

    Return `None` if OFT skips the episode: it has no instruction, or fewer than 8 steps.
    """
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
    """Map the columns of ``values`` (T, D) from [q01, q99] to [-1, 1] and clip them; a constant column becomes 0.

    If ``figures`` has a mask, columns outside the mask keep their values (the gripper).
    """
    low, high, smallest, largest = (np.asarray(figures[name]) for name in ("q01", "q99", "min", "max"))
    mask = np.asarray(figures.get("mask", [True] * values.shape[1]))
    scaled = np.clip(2 * (values - low) / (high - low + 1e-8) - 1, -1, 1)
    return np.where(smallest == largest, 0.0, np.where(mask, scaled, values)).astype(np.float32)


def check(folder: Path, statistics: Mapping[str, Any], size_px: int = SIZE_PX) -> dict[str, Any]:
    """Read a dataset as OFT would and report counts and violations, JSON-serialisable.

    Args:
        statistics: content of ``dataset_statistics.json``: dataset to its statistics.
        size_px: height and width of the frames.

    Returns:
        Dictionary with these keys. If ``statistics`` lacks the dataset, it has ``violations`` only. If OFT would train
        on no episode, it has ``episodes`` and ``violations`` only.

        * ``episodes``, ``steps`` and ``chunks`` (training samples): counts.
        * ``passed_by``: number of episodes that OFT would not use.
        * ``clipped_share``: share of the arm's normalised action entries that are equal to a bound.
        * ``statistics_difference``: largest difference between the measured statistics and ``statistics``.
        * ``violations``: texts.
    """
    stored = statistics.get(folder.parent.name)
    if stored is None:
        return {"violations": ["dataset_statistics.json lacks this dataset"]}
    violations: list[str] = []
    motions: list[exact_statistics.Motion] = []
    samples: list[int] = []
    episodes = clipped = 0
    for episode in read(folder):
        episodes += 1
        faults = list(_faults(episode, size_px))
        violations += [f"{episode.name}: {fault}" for fault in faults]
        if faults:
            continue
        motions.append((episode.action, episode.state))
        trained = trajectory(episode, stored)
        if trained is not None:
            samples.append(len(trained))
            clipped += int((np.abs(trained.actions[:, 0, :6]) == 1).sum())
    if not samples:
        return {
            "episodes": episodes,
            "violations": [*violations, "has no episode to train on, so OFT would wait for ever"],
        }
    if _closes_on_open(motions):
        violations.append("fingers open after a command to close: the command's sign is wrong")
    measured = exact_statistics.openvla(motions)
    difference = _difference(measured, stored)
    if not difference <= SAME:
        violations.append(f"dataset_statistics.json differs from the data by up to {difference:g}")
    return {
        "episodes": episodes,
        "steps": measured["num_transitions"],
        "chunks": sum(samples),
        "passed_by": episodes - len(samples),
        "clipped_share": round(clipped / (6 * sum(samples)), 4),
        "statistics_difference": difference,
        "violations": violations,
    }


def check_all(rlds: Path, statistics_file: Path, size_px: int = SIZE_PX) -> dict[str, dict[str, Any]]:
    """Check every dataset below a folder against ``dataset_statistics.json``; keys are dataset names.

    Raises:
        PipelineError: if there is no dataset, or if a file cannot be read.
    """
    folders = datasets(rlds)
    statistics = read_json(statistics_file)
    return {folder.parent.name: check(folder, statistics, size_px) for folder in folders}


def _faults(episode: Recorded, size_px: int) -> Iterator[str]:
    """Yield a text for each fault of an episode."""
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
        wrong = sum(not _is_frame(frame, size_px) for frame in frames)
        if wrong or len(frames) != steps:
            yield f"{view}: {wrong} of {len(frames)} frames are not {(size_px, size_px, 3)} JPEG, {steps} expected"


def _is_frame(data: bytes, size_px: int) -> bool:
    """Return whether an encoded image is a square RGB JPEG of a size."""
    try:
        with Image.open(io.BytesIO(data)) as image:  # reads the header only
            return (image.format, image.mode, image.size) == ("JPEG", "RGB", (size_px, size_px))
    except OSError:  # no image, or one that is cut short
        return False


def _closes_on_open(motions: Sequence[exact_statistics.Motion]) -> bool:
    """Return whether the gripper's command has the wrong sign.

    The sign is wrong if the fingers, in sum over all turns of the command, follow it the other way round: they open
    after it turns positive and close after it turns negative.
    """
    moved = 0.0
    for action, state in motions:
        command, gap = np.sign(action[:, -1]), state[:, 6] - state[:, 7]
        for turn in np.flatnonzero(np.diff(command)) + 1:
            moved += float(command[turn] * (gap[min(turn + SETTLED, len(gap) - 1)] - gap[turn]))
    return moved > 0


def _difference(measured: Mapping[str, Any], stored: Mapping[str, Any]) -> float:
    """Return the largest absolute difference between two entries of ``dataset_statistics.json``.

    The difference is infinite if shapes differ, or if a stored value is missing or NaN.
    """
    largest = 0.0
    for name, value in measured.items():
        reference = stored.get(name)
        if isinstance(value, Mapping):
            difference = _difference(value, reference) if isinstance(reference, Mapping) else np.inf
        elif (
            reference is None or np.shape(value) != np.shape(reference) or np.isnan(np.asarray(reference, float)).any()
        ):
            difference = np.inf
        else:
            difference = float(np.abs(np.asarray(value, float) - np.asarray(reference, float)).max())
        largest = max(largest, difference)
    return largest
