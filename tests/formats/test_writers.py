"""Both formats on synthetic episodes: what is read back is what went in, and bad episodes replace nothing."""

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import av
import cv2
import datasets
import lerobot.datasets.aggregate
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tensorflow_datasets as tfds
import tf_readback
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import dataset_to_policy_features
from numpy.typing import NDArray
from synthetic import (
    EXTRAS,
    IDS,
    MATRICES,
    REPO,
    SET,
    episode,
    files,
    loop,
    records,
    with_extras,
    write_lerobot,
    write_lerobot_v21,
    write_rlds,
)

from pipeline.clients import oft
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats import lerobot as lerobot_format
from pipeline.formats import lerobot_v21, rlds_write
from pipeline.formats.episodes import Episodes, split
from pipeline.formats.lerobot import LeRobot
from pipeline.formats.lerobot_v21 import LeRobotV21
from pipeline.formats.rlds import Rlds
from pipeline.formats.tfrecord import columns
from pipeline.types import Episode, Scene, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

MIN_PSNR_DB = 36.0


def pixels(jpeg: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


def psnr_db(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(np.float64) - b) ** 2)))


def spread(
    executor: ProcessPoolExecutor, fn: Callable[[Any], Any], items: Sequence[Any], description: str
) -> list[Any]:
    return list(executor.map(fn, items))


def loaded_packages() -> set[str]:
    return {name.split(".")[0] for name in sys.modules}


@dataclass(frozen=True)
class Written:
    rlds: Rlds
    lerobot: LeRobot
    images: LeRobot

    @property
    def version(self) -> Path:
        """The version folder of the RLDS set."""
        return self.rlds.folder / SET / "1.0.0"


def write_all(out: Path, run: Any = loop) -> Written:
    return Written(
        write_rlds(out, run=run), write_lerobot(out, run=run), write_lerobot(out / "images", run=run, frames="images")
    )


def lerobot_index(target: LeRobot) -> dict[str, int]:
    return {episode_id: place["lerobot_episode_index"] for episode_id, place in target.record().places.items()}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    """All sets, made without a network and without a trace in the cache of ``datasets``."""
    out, cache_folder = tmp_path_factory.mktemp("out"), tmp_path_factory.mktemp("cache") / "datasets"

    def refuse(*_: object) -> None:
        raise AssertionError("a writer reached for the network")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", cache_folder)
        with pytest.MonkeyPatch.context() as offline:
            offline.setattr(socket.socket, "connect", refuse)
            every = write_all(out)
        assert not cache_folder.exists()
        assert sorted(path.name for path in out.iterdir()) == [
            *("images", "lerobot", "lerobot.json", "rlds", "rlds.json")
        ]
        yield every


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
        texts = {name: str(text) for name, text in metadata.items() if name != "instances"}
        said = {name: str(value) for name, value in source.provenance.items()}
        assert texts == {"file_path": said["demo_source"], **said}


