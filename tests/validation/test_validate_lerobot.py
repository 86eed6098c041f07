"""Faults of either version of LeRobot are found, and nothing where nothing was planted."""

import json
import shutil
from collections.abc import Callable
from contextlib import chdir, suppress
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.compute.pool import loop
from pipeline.config import Config, load
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats.lerobot import LeRobot, LeRobotV21, LeRobotV21Config
from pipeline.formats.lerobot.video import Video
from pipeline.formats.read_back import Fault
from pipeline.run import manifest
from pipeline.run.dataset_basis import episodes_of
from pipeline.run.export import export
from pipeline.run.run import Run
from pipeline.validation.validate import EpisodesJob

Rows = list[dict[str, Any]]

VERSIONS = ("lerobot", "lerobot_v21")
KEYS = {"lerobot": "observation.images.image2", "lerobot_v21": "observation.images.wrist_image"}
"""Version to its key of the wrist view."""


@pytest.fixture(scope="module")
def exported(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the run that has LeRobot v2.1 too, in IPEC's convention."""
    folder = tmp_path_factory.mktemp("exported")
    shutil.copytree(finished, folder / "data" / "tiny")
    with chdir(folder):
        config = with_v21(finished)
        options = config.export.options_for(LeRobotV21)
        assert options is not None
        dataset = LeRobotV21(config.run_folder, options)
        export(dataset, episodes_of(dataset, Run(config)), loop)
    return folder


def with_v21(finished: Path) -> Config:
    config = load(finished.parent.parent / "configs" / "tiny.yaml")
    v21 = LeRobotV21Config(name="tiny", convention="ipec")
    return config.model_copy(update={"export": config.export.model_copy(update={"lerobot_v21": v21})})


def checked(version: str, config: Config) -> dict[str, list[Fault]]:
    """What is found in one dataset, by check; nothing is rendered again."""
    run = Run(config).resolved()
    data = run.folder
    kept = {row["episode_id"]: row for row in manifest.read(data / "manifest.parquet") if row["kept"]}
    (dataset,) = (one for one in config.export.datasets(data) if one.name == version)
    results = EpisodesJob(run, [dataset], data, frozenset())(list(kept.values()))
    with suppress(PipelineError):  # An episode says it too.
        for check, fault in dataset.check(kept, data / "cache"):
            results.note(check, [fault])
    return {check: faults for check, faults in results.findings.items() if faults}


def change_lines(file: Path, change: Callable[[Rows], Rows]) -> None:
    rows = change([json.loads(line) for line in file.read_text().splitlines()])
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))


def change_column(file: Path, name: str, change: Callable[[Any], Any]) -> None:
    table = pq.read_table(file)
    values = change(np.array(table[name].to_pylist()))
    place, field = table.schema.get_field_index(name), table.schema.field(name)
    pq.write_table(table.set_column(place, field, pa.array(list(values), field.type)), file)


def swap_videos(root: Path, version: str) -> None:
    folders = [min(root.glob(f"videos/**/{key}")) for key in ("observation.images.image", KEYS[version])]
    one, other = (min(folder.rglob("*.mp4")) for folder in folders)
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


def shift_timestamps(root: Path, version: str) -> None:
    # All but the last: there may be no frame behind that.
    late = np.float32(1 / SCHEMA.fps_hz)
    change_column(min(root.glob("data/*/*")), "timestamp", lambda found: np.append(found[:-1] + late, found[-1]))


def shorten(root: Path, version: str) -> None:
    def change(rows: Rows) -> Rows:
        return [{**rows[0], "length": rows[0]["length"] - 1}, *rows[1:]]

    if version == "lerobot_v21":
        change_lines(root / "meta" / "episodes.jsonl", change)
        return
    file = min((root / "meta" / "episodes").rglob("*.parquet"))
    table = pq.read_table(file)
    pq.write_table(pa.Table.from_pylist(change(table.to_pylist()), schema=table.schema), file)


