"""Six synthetic episodes as RLDS, as LeRobot with videos and with images, and the samples that lerobot must return."""

import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import datasets
import numpy as np
import pytest
from conftest import Once
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray
from synthetic import IDS, NAME, REPO, SET, episode, episodes, loop

from pipeline.formats.lerobot import LeRobot, LeRobotConfig
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.run.export import export

MIN_PSNR_DB = 36.0


def pixels(jpeg: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


def psnr_db(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(np.float64) - b) ** 2)))


@dataclass(frozen=True)
class Written:
    """The datasets of six episodes in each format."""

    rlds: Rlds
    lerobot: LeRobot
    images: LeRobot

    @property
    def version(self) -> Path:
        """Return the version folder of the RLDS set."""
        return self.rlds.folder / SET / "1.0.0"


def sets_in(out: Path) -> Written:
    return Written(
        Rlds(out, RldsConfig(name=NAME, shards=3)),
        LeRobot(out, LeRobotConfig(name=NAME, shards=3)),
        LeRobot(out / "images", LeRobotConfig(name=NAME, shards=3, frames="images")),
    )


def write_all(out: Path, run: Any = loop) -> Written:
    every = sets_in(out)
    for dataset in (every.rlds, every.lerobot, every.images):
        export(dataset, episodes(), run)
    return every


def write_offline(folder: Path) -> None:
    """Write all sets without a network and without a trace in the cache of ``datasets``."""

    def reject(*_: object) -> None:
        raise AssertionError("a writer reached for the network")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", folder / "cache")
        patch.setattr(socket.socket, "connect", reject)
        write_all(folder / "out")
    assert not (folder / "cache").exists()
    names = ["images", "lerobot", "lerobot.json", "rlds", "rlds.json"]
    assert sorted(path.name for path in (folder / "out").iterdir()) == names


@contextmanager
def every_set(once: Once, cache: Path) -> Iterator[Written]:
    """Yield the sets that all modules share; ``datasets`` reads them through a separate cache."""
    out = once("every_set", write_offline) / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", cache)
        yield sets_in(out)


def spread(
    executor: ProcessPoolExecutor, fn: Callable[[Any], Any], items: Sequence[Any], description: str
) -> list[Any]:
    return list(executor.map(fn, items))


def lerobot_index(dataset: LeRobot) -> dict[str, int]:
    return {episode_id: place["lerobot_episode_index"] for episode_id, place in dataset.record().places.items()}


def assert_lerobot_episodes(folder: Path, *, exact: bool = False) -> None:
    """Assert that lerobot returns the episodes; frames are equal if ``exact``, else within ``MIN_PSNR_DB``."""
    dataset = LeRobotDataset(REPO, root=folder, video_backend="pyav")
    assert (dataset.num_episodes, dataset.fps, dataset.meta.robot_type) == (len(IDS), 20, "panda")
    assert dataset.num_frames == sum(len(episode(episode_id)) for episode_id in IDS)
    start = 0
    for index, source in enumerate(map(episode, IDS)):
        row = dataset.meta.episodes[index]
        assert row["length"] == len(source)
        # lerobot 0.6.1 selects by these in its ``episode_filter``.
        for name in ("episode_id", "suite", "axis", "component", "level"):
            assert row[name] == source.provenance[name]
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
            for decoded_frame, frame in zip(decoded, source.frames[view], strict=True):
                if exact:
                    np.testing.assert_array_equal(decoded_frame, pixels(frame))
                else:
                    assert psnr_db(decoded_frame, pixels(frame)) > MIN_PSNR_DB
