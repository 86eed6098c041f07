"""A validation split has whole demonstrations, and lerobot's tools keep the episodes' ids."""

import base64
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import lerobot.policies.factory  # noqa: F401 - by which policies have names
import numpy as np
import pyarrow.parquet as pq
import pytest
import tensorflow_datasets as tfds
from checkout import link_testset
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.factory import make_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from short_runs import datasets_in, run_stages, tiny_config
from synthetic import EXTRAS, IDS, NAME, SET, episode, loop, with_extras, write_lerobot

from pipeline.clients import recipe
from pipeline.clients.files import OPENPI_ASSETS
from pipeline.errors import PipelineError
from pipeline.export_config import ExportConfig, Where
from pipeline.formats.episodes import EpisodeFacts, Episodes, split
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.formats.tfrecord import METADATA, columns, records
from pipeline.run.export import export
from pipeline.run.foreign import reject_foreign_files

DEMOS = {episode_id: f"libero_spatial/task/demo_{number // 2}" for number, episode_id in enumerate(IDS)}
"""Two episodes of each of three demonstrations."""


@pytest.fixture(scope="module")
def episodes() -> Episodes:
    made = {one: episode(one) for one in IDS}
    known = {
        one: EpisodeFacts("libero_spatial", "content", DEMOS[one], made[one].instruction, len(made[one])) for one in IDS
    }
    return Episodes(known, episode)


def test_a_demonstration_is_on_one_side(episodes: Episodes) -> None:
    splits = episodes.by_split(0.34)
    assert sorted(splits["train"] + splits["val"]) == sorted(IDS)
    assert len(splits["val"]) == 2
    sides = [{DEMOS[episode_id] for episode_id in ids} for ids in splits.values()]
    assert not sides[0] & sides[1]
    assert episodes.by_split(0.0) == {"train": IDS}
    with pytest.raises(PipelineError, match=r"(?s)no task has enough demonstrations.*6 or more"):
        episodes.by_split(0.1)


def test_all_that_was_made_from_one_demonstration_is_on_one_side(episodes: Episodes) -> None:
    """Expanded demonstrations may have bit-identical actions, such as the second and the third here."""
    origins = dict(zip(IDS, ("a", "a", "b", "b", "b", "b"), strict=True))
    known = {one: value._replace(origin=origins[one]) for one, value in episodes.facts.items()}
    for share in (0.3, 0.4, 0.5):
        splits = Episodes(known, episode).by_split(share)
        sides = [{origins[one] for one in ids} for ids in splits.values()]
        assert sorted(map(len, sides)) == [1, 1]
        assert not sides[0] & sides[1]
    with pytest.raises(PipelineError, match="expansions of one demonstration count as one"):
        Episodes({one: value._replace(origin="a") for one, value in known.items()}, episode).by_split(0.5)


def test_split_keeps_order_and_balance() -> None:
    ids = [str(k) for k in range(11)]
    pieces = split(ids, 4)
    assert [name for piece in pieces for name in piece] == ids
    assert sorted(map(len, pieces)) == [2, 3, 3, 3]
    assert split(ids[:2], 4) == [["0"], ["1"]]
    with pytest.raises(PipelineError, match="no episodes to write"):
        Episodes({}, episode).by_split(0.0)


def test_each_suite_of_rlds_must_have_a_validation_split() -> None:
    """OpenVLA-OFT asks each set of a mixture for one."""
    options = ExportConfig.model_validate({"rlds": RldsConfig(name=NAME, validation=0.1), "lerobot": None})
    options.reject_too_few({"libero_goal": 10, "my_suite": 6})
    with pytest.raises(PipelineError, match="no task has enough demonstrations"):
        options.reject_too_few({"libero_goal": 10, "my_suite": 4})
    of_goal = options.model_copy(update={"where": Where(suite=("libero_goal",))})
    of_goal.reject_too_few({"libero_goal": 10, "my_suite": 4})
    of_one = ExportConfig.model_validate({"rlds": None, "lerobot": LeRobotConfig(name=NAME, validation=0.1)})
    of_one.reject_too_few({"libero_goal": 10, "my_suite": 4})


