"""All formats carry the same numbers and extras, and their bytes do not depend on who writes them."""

import json
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import tensorflow_datasets as tfds
import tf_readback
from conftest import Once
from every_set import Written, assert_lerobot_episodes, every_set, lerobot_index, spread, write_all
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import dataset_to_policy_features
from synthetic import (
    EXTRAS,
    IDS,
    REPO,
    SET,
    files,
    loaded_packages,
    records,
    with_extras,
    write_lerobot,
    write_lerobot_v21,
    write_rlds,
)

from pipeline.clients import oft
from pipeline.episode_schema import STANDARD, Content
from pipeline.formats import rlds_write
from pipeline.formats.tfrecord import columns


@pytest.fixture(scope="module")
def written(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    with every_set(once, tmp_path_factory.mktemp("cache")) as sets:
        yield sets


def test_formats_carry_the_same_numbers(written: Written) -> None:
    table = pq.read_table(written.lerobot.root / "data").to_pydict()
    features = tfds.builder_from_directory(written.version).info.features
    for episode_id, place in written.rlds.record().places.items():
        shard, position = place["rlds_shard"], place["rlds_index"]
        record = list(records(written.version / shard))[position]
        steps = tf_readback.columns(features.deserialize_example_np(record))
        index = lerobot_index(written.lerobot)[episode_id]
        rows = [row for row, found in enumerate(table["episode_index"]) if found == index]
        for name, key in (
            ("action", "action"),
            ("action_absolute", "absolute_action"),
            ("state", "observation.state"),
            ("joint_state", "observation.joint_state"),
        ):
            np.testing.assert_array_equal(np.array([table[key][row] for row in rows], np.float32), steps[name])


@pytest.mark.slow
def test_bytes_do_not_depend_on_the_workers(written: Written, tmp_path: Path) -> None:
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        run = partial(spread, executor)
        again = write_all(tmp_path, run=run)
        modules = executor.submit(loaded_packages).result()
    for first, second in zip(vars(written).values(), vars(again).values(), strict=True):
        one, two = files(first.folder), files(second.folder)
        assert one.keys() == two.keys()
        assert [name for name in one if one[name] != two[name]] == []
        assert [name for name, data in two.items() if str(tmp_path).encode() in data] == []
    # Export imports no simulator; TensorFlow would crash a process that renders.
    assert not {"mujoco", "robosuite", "libero", "tensorflow"} & modules


WITHOUT_TORCH = """
import sys, tempfile
from pathlib import Path
import pipeline
from synthetic import IDS, write_lerobot, write_rlds

folder = Path(tempfile.mkdtemp(dir=sys.argv[1]))
write_lerobot(folder)
made = write_rlds(folder)
rows = {}
for name in IDS:
    told = {"episode_id": name, "demo_id": name, "suite": "synthetic", "steps": 1}
    rows[name] = {**made.record().places[name], **told}
assert all(made.read(row) for row in rows.values())
list(made.check(rows, folder))
print(sorted({"torch", "tensorflow", "lerobot"} & sys.modules.keys()))
"""


@pytest.mark.slow
def test_rlds_is_made_and_checked_and_lerobot_written_without_torch(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, str(tmp_path)],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout == "[]\n"


@pytest.mark.slow
def test_extras_are_further_features(written: Written, tmp_path: Path) -> None:
    """Both formats hand out the files and numbers that went in; what is not extra stays as it is without them."""
    rlds = write_rlds(tmp_path, with_extras, extras=EXTRAS)
    lerobot_set = write_lerobot(tmp_path, with_extras, extras=EXTRAS)
    plain, tree = rlds_write.features(STANDARD), rlds_write.features(Content(extras=EXTRAS))
    rows = {name: {**rlds.record().places[name], "episode_id": name, "demo_id": name} for name in IDS}
    for episode_id, row in rows.items():
        source = with_extras(episode_id)
        for copy in (rlds.read(row), lerobot_set.read(row)):
            assert copy is not None
            assert copy.episode.object_poses is not None
            np.testing.assert_array_equal(copy.episode.object_poses, source.object_poses)
            assert tuple(copy.episode.instances) == tuple(source.instances)
            assert {view: seen.maps for view, seen in copy.episode.geometry.items()} == {
                view: seen.maps for view, seen in source.geometry.items()
            }
            for view, seen in source.geometry.items():
                np.testing.assert_array_equal(copy.episode.geometry[view].boxes, seen.boxes)
        shard, place = row["rlds_shard"], row["rlds_index"]
        record = list(records(rlds.folder / SET / "1.0.0" / shard))[place]
        before = columns(list(records(written.version / shard))[place], plain)
        after = columns(record, tree)
        assert before.keys() < after.keys()
        assert [name for name in before if not np.array_equal(before[name], after[name])] == []
        first = next(iter(tree.deserialize_example_np(record)["steps"]))["observation"]
        for name, dtype in (("image_depth", np.uint16), ("wrist_image_segmentation", np.uint8)):
            view, _, extra = name.rpartition("_")
            file = source.geometry[view].maps["depth" if extra == "depth" else "segmentation"][0]
            np.testing.assert_array_equal(first[name][..., 0], cv2.imdecode(np.frombuffer(file, np.uint8), -1))
            assert first[name].dtype == dtype
    assert [found.name for found in oft.read(rlds.folder / SET / "1.0.0")] == IDS
    assert_lerobot_episodes(lerobot_set.root)
    with_, without = (LeRobotDataset(REPO, root=made.root).meta.features for made in (lerobot_set, written.lerobot))
    assert without.items() < with_.items()
    assert dataset_to_policy_features(with_) == dataset_to_policy_features(without), "policies take what they took"
    checks = [*rlds.check(rows, tmp_path), *lerobot_set.check({}, tmp_path)]
    assert [fault for check, fault in checks if check == "format"] == []


def test_modality_names_columns_that_are_there(written: Written, tmp_path: Path) -> None:
    """starVLA's names, and GR00T's for the agent view; only in the layout with the gripper that both expect."""
    assert not (written.lerobot.root / "meta" / "modality.json").exists()
    root = write_lerobot_v21(tmp_path).folder / SET
    modality = json.loads((root / "meta" / "modality.json").read_text())
    features = json.loads((root / "meta" / "info.json").read_text())["features"]
    assert list(modality["state"]) == ["x", "y", "z", "roll", "pitch", "yaw", "pad", "gripper"]
    assert list(modality["action"]) == ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
    for kind, width, column in (("state", 8, "observation.state"), ("action", 7, "action")):
        spans = [(of["start"], of["end"]) for of in modality[kind].values()]
        assert spans == [(k, k + 1) for k in range(width)]
        assert {of["original_key"] for of in modality[kind].values()} == {column}
    agent, wrist = "observation.images.image", "observation.images.wrist_image"
    shown = {name: of["original_key"] for name, of in modality["video"].items()}
    assert shown == {"primary_image": agent, "image": agent, "wrist_image": wrist}
    assert {"observation.state", "action", *shown.values()} <= set(features)
    assert modality["annotation"] == {"human.action.task_description": {"original_key": "task_index"}}
