"""LeRobot hands out what went in, from videos and from images, in few files and in many."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import av
import cv2
import datasets
import lerobot.datasets.aggregate
import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import Once
from every_set import Written, assert_lerobot_episodes, every_set, lerobot_index, pixels, psnr_db
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray
from synthetic import IDS, MATRICES, REPO, episode, write_lerobot

from pipeline.episode_schema import SCHEMA, Content
from pipeline.formats import lerobot as lerobot_format
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.lerobot.columns import FILE_MB
from pipeline.formats.lerobot.video import Video


@pytest.fixture(scope="module")
def written(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    with every_set(once, tmp_path_factory.mktemp("cache")) as sets:
        yield sets


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
        dataset = write_lerobot(tmp_path, frames=frames)
        numbers = [
            sorted(file.stem for file in (dataset.root / kind).rglob("file-*"))
            for kind in ("data", "meta/episodes", *(["videos/observation.images.image2"] if frames == "video" else []))
        ]
        assert len(numbers[0]) > 3
        assert all(found == numbers[0] for found in numbers), "files of one number hold the same episodes"
        assert_lerobot_episodes(dataset.root, exact=frames == "images")
        # Merging finds the files by what the rows of meta/episodes say.
        lerobot.datasets.aggregate.aggregate_datasets([REPO], REPO, roots=[dataset.root], aggr_root=tmp_path / "again")
        assert_lerobot_episodes(tmp_path / "again", exact=frames == "images")


@pytest.mark.parametrize("views", [("image", "wrist_image"), ("image", "wrist_image", "front_image", "side_image")])
def test_a_video_file_has_almost_the_stated_size(views: tuple[str, ...], tmp_path: Path) -> None:
    """Each view has its own file, so the number of views does not change the steps of a file."""
    known = {f"episode-{k}": EpisodeFacts("libero_spatial", demo=f"task/demo_{k}", steps=100) for k in range(3000)}
    dataset = lerobot_format.LeRobot(tmp_path, lerobot_format.LeRobotConfig(name=REPO), Content(views=views))
    pieces = dataset.pieces(Episodes(known, episode))
    measured_kb = 6.7  # The mean frame of ``benchmarks/video_quality.py``.
    sizes_mb = [piece.steps * measured_kb / 1000 for piece in pieces]
    assert len(pieces) == 12
    assert 0.75 * FILE_MB < min(sizes_mb) <= max(sizes_mb) < FILE_MB


def test_lerobot_provenance_has_a_row_for_each_episode(written: Written) -> None:
    for dataset in (written.lerobot, written.images):
        rows = pq.read_table(dataset.root / "meta" / "provenance.parquet").to_pylist()
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
    for dataset in (written.lerobot, written.images):
        assert json.loads((dataset.root / "meta" / "stats.json").read_text()) == json.loads(
            (written.lerobot.root / "meta" / "stats.json").read_text()
        )
        for row, shown in zip(pq.read_table(dataset.root / "meta" / "episodes").to_pylist(), frames, strict=True):
            of_episode = {name.rpartition("/")[2]: value for name, value in row.items() if "image/" in name}
            assert_statistics(of_episode, shown, (0, 1, 2))


@pytest.mark.parametrize("size_px", [66, 98, 250, 256, 510])
def test_a_video_shows_the_frames_of_each_permitted_size(size_px: int, tmp_path: Path) -> None:
    """Frames of a coloured picture that is not symmetric, also of a size that is not a multiple of 4."""
    picture = pixels(episode(IDS[0]).frames["image"][0])
    source = np.asarray(cv2.resize(picture, (size_px, size_px), interpolation=cv2.INTER_AREA), np.uint8)
    frames = [np.roll(source, 2 * shift, axis=1) for shift in range(3)]
    with Video(tmp_path / "video.mp4", Content(size_px=size_px)) as video:
        for frame in frames:
            video.add(frame, first=frame is frames[0])
    with av.open(str(tmp_path / "video.mp4")) as stored:
        shown = [frame.to_ndarray(format="rgb24") for frame in stored.decode(video=0)]
    assert [frame.shape for frame in shown] == [(size_px, size_px, 3)] * 3
    assert min(map(psnr_db, shown, frames)) > 34, "with rows or colours displaced it is below 29"
