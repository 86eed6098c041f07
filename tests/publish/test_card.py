"""The card says what the run's files say, its pictures are beside it, and the hub can read its metadata."""

import hashlib
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pytest
import yaml
from conftest import BOWL, MILK, STOVE
from huggingface_hub import DatasetCard

from pipeline.axes import to_json
from pipeline.axes.background import BackgroundAxis, BackgroundPerturbation
from pipeline.axes.base import Perturbation
from pipeline.axes.camera import CameraAxis
from pipeline.axes.language import LanguagePerturbation, deal
from pipeline.axes.layout import LayoutAxis
from pipeline.axes.pose import PoseAxis
from pipeline.config import RenderConfig, ReplayConfig
from pipeline.episode_schema import SCHEMA
from pipeline.export_config import ExportConfig, LeRobotConfig, LeRobotV21Config, RldsConfig
from pipeline.formats.registry import FORMATS, columns, formats_of
from pipeline.publish import card
from pipeline.run import manifest
from pipeline.seeding import rng
from pipeline.types import Extra, Task

NAME = "libero_tiny"
CAMERA = CameraAxis(levels=(4,)).sample(rng("card"), MILK, 0)
BACKGROUND = BackgroundAxis(levels=(2,)).sample(rng("card"), MILK, 0)
LAYOUT = LayoutAxis(levels=(1,)).sample(rng("card"), MILK, 0)


def row(axis: str, *changes: Perturbation, task: Task = MILK, reason: str = "kept", **other: Any) -> dict[str, Any]:
    kept = reason == "kept"
    number = f"{axis}{len(changes)}{task.name}{reason}"
    return {
        "episode_id": number,
        "role": "perturbed" if changes else "twin",
        "suite": task.suite,
        "task": task.name,
        "demo_id": f"{task.suite}/{task.name}/demo_0",
        "demo_origin": "human",
        "axis": axis,
        "perturbations": to_json(list(changes)),
        "kept": kept,
        "reason": reason,
        "chosen": True,
        "replay_mode": "open_loop",
        "steps": 100,
        "gl_device": "llvmpipe" if kept else None,
        "rlds_shard": f"{NAME}-train.tfrecord-00000-of-00001" if kept else None,
        "mujoco_version": "3.2.7",
        **other,
    }


ROWS = [
    row("clean"),
    row("clean", task=STOVE),
    row("camera", CAMERA),
    row("camera", CAMERA, task=STOVE),
    row("background", BACKGROUND),
    row("layout", LAYOUT, replay_mode="tracked"),
    row("layout", LAYOUT, task=STOVE, reason="goal_not_reached"),
    row("layout", LAYOUT, task=STOVE, reason="reserve_not_needed", steps=None),
    row("camera+background", CAMERA, BACKGROUND),
]
COVERAGE = {"test_tasks": 313, "compared": 313, "smallest": 5.379, "median": 6.12, "p90": 7.34, "largest": 8.56}
FINDING = {"rows": 3, "test_tasks": 1599, "comparisons": 4797, "smallest": 5.379, "closest": "e", "clearance": 5.0}
FINDING |= {"not_compared": 0}
DATA_SHA256 = hashlib.sha256(b"data").hexdigest()
VALIDATION: dict[str, dict[str, Any]] = {"gripper": {"checked": 7, "findings": []}}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """The folder of a run, as far as the card reads it."""
    write_rows(tmp_path, ROWS)
    column = list(range(1, 8))
    for name, report in {
        "leakage.json": {
            "camera": FINDING
            | {"measure": "degrees | turned", "overlaps": 0, "verdict": "disjoint", "coverage": {"distance": COVERAGE}},
            # Of the plan, and of no episode that is kept.
            "robot": FINDING | {"measure": "radians", "overlaps": 0, "verdict": "disjoint", "coverage": {}},
        },
        "validation.json": VALIDATION,
        "dataset_statistics.json": {
            NAME: {"action": dict.fromkeys(("mean", "std", "min", "max", "q01", "q99"), column)}
        },
    }.items():
        (tmp_path / name).write_text(json.dumps(report))
    for kind in FORMATS:
        record = {"identity": "", "files": {f"{NAME}/data.bin": DATA_SHA256}, "places": {}}
        (tmp_path / f"{kind.name}.json").write_text(json.dumps(record))
    (tmp_path / "sheets").mkdir()
    for axis in ("camera", "camera+background"):
        (tmp_path / "sheets" / f"{axis}.png").write_bytes(axis.encode())
    (tmp_path / "finetune").mkdir()
    clients = {
        name: {"where": "there", "command": f"train --with {name}"}
        for name in ("openvla_oft", "lerobot_act", "starvla")
    }
    (tmp_path / "finetune" / "finetune.yaml").write_text(yaml.safe_dump({"clients": clients}))
    return tmp_path


