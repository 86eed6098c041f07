"""Reader and checks of RLDS sets without TensorFlow."""

import json
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline.episode_schema import MATRICES, SCHEMA, Content
from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import Edition, edition
from pipeline.formats.base import ManifestRow
from pipeline.formats.read_back import Copy, Fault, in_both_splits, subtasks_of, too_many_episodes, unlike, wrong_splits
from pipeline.formats.rlds_layout import VERSION, dataset_of, datasets, split_of
from pipeline.formats.rlds_write import features
from pipeline.formats.rlds_write import texts as rlds_texts
from pipeline.formats.tfrecord import METADATA, OVERHEAD_BYTES, columns, info_of, record_at, records, spans
from pipeline.types import Episode, Geometry

MARKS = ("is_first", "is_last", "is_terminal", "reward", "discount")
"""Columns that distinguish steps."""

Place = tuple[Path, int]
"""Shard, and index in the shard."""


def open_all(root: Path) -> None:
    """Open every set by TFDS.

    Raises:
        PipelineError: when TFDS fails, or no set exists.
    """
    for folder in datasets(root):
        _info(folder)


def check(
    root: Path, kept: Mapping[str, ManifestRow], content: Content, validation: float = 0.0
) -> Iterator[tuple[str, Fault]]:
    """Compare the metadata of the sets with the content of their files.

    The check covers the feature tree of this version, and every field of ``dataset_info.json`` that readers use. All
    shards must exist and be complete, and the number of episodes must be that of the kept episodes. No demonstration
    may be in two splits.
    """
    stored = 0
    present = {file.parent.parent.name for file in root.glob("*/*/dataset_info.json")}
    for name in sorted(present | {dataset_of(row) for row in kept.values()}):
        folder = root / name / VERSION
        info = _info(folder)
        if info.features.to_json() != features(content).to_json():
            yield "format", Fault("rlds", None, f"features.json of {name} differs", "that of this version")
        counts: dict[str, int] = {}
        for shard in sorted(folder.glob("*.tfrecord-*")):
            try:
                counts[shard.name] = sum(1 for _ in spans(shard))
            except PipelineError as error:
                yield "readable", Fault("rlds", None, str(error), "a whole file")
        for shard_name, length in _lengths(info).items():
            if shard_name in counts and counts[shard_name] != length:
                expected = f"{length}, as dataset_info.json states"
                yield "readable", Fault("rlds", None, f"{shard_name} has {counts[shard_name]} records", expected)
        yield from (("format", fault) for fault in _wrong_info(folder, info, counts, content))
        stored += sum(counts.values())
    yield from too_many_episodes("rlds", stored, len(kept))
    yield from wrong_splits("rlds", {split_of(file) for file in root.glob("*/*/*.tfrecord-*")}, validation)
    # The check ``place`` ensures that each episode is in the shard of its row.
    splits_of = {episode_id: split_of(Path(row["rlds_shard"])) for episode_id, row in kept.items()}
    yield from in_both_splits("rlds", splits_of, kept)


def _lengths(info: Any) -> dict[str, int]:
    """Return the number of episodes of each shard, by the shard's name, as ``dataset_info.json`` states it."""
    lengths: dict[str, int] = {}
    for split_info in info.splits.values():
        lengths |= dict(zip(split_info.filenames, split_info.shard_lengths, strict=True))
    return lengths


def _wrong_info(folder: Path, info: Any, counts: Mapping[str, int], content: Content) -> Iterator[Fault]:
    """Compare ``dataset_info.json`` of a set with its shards.

    Args:
        folder: version folder of the set.
        info: TFDS's information about the set.
        counts: name of each complete shard to the number of its records.
        content: content of the episodes.
    """
    name = folder.parent.name
    bytes_of: dict[str, int] = {}
    for shard, count in counts.items():
        split_name = split_of(Path(shard))
        stored = (folder / shard).stat().st_size - OVERHEAD_BYTES * count
        bytes_of[split_name] = bytes_of.get(split_name, 0) + stored
    stated = json.loads((folder / "dataset_info.json").read_text())
    existing = sorted(path.name for path in folder.glob("*.tfrecord-*"))
    read = {
        "name": stated.get("name"),
        "version": stated.get("version"),
        "fileFormat": stated.get("fileFormat"),
        "filepathTemplate": sorted({split.get("filepathTemplate") for split in stated.get("splits", [])}),
        "unlisted shards": sorted({*existing} - _lengths(info).keys()),
        "missing shards": sorted(_lengths(info).keys() - {*existing}),
        "number of bytes": {split.name: split.num_bytes for split in info.splits.values()},
        "description": stated.get("description"),
        "homepage": stated.get("location", {}).get("urls"),
        "citation": stated.get("citation"),
        "license": stated.get("redistributionInfo", {}).get("license"),
    }
    texts = {key: text.strip() for key, text in rlds_texts(content).items()}
    wanted: dict[str, Any] = {
        "name": name,
        "version": VERSION,
        "fileFormat": "tfrecord",
        "filepathTemplate": ["{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"],
        "unlisted shards": [],
        "missing shards": [],
        **texts,
        "homepage": [texts["homepage"]],
    }
    if len(counts) == len(existing):
        wanted["number of bytes"] = bytes_of
    yield from unlike("rlds", read, wanted, f"{name}: ")


