"""Every image, number, id and statistic of either version of LeRobot is read back and held against what went in."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic import IDS, episode, write_lerobot, write_lerobot_v21

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.lerobot import LeRobot, LeRobotV21
from pipeline.formats.read_back import Fault
from pipeline.types import Episode, Scene, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

WITH_IMAGES: dict[str, Callable[[Path], LeRobot | LeRobotV21]] = {
    "v3.0": partial(write_lerobot, frames="images"),
    "v2.1": partial(write_lerobot_v21, convention="openpi"),
}


def replay_of(source: Episode) -> Trajectory:
    """A replay whose joints are those of an episode."""
    states = np.zeros((len(source) + 1, 10))
    states[:, 0] = np.arange(len(states)) / SCHEMA.fps_hz
    states[:-1, 1:8] = source.joint_state
    none = np.zeros((len(states), 0), np.float32)
    scene = Scene("", states[0])
    return Trajectory("", "open_loop", scene, states, source.action.astype(float), none, Verdict(True, "kept"))


def put(file: Path, column: str, value: Any) -> None:
    """Into the last step of a data file."""
    table = pq.read_table(file)
    place, field = table.schema.get_field_index(column), table.schema.field(column)
    cells = [*table[column].to_pylist()[:-1], value]
    pq.write_table(table.set_column(place, field, pa.array(cells, field.type)), file)


@pytest.mark.parametrize("version", WITH_IMAGES)
def test_every_image_file_is_read_back(version: str, tmp_path: Path) -> None:
    dataset, source = WITH_IMAGES[version](tmp_path), episode(IDS[-1])
    copy = dataset.read(source.provenance)
    assert copy is not None
    assert copy.episode.frames == source.frames
    other = {"bytes": source.frames["wrist_image"][0], "path": None}
    put(max(dataset.folder.glob("*/data/**/*.parquet")), dataset.keys["wrist_image"], other)
    copy = dataset.read(source.provenance)
    assert copy is not None
    (fault,) = CHECKS["jpeg"].find(Case({}, source, replay_of(source), [copy], None))
    assert fault.what == f"wrist_image differs at 1 steps, first at {len(source) - 1}"


def stored_otherwise(text: str) -> str:
    """Statistics with another mean of an action."""
    found = json.loads(text)
    stats = found.get("stats", found)
    name = next(name for name in stats if name.startswith("action"))
    stats[name]["mean"][2] += 1e-3
    return json.dumps(found)


def of_first(dataset: LeRobot | LeRobotV21) -> list[Fault]:
    """What is found in the statistics of the first episode, as ``validate`` finds it."""
    source = episode(IDS[0])
    copy = dataset.read(source.provenance)
    assert copy is not None
    return list(CHECKS["statistics"].find(Case({}, source, replay_of(source), [copy], None)))


@pytest.mark.slow
@pytest.mark.parametrize("version", WITH_IMAGES)
def test_ids_and_numbers_of_steps_and_statistics_are_read(version: str, tmp_path: Path) -> None:
    dataset = WITH_IMAGES[version](tmp_path)
    kept = {one: {**episode(one).provenance, "steps": len(episode(one))} for one in IDS}
    assert list(dataset.check(kept, tmp_path)) == []
    for file in dataset.folder.glob("*/meta/*stats.json*"):
        first, *others = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
        file.write_text("\n".join([stored_otherwise(first), *others]))
        (fault,) = (
            (fault for _, fault in dataset.check(kept, tmp_path)) if file.suffix == ".json" else of_first(dataset)
        )
        assert f"mean of {dataset.keys['action']} is" in fault.what
        file.write_text("\n".join([first, *others]))
    data = max(dataset.folder.glob("*/data/**/*.parquet"))
    whole = data.read_bytes()
    for column, value in (("episode_id", IDS[0]), ("index", 0), ("episode_index", 0)):
        put(data, column, value)
        with pytest.raises(PipelineError, match=f"by {column}, these are not the {len(episode(IDS[-1]))} steps"):
            dataset.read(kept[IDS[-1]])
        data.write_bytes(whole)
    assert dataset.read(kept[IDS[-1]]) is not None
