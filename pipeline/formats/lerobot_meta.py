"""Checks of the files of ``meta/`` that both versions of LeRobot have."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import av

from pipeline.episode_schema import SCHEMA
from pipeline.formats.lerobot_columns import Convention
from pipeline.formats.lerobot_video import INFO
from pipeline.formats.read_back import Fault, unlike


def as_json(value: Any) -> Any:
    """Convert a value to the value that a JSON file returns for it."""
    return json.loads(json.dumps(value))


def described(convention: Convention, extras: Sequence[Any]) -> dict[str, Any]:
    """Describe the columns as ``meta/info.json`` should, videos with the properties of their encoding."""
    columns = {}
    for name, description in convention.columns(extras).items():
        encoding = {"info": INFO} if description["dtype"] == "video" else {}
        columns[name] = {**description, **encoding}
    return columns


def wrong_tasks(dataset: str, tasks: Sequence[Mapping[str, Any]], used: Sequence[str]) -> Iterator[Fault]:
    """Compare the numbered tasks with the instructions of the episodes."""
    numbers, texts = [row["task_index"] for row in tasks], [row["task"] for row in tasks]
    yield from unlike(dataset, {"tasks": sorted(texts)}, {"tasks": sorted(set(used))})
    yield from unlike(dataset, {"task_index": numbers}, {"task_index": [*range(len(tasks))]})


def wrong_modality(
    dataset: str, root: Path, features: Mapping[str, Mapping[str, Any]], convention: Convention
) -> Iterator[Fault]:
    """Compare ``meta/modality.json`` with the columns: parts cover a vector in order, and views are the cameras."""
    modality = json.loads((root / "meta" / "modality.json").read_text())
    pose = ["x", "y", "z", "roll", "pitch", "yaw"]
    for name, spec, parts in (
        ("state", SCHEMA.state, [*pose, "pad", "gripper"]),
        ("action", SCHEMA.action, [*pose, "gripper"]),
    ):
        column = convention.name(spec.lerobot_key)
        width = features[column]["shape"][0]
        wanted = [(part, k, k + 1, column) for k, part in zip(range(width), parts, strict=True)]
        entries = modality[name].items()
        read = [(part, entry["start"], entry["end"], entry["original_key"]) for part, entry in entries]
        yield from unlike(dataset, {f"{name} of modality.json": read}, {f"{name} of modality.json": wanted})
    views = {view: convention.name(spec.lerobot_key) for view, spec in SCHEMA.views.items()}
    columns = {
        "video": {"primary_image": views["image"], **views},
        "annotation": {"human.action.task_description": "task_index"},
    }
    for name, wanted_keys in columns.items():
        keys = {part: entry["original_key"] for part, entry in modality[name].items()}
        yield from unlike(dataset, {f"{name} of modality.json": keys}, {f"{name} of modality.json": wanted_keys})
    yield from unlike(dataset, {"parts of modality.json": [*modality]}, {"parts of modality.json": [*_PARTS]})


_PARTS = ("state", "action", "video", "annotation")


def wrong_video(dataset: str, file: Path, stated: Mapping[str, Any]) -> Iterator[Fault]:
    """Compare a video with the properties that ``meta/info.json`` states."""
    with av.open(str(file)) as video:
        stream = video.streams.video[0]
        read = {
            "video.height": stream.height,
            "video.width": stream.width,
            "video.codec": stream.codec_context.name,
            "video.pix_fmt": stream.codec_context.pix_fmt,
            "video.fps": float(stream.average_rate or 0),
            "has_audio": bool(video.streams.audio),
        }
    yield from unlike(dataset, read, {name: stated[name] for name in read}, f"{file.parent.name}/{file.name}: ")