@pytest.mark.slow
def test_rlds_features_are_openvlas(written: Written) -> None:
    builder = tfds.builder_from_directory(written.version)
    features = builder.info.features
    assert features.to_json() == rlds_write.features().to_json()
    specs = {
        name: (spec.shape, np.dtype(spec.np_dtype))
        for name, spec in features["steps"].feature.items()
        if name != "observation"
    }
    text = ((), np.dtype(object))
    assert specs == {
        "action": ((7,), np.float32),
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
    assert set(features["episode_metadata"]) == {"file_path", *matrices, *SCHEMA.provenance}
    assert {name: features["episode_metadata"][name].shape for name in matrices} == matrices
    assert {name for name, of in features["episode_metadata"].items() if of.np_dtype == np.int64} == {
        "seed",
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


def assert_lerobot_episodes(folder: Path, *, exact: bool = False) -> None:
    """What lerobot must hand out; frames the very pixels of the stored ones, or within ``MIN_PSNR_DB``."""
    dataset = LeRobotDataset(REPO, root=folder, video_backend="pyav")
    assert (dataset.num_episodes, dataset.fps, dataset.meta.robot_type) == (len(IDS), 20, "panda")
    assert dataset.num_frames == sum(len(episode(episode_id)) for episode_id in IDS)
    start = 0
    for index, source in enumerate(map(episode, IDS)):
        assert dataset.meta.episodes[index]["length"] == len(source)
        items = [dataset[t] for t in range(start, start + len(source))]
        start += len(source)
        assert {int(item["episode_index"]) for item in items} == {index}
        assert {item["task"] for item in items} == {source.instruction}
        np.testing.assert_array_equal([item["frame_index"] for item in items], np.arange(len(source)))
        for key in ("state", "joint_state", "action"):
            name = key if key == "action" else f"observation.{key}"
            np.testing.assert_array_equal(np.stack([item[name] for item in items]), getattr(source, key))
        for key, view in (("image", "image"), ("image2", "wrist_image")):
            decoded = [item[f"observation.images.{key}"].numpy().transpose(1, 2, 0) * 255 for item in items]
            for shown, frame in zip(decoded, source.frames[view], strict=True):
                if exact:
                    np.testing.assert_array_equal(shown, pixels(frame))
                else:
                    assert psnr_db(shown, pixels(frame)) > MIN_PSNR_DB


@pytest.mark.slow
def test_lerobot_holds_the_episodes(written: Written) -> None:
    assert_lerobot_episodes(written.lerobot.root)
    assert lerobot_index(written.lerobot) == {episode_id: index for index, episode_id in enumerate(IDS)}
    info = json.loads((written.lerobot.root / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["features"]["action"]["names"] == list(SCHEMA.action.names)
    assert info["features"]["observation.images.image"]["info"]["video.codec"] == "h264"
    assert info["splits"] == {"train": f"0:{len(IDS)}"}


@pytest.mark.slow
def test_lerobot_images_are_the_stored_frames(written: Written) -> None:
    assert_lerobot_episodes(written.images.root, exact=True)
    assert lerobot_index(written.images) == lerobot_index(written.lerobot)
    info = json.loads((written.images.root / "meta" / "info.json").read_text())
    assert info["features"]["observation.images.image"]["dtype"] == "image"
    assert info["splits"] == {"train": f"0:{len(IDS)}"}
    assert {path.suffix for path in written.images.root.rglob("*") if path.is_file()} == {".parquet", ".json"}
    table = pq.read_table(written.images.root / "data", columns=["observation.images.image2"])
    # Not a second encoding.
    found = [row["bytes"] for row in table["observation.images.image2"].to_pylist()]
    assert found == [frame for episode_id in IDS for frame in episode(episode_id).frames["wrist_image"]]


@pytest.mark.slow
@pytest.mark.parametrize("frames", ["video", "images"])
def test_lerobot_reads_and_merges_many_files(tmp_path: Path, frames: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
        patch.setattr(lerobot_format, "FILE_MB", 0.2)
        target = write_lerobot(tmp_path, frames=frames)
        numbers = [
            sorted(file.stem for file in (target.root / kind).rglob("file-*"))
            for kind in ("data", "meta/episodes", *(["videos/observation.images.image2"] if frames == "video" else []))
        ]
        assert len(numbers[0]) > 3
        assert all(found == numbers[0] for found in numbers), "files of one number hold the same episodes"
        assert_lerobot_episodes(target.root, exact=frames == "images")
        # Merging finds the files by what the rows of meta/episodes say.
        lerobot.datasets.aggregate.aggregate_datasets([REPO], REPO, roots=[target.root], aggr_root=tmp_path / "again")
        assert_lerobot_episodes(tmp_path / "again", exact=frames == "images")


def test_lerobot_provenance_has_a_row_for_each_episode(written: Written) -> None:
    for target in (written.lerobot, written.images):
        rows = pq.read_table(target.root / "meta" / "provenance.parquet").to_pylist()
        assert [{name: row[name] for name in ("episode_index", *SCHEMA.provenance)} for row in rows] == [
            {"episode_index": k, **episode(episode_id).provenance} for k, episode_id in enumerate(IDS)
        ]
        for row, source in zip(rows, map(episode, IDS), strict=True):
            for key, view in (("agent", "image"), ("wrist", "wrist_image")):
                for name, shape in MATRICES.items():
                    matrix = np.array(row[f"camera.{key}.{name}"], np.float32).reshape(shape)
                    np.testing.assert_array_equal(matrix, getattr(source.geometry[view], name))
    assert "level" in rows[0]


def assert_statistics(found: Mapping[str, Any], values: NDArray[Any], axes: int | tuple[int, ...]) -> None:
    """Of all ``values``, over ``axes``; quantiles as a level that occurs, or between two."""
    for name, expected in (
        ("min", values.min(axis=axes)),
        ("max", values.max(axis=axes)),
        ("mean", values.mean(axis=axes)),
        ("std", values.std(axis=axes)),
        ("q01", np.quantile(values, 0.01, axis=axes)),
        ("q50", np.quantile(values, 0.50, axis=axes)),
        ("q99", np.quantile(values, 0.99, axis=axes)),
    ):
        np.testing.assert_allclose(np.ravel(found[name]), expected, atol=1e-6, err_msg=name)
    np.testing.assert_array_equal(np.ravel(found["count"]), [len(values)])


@pytest.mark.slow
def test_lerobot_statistics_are_exact(written: Written) -> None:
    stats = LeRobotDataset(REPO, root=written.lerobot.root, video_backend="pyav").meta.stats
    sources = [episode(episode_id) for episode_id in IDS]
    frames = [np.stack([pixels(frame) for frame in source.frames["image"]]) / 255 for source in sources]
    assert_statistics(stats["action"], np.concatenate([source.action for source in sources]).astype(np.float64), 0)
    assert_statistics(stats["observation.images.image"], np.concatenate(frames), (0, 1, 2))
    assert stats["observation.images.image"]["mean"].shape == (3, 1, 1)
    assert set(stats) >= {"observation.state", "observation.joint_state", "observation.images.image2", "timestamp"}
    for target in (written.lerobot, written.images):
        assert json.loads((target.root / "meta" / "stats.json").read_text()) == json.loads(
            (written.lerobot.root / "meta" / "stats.json").read_text()
        )
        for row, shown in zip(pq.read_table(target.root / "meta" / "episodes").to_pylist(), frames, strict=True):
            of_episode = {name.rpartition("/")[2]: value for name, value in row.items() if "image/" in name}
            assert_statistics(of_episode, shown, (0, 1, 2))


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
rows = {name: {**made.record().places[name], "episode_id": name, "suite": "synthetic", "steps": 1} for name in IDS}
assert all(made.read(row, folder) for row in rows.values())
list(made.check(rows, folder))
print(sorted({"torch", "tensorflow", "lerobot"} & sys.modules.keys()))
"""


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
    plain, tree = rlds_write.features(), rlds_write.features(EXTRAS)
    rows = {episode_id: {**rlds.record().places[episode_id], "episode_id": episode_id} for episode_id in IDS}
    for episode_id, row in rows.items():
        source = with_extras(episode_id)
        for copy in (rlds.read(row, tmp_path / "cache"), lerobot_set.read(row, tmp_path / "cache")):
            assert copy is not None
            assert copy.episode.object_poses is not None
            np.testing.assert_array_equal(copy.episode.object_poses, source.object_poses)
            assert tuple(copy.episode.instances) == tuple(source.instances)
            assert {view: seen.maps for view, seen in copy.episode.geometry.items()} == {
                view: seen.maps for view, seen in source.geometry.items()
            }
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


def truncated(source: Episode, steps: int) -> Episode:
    frames = {view: frames[:steps] for view, frames in source.frames.items()}
    arrays = {name: getattr(source, name)[:steps] for name in ("state", "joint_state", "action")}
    return replace(source, frames=frames, **arrays)


BAD: dict[str, tuple[str, Callable[[Episode], Episode]]] = {
    "empty text": ("instruction", lambda e: replace(e, instruction=" ")),
    "file name": ("instruction", lambda e: replace(e, instruction="put_the_bowl_on_the_plate")),
    "too short": ("action", lambda e: truncated(e, SCHEMA.min_steps - 1)),
    "nan": ("state", lambda e: replace(e, state=np.full_like(e.state, np.nan))),
    "wrong shape": ("joint_state", lambda e: replace(e, joint_state=e.joint_state[:, :6])),
    "wrong dtype": ("state", lambda e: replace(e, state=e.state.astype(np.float64))),
    "out of range": ("action", lambda e: replace(e, action=e.action * 2)),
    "lost frame": (
        "wrist_image",
        lambda e: replace(e, frames={**e.frames, "wrist_image": e.frames["wrist_image"][1:]}),
    ),
    "lost camera": ("geometry", lambda e: replace(e, geometry={})),
    "depth unasked": ("image maps", lambda e: replace(e, geometry=with_extras(e.episode_id).geometry)),
    "lost view": ("frames", lambda e: replace(e, frames={"image": e.frames["image"]})),
    "no image": ("image", lambda e: replace(e, frames={**e.frames, "image": [b"noise"] * len(e)})),
    "cut image": ("image", lambda e: replace(e, frames={**e.frames, "image": [f[:-99] for f in e.frames["image"]]})),
    "lost column": ("provenance", lambda e: replace(e, provenance={"episode_id": e.episode_id})),
    "wrong id": ("provenance", lambda e: replace(e, provenance={**e.provenance, "episode_id": "other"})),
    "no number": ("provenance", lambda e: replace(e, provenance={**e.provenance, "seed": "7"})),
}


def load_spoilt(episode_id: str, spoil: Callable[[Episode], Episode]) -> Episode:
    return spoil(episode(episode_id)) if episode_id == IDS[-1] else episode(episode_id)


@pytest.mark.parametrize("fault", BAD)
def test_rlds_refuses_a_bad_episode(fault: str, tmp_path: Path) -> None:
    field, spoil = BAD[fault]
    with pytest.raises(PipelineError, match=rf"episode {IDS[-1]}: {field} "):
        write_rlds(tmp_path, load=partial(load_spoilt, spoil=spoil))
    assert not (tmp_path / "rlds").exists()
    assert not (tmp_path / "rlds.json").exists()


@pytest.mark.slow
def test_lerobot_refuses_a_bad_episode_and_keeps_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "lerobot").mkdir()
    (tmp_path / "lerobot" / "earlier").write_text("set")
    field, spoil = BAD["nan"]
    with pytest.raises(PipelineError, match=rf"episode {IDS[-1]}: {field} "):
        write_lerobot(tmp_path, load=partial(load_spoilt, spoil=spoil))
    assert files(tmp_path / "lerobot") == {"earlier": b"set"}
    # Of the three pieces the two that are whole stay, for the next time.
    assert [path.name for path in sorted((tmp_path / ".work").rglob("0000*"))] == ["00000", "00001"]
    write_lerobot(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lerobot", "lerobot.json"]


def test_split_keeps_order_and_balance() -> None:
    ids = [str(k) for k in range(11)]
    pieces = split(ids, 4)
    assert [name for piece in pieces for name in piece] == ids
    assert sorted(map(len, pieces)) == [2, 3, 3, 3]
    assert split(ids[:2], 4) == [["0"], ["1"]]
    with pytest.raises(PipelineError, match="no episodes to write"):
        Episodes({}, episode).by_split(0.0)


V21 = {
    "ipec": (SET, "observation.images.image", "observation.images.wrist_image", "observation.state", "action"),
    "openpi": (REPO, "image", "wrist_image", "state", "actions"),
}
"""Convention to its set and its columns."""


@pytest.mark.parametrize("convention", V21)
def test_v21_has_the_conventions_names_and_gripper(convention: str, tmp_path: Path) -> None:
    root = write_lerobot_v21(tmp_path, convention).folder / V21[convention][0]
    _, image, wrist, state, action = V21[convention]
    info = json.loads((root / "meta" / "info.json").read_text())
    lines = {
        name: [json.loads(line) for line in (root / "meta" / f"{name}.jsonl").read_text().splitlines()]
        for name in ("episodes", "episodes_stats", "tasks")
    }
    tasks = {line["task_index"]: line["task"] for line in lines["tasks"]}
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v2.1", 20, len(IDS))
    assert info["total_frames"] == sum(len(episode(one)) for one in IDS)
    before = 0
    for index, source in enumerate(map(episode, IDS)):
        place = {"episode_chunk": 0, "episode_index": index}
        table = pq.read_table(root / info["data_path"].format(**place))
        commands = source.action.copy()
        if convention == "ipec":
            commands[:, 6] = np.where(commands[:, 6] < 0, 1, 0)
        np.testing.assert_array_equal(np.stack(table[action].to_numpy()), commands)
        np.testing.assert_array_equal(np.stack(table[state].to_numpy()), source.state)
        np.testing.assert_array_equal(table["index"].to_numpy(), before + np.arange(len(source)))
        np.testing.assert_allclose(table["timestamp"].to_numpy(), np.arange(len(source)) / 20, atol=1e-6)
        assert {tasks[task] for task in table["task_index"].to_pylist()} == {source.instruction}
        assert lines["episodes"][index]["tasks"] == [source.instruction]
        assert (lines["episodes"][index]["length"], lines["episodes"][index]["episode_id"]) == (len(source), IDS[index])
        assert_close(lines["episodes_stats"][index]["stats"][action], commands)
        for view, key in (("image", image), ("wrist_image", wrist)):
            if convention == "openpi":
                assert [row["bytes"] for row in table[key].to_pylist()] == source.frames[view]
            else:
                shown = decoded(root / info["video_path"].format(video_key=key, **place))
                assert len(shown) == len(source)
                assert min(map(psnr_db, shown, map(pixels, source.frames[view]))) > MIN_PSNR_DB
        before += len(source)
    # Newer versions of datasets call it a List, which those of the clients do not know.
    assert b'"List"' not in pq.read_schema(root / info["data_path"].format(**place)).metadata[b"huggingface"]


def assert_close(found: Mapping[str, Any], values: NDArray[Any]) -> None:
    assert set(found) == {"min", "max", "mean", "std", "count"}
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(found[name], getattr(values.astype(np.float64), name)(axis=0), atol=1e-6)
    assert found["count"] == [len(values)]


def decoded(file: Path) -> list[NDArray[np.uint8]]:
    with av.open(str(file)) as video:
        return [np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) for frame in video.decode(video=0)]


WITH_IMAGES: dict[str, Callable[[Path], LeRobot | LeRobotV21]] = {
    "v3.0": partial(write_lerobot, frames="images"),
    "v2.1": partial(write_lerobot_v21, convention="openpi"),
}


def put(file: Path, column: str, value: Any) -> None:
    """Into the last step of a data file."""
    table = pq.read_table(file)
    place, field = table.schema.get_field_index(column), table.schema.field(column)
    cells = [*table[column].to_pylist()[:-1], value]
    pq.write_table(table.set_column(place, field, pa.array(cells, field.type)), file)


@pytest.mark.parametrize("version", WITH_IMAGES)
def test_every_image_file_is_read_back(version: str, tmp_path: Path) -> None:
    target, source = WITH_IMAGES[version](tmp_path), episode(IDS[-1])
    copy = target.read(source.provenance, tmp_path)
    assert copy is not None
    assert copy.episode.frames == source.frames
    other = {"bytes": source.frames["wrist_image"][0], "path": None}
    put(max(target.folder.glob("*/data/**/*.parquet")), target.keys["wrist_image"], other)
    copy = target.read(source.provenance, tmp_path)
    assert copy is not None
    none = np.zeros((0, 0), np.float32)
    replay = Trajectory("", "open_loop", Scene("", np.zeros(1)), np.zeros(0), np.zeros(0), none, Verdict(True, "kept"))
    (fault,) = CHECKS["jpeg"](Case({}, source, replay, [copy], None))
    assert fault.what == f"wrist_image differs at 1 steps, first at {len(source) - 1}"


def stored_otherwise(text: str) -> str:
    """Statistics with another mean of an action."""
    found = json.loads(text)
    stats = found.get("stats", found)
    name = next(name for name in stats if name.startswith("action"))
    stats[name]["mean"][2] += 1e-3
    return json.dumps(found)


@pytest.mark.parametrize("version", WITH_IMAGES)
def test_ids_and_numbers_of_steps_and_statistics_are_read(version: str, tmp_path: Path) -> None:
    target = WITH_IMAGES[version](tmp_path)
    kept = {one: {**episode(one).provenance, "steps": len(episode(one))} for one in IDS}
    assert list(target.check(kept, tmp_path)) == []
    for file in target.folder.glob("*/meta/*stats.json*"):
        first, *others = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
        file.write_text("\n".join([stored_otherwise(first), *others]))
        ((check, fault),) = target.check(kept, tmp_path)
        assert check == "format"
        assert f"mean of {target.keys['action']} is" in fault.what
        file.write_text("\n".join([first, *others]))
    data = max(target.folder.glob("*/data/**/*.parquet"))
    whole = data.read_bytes()
    for column, value in (("episode_id", IDS[0]), ("index", 0), ("episode_index", 0)):
        put(data, column, value)
        with pytest.raises(PipelineError, match=f"by {column}, these are not the {len(episode(IDS[-1]))} steps"):
            target.read(kept[IDS[-1]], tmp_path)
        data.write_bytes(whole)
    assert target.read(kept[IDS[-1]], tmp_path) is not None


def test_modality_names_columns_that_are_there(written: Written, tmp_path: Path) -> None:
    """In both versions; starVLA's names, and GR00T's for the agent view."""
    for root in (written.lerobot.root, write_lerobot_v21(tmp_path).folder / SET):
        modality = json.loads((root / "meta" / "modality.json").read_text())
        features = json.loads((root / "meta" / "info.json").read_text())["features"]
        assert list(modality["state"]) == ["x", "y", "z", "roll", "pitch", "yaw", "pad", "gripper"]
        assert list(modality["action"]) == ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
        for kind, width in (("state", 8), ("action", 7)):
            spans = [(of["start"], of["end"]) for of in modality[kind].values()]
            assert spans == [(k, k + 1) for k in range(width)]
            assert {of["original_key"] for of in modality[kind].values()} <= set(features)
        assert set(modality["video"]) == {"primary_image", "image", "wrist_image"}
        assert {of["original_key"] for of in modality["video"].values()} <= set(features)
        assert modality["annotation"] == {"human.action.task_description": {"original_key": "task_index"}}


@pytest.mark.slow
@pytest.mark.parametrize("convention", V21)
def test_v21_does_not_depend_on_workers_and_keeps_extras(convention: str, tmp_path: Path) -> None:
    one = write_lerobot_v21(tmp_path / "one", convention, with_extras, extras=EXTRAS)
    with (
        pytest.MonkeyPatch.context() as patch,
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor,
    ):
        patch.setattr(lerobot_v21, "EPISODES_OF_A_PIECE", 1)
        run = partial(spread, executor)
        two = write_lerobot_v21(tmp_path / "two", convention, with_extras, run, EXTRAS)
        # Another number of pieces, and so another identity, but the same files.
        assert files(one.folder) == files(two.folder)
    kept = {episode_id: {"episode_id": episode_id} for episode_id in IDS}
    assert list(two.check(kept, tmp_path)) == []
    for episode_id in IDS:
        source, copy = with_extras(episode_id), two.read(kept[episode_id], tmp_path)
        assert copy is not None
        np.testing.assert_array_equal(copy.episode.action, source.action)
        np.testing.assert_array_equal(copy.episode.object_poses, source.object_poses)
        assert copy.episode.geometry["image"].maps["depth"] == list(source.geometry["image"].maps["depth"])
        np.testing.assert_array_equal(copy.episode.geometry["image"].extrinsics, source.geometry["image"].extrinsics)
