"""RLDS has OpenVLA's features and the very bytes of every frame, as TensorFlow and TFDS read it."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tensorflow_datasets as tfds
import tf_readback
from conftest import Once
from every_set import Written, every_set, pixels
from numpy.typing import NDArray
from synthetic import EXTRAS, IDS, MATRICES, SET, episode, records, with_extras, write_rlds

from pipeline.episode_schema import SCHEMA, STANDARD
from pipeline.formats import rlds_write


@pytest.fixture(scope="module")
def written(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    with every_set(once, tmp_path_factory.mktemp("cache")) as sets:
        yield sets


def assert_episodes(read: Sequence[dict[str, NDArray[Any]]]) -> None:
    """What a reader of RLDS must find, whichever reader it is."""
    assert len(read) == len(IDS)
    for found, source in zip(read, map(episode, IDS), strict=True):
        last = np.arange(len(source)) == len(source) - 1
        for name in ("action", "state", "joint_state"):
            assert found[name].dtype == np.float32
            np.testing.assert_array_equal(found[name], getattr(source, name))
        np.testing.assert_array_equal(found["discount"], np.ones(len(source)))
        np.testing.assert_array_equal(found["reward"], last)
        np.testing.assert_array_equal(found["is_last"], last)
        np.testing.assert_array_equal(found["is_terminal"], last)
        np.testing.assert_array_equal(found["is_first"], np.arange(len(source)) == 0)
        assert found["language_instruction"].tolist() == [source.instruction] * len(source)
        for view in SCHEMA.views:
            # TensorFlow decodes JPEG with the fast DCT: one grey level off in the mean, measured 5 at most.
            off = np.abs(found[view].astype(int) - pixels(source.frames[view][0]))
            assert (off.mean() < 1.5, off.max() <= 8) == (True, True)
        metadata = {name.removeprefix("metadata/"): value for name, value in found.items() if "/" in name}
        for view, seen in source.geometry.items():
            np.testing.assert_array_equal(metadata.pop(f"{view}_intrinsics"), seen.intrinsics)
            np.testing.assert_array_equal(metadata.pop(f"{view}_extrinsics"), seen.extrinsics)
        starts, described = metadata.pop("subtask_starts"), metadata.pop("subtask_texts")
        assert list(zip(starts.tolist(), described.tolist(), strict=True)) == [*source.subtasks]
        assert metadata.pop("rewrites").tolist() == [*source.rewrites]
        texts = {name: str(text) for name, text in metadata.items() if name != "instances"}
        said = {name: str(value) for name, value in source.provenance.items()}
        assert texts == {"file_path": said["demo_source"], **said}


@pytest.mark.slow
def test_rlds_features_are_openvlas(written: Written) -> None:
    builder = tfds.builder_from_directory(written.version)
    features = builder.info.features
    assert features.to_json() == rlds_write.features(STANDARD).to_json()
    specs = {
        name: (spec.shape, np.dtype(spec.np_dtype))
        for name, spec in features["steps"].feature.items()
        if name != "observation"
    }
    text = ((), np.dtype(object))
    assert specs == {
        "action": ((7,), np.float32),
        "action_absolute": ((7,), np.float32),
        "discount": ((), np.float32),
        "reward": ((), np.float32),
        "is_first": ((), np.bool_),
        "is_last": ((), np.bool_),
        "is_terminal": ((), np.bool_),
        "language_instruction": text,
    }
    observation = features["steps"].feature["observation"]
    assert {name: (spec.shape, np.dtype(spec.np_dtype)) for name, spec in observation.items()} == {
        "image": ((256, 256, 3), np.uint8),
        "wrist_image": ((256, 256, 3), np.uint8),
        "state": ((8,), np.float32),
        "joint_state": ((7,), np.float32),
    }
    assert observation["image"].encoding_format == "jpeg"
    matrices = {f"{view}_{name}": shape for view in SCHEMA.views for name, shape in MATRICES.items()}
    assert set(features["episode_metadata"]) == {
        "file_path",
        *matrices,
        *SCHEMA.provenance,
        "subtask_starts",
        "subtask_texts",
        "rewrites",
    }
    assert {name: features["episode_metadata"][name].shape for name in matrices} == matrices
    assert {name for name, of in features["episode_metadata"].items() if of.np_dtype == np.int64} == {
        "seed",
        "subtask_starts",
        "touched_steps",
    }
    leaves = [*features["steps"].feature.items(), *observation.items(), *features["episode_metadata"].items()]
    assert [name for name, of in leaves if name != "observation" and not of.doc.desc] == []
    assert all(word in observation["state"].doc.desc for word in ("world", "metres", "radians", "eef_x_m"))
    assert (builder.info.name, str(builder.info.version)) == (SET, "1.0.0")
    assert "LIBERO-Plus" in builder.info.citation
    assert builder.info.homepage
    assert "CC BY 4.0" in (builder.info.redistribution_info.license or "")
    assert builder.info.splits["train"].shard_lengths == [2, 2, 2]


def test_rlds_holds_the_episodes(written: Written) -> None:
    features = tfds.builder_from_directory(written.version).info.features
    shards = sorted(written.version.glob("*.tfrecord-*"))
    assert [shard.name for shard in shards] == [f"{SET}-train.tfrecord-0000{k}-of-00003" for k in range(3)]
    stored = {shard.name: list(records(shard)) for shard in shards}
    for episode_id, place in written.rlds.record().places.items():
        shard, position = place["rlds_shard"], place["rlds_index"]
        # The very bytes of every frame, not a second encoding.
        assert all(frame in stored[shard][position] for view in episode(episode_id).frames.values() for frame in view)
    examples = [features.deserialize_example_np(record) for shard in stored.values() for record in shard]
    assert_episodes([tf_readback.columns(example) for example in examples])
    assert tfds.builder_from_directory(written.version).info.splits["train"].num_bytes == sum(
        len(record) for shard in stored.values() for record in shard
    )
    assert "tensorflow" not in sys.modules


def test_a_set_with_an_episode_too_many_or_a_foreign_shard_is_found(tmp_path: Path) -> None:
    dataset = write_rlds(tmp_path)
    places = {name: {**place, "demo_id": name} for name, place in dataset.record().places.items()}
    assert list(dataset.check(places, tmp_path)) == []
    ((check, fault),) = dataset.check({one: places[one] for one in IDS[1:]}, tmp_path)
    assert (check, fault.what) == ("ids", "has 6 episodes, of which some are foreign or repeated")
    (shard, *_) = sorted(dataset.folder.rglob("*.tfrecord-*"))
    shutil.copy(shard, shard.with_name(f"{SET}-train.tfrecord-00003-of-00003"))
    assert ("format", True) in [
        (check, "00003-of-00003" in fault.what) for check, fault in dataset.check(places, tmp_path)
    ]


@pytest.mark.slow
def test_rlds_reads_with_tensorflow(written: Written, tmp_path: Path) -> None:
    """As it is by default, and with extras."""
    extended = write_rlds(tmp_path, with_extras, extras=EXTRAS).folder / SET / "1.0.0"
    requirements = ["--with", "tensorflow-cpu==2.21.0", "--with", "tensorflow-datasets==4.9.10"]
    script, target = Path(tf_readback.__file__), tmp_path / "read.npz"
    command = ["uv", "run", "--no-project", "--isolated", "--python", "3.11", *requirements, "python", str(script)]
    done = subprocess.run([*command, str(target), str(written.version), str(extended)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("tensorflow")
    saved = np.load(target)
    read = [
        {name.split("/", 1)[1]: saved[name] for name in saved.files if name.startswith(f"{index}/")}
        for index in range(len({name.split("/")[0] for name in saved.files}))
    ]
    assert_episodes(read[: len(IDS)])
    assert_episodes(read[len(IDS) :])
    for episode_id, leaves in zip(IDS, read[len(IDS) :], strict=True):
        source = with_extras(episode_id)
        assert json.loads(str(leaves["metadata/instances"])) == list(source.instances)
        for view, seen in source.geometry.items():
            for extra, maps in seen.maps.items():
                first = cv2.imdecode(np.frombuffer(maps[0], np.uint8), -1)
                np.testing.assert_array_equal(leaves[f"{view}_{extra}"][..., 0], first)