def lose_a_task(root: Path, version: str) -> None:
    if version == "lerobot_v21":
        change_lines(root / "meta" / "tasks.jsonl", lambda rows: rows[1:])
    else:
        tasks = pd.read_parquet(root / "meta" / "tasks.parquet")
        tasks[1:].to_parquet(root / "meta" / "tasks.parquet")


def change_an_episode(root: Path, version: str) -> None:
    """What lerobot reads of it, and its steps do not say."""
    if version == "lerobot_v21":
        file = root / "meta" / "episodes.jsonl"
        change_lines(file, lambda rows: [{**rows[0], "tasks": ["another"]}, *rows[1:]])
        return
    change_column(min((root / "meta" / "episodes").rglob("*.parquet")), "dataset_to_index", lambda ends: ends + 7)


def change_a_quantile(root: Path, version: str) -> None:
    file = root / "meta" / "stats.json"
    found = json.loads(file.read_text())
    found["action"]["q99"][0] += 0.01
    file.write_text(json.dumps(found))


def bleach(root: Path, version: str) -> None:
    for file in root.glob("videos/**/*.mp4"):
        with av.open(str(file)) as video:
            grey = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
        with Video(file) as again:
            for frame in grey:
                again.add(np.repeat(frame[..., None], 3, axis=2), first=False)


def turn_the_gripper(root: Path, version: str) -> None:
    def change(found: Any) -> Any:
        command = -found[:, 6:] if version == "lerobot" else 1 - found[:, 6:]
        return np.hstack([found[:, :6], command])

    change_column(min(root.glob("data/*/*")), "action", change)


@pytest.mark.parametrize("version", VERSIONS)
def test_nothing_is_found_where_nothing_was_planted(
    version: str, exported: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(exported)
    assert checked(version, with_v21(finished)) == {}


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("plant", "checks"),
    [
        (swap_videos, {"cameras"}),
        (shift_timestamps, {"clock"}),
        (shorten, {"length", "readable"}),
        (lose_a_task, {"readable"}),
        (turn_the_gripper, {"motion"}),
        (change_an_episode, {"readable"}),
        (change_a_quantile, {"format"}),
        (bleach, {"video"}),
    ],
)
def test_faults_of_either_version_are_found(
    version: str,
    plant: Callable[[Path, str], None],
    checks: set[str],
    exported: Path,
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shutil.copytree(exported, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    config = with_v21(finished)
    plant(min(path for path in (config.run_folder / version).iterdir() if path.is_dir()), version)
    found = checked(version, config)
    assert checks & found.keys()
    assert {fault.dataset for faults in found.values() for fault in faults} == {version}


def test_language_columns_are_held_against_what_was_to_be_written(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(finished, tmp_path / "data" / "tiny")
    config = load(finished.parent.parent / "configs" / "tiny.yaml")
    options = config.export.options_for(LeRobot)
    assert options is not None
    # Before 0.6, lerobot cannot read it and a configuration that asks for it is rejected; here lerobot is not asked.
    told = options.model_copy(update={"language": True})
    config = config.model_copy(update={"export": config.export.model_copy(update={"lerobot": told})})
    monkeypatch.chdir(tmp_path)
    dataset = LeRobot(config.run_folder, told)
    export(dataset, episodes_of(dataset, Run(config)), loop)
    job = EpisodesJob(Run(config), [dataset], config.run_folder, frozenset())
    rows = [row for row in manifest.read(config.run_folder / "manifest.parquet") if row["kept"]]
    assert not any(job(rows).findings.values())
    file = min(dataset.root.glob("data/*/*"))
    table = pq.read_table(file)
    place, field = table.schema.get_field_index("language_persistent"), table.schema.field("language_persistent")
    # All say what the last step does.
    pq.write_table(table.set_column(place, field, table[place].take([len(table) - 1] * len(table))), file)
    found = {check: faults for check, faults in job(rows).findings.items() if faults}
    assert found.keys() == {"instruction"}
    assert all(fault.what.startswith("language column of step 0 has") for fault in found["instruction"])