def write_rows(data: Path, rows: list[dict[str, Any]], source: Literal["starter", "hdf5"] = "starter") -> None:
    settings = manifest.Settings(source=source, replay=ReplayConfig(), render=RenderConfig())
    table = pa.Table.from_pylist(rows, schema=manifest.schema(columns()))
    manifest.write(table, data / "manifest.parquet", settings)


OPTIONS = ExportConfig(
    rlds=RldsConfig(name=NAME, shards=1),
    lerobot=LeRobotConfig(name=NAME, shards=1),
    lerobot_v21=LeRobotV21Config(name=NAME, convention="ipec"),
)


def write(data: Path, options: ExportConfig = OPTIONS, extras: Sequence[Extra] = ()) -> None:
    card.write(data, formats_of(data, options, extras), NAME)


def test_other_formats_are_named_where_there_are_any(data: Path) -> None:
    assert "the same episodes exist as LeRobot and LeRobot v2.1,\njoined by `episode_id`." in written(data, "rlds")
    card.write(data, formats_of(data, ExportConfig(rlds=RldsConfig(name=NAME), lerobot=None)), NAME)
    alone = (data / "card" / "rlds" / "README.md").read_text()
    assert "This repository holds the RLDS form. `manifest.parquet` has" in alone


def written(data: Path, kind: str, options: ExportConfig = OPTIONS, extras: Sequence[Extra] = ()) -> str:
    write(data, options, extras)
    return (data / "card" / kind / "README.md").read_text()


def metadata_of(text: str) -> dict[str, Any]:
    return dict(yaml.safe_load(DatasetCard(text).data.to_yaml()))


def cells(text: str, first: str, under: str) -> list[str]:
    """The row that begins with ``first`` in the section ``under``."""
    section = text.partition(f"## {under}\n")[2]
    found = re.search(rf"^\| {re.escape(first)} \|(.*)\|$", section, re.MULTILINE)
    assert found, f"no {first} under {under}"
    return [cell.strip() for cell in found[1].split(" | ")]


@pytest.mark.parametrize("kind", [kind.name for kind in FORMATS])
def test_the_hub_reads_the_metadata(data: Path, kind: str) -> None:
    metadata = metadata_of(written(data, kind))
    assert metadata["license"] == "cc-by-4.0"
    assert metadata["task_categories"] == ["robotics"]
    assert ("LeRobot" in metadata["tags"]) == (kind == "lerobot")
    first = metadata["configs"][0]
    assert first["data_files"] == ("data/*/*.parquet" if kind == "lerobot" else "manifest.parquet")


