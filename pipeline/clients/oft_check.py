"""Whether OpenVLA-OFT would train on a dataset as it was meant: a part of `python -m pipeline check`."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from pipeline.clients import oft
from pipeline.episode_schema import SCHEMA
from pipeline.files import read_json
from pipeline.formats import exact_statistics

SAME = 1e-9
"""Largest difference between statistics read back and those stored; both are computed in double precision."""

SETTLED = 5
"""Steps (a quarter of a second) after which the fingers have clearly followed a turn of the command."""


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
    for episode in oft.read(folder):
        episodes += 1
        faults = list(_faults(episode))
        violations += [f"{episode.name}: {fault}" for fault in faults]
        if faults:
            continue
        motions.append((episode.action, episode.state))
        if (trained := oft.trajectory(episode, stored)) is not None:
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


def check_run(data: Path) -> dict[str, dict[str, Any]]:
    """Check every dataset below ``data/rlds`` against ``data/dataset_statistics.json``; keys are dataset names.

    Raises:
        PipelineError: when there is no dataset, or a file that cannot be read.
    """
    folders = oft.datasets(data / "rlds")
    known = read_json(data / "dataset_statistics.json", "dvc repro manifest")
    return {folder.parent.name: check(folder, known) for folder in folders}


def _faults(episode: oft.Recorded) -> Iterator[str]:
    """What would stop OFT, or have it train on something else than was meant."""
    steps = len(episode.action)
    if steps < oft.CHUNK:
        yield f"has {steps} steps, fewer than a chunk of {oft.CHUNK}"
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
    """Largest absolute difference between two entries of ``dataset_statistics.json``; infinite when shapes differ."""
    largest = 0.0
    for name, value in measured.items():
        other = stored.get(name)
        if isinstance(value, Mapping):
            off = _difference(value, other) if isinstance(other, Mapping) else np.inf
        elif other is None or np.shape(value) != np.shape(other):
            off = np.inf
        else:
            off = float(np.abs(np.asarray(value, float) - np.asarray(other, float)).max())
        largest = max(largest, off)
    return largest