@pytest.mark.parametrize("share", [0.001, 0.01, 0.05, 0.07, 0.1, 0.125, 0.15, 0.2, 0.3, 1 / 3, 0.34, 0.35, 0.5])
def test_as_many_demonstrations_as_a_rejection_asks_for_are_enough_and_one_fewer_is_not(share: float) -> None:
    def splits(demonstrations: int) -> dict[str, list[str]]:
        ids = [f"{number}" for number in range(demonstrations)]
        known = {name: EpisodeFacts("libero_goal", demo=f"libero_goal/task/demo_{name}") for name in ids}
        return Episodes(known, episode).by_split(share)

    with pytest.raises(PipelineError) as caught:
        splits(1)
    (least,) = map(int, re.findall(r"(\d+) or more demonstrations of a task", str(caught.value)))
    assert len(splits(least)["val"]) == 1
    with pytest.raises(PipelineError, match=f"{least} or more"):
        splits(least - 1)


@pytest.mark.slow
def test_too_small_a_share_is_rejected_before_any_work(short_demos: Path, tmp_path: Path) -> None:
    """The milk has two demonstrations, the others one. The last share is another than the plan was made with."""
    link_testset(tmp_path)

    def run_stage(stage: str, share: float) -> None:
        fields = tiny_config(short_demos)
        fields["export"]["lerobot"]["validation"] = share
        run_stages(tmp_path, fields, [stage])

    too_small = (
        r"export\.lerobot\.validation: no task has enough demonstrations for 0\.25 of them"
        r"(?s:.*)3 or more demonstrations of a task"
    )
    with pytest.raises(AssertionError, match=too_small):
        run_stage("plan", 0.25)
    run_stage("plan", 0.26)
    with pytest.raises(AssertionError, match=too_small):
        run_stage("render", 0.25)


def test_tfds_finds_both_splits(episodes: Episodes, tmp_path: Path) -> None:
    export(Rlds(tmp_path, RldsConfig(name=NAME, shards=3, validation=0.34)), episodes, loop)
    info = tfds.builder_from_directory(tmp_path / "rlds" / SET / "1.0.0").info
    assert {name: split.num_examples for name, split in info.splits.items()} == {"train": 4, "val": 2}
    for name, ids in episodes.by_split(0.34).items():
        shards = [tmp_path / "rlds" / SET / "1.0.0" / file for file in info.splits[name].filenames]
        stored = [columns(record, info.features) for shard in shards for record in records(shard)]
        assert [steps[f"{METADATA}episode_id"][0].decode() for steps in stored] == ids


def episode_ids(dataset: LeRobotDataset) -> list[str]:
    """By the column of the frames, in the order of the dataset's own indices."""
    frames = dataset.hf_dataset.with_format(None)
    ids = dict(zip(frames["episode_index"], frames["episode_id"], strict=True))
    return [ids[index] for index in sorted(ids)]


