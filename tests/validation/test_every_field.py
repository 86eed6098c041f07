"""Every stored field is compared with what it is about: one is changed, and it is found."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic import IDS, SET, episode, records, write_lerobot, write_lerobot_v21, write_rlds

from pipeline.episode_schema import labels_of
from pipeline.errors import PipelineError
from pipeline.formats.base import Format
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.read_back import Fault
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.formats.tfrecord import framed
from pipeline.run.manifest import OWN_VERSION
from pipeline.types import Scene, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS

NAMES = {"lerobot": "synthetic", "lerobot_v21": SET, "rlds": f"{SET}/1.0.0"}
"""Format to the folder of its set."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_lerobot(folder)
    write_lerobot_v21(folder)
    write_rlds(folder)
    return folder


def opened(name: str, written: Path, folder: Path) -> Format[Any]:
    """A copy of a dataset."""
    shutil.copytree(written / name, folder / name)
    shutil.copy(written / f"{name}.json", folder)
    if name == "lerobot":
        return LeRobot(folder, LeRobotConfig(name="synthetic", shards=3))
    if name == "lerobot_v21":
        return LeRobotV21(folder, LeRobotV21Config(name="synthetic", convention="ipec"))
    return Rlds(folder, RldsConfig(name="synthetic", shards=3))


def rows(dataset: Format[Any]) -> dict[str, dict[str, Any]]:
    places = dataset.record().places
    return {one: {**episode(one).provenance, "steps": len(episode(one)), **places.get(one, {})} for one in IDS}


def found(dataset: Format[Any], folder: Path) -> list[str]:
    """What is off with a dataset as a whole, and with its first episode."""
    kept, texts = rows(dataset), []
    try:
        for _, fault in dataset.check(kept, folder / "cache"):
            texts.append(fault.what)
        texts += [fault.what for fault in of_first(dataset, kept, folder)]
    except PipelineError as error:
        texts.append(str(error))
    return texts


def found_in_first(dataset: Format[Any], folder: Path) -> list[str]:
    """Return the faults of the first episode alone, which is faster."""
    try:
        return [fault.what for fault in of_first(dataset, rows(dataset), folder)]
    except PipelineError as error:
        return [str(error)]


def of_first(
    dataset: Format[Any], kept: dict[str, dict[str, Any]], folder: Path, decodes_all_frames: bool = True
) -> list[Fault]:
    source = episode(IDS[0])
    copy = dataset.read(kept[IDS[0]])
    if copy is None:
        return [Fault(dataset.name, IDS[0], "is not in the dataset", "every kept episode")]
    none = np.zeros((0, 0), np.float32)
    actions = source.action.astype(float)
    states = np.zeros((len(source) + 1, 10))
    states[:-1, 1:8] = source.joint_state
    replay = Trajectory("", "open_loop", Scene("", np.zeros(1)), states, actions, none, Verdict(True, "kept"))
    labels = labels_of(source)
    row = {**kept[IDS[0]], **labels, "rewrites": json.dumps(labels["rewrites"]), "kept": True}
    case = Case({**row, "instruction": source.instruction}, source, replay, [copy], None, decodes_all_frames)
    names = ("length", "motion", "instruction", "labels", "provenance", "place", "jpeg", "geometry", "flags", "clock")
    faults = [fault for name in ("statistics", *names) for fault in CHECKS[name].find(case)]
    return [fault for fault in faults if fault.dataset == dataset.name]


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_found_in_what_was_written(name: str, written: Path, tmp_path: Path) -> None:
    assert found(opened(name, written, tmp_path), tmp_path) == []


Path_ = tuple[str | int, ...]


def changed(value: Any, at: Path_, change: Callable[[Any], Any]) -> Any:
    """A JSON value with another one at a place."""
    if not at:
        return change(value)
    value[at[0]] = changed(value[at[0]], at[1:], change)
    return value


def spoil(file: Path, at: Path_, change: Callable[[Any], Any]) -> None:
    """Change a value of a JSON file, or of the first line of a file of such lines."""
    first, *others = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
    file.write_text("\n".join([json.dumps(changed(json.loads(first), at, change)), *others, ""]))


def spoil_table(file: Path, column: str, change: Callable[[Any], Any]) -> None:
    """Change a column's value of the first row of a Parquet file."""
    table = pq.read_table(file)
    cells = table[column].to_pylist()
    cells[0] = change(cells[0])
    place, field = table.schema.get_field_index(column), table.schema.field(column)
    pq.write_table(table.set_column(place, field, pa.array(cells, field.type)), file)


IMAGE, WRIST = "observation.images.image", "observation.images.image2"


def tenth(value: Any) -> Any:
    return (np.array(value) / 10).tolist()


