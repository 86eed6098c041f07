"""What must hold of a run's datasets and manifest as a whole: functions that yield what is off."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import tensorflow_datasets as tfds

from pipeline.episode_schema import SCHEMA
from pipeline.run import manifest, plan
from pipeline.validation import oft_check
from pipeline.validation.checks import Fault
from pipeline.validation.readback import LeRobotSet
from pipeline.writers import lerobot, rlds

Row = Mapping[str, Any]
"""A row of the manifest."""


def counts(data: Path, rows: Sequence[Row]) -> Iterator[Fault]:
    """Every planned row in the manifest; no quota overfilled, and none left open while candidates are left."""
    planned = [row.episode_id for row in plan.read(data / "plan.parquet")]
    if planned != [row["episode_id"] for row in rows]:
        yield Fault("manifest", None, f"{len(rows)} rows", f"the {len(planned)} of the plan, in its order")
    quotas: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        quotas[row["axis"], row["suite"], row["task"]].append(row)
    for (axis, suite, task), members in quotas.items():
        wanted, kept = sum(row["wanted"] for row in members), sum(row["kept"] for row in members)
        left = any(row["reason"] == "reserve_not_needed" for row in members)
        if kept > wanted or (kept < wanted and left):
            yield Fault("manifest", None, f"{kept} episodes of {axis} for {suite}/{task}", f"{wanted}")
    if json.loads((data / "counts.json").read_text()) != manifest.counts(rows):
        yield Fault("manifest", None, "counts.json does not follow from the rows", "the counts that do")


def rlds_format(sets: Sequence[Path]) -> Iterator[Fault]:
    """The feature tree of this version, and all shards there."""
    for folder in sets:
        info = tfds.builder_from_directory(folder).info
        if info.features.to_json() != rlds.features().to_json():
            yield Fault("rlds", None, f"features.json of {info.name} is another", "the one of this version")
        names, found = info.splits[rlds.SPLIT].filenames, {path.name for path in folder.glob("*.tfrecord-*")}
        if set(names) != found:
            yield Fault("rlds", None, f"{info.name} has the shards {sorted(found)}", f"{sorted(names)}")


def rlds_ids(kept: Mapping[str, Row], places: Counter[str]) -> Iterator[Fault]:
    """Every kept episode in RLDS once, and nothing else."""
    for episode_id in sorted({*kept, *places}):
        times = int(episode_id in kept)
        if places[episode_id] != times:
            yield Fault("rlds", episode_id, f"is there {places[episode_id]} times", f"{times}")


def lerobot_format(opened: LeRobotSet, frames: lerobot.Frames) -> Iterator[Fault]:
    """Frame rate, robot, and the columns' names and shapes; the videos' own frame rate."""
    meta = opened.data.meta
    told = {"fps": meta.fps, "robot_type": meta.robot_type}
    wanted: dict[str, Any] = {"fps": SCHEMA.fps_hz, "robot_type": SCHEMA.robot_type}
    for key, spec in lerobot.features(frames).items():
        has = meta.features.get(key, {})
        told[key] = (has.get("dtype"), tuple(has.get("shape", ())), tuple(has.get("names") or ()))
        wanted[key] = (spec["dtype"], tuple(spec["shape"]), tuple(spec["names"]))
    for file in sorted(meta.root.glob("videos/**/*.mp4")):
        name = str(file.relative_to(meta.root))
        with av.open(str(file)) as video:
            told[name], wanted[name] = float(video.streams.video[0].average_rate or 0), SCHEMA.fps_hz
    for key, expected in wanted.items():
        if told[key] != expected:
            yield Fault("lerobot", None, f"{key} is {told[key]}", f"{expected}")


def lerobot_ids(opened: LeRobotSet, kept: Mapping[str, Row]) -> Iterator[Fault]:
    """Every kept episode in LeRobot at the index that the manifest says, and nothing else."""
    steps = sum(row["steps"] for row in kept.values())
    if (opened.data.meta.total_episodes, opened.data.num_frames) != (len(kept), steps):
        what = f"{opened.data.meta.total_episodes} episodes of {opened.data.num_frames} steps"
        yield Fault("lerobot", None, what, f"{len(kept)} of {steps}")
    for episode_id in sorted({*kept, *opened.provenance}):
        found = opened.provenance.get(episode_id, {}).get("episode_index")
        expected = kept[episode_id]["lerobot_episode_index"] if episode_id in kept else None
        if found != expected:
            yield Fault("lerobot", episode_id, f"is at the index {found}", f"{expected}, as the manifest says")


def openvla_oft(statistics: Mapping[str, Any], folder: Path) -> list[Fault]:
    """What would mislead OpenVLA-OFT."""
    name = folder.parent.name
    if name not in statistics:
        return [Fault("rlds", None, f"dataset_statistics.json has nothing on {name}", "its statistics")]
    found = oft_check.check(folder, statistics[name])
    return [Fault("rlds", None, f"{name}: {what}", "what OpenVLA-OFT trains on") for what in found["violations"]]