def test_tables_say_what_the_manifest_says(data: Path) -> None:
    text = written(data, "rlds")
    assert "7 episodes (700 steps" in text
    assert cells(text, "axis", "Episodes") == ["libero_object", "libero_goal", "all"]
    assert cells(text, "camera", "Episodes") == ["1", "1", "2"]
    assert cells(text, "layout", "Episodes") == ["1", "0", "1"]
    assert cells(text, "**all**", "Episodes") == ["5", "2", "7"]
    levels = text.partition("By strength")[2]
    assert "| camera | 0 | 0 | 0 | 3 | 0 |" in levels
    assert "| background | 0 | 2 | 0 | 0 | 0 |" in levels
    assert f"{CAMERA.component} (3)" in text
    assert cells(text, "layout", "Yield") == ["2", "2", "1", "50%", "goal_not_reached 1", "tracked 1"]
    assert cells(text, "camera", "Yield") == ["2", "2", "2", "100%", "-", "open_loop 2"]
    assert cells(text, "camera", "Distance to the LIBERO-Plus test set")[-2:] == ["5.38", "disjoint"]
    assert "| camera | distance | 313 | 313 | 5.38 | 6.12 | 7.34 | 8.56 |" in text
    assert "hf download OWNER/NAME" in text
    assert "radians" not in text.partition("## Distance")[2].partition("##")[0]
    assert re.search(rf"regenerate ({'|'.join(row['episode_id'] for row in ROWS if row['kept'])}) --manifest", text)


def test_what_is_left_out_is_not_lost(data: Path) -> None:
    """Nor is what failed of the same kind, also where all of it did."""
    before = written(data, "rlds")
    reasons = ("left_out", "goal_not_reached")
    others = [row("camera", CAMERA, reason=reason, level="1", chosen=False) for reason in reasons]
    write_rows(data, [*ROWS, *others, row("noise", reason="goal_not_reached", chosen=False)])
    assert written(data, "rlds") == before


@pytest.mark.parametrize(("kind", "path"), [("rlds", f"rlds/{NAME}/data.bin"), ("lerobot", "data.bin")])
def test_a_download_can_be_checked(data: Path, tmp_path: Path, kind: str, path: str) -> None:
    write(data)
    download = tmp_path / "download"
    (download / path).parent.mkdir(parents=True)
    (download / path).write_bytes(b"data")
    for file in (data / "manifest.parquet", data / "card" / kind / "SHA256SUMS"):
        shutil.copy(file, download)
    check = ["sha256sum", "--check", "--quiet", "SHA256SUMS"]
    assert subprocess.run(check, cwd=download, check=False).returncode == 0
    (download / path).write_bytes(b"dara")
    assert subprocess.run(check, cwd=download, check=False, capture_output=True).returncode == 1


def test_pictures_are_beside_the_card_and_only_those_that_exist(data: Path) -> None:
    text = written(data, "lerobot")
    shown = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert shown == ["pictures/camera.png", "pictures/camera+background.png"]
    for picture in shown:
        axis = Path(picture).stem
        assert (data / "card" / "lerobot" / picture).read_bytes() == axis.encode()


@pytest.mark.parametrize(
    ("kind", "state", "client", "other"),
    [
        ("rlds", "`state`", "openvla_oft", "starvla"),
        ("lerobot", "`observation.state`", "lerobot_act", "openvla_oft"),
        ("lerobot_v21", "`observation.state`", "starvla", "lerobot_act"),
    ],
)
def test_conventions_and_commands_are_the_formats_own(
    data: Path, kind: str, state: str, client: str, other: str
) -> None:
    text = written(data, kind)
    assert f"**State**, {state} (8)" in text
    for names in (SCHEMA.state.names, SCHEMA.action.names):
        assert ", ".join(names) in text
    view = "`image`" if kind == "rlds" else "`observation.images.image`"
    assert f"relative to the scene's own. Changes {view}." in text
    assert ("1 opens and 0 closes." if kind == "lerobot_v21" else "-1 opens and 1 closes, as LIBERO has it.") in text
    assert f"train --with {client}" in text
    assert f"train --with {other}" not in text


def test_a_failed_check_is_not_hidden(data: Path) -> None:
    assert "The run's datasets were opened again and checked, and passed" in written(data, "rlds")
    failed = VALIDATION | {"rotation": {"checked": 7, "findings": ["episode 3 stands upside down"]}}
    (data / "validation.json").write_text(json.dumps(failed))
    text = written(data, "rlds")
    assert "**rotation failed**" in text
    assert cells(text, "rotation", "Conventions") == ["7", "1 findings, such as: episode 3 stands upside down"]
    assert "and passed" not in text