def brighter(value: Any) -> Any:
    return (np.array(value) + 0.15).tolist()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "at", "change", "what"),
    [
        ("meta/stats.json", (IMAGE, "std"), tenth, f"std of {IMAGE}"),
        ("meta/stats.json", (WRIST, "mean"), brighter, f"mean of {WRIST}"),
        ("meta/stats.json", (WRIST, "q50"), tenth, f"q50 of {WRIST}"),
        ("meta/stats.json", ("observation.joint_state", "std"), tenth, "std of observation.joint_state"),
        ("meta/stats.json", ("task_index", "max", 0), lambda number: number + 1, "max of task_index"),
        ("meta/info.json", ("splits",), lambda splits: {"train": "0:4"}, "splits is"),
        ("meta/info.json", ("splits",), lambda splits: {"train": "0:4", "val": "4:6"}, "splits is"),
        ("meta/info.json", ("total_tasks",), lambda number: number + 1, "total_tasks is 3"),
        ("meta/info.json", ("total_episodes",), lambda number: number + 1, "total_episodes is 7"),
        ("meta/info.json", ("total_frames",), lambda number: number + 1, "total_frames is"),
        ("meta/info.json", ("features", IMAGE, "info", "video.codec"), lambda name: "av1", f"{IMAGE} is"),
        ("meta/info.json", ("features", "action", "names", 0), lambda name: "yaw", "action is"),
    ],
)
def test_each_changed_field_of_version_3_is_found(
    file: str, at: Path_, change: Callable[[Any], Any], what: str, written: Path, tmp_path: Path
) -> None:
    dataset = opened("lerobot", written, tmp_path)
    spoil(dataset.root / file, at, change)
    texts = found(dataset, tmp_path)
    assert any(text.startswith(what) for text in texts), texts


@pytest.mark.parametrize("column", [f"stats/{IMAGE}/std", f"stats/{WRIST}/q50", "stats/action/mean", "stats/index/max"])
def test_changed_statistics_of_an_episode_of_version_3_are_found(column: str, written: Path, tmp_path: Path) -> None:
    dataset = opened("lerobot", written, tmp_path)
    spoil_table(min((dataset.root / "meta" / "episodes").rglob("*.parquet")), column, tenth)
    _, name, figure = column.split("/")
    texts = [fault.what for fault in of_first(dataset, rows(dataset), tmp_path)]
    assert any(text.startswith(f"{figure} of {name} is") for text in texts)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_changed_deviation_is_found_in_sampled_frames(factor: float, written: Path, tmp_path: Path) -> None:
    """Of most episodes, only three frames are decoded."""
    dataset = opened("lerobot", written, tmp_path)
    assert of_first(dataset, rows(dataset), tmp_path, decodes_all_frames=False) == []
    table = min((dataset.root / "meta" / "episodes").rglob("*.parquet"))
    spoil_table(table, f"stats/{IMAGE}/std", lambda value: (factor * np.array(value)).tolist())
    os.utime(dataset.root / "meta" / "info.json", ns=(1, 1))
    texts = [fault.what for fault in of_first(dataset, rows(dataset), tmp_path, decodes_all_frames=False)]
    assert [text.startswith(f"std of {IMAGE} is") for text in texts] == [True]


@pytest.mark.slow
@pytest.mark.parametrize("column", ["episode_id", "suite", "axis", "component", "level"])
def test_a_changed_label_by_which_users_select_is_found(column: str, written: Path, tmp_path: Path) -> None:
    dataset = opened("lerobot", written, tmp_path)
    spoil_table(min((dataset.root / "meta" / "episodes").rglob("*.parquet")), column, another)
    texts = found(dataset, tmp_path)
    assert any(text.startswith(f"meta/episodes, {IDS[0]}: {column} is") for text in texts), texts


@pytest.mark.parametrize("file", ["stats.json", "episodes_stats.jsonl"])
@pytest.mark.parametrize("change", [tenth, brighter])
@pytest.mark.parametrize("figure", ["std", "mean", "max"])
def test_changed_image_statistics_of_version_21_are_found(
    figure: str, change: Callable[[Any], Any], file: str, written: Path, tmp_path: Path
) -> None:
    dataset = opened("lerobot_v21", written, tmp_path)
    at = ("stats", IMAGE, figure) if file.endswith("l") else (IMAGE, figure)
    spoil(dataset.folder / SET / "meta" / file, at, change)
    assert any(f"{figure} of {IMAGE} is" in text for text in found(dataset, tmp_path))


def leaves(value: Any, at: Path_ = ()) -> Iterator[Path_]:
    """Places of all values of a JSON object, of lists those of the first entry."""
    if isinstance(value, dict):
        for name, below in value.items():
            yield from leaves(below, (*at, name))
    elif isinstance(value, list):
        yield from leaves(value[0], (*at, 0)) if value else ()
    else:
        yield at