def read(root: Path, row: ManifestRow, content: Content) -> Copy | None:
    """Read a kept episode from its place in the manifest or, if that is wrong, from any other place.

    Raises:
        PipelineError: when its record is damaged, or lacks a feature.
    """
    episode_id = row["episode_id"]
    folder = root / dataset_of(row) / VERSION
    place: Place | None = (folder / row["rlds_shard"], row["rlds_index"])
    try:
        steps = _columns(place)
        if steps is None or _id(steps) != episode_id:
            shards = sorted(root.glob("*/*/*.tfrecord-*"))
            place = _places(tuple(map(edition, shards))).get(episode_id)
            steps = _columns(place)
        return None if place is None or steps is None else _copy(steps, place, content)
    except KeyError as error:
        raise PipelineError(f"has no feature {error}", where=f"episode {episode_id}") from error


def _columns(place: Place | None) -> dict[str, Any] | None:
    if place is None:
        return None
    shard, index = place
    record = record_at(shard, index)
    return None if record is None else columns(record, _info(shard.parent).features)


def _id(steps: Mapping[str, Any]) -> str:
    return str(steps[f"{METADATA}episode_id"][0].decode())


@lru_cache(maxsize=1)
def _places(shards: tuple[Edition, ...]) -> dict[str, Place]:
    """Find the place of each episode by its id; in each shard, read the records before the first damaged one."""
    places: dict[str, Place] = {}
    for shard_edition in shards:
        shard = shard_edition.path
        try:
            for index, record in enumerate(records(shard)):
                places[_id(columns(record, _info(shard.parent).features))] = (shard, index)
        except (PipelineError, KeyError):
            continue  # ``check``, or ``read`` of the record, reports the fault.
    return places


def _info(folder: Path) -> Any:
    try:
        return _opened(edition(folder / "dataset_info.json"))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError) as error:
        raise PipelineError(
            f"{type(error).__name__}: {error}", where=folder, expected="a set that TFDS opens", remedy=MAKE_AGAIN
        ) from error


@lru_cache(maxsize=8)
def _opened(info_file: Edition) -> Any:
    info = info_of(info_file.path.parent)
    _lengths(info)  # Raises if the names of the shards do not follow from the stated ones.
    return info


def _geometry(steps: Mapping[str, Any], view: str, content: Content) -> Geometry:
    matrices = {name: steps[f"{METADATA}{view}_{name}"] for name in MATRICES}
    maps = {name: steps[f"observation/{view}_{name}"].tolist() for name in content.maps}
    boxes = steps[f"observation/{view}_boxes"] if "boxes" in content.extras else None
    return Geometry(**matrices, maps=maps, boxes=boxes)


def _as_python_value(value: Any) -> str | int | float:
    return value.decode() if isinstance(value, bytes) else value.item()


def _labels(steps: Mapping[str, Any], name: str) -> list[Any]:
    values = steps[METADATA + name].tolist()
    return [text.decode() for text in values] if SCHEMA.labels[name] == "string" else values


def _copy(steps: Mapping[str, Any], place: Place, content: Content) -> Copy:
    shard, index = place
    instructions = [text.decode() for text in steps["language_instruction"]]
    frames = {view: steps[f"observation/{view}"].tolist() for view in content.views}
    episode = Episode(
        episode_id=_id(steps),
        frames=frames,
        state=steps["observation/state"],
        joint_state=steps["observation/joint_state"],
        action=steps["action"],
        action_absolute=steps["action_absolute"],
        instruction=instructions[0],
        provenance={name: _as_python_value(steps[METADATA + name][0]) for name in content.provenance},
        geometry={view: _geometry(steps, view, content) for view in content.views},
        object_poses=steps["observation/object_poses"] if "object_poses" in content.extras else None,
        instances=json.loads(steps[f"{METADATA}instances"][0]) if content.has_names else (),
        rewrites=_labels(steps, "rewrites"),
        subtasks=subtasks_of(_labels(steps, "subtask_starts"), _labels(steps, "subtask_texts")),
    )
    return Copy(
        dataset="rlds",
        episode=episode,
        instructions=instructions,
        decoded={},
        step_marks={name: steps[name] for name in MARKS},
        place={"rlds_shard": shard.name, "rlds_index": index},
        repeated={"file_path": ("demo_source", _as_python_value(steps[f"{METADATA}file_path"][0]))},
    )
