"""lerobot, as it is installed, streams a dataset and changes its features."""

import shlex
from pathlib import Path
from typing import Any

import draccus
import lerobot.policies.factory  # noqa: F401 - by which policies have names
import numpy as np
import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_tools import add_features, remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from synthetic import IDS, NAME, episode, write_lerobot

from pipeline.clients import recipe
from pipeline.episode_schema import Content
from pipeline.export_config import ExportConfig
from pipeline.formats.lerobot import LeRobotConfig

pytestmark = pytest.mark.slow
KEYS = ("action", "observation.state", "observation.joint_state")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lerobot(tmp_path_factory.mktemp("tools")).root


@pytest.mark.parametrize(("frames", "files"), [("images", 3), ("video", 1)])
def test_streams_every_step_once(tmp_path: Path, frames: str, files: int) -> None:
    """Videos of one file alone: lerobot looks for a step's frame at the step's index in the whole dataset."""
    root = write_lerobot(tmp_path, frames=frames, shards=files).root
    made = [episode(episode_id) for episode_id in IDS]
    items = sorted(StreamingLeRobotDataset(NAME, root=root), key=lambda item: int(item["index"]))
    assert [int(item["index"]) for item in items] == list(range(sum(map(len, made))))
    for key, name in zip(KEYS, ("action", "state", "joint_state"), strict=True):
        expected = np.concatenate([getattr(one, name) for one in made])
        np.testing.assert_array_equal(np.stack([item[key].numpy() for item in items]), expected)
    dataset = LeRobotDataset(NAME, root=root, video_backend="pyav")
    for index in (0, 17, len(dataset) - 1):
        streamed, read = (np.asarray(one["observation.images.image"]) for one in (items[index], dataset[index]))
        if streamed.shape[-1] == 3:  # lerobot 0.4 hands images out as they are stored
            streamed = streamed.transpose(2, 0, 1) / 255
        assert np.abs(streamed - read).max() <= 1.5 / 255, "torchcodec and PyAV round differently"


def test_adds_and_removes_a_feature(root: Path, tmp_path: Path) -> None:
    dataset = LeRobotDataset(NAME, root=root, video_backend="pyav")
    values = np.arange(len(dataset), dtype=np.float32)[:, None]
    spec = {"dtype": "float32", "shape": (1,), "names": None}
    more = add_features(dataset, {"weight": (values, spec)}, output_dir=tmp_path / "more", repo_id="more")
    assert more.meta.features.keys() == dataset.meta.features.keys() | {"weight"}
    fewer = remove_feature(more, "weight", output_dir=tmp_path / "fewer", repo_id="fewer")
    assert fewer.meta.features.keys() == dataset.meta.features.keys()
    for index in (0, len(dataset) - 1):
        assert float(more[index]["weight"]) == index
        for changed in (more, fewer):
            assert changed[index]["task"] == dataset[index]["task"]
            for key in KEYS:
                np.testing.assert_array_equal(changed[index][key].numpy(), dataset[index][key].numpy())


def test_the_recipes_leave_depth_videos_out_of_the_inputs(tmp_path: Path) -> None:
    """As lerobot-train reads the option; by default it passes all videos to a policy."""
    manifest = tmp_path / "manifest"
    manifest.touch()
    # As it is written by lerobot 0.6, where the field is not rejected.
    lerobot = LeRobotConfig(name=NAME).model_copy(update={"depth": "video"})
    export = ExportConfig().model_copy(update={"lerobot": lerobot})
    content = Content(size_px=128, extras=("depth",))
    clients = recipe.build(manifest, [], export, content=content)["clients"]
    for client in ("lerobot_act", "lerobot_pi05", "lerobot_pi0_fast"):
        words = shlex.split(clients[client]["command"])[1:]
        options: Any = draccus.argparsing.parse(TrainPipelineConfig, args=words)
        shapes = {name: tuple(feature.shape) for name, feature in options.policy.input_features.items()}
        assert shapes == {
            "observation.state": (8,),
            "observation.images.image": (3, 128, 128),
            "observation.images.image2": (3, 128, 128),
        }
        assert [*options.policy.image_features] == ["observation.images.image", "observation.images.image2"]


def test_takes_the_words_of_the_recipe(tmp_path: Path) -> None:
    """As lerobot-train reads pi0.5's; SmolVLA's begin with its weights from the hub, where its reader looks first."""
    manifest = tmp_path / "manifest"
    manifest.touch()
    clients = recipe.build(manifest, [], ExportConfig.model_validate({"lerobot": LeRobotConfig(name=NAME)}))["clients"]
    words = shlex.split(clients["lerobot_pi05"]["command"])[1:]
    pi05: Any = draccus.argparsing.parse(TrainPipelineConfig, args=words)
    assert (pi05.dataset.repo_id, pi05.policy.push_to_hub) == (NAME, False)
    assert (pi05.policy.type, pi05.policy.n_action_steps, pi05.steps, pi05.batch_size) == ("pi05", 10, 30000, 64)
    modes = {kind: mode.value for kind, mode in pi05.policy.normalization_mapping.items()}
    assert modes == {"ACTION": "MEAN_STD", "STATE": "MEAN_STD", "VISUAL": "IDENTITY"}
