"""A LeRobot v3.0 dataset in IPEC's convention has its columns and its gripper, and else the content of the default."""

from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import dataset_to_policy_features
from numpy.typing import NDArray
from synthetic import IDS, NAME, episode, episodes, loop

from pipeline.config import load
from pipeline.formats.lerobot import LeRobot, LeRobotConfig
from pipeline.run import manifest
from pipeline.run.dataset_basis import episodes_of
from pipeline.run.export import export
from pipeline.run.run import Run
from pipeline.validation.validate import EpisodesJob

V30_NAMES = {"observation.images.wrist_image": "observation.images.image2", "joint_state": "observation.joint_state"}
"""Columns of ``ipec`` to the columns of the default, where they differ."""

ACTIONS = ("action", "absolute_action")


def column(dataset: LeRobotDataset, name: str) -> NDArray[Any]:
    return np.stack(dataset.hf_dataset.with_format("numpy")[name])


def test_lerobot_reads_columns_gripper_and_frames_of_a_real_run(finished: Path, tmp_path: Path) -> None:
    with chdir(finished.parent.parent):
        config = load(Path("configs/tiny.yaml"))
        default = config.export.options_for(LeRobot)
        assert default is not None
        run = Run(config)
        target = LeRobot(tmp_path, default.model_copy(update={"convention": "ipec"}))
        export(target, episodes_of(target, run), loop)
        kept = {row["episode_id"]: row for row in manifest.read(run.manifest_file) if row["kept"]}
        job = EpisodesJob(run, [target], tmp_path / "cache", frozenset())
        places = target.record().places
        rows = [{**row, **places[episode_id]} for episode_id, row in kept.items()]
        assert not any(job(rows).findings.values())
        assert [fault.what for _, fault in target.check(kept, tmp_path / "cache")] == []
    plain = LeRobotDataset("plain", root=finished / "lerobot" / "tiny", video_backend="pyav")
    ipec = LeRobotDataset("ipec", root=target.root, video_backend="pyav")
    assert {V30_NAMES.get(name, name) for name in ipec.meta.features} == set(plain.meta.features)
    assert ipec.meta.stats.keys() == {name for name, of in ipec.meta.features.items() if of["dtype"] != "string"}
    for name in ACTIONS:
        stored, libero = column(ipec, name), column(plain, name)
        np.testing.assert_array_equal(stored[:, :6], libero[:, :6])
        np.testing.assert_array_equal(stored[:, 6], np.where(libero[:, 6] < 0, 1, 0))
        assert {*stored[:, 6].tolist()} == {0.0, 1.0}
        np.testing.assert_allclose(ipec.meta.stats[name]["mean"], stored.mean(axis=0, dtype=np.float64), atol=1e-6)
    # The fingers open (their distance grows) while the command is 1.
    state = column(ipec, "observation.state")
    same_episode = np.diff(column(ipec, "episode_index")) == 0
    moved_m = np.diff(state[:, 6] - state[:, 7])[same_episode]
    commands = column(ipec, "action")[:-1, 6][same_episode]
    assert moved_m[commands == 1].mean() > moved_m[commands == 0].mean()
    for step in (0, len(plain) // 2, len(plain) - 1):
        ours, libero = ipec[step], plain[step]
        assert ours["task"] == libero["task"]
        for name in ipec.meta.features.keys() - {*ACTIONS}:
            np.testing.assert_array_equal(np.asarray(ours[name]), np.asarray(libero[V30_NAMES.get(name, name)]))


@pytest.mark.parametrize("frames", ["video", "images"])
def test_ipec_keeps_frames_and_inputs_in_either_storage(frames: str, tmp_path: Path) -> None:
    options = LeRobotConfig.model_validate(
        {"name": NAME, "shards": 2, "frames": frames, "convention": "ipec", "action": "absolute"}
    )
    target = LeRobot(tmp_path, options)
    export(target, episodes(), loop)
    assert (target.gripper.open, target.gripper.close) == (1.0, 0.0)
    dataset = LeRobotDataset(NAME, root=target.root, video_backend="pyav")
    inputs = dataset_to_policy_features(dataset.meta.features)
    views = {"observation.images.image", "observation.images.wrist_image"}
    assert inputs.keys() == {"observation.state", "action", *views}
    goals = np.concatenate([episode(one).action_absolute for one in IDS])
    goals[:, 6] = np.where(goals[:, 6] < 0, 1, 0)
    np.testing.assert_array_equal(column(dataset, "action"), goals)
    rows = {one: {"episode_id": one, "demo_id": "task/demo", "steps": len(episode(one))} for one in IDS}
    assert [fault.what for _, fault in target.check(rows, tmp_path / "cache")] == []
    for one in IDS:
        copy = target.read(rows[one])
        assert copy is not None
        np.testing.assert_array_equal(copy.episode.action, episode(one).action)
        np.testing.assert_array_equal(copy.episode.action_absolute, episode(one).action_absolute)
        if frames == "images":
            assert copy.episode.frames == episode(one).frames


def test_the_default_convention_keeps_the_identity_of_datasets() -> None:
    assert "convention" not in LeRobotConfig().model_dump()
    assert LeRobotConfig(convention="ipec").model_dump()["convention"] == "ipec"