def test_everything_shown_is_attributed(data: Path) -> None:
    text = written(data, "rlds")
    assert isinstance(BACKGROUND, BackgroundPerturbation)
    for covering in BACKGROUND.coverings:
        assert cells(text, covering.texture, "Licences and attributions")[1] == covering.licence
    for added in LAYOUT.objects:
        assert cells(text, added.name, "Licences and attributions")[2] == added.attribution


@pytest.mark.parametrize(
    ("licence", "free"),
    [("CC-BY-3.0-US", True), ("CC0-1.0", True), ("CC-BY-NC-4.0", False), ("CC-BY-SA-4.0", False), ("mine", False)],
)
def test_a_licence_that_forbids_it_is_not_overruled(data: Path, licence: str, free: bool) -> None:
    coverings = tuple(covering.model_copy(update={"licence": licence}) for covering in BACKGROUND.coverings)
    rows = [*ROWS[:2], row("background", BACKGROUND.model_copy(update={"coverings": coverings}))]
    write_rows(data, rows)
    text = written(data, "rlds")
    assert metadata_of(text)["license"] == ("cc-by-4.0" if free else "other")
    assert ("licensed under [CC BY 4.0]" in text) == free


def test_demonstrations_of_own_tasks_are_not_attributed_to_libero(data: Path) -> None:
    own = [row(one["axis"], suite="my_suite") for one in ROWS[:1]]
    write_rows(data, own, "hdf5")
    text = written(data, "lerobot")
    metadata = metadata_of(text)
    assert metadata["license"] == "other"
    assert "source_datasets" not in metadata
    for claim in ("Liu, Zhu", "yifengzhu-hf", "human", "LIBERO demonstration", "LIBERO's wording", "[CC BY 4.0]"):
        assert claim not in text
    assert "1 recorded demonstrations of 1 tasks went in" in text
    assert "**Demonstrations and tasks of my_suite**: of whoever published this dataset" in text
    # Beside LIBERO's, both are named.
    write_rows(data, [*own, row("clean", task=STOVE)], "hdf5")
    text = written(data, "lerobot")
    metadata = metadata_of(text)
    assert metadata["license"] == "other"
    assert metadata["source_datasets"] == ["yifengzhu-hf/LIBERO-datasets"]
    assert "**Demonstrations of LIBERO's tasks**: [LIBERO]" in text
    assert "tasks of my_suite" in text


def test_only_the_starter_sets_demonstrations_are_called_human(data: Path) -> None:
    assert "2 human demonstrations of 2 tasks" in written(data, "rlds")
    write_rows(data, ROWS, "hdf5")
    text = written(data, "rlds")
    assert "2 recorded demonstrations of 2 tasks" in text
    assert "Whether the publisher's files are LIBERO's own was not checked." in text
    assert metadata_of(text)["license"] == "cc-by-4.0"


def test_rewrites_of_another_bank_are_not_licensed(data: Path) -> None:
    shipped = deal(STOVE)[0]
    write_rows(data, [row("clean", task=STOVE), row("language", shipped, task=STOVE)])
    text = written(data, "rlds")
    assert "that made this dataset are under MIT.\n" in text
    assert metadata_of(text)["license"] == "cc-by-4.0"
    own = LanguagePerturbation(component="paraphrase", level=1, text="please turn that stove on for me")
    write_rows(data, [row("clean", task=STOVE), row("language", own, task=STOVE)])
    text = written(data, "rlds")
    assert "others are of\n  whoever published it, and their licence is not known here." in text
    assert metadata_of(text)["license"] == "other"


LEROBOT_COLUMNS = [f"camera.{view}.{name}" for view in ("agent", "wrist") for name in ("depth", "segmentation")]
NAMES = {
    "rlds": ["image_depth", "wrist_image_depth", "image_segmentation", "wrist_image_segmentation"],
    "lerobot": LEROBOT_COLUMNS,
    "lerobot_v21": LEROBOT_COLUMNS,
}


