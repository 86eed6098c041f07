"""Replays that missed their goal are sets of their own, where they are asked for, and nothing else changes."""

import json
import shutil
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from short_runs import run_stages, tiny_config
from synthetic import IDS, NAME, episode, episodes, loop

from pipeline.config import load
from pipeline.episode_schema import STANDARD
from pipeline.files import checksum, read_json
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.registry import places
from pipeline.formats.tfrecord import METADATA, columns, records
from pipeline.run import manifest
from pipeline.run.cleaning import PARTS
from pipeline.run.export import export
from pipeline.run.layout import DATASETS
from pipeline.run.run import Run
from pipeline.stages import write_inputs
from pipeline.types import Episode, Scene, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS
from pipeline.validation.validate import EpisodesJob
from pipeline.validation.verify import verify

STAGES = ("inputs", "render", "exports", "manifest", "validate")


def sums(data: Path) -> dict[str, str]:
    """Of all frames and datasets but those of failures."""
    files = (file for name in ("frames", "rlds", "lerobot") for file in (data / name).rglob("*") if file.is_file())
    return {str(file.relative_to(data)): checksum(file) for file in files if file.name != "index.parquet"}


@pytest.fixture(scope="module")
def asked(finished: Path, short_demos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's folder after all formats were asked for with failures."""
    folder = tmp_path_factory.mktemp("asked")
    shutil.copytree(finished, folder / "data" / "tiny")
    run_stages(folder, with_failures(short_demos), STAGES)
    return folder / "data" / "tiny"


def with_failures(short_demos: Path) -> dict[str, Any]:
    config = tiny_config(short_demos)
    v21 = {"name": "tiny", "convention": "ipec"}
    return config | {"export": config["export"] | {"lerobot_v21": v21, "failures": True}}


def test_each_format_has_the_failures_with_their_reason(asked: Path) -> None:
    rows = manifest.read(asked / "manifest.parquet")
    missed = {row["episode_id"]: row for row in rows if row["reason"] in ("goal_not_reached", "goal_lost")}
    assert missed
    assert not any(row["kept"] for row in missed.values())
    said = {}
    for shard in (asked / "failures" / "rlds").glob("libero_tiny_failures_*/*/*.tfrecord*"):
        builder_dir = shard.parent
        for record in records(shard):
            steps = columns(record, features_of(builder_dir))
            episode_id = steps[f"{METADATA}episode_id"][0].decode()
            said[episode_id] = (bool(steps[f"{METADATA}success"][0]), steps[f"{METADATA}reason"][0].decode())
            assert not steps["reward"].any()
            assert not steps["is_terminal"].any()
            assert steps["is_last"].tolist() == [0] * (missed[episode_id]["steps"] - 1) + [1]
    assert said == {episode_id: (False, row["reason"]) for episode_id, row in missed.items()}
    for name in ("lerobot/tiny_failures", "lerobot_v21/tiny_failures_object"):
        (file,) = (asked / "failures" / name).glob("meta/provenance.parquet")
        listed = pq.read_table(file).to_pylist()
        assert {row["episode_id"]: (row["success"], row["reason"]) for row in listed} == said
        assert all(row["path_m"] > 0 for row in listed)
        root = asked / "failures" / name
        info = json.loads((root / "meta" / "info.json").read_text())
        assert info["features"]["is_success"] == {"dtype": "bool", "shape": [1], "names": None}
        marks = pq.read_table(root / "data", columns=["is_success"])
        assert marks.schema.field("is_success").type == pa.bool_()
        assert marks["is_success"].to_pylist() == [False] * info["total_frames"]
    read = LeRobotDataset("failures", root=asked / "failures" / "lerobot" / "tiny_failures", video_backend="pyav")
    assert not any(read[step]["is_success"].item() for step in (0, len(read) - 1))
    info = json.loads((asked / "lerobot" / "tiny" / "meta" / "info.json").read_text())
    assert "is_success" not in info["features"]


def features_of(folder: Path) -> Any:
    import tensorflow_datasets as tfds

    return tfds.builder_from_directory(folder).info.features


def test_validate_checks_them_and_finds_a_success_among_them(asked: Path, tmp_path: Path) -> None:
    report = json.loads((asked / "validation.json").read_text())
    rows = manifest.read(asked / "manifest.parquet")
    missed = [row for row in rows if row["reason"] in ("goal_not_reached", "goal_lost")]
    assert report["flags"]["checked"] == sum(row["kept"] for row in rows) + len(missed)
    shutil.copytree(asked.parents[1], tmp_path, dirs_exist_ok=True)
    with chdir(tmp_path):
        config = load(Path("configs/tiny.yaml"))
        file = config.run_folder / "failures" / "lerobot" / "tiny_failures" / "meta" / "provenance.parquet"
        table = pq.read_table(file)
        succeeded = pa.array([True] * len(table))
        place = table.schema.get_field_index("success")
        pq.write_table(table.set_column(place, table.schema.field("success"), succeeded), file)
        sets = config.export.failure_datasets(config.run_folder, config.render.content)
        job = EpisodesJob(Run(config), sets, tmp_path / "cache", frozenset(), of_failures=True)
        found = job([missed[0] | places(sets)[missed[0]["episode_id"]]]).findings
    told = {check: {fault.dataset for fault in faults} for check, faults in found.items() if faults}
    assert told == {"provenance": {"lerobot"}}


def test_another_mark_of_success_is_found(tmp_path: Path) -> None:
    content = STANDARD.including("outcome")
    for target in (
        LeRobot(tmp_path, LeRobotConfig(name=NAME, shards=1), content),
        LeRobotV21(tmp_path, LeRobotV21Config(name=NAME, convention="ipec"), content),
    ):
        export(target, episodes(of_failure), loop)
        row = {**of_failure(IDS[0]).provenance, "kept": False}
        none = np.zeros((0, 0), np.float32)
        replay = Trajectory("", "open_loop", Scene("", np.zeros(1)), np.zeros(0), np.zeros(0), none, Verdict(False, ""))
        copy = target.read(row)
        assert copy is not None
        assert list(CHECKS["flags"].find(Case(row, of_failure(IDS[0]), replay, [copy], None))) == []
        (fault,) = CHECKS["flags"].find(Case(row | {"kept": True}, of_failure(IDS[0]), replay, [copy], None))
        assert (fault.dataset, fault.what) == (target.name, "is_success of step 0 is 0")


def of_failure(episode_id: str) -> Episode:
    """Return a synthetic episode with the outcome of a failure."""
    source = episode(episode_id)
    return replace(source, provenance={**source.provenance, "success": False, "reason": "goal_not_reached"})


def test_check_misses_a_lost_set_of_failures(asked: Path, tmp_path: Path) -> None:
    shutil.copytree(asked.parents[1], tmp_path, dirs_exist_ok=True)
    with chdir(tmp_path):
        run = Run(load(Path("configs/tiny.yaml")))
        assert not any(result["damaged"] for result in verify(run, loop).values())
        (run.folder / "failures" / "lerobot.json").unlink()
        shutil.rmtree(run.folder / "failures" / "rlds")
        (run.folder / "failures" / "rlds.json").unlink()
        results = verify(run, loop)
    lost = {name: result["damaged"] for name, result in results.items() if result["damaged"]}
    assert lost.keys() == {"failures/lerobot", "failures/rlds"}
    assert all("there is no finished dataset" in told for (told,) in lost.values())


def test_a_damaged_set_of_failures_leaves_the_record_of_the_others(asked: Path, tmp_path: Path) -> None:
    shutil.copytree(asked.parents[1], tmp_path, dirs_exist_ok=True)
    with chdir(tmp_path):
        config = load(Path("configs/tiny.yaml"))
        (failed,) = (
            one
            for one in config.export.failure_datasets(config.run_folder, config.render.content)
            if one.name == "rlds"
        )
        write_inputs(Run(config))
        assert failed.record_file.relative_to(config.run_folder).as_posix() in read_json(config.run_folder / DATASETS)
        next(failed.folder.rglob("*.tfrecord*")).write_bytes(b"damaged")
        write_inputs(Run(config))
        assert not failed.record_file.exists()
        assert not (config.run_folder / DATASETS).exists(), "so that DVC starts the exports"
        assert {name for name in PARTS["rlds"].names if (config.run_folder / name).exists()} == {
            "rlds",
            "rlds.json",
            "failures/rlds",
        }


def test_nothing_else_changes_and_what_is_not_asked_for_any_more_is_not_kept(
    asked: Path, finished: Path, short_demos: Path, tmp_path: Path
) -> None:
    before = sums(finished)
    assert before.items() < sums(asked).items()
    shutil.copytree(asked, tmp_path / "data" / "tiny")
    run_stages(tmp_path, tiny_config(short_demos), ["inputs", "render"])
    assert sums(tmp_path / "data" / "tiny") == before
