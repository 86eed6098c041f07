"""LeRobot datasets store each action as a delta and as a goal; policies train on the one that was chosen."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.configs.types import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import dataset_to_policy_features
from synthetic import IDS, NAME, episode, episodes, loop

from pipeline.episode_schema import SCHEMA
from pipeline.formats.lerobot import LeRobot, LeRobotConfig
from pipeline.run.export import export


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "trained", "other"),
    [
        ("delta", "action", "absolute_action"),
        ("absolute", "action_absolute", "delta_action"),
    ],
)
def test_policies_train_on_the_chosen_actions(choice: str, trained: str, other: str, tmp_path: Path) -> None:
    options = LeRobotConfig.model_validate({"name": NAME, "action": choice})
    target = LeRobot(tmp_path, options)
    export(target, episodes(), loop)
    written = [episode(episode_id) for episode_id in IDS]
    expected = np.concatenate([getattr(source, trained) for source in written])
    untrained = "action_absolute" if choice == "delta" else "action"
    expected_of_other = np.concatenate([getattr(source, untrained) for source in written])
    dataset = LeRobotDataset(NAME, root=target.root, video_backend="pyav")
    np.testing.assert_array_equal(np.stack(dataset.hf_dataset.with_format("numpy")["action"]), expected)
    np.testing.assert_array_equal(np.stack(dataset.hf_dataset.with_format("numpy")[other]), expected_of_other)
    features = dataset_to_policy_features(dataset.meta.features)
    assert [name for name, feature in features.items() if feature.type is FeatureType.ACTION] == ["action"]
    assert dataset.meta.features["action"]["names"] == list(getattr(SCHEMA, trained).names)
    np.testing.assert_allclose(dataset.meta.stats["action"]["mean"], expected.mean(axis=0), atol=1e-6)
    rows = {
        source.episode_id: {"episode_id": source.episode_id, "demo_id": "task/demo", "steps": len(source)}
        for source in written
    }
    assert [fault.what for _, fault in target.check(rows, tmp_path / "cache")] == []
    for source in written:
        copy = target.read(rows[source.episode_id])
        assert copy is not None
        np.testing.assert_array_equal(copy.episode.action, source.action)
        np.testing.assert_array_equal(copy.episode.action_absolute, source.action_absolute)