@pytest.mark.parametrize("kind", NAMES)
def test_what_is_beside_the_frames_is_described_where_it_is_there(data: Path, kind: str) -> None:
    plain = written(data, kind)
    for matrix in ("intrinsics", "extrinsics"):
        views = ("image", "wrist_image") if kind == "rlds" else ("camera.agent", "camera.wrist")
        assert all(f"`{view}{'_' if kind == 'rlds' else '.'}{matrix}`" in plain for view in views)
    assert "fx is negative" in plain
    assert ("`episode_metadata`" if kind == "rlds" else "`meta/provenance.parquet`:") in plain
    full = written(data, kind, extras=("depth", "segmentation", "object_poses"))
    for name in (*NAMES[kind], "object_poses", "instances"):
        assert f"`{name}`" in full
        assert f"`{name}`" not in plain
    assert "uint16 PNG as base64 text" in full or kind == "rlds"
    assert "65535 is 6.5535 m or more;\n  a unit is 0.0001 m." in full
    assert "`instances`" in written(data, kind, extras=("segmentation",))
    assert "`instances`" not in written(data, kind, extras=("depth",))


def test_a_language_column_and_who_can_open_it_are_named(data: Path) -> None:
    # As it is written by lerobot 0.6, where the field is not refused.
    lerobot = LeRobotConfig(name=NAME).model_copy(update={"language": True})
    text = written(data, "lerobot", ExportConfig(rlds=None).model_copy(update={"lerobot": lerobot}))
    assert "`language_persistent`" in text
    assert "before 0.6 cannot open" in text
    assert "0.6" not in written(data, "lerobot")


@pytest.mark.parametrize(
    ("kind", "words"),
    [("rlds", "the split `val` of each set"), ("lerobot", "`meta/info.json`"), ("lerobot_v21", "end in `_val`")],
)
def test_a_validation_split_is_named(data: Path, kind: str, words: str) -> None:
    assert "For validation" not in written(data, kind)
    split = {one: options.model_copy(update={"validation": 0.2}) for one, options in OPTIONS.formats.items()}
    told = written(data, kind, OPTIONS.model_copy(update=split)).partition("For validation, 20 % of")[2]
    assert words in told.partition("## Episodes")[0]


def test_what_was_not_compared_is_counted(data: Path) -> None:
    leakage = json.loads((data / "leakage.json").read_text())
    leakage["camera"] |= {"not_compared": 3, "verdict": "unknown"}
    (data / "leakage.json").write_text(json.dumps(leakage))
    text = written(data, "rlds")
    distance = cells(text, "axis", "Distance to the LIBERO-Plus test set")
    assert cells(text, "camera", "Distance to the LIBERO-Plus test set")[distance.index("not_compared")] == "3"
    assert "`unknown` means that no row could be compared, `disjoint where compared` that some could not." in text


def test_each_kind_of_an_axis_is_described_with_its_own_components(data: Path) -> None:
    moved = [PoseAxis(components=(one,)).sample(rng("card", one), BOWL, 0) for one in ("scene", "target")]
    for order in (moved, moved[::-1]):
        write_rows(data, [row("clean"), *(row("pose", one, level=str(place)) for place, one in enumerate(order))])
        pose = written(data, "rlds").partition("### pose\n")[2].partition("##")[0]
        assert re.search(r"Every object and fixture moved .*\nComponents: scene \(1\)\.\n", pose)
        assert re.search(r"One object moved .*\nComponents: target \(1\)\.\n", pose)


def test_the_command_that_makes_an_episode_again_has_the_demonstrations(data: Path) -> None:
    assert "--demos" not in written(data, "rlds")
    write_rows(data, ROWS, "hdf5")
    text = written(data, "rlds")
    assert "--manifest manifest.parquet --demos DIR --out again\n" in text
    assert "demos expand" not in text
    write_rows(data, [one | {"demo_origin": "expanded"} for one in ROWS], "hdf5")
    assert "the very files that `demos expand` wrote" in written(data, "rlds")