def another(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, list):
        return [another(value[0]), *value[1:]]
    if isinstance(value, str):
        return str(int(value) + 1) if value.isdigit() else f"{value}x"
    return "x" if value is None else value + 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("lerobot_v21", "meta/info.json"),
        ("lerobot_v21", "meta/episodes.jsonl"),
        ("lerobot_v21", "meta/tasks.jsonl"),
        ("lerobot_v21", "meta/modality.json"),
        ("lerobot_v21", "meta/stats_gr00t.json"),
        ("rlds", "dataset_info.json"),
    ],
)
def test_every_value_counts(name: str, file: str, written: Path, tmp_path: Path) -> None:
    """Changed one after another, each is found; so is each that is not there."""
    dataset = opened(name, written, tmp_path)
    path = dataset.folder / NAMES[name] / file
    text = path.read_text()
    places = list(leaves(json.loads(text.splitlines()[0] if path.suffix == ".jsonl" else text)))
    assert len(places) > 1
    passed = []
    for place in places:
        spoil(path, place, another)
        if not found(dataset, tmp_path):
            passed.append(place)
        path.write_text(text)
    assert passed == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("lerobot", "meta/provenance.parquet"),
        ("lerobot", "data/chunk-000/file-000.parquet"),
        ("lerobot_v21", "meta/provenance.parquet"),
        ("lerobot_v21", "data/chunk-000/episode_000000.parquet"),
    ],
)
def test_every_column_counts(name: str, file: str, written: Path, tmp_path: Path) -> None:
    """Changed at the first episode or step, one after another, each is found."""
    dataset = opened(name, written, tmp_path)
    path = dataset.folder / NAMES[name] / file
    # The version of this project is for information only.
    columns = [column for column in pq.read_schema(path).names if column != OWN_VERSION]
    content = path.read_bytes()
    assert len(columns) >= 9
    passed = []
    for number, column in enumerate(columns):
        spoil_table(path, column, another)
        # Readers keep the tables of meta/ until info.json changes.
        os.utime(dataset.folder / NAMES[name] / "meta" / "info.json", ns=(number, number))
        if not (found_in_first(dataset, tmp_path) or found(dataset, tmp_path)):
            passed.append(column)
        path.write_bytes(content)
    assert passed == []


@pytest.mark.parametrize("name", ["lerobot_v21"])
def test_a_provenance_of_episodes_in_another_order_is_found(name: str, written: Path, tmp_path: Path) -> None:
    dataset = opened(name, written, tmp_path)
    path = dataset.folder / NAMES[name] / "meta" / "provenance.parquet"
    table = pq.read_table(path)
    place = table.schema.get_field_index("episode_index")
    reversed_indices = pa.array(table["episode_index"].to_pylist()[::-1], pa.int64())
    pq.write_table(table.set_column(place, table.schema.field(place), reversed_indices), path)
    assert any("episode_index of provenance.parquet is [5, 4" in text for text in found(dataset, tmp_path))


def test_a_changed_path_of_the_demonstration_in_rlds_is_found(written: Path, tmp_path: Path) -> None:
    dataset = opened("rlds", written, tmp_path)
    path = f"demo_source of {IDS[0]}"
    for shard in dataset.folder.rglob("*.tfrecord-*"):
        changed_records = []
        for record in records(shard):
            before, name, after = record.partition(b"episode_metadata/file_path")
            # The same value is also stored as demo_source.
            changed_records.append(before + name + after.replace(path.encode(), b"x" * len(path), 1))
        shard.write_bytes(b"".join(map(framed, changed_records)))
    assert found(dataset, tmp_path) == [f"file_path is '{'x' * len(path)}'"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lerobot", "rlds"])
def test_a_demonstration_in_both_splits_is_found(name: str, tmp_path: Path) -> None:
    """Written with each episode as a demonstration of its own, where it is said that two are of one."""
    from synthetic import episodes, loop

    from pipeline.formats.episodes import Episodes
    from pipeline.run.export import export

    made = episodes()
    known = {one: of._replace(demo=f"libero_spatial/bowl/demo_{k}") for k, (one, of) in enumerate(made.facts.items())}
    dataset: Format[Any] = (
        LeRobot(tmp_path, LeRobotConfig(name="synthetic", shards=3, validation=0.4))
        if name == "lerobot"
        else Rlds(tmp_path, RldsConfig(name="synthetic", shards=3, validation=0.4))
    )
    export(dataset, Episodes(known, made.load), loop)
    kept = rows(dataset)
    for one, row in kept.items():
        row["demo_id"] = known[one].demo
    assert [fault.what for _, fault in dataset.check(kept, tmp_path)] == []
    for label in ("demo_id", "demo_origin_sha256"):
        same = {one: {**row, label: "libero_spatial/bowl/one"} for one, row in kept.items()}
        faults = [(check, fault.what) for check, fault in dataset.check(same, tmp_path)]
        assert faults
        assert all(check == "splits" and "of the same demonstration" in what for check, what in faults)