@pytest.fixture(scope="module")
def held_out(episodes: Episodes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of a LeRobot dataset with a validation split."""
    dataset = LeRobot(tmp_path_factory.mktemp("held_out"), LeRobotConfig(name=NAME, shards=3, validation=0.34))
    export(dataset, episodes, loop)
    return dataset.root


@pytest.mark.slow
def test_lerobot_has_the_splits_as_ranges(episodes: Episodes, held_out: Path) -> None:
    assert json.loads((held_out / "meta" / "info.json").read_text())["splits"] == {"train": "0:4", "val": "4:6"}
    splits = episodes.by_split(0.34)
    assert episode_ids(LeRobotDataset(NAME, root=held_out)) == splits["train"] + splits["val"]


@pytest.mark.slow
def test_lerobot_trains_without_what_is_held_out(
    episodes: Episodes, held_out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the recipe's command for ACT, read by lerobot's own parser and opened by its own factory."""
    data = held_out.parents[1]
    (data / "manifest.parquet").touch()
    options = ExportConfig.model_validate(
        {"rlds": None, "lerobot": LeRobotConfig(name=NAME, shards=3, validation=0.34)}
    )
    made = recipe.build(data / "manifest.parquet", [], options)
    recipe.write(made, data / "finetune", options, datasets_in(data))
    commands = {name: client["command"].replace("$DATA", str(data)) for name, client in made["clients"].items()}
    assert len({shlex.split(command)[1] for command in commands.values()}) == 1
    monkeypatch.setattr(sys, "argv", shlex.split(commands["lerobot_act"]))
    config = as_lerobot_train_reads()
    assert (config.policy.type, config.policy.push_to_hub) == ("act", False)
    assert episode_ids(make_dataset(config)) == episodes.by_split(0.34)["train"]


@parser.wrap()
def as_lerobot_train_reads(config: TrainPipelineConfig) -> TrainPipelineConfig:
    return config


@pytest.mark.parametrize(("convention", "name"), [("openpi", NAME), ("ipec", SET)])
def test_what_is_held_out_of_v21_is_a_set_of_its_own(
    episodes: Episodes, convention: Literal["ipec", "openpi"], name: str, tmp_path: Path
) -> None:
    """Its clients read no splits: they neither train on it nor measure it."""
    options = LeRobotV21Config(name=NAME, convention=convention, validation=0.34)
    export(LeRobotV21(tmp_path, options), episodes, loop)
    splits = episodes.by_split(0.34)
    for folder, ids in ((name, splits["train"]), (f"{name}_val", splits["val"])):
        rows = pq.read_table(tmp_path / "lerobot_v21" / folder / "data").to_pylist()
        assert list(dict.fromkeys(row["episode_id"] for row in rows)) == ids
        assert [row["index"] for row in rows] == list(range(len(rows)))
    rlds, lerobot = RldsConfig(name=NAME, shards=1), LeRobotConfig(name=NAME, shards=1)
    formats = ExportConfig.model_validate({"rlds": rlds, "lerobot": lerobot, "lerobot_v21": options})
    recipe.write({}, tmp_path / "finetune", formats, datasets_in(tmp_path))
    reject_foreign_files(tmp_path, ["finetune"])
    if convention == "openpi":
        found = json.loads((tmp_path / "finetune" / OPENPI_ASSETS).read_text())["norm_stats"]
        for key, column in (("actions", "action"), ("state", "state")):
            values = np.concatenate([getattr(episode(one), column) for one in splits["train"]]).astype(np.float64)
            assert np.allclose(found[key]["mean"], values.mean(0), atol=1e-12)
            assert np.allclose(found[key]["std"], values.std(0), atol=1e-12)
    else:
        assert "_val" not in (tmp_path / "finetune" / "starvla_data_config.py").read_text()


@pytest.fixture
def unchanged_scheduling() -> Iterator[None]:
    """Restore the scheduling of this process.

    lerobot's tools encode videos with SVT-AV1, which gives processes of root real-time priority. Other processes of the
    machine would then wait for the remaining tests.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    yield
    os.sched_setscheduler(0, policy, parameters)


@pytest.mark.slow
@pytest.mark.usefixtures("unchanged_scheduling")
def test_lerobots_tools_keep_the_episodes_ids(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, with_extras, extras=EXTRAS).root
    dataset = LeRobotDataset(NAME, root=root)
    assert episode_ids(dataset) == IDS
    fewer = delete_episodes(dataset, [0, 3], output_dir=tmp_path / "fewer", repo_id="fewer")
    assert episode_ids(fewer) == [IDS[index] for index in (1, 2, 4, 5)]
    halves = split_dataset(dataset, {"one": [0, 1, 2], "two": [3, 4, 5]}, output_dir=tmp_path / "halves")
    assert episode_ids(halves["two"]) == IDS[3:]
    merged = merge_datasets([halves["two"], halves["one"]], output_repo_id="merged", output_dir=tmp_path / "merged")
    assert episode_ids(merged) == IDS[3:] + IDS[:3]
    shutil.rmtree(tmp_path / "halves")
    seen = with_extras(IDS[3]).geometry["image"]
    for step in (0, 7):
        assert base64.b64decode(merged[step]["camera.agent.depth"]) == seen.maps["depth"][step]
