"""The card says what the run's files say, its pictures are next to it, and the hub can read its metadata."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from card_of_run import (
    CAMERA,
    LAYOUT,
    NAME,
    OPTIONS,
    ROWS,
    VALIDATION,
    cells,
    metadata_of,
    row,
    write,
    write_files,
    write_rows,
    written,
)
from short_demonstrations import BOWL, MILK, STOVE
from short_runs import run_in

from pipeline.axes.camera import CameraAxis
from pipeline.axes.pose import PoseAxis
from pipeline.episode_schema import SCHEMA
from pipeline.export_config import ExportConfig
from pipeline.formats.hdf5 import Hdf5Config
from pipeline.formats.lerobot import LeRobotConfig
from pipeline.formats.rlds import RldsConfig
from pipeline.publish import card
from pipeline.seeding import rng
from pipeline.testset import benchmark


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_files(tmp_path)
    return tmp_path


def test_other_formats_are_named_where_there_are_any(data: Path) -> None:
    assert "the same episodes exist as LeRobot and LeRobot v2.1, with the same\n`episode_id`." in written(data, "rlds")
    alone = written(data, "rlds", ExportConfig.model_validate({"rlds": RldsConfig(name=NAME), "lerobot": None}))
    assert "This repository has the RLDS format. `manifest.parquet` has" in alone


@pytest.mark.parametrize("kind", OPTIONS.formats)
def test_the_hub_reads_the_metadata(data: Path, kind: str) -> None:
    metadata = metadata_of(written(data, kind))
    assert metadata["license"] == "cc-by-4.0"
    assert metadata["task_categories"] == ["robotics"]
    assert ("LeRobot" in metadata["tags"]) == (kind == "lerobot")
    first = metadata["configs"][0]
    assert first["data_files"] == ("data/*/*.parquet" if kind == "lerobot" else "manifest.parquet")


def test_the_yield_counts_episodes_that_were_not_replayed(data: Path) -> None:
    write_rows(data, [*ROWS, row("layout", LAYOUT, task=BOWL, reason="object_in_collision", steps=None)])
    lost = "goal_not_reached 1, object_in_collision 1"
    assert cells(written(data, "rlds"), "layout", "Yield") == ["3", "2", "1", "33%", lost, "tracked 1"]


def test_tables_say_what_the_manifest_says(data: Path) -> None:
    text = written(data, "rlds")
    assert "7 episodes (700 steps" in text
    assert cells(text, "axis", "Episodes") == ["libero_object", "libero_goal", "all", "wanted"]
    assert cells(text, "camera", "Episodes") == ["1", "1", "2", "2"]
    assert cells(text, "layout", "Episodes") == ["1", "0", "1", "2"]
    assert cells(text, "**all**", "Episodes") == ["5", "2", "7", "8"]
    levels = text.partition("by level, from 1")[2]
    assert "| camera | 0 | 0 | 0 | 3 | 0 |" in levels
    assert "| background | 0 | 2 | 0 | 0 | 0 |" in levels
    assert f"{CAMERA.component} (3)" in text
    assert cells(text, "layout", "Yield") == ["2", "2", "1", "50%", "goal_not_reached 1", "tracked 1"]
    assert cells(text, "camera", "Yield") == ["2", "2", "2", "100%", "-", "open_loop 2"]
    assert cells(text, "camera", "Distance to the LIBERO-Plus test set")[-2:] == ["5.38", "disjoint"]
    assert "hf download OWNER/NAME" in text
    assert "radians" not in text.partition("## Distance")[2].partition("##")[0]
    assert re.search(rf"regenerate ({'|'.join(row['episode_id'] for row in ROWS if row['kept'])}) --manifest", text)


def test_distinct_action_sequences_are_counted_by_task(data: Path) -> None:
    text = written(data, "rlds")
    assert cells(text, str(MILK), "Diversity") == ["5", "2", "4"]
    assert cells(text, str(STOVE), "Diversity") == ["2", "1", "2"]
    assert cells(text, "**all**", "Diversity") == ["7", "3", "6"]


def test_tasks_of_equal_names_in_two_suites_are_two(data: Path) -> None:
    assert "demonstrations of 2 tasks." in written(data, "rlds")
    write_rows(data, [*ROWS, row("clean") | {"suite": "libero_90", "demo_id": f"libero_90/{MILK.name}/demo_0"}])
    assert "demonstrations of 3 tasks." in written(data, "rlds")


def test_distances_are_those_of_the_episodes_in_the_dataset(data: Path) -> None:
    """The file ``leakage.json`` has the distances of the wanted episodes, and some of them are not in the dataset."""
    near = CameraAxis(levels=(1,)).sample(rng("near"), MILK, 0)
    test = benchmark.load()
    components = np.array([one.component for one in test.on_axis("camera")])
    cameras = {"kept": (CAMERA, near), "goal_not_reached": (CAMERA,), "left_out": (CAMERA,)}
    lines = []
    for reason, in_dataset in cameras.items():
        write_rows(data, [*ROWS, row("camera", near, reason=reason, chosen=reason != "left_out")])
        text = written(data, "rlds").partition("## Distance to the LIBERO-Plus test set")[2]
        compared = [camera.distances(test, task) for camera in in_dataset for task in (MILK, STOVE)]
        for component in dict.fromkeys(components.tolist()):
            nearest = np.nanmin(np.stack(compared)[:, components == component], axis=0)
            figures = [f"{figure:.3g}" for figure in np.quantile(nearest, (0, 0.5, 0.9, 1))]
            number = f"{len(nearest):,}"
            lines.append(f"| camera | {component} | {' | '.join([number, number, *figures])} |")
            assert lines[-1] in text
    assert len({*lines}) == 2 * len({*components.tolist()}), "only a kept episode changes the distances"


def test_what_is_left_out_is_not_lost(data: Path) -> None:
    """Nor is what failed of the same kind, also where all of it did. Neither was wanted."""
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


def test_pictures_are_next_to_the_card_and_only_those_that_exist(data: Path) -> None:
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
    assert f"relative to the scene's own. It changes {view}." in text
    assert ("1 opens and 0 closes." if kind == "lerobot_v21" else "-1 opens and 1 closes, as in LIBERO.") in text
    assert f"train --with {client}" in text
    assert f"train --with {other}" not in text


def test_a_failed_check_is_not_hidden(data: Path) -> None:
    assert "The run's datasets were read back and passed all checks" in written(data, "rlds")
    failed = VALIDATION | {"rotation": {"checked": 7, "findings": ["episode 3 stands upside down"]}}
    (data / "validation.json").write_text(json.dumps(failed))
    text = written(data, "rlds")
    assert "**rotation failed**" in text
    assert cells(text, "rotation", "Conventions") == ["7", "1 findings, such as: episode 3 stands upside down"]
    assert "passed all checks" not in text


def test_a_check_that_compared_nothing_is_left_out(data: Path) -> None:
    cards = {}
    for checked in (0, 7):
        report = VALIDATION | {"depth": {"checked": checked, "findings": []}}
        (data / "validation.json").write_text(json.dumps(report))
        cards[checked] = written(data, "rlds").splitlines()
    assert {*cards[7]} - {*cards[0]} == {"| depth | 7 | passed |"}
    assert {*cards[0]} <= {*cards[7]}


LEROBOT_COLUMNS = [f"camera.{view}.{name}" for view in ("agent", "wrist") for name in ("depth", "segmentation")]
NAMES = {
    "rlds": ["image_depth", "wrist_image_depth", "image_segmentation", "wrist_image_segmentation"],
    "lerobot": LEROBOT_COLUMNS,
    "lerobot_v21": LEROBOT_COLUMNS,
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMES)
def test_columns_in_addition_to_the_frames_are_described_where_they_are_there(data: Path, kind: str) -> None:
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


@pytest.mark.parametrize(("views", "all_of_them"), [((), "Both"), (("frontview",), "All")])
def test_frames_that_are_not_turned_are_described_without_a_contradiction(
    data: Path, views: tuple[str, ...], all_of_them: str
) -> None:
    options = OPTIONS.model_copy(update={"hdf5": Hdf5Config(name=NAME)})
    card.write(run_in(data, export=options, render={"views": views}))
    text = (data / "card" / "hdf5" / "README.md").read_text()
    assert f"  {all_of_them} are the simulator's own pictures" in text
    # LIBERO's raw frame begins with its lowest row: columns run with the camera's x, and rows against its y.
    assert "fx is positive and fy is negative" in text
    assert "fx is negative" not in text
    assert f"  {all_of_them} are rotated by 180 degrees" in (data / "card" / "rlds" / "README.md").read_text()


def test_depth_as_video_and_its_readers_are_named(data: Path) -> None:
    # As it is written by lerobot 0.6, where the field is not rejected.
    lerobot = LeRobotConfig(name=NAME).model_copy(update={"depth": "video"})
    config = ExportConfig.model_validate({"rlds": None}).model_copy(update={"lerobot": lerobot})
    text = written(data, "lerobot", config, extras=("depth", "segmentation"))
    assert "`observation.images.image_depth`" in text
    assert "`camera.agent.depth`" not in text
    assert "before 0.6 cannot read depth" in text
    assert "a unit is 0.0001 m" not in text
    assert "`camera.agent.segmentation`" in text
    assert "0.6" not in written(data, "lerobot", extras=("depth",))


def test_a_language_column_and_who_can_open_it_are_named(data: Path) -> None:
    # As it is written by lerobot 0.6, where the field is not rejected.
    lerobot = LeRobotConfig(name=NAME).model_copy(update={"language": True})
    text = written(data, "lerobot", ExportConfig.model_validate({"rlds": None}).model_copy(update={"lerobot": lerobot}))
    assert "`language_persistent`" in text
    assert "before 0.6 cannot open" in text
    assert "0.6" not in written(data, "lerobot")


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("rlds", "the split `val` of each set that has this split"),
        ("lerobot", "`meta/info.json`"),
        ("lerobot_v21", "end in `_val`"),
    ],
)
def test_a_validation_split_is_named(data: Path, kind: str, words: str) -> None:
    assert "For validation" not in written(data, kind)
    split = {one: options.model_copy(update={"validation": 0.2}) for one, options in OPTIONS.formats.items()}
    # Of eight demonstrations of a task 1.6 are two, and of the one of another task none is.
    eight = [row("clean", demo_id=f"{MILK.suite}/{MILK.name}/demo_{number}") for number in range(8)]
    write_rows(data, [*eight, row("clean", task=STOVE)])
    options = OPTIONS.model_copy(update=split)
    told = written(data, kind, options).partition("For validation, 2 of the 9 demonstrations, with all")[2]
    assert words in told.partition("## Episodes")[0]


def test_demonstrations_of_one_origin_are_held_out_together(data: Path) -> None:
    """Six demonstrations of a task come from three human ones; half of these, rounded to even, are two."""
    pairs = [(f"{MILK.suite}/{MILK.name}/demo_{number}", f"origin {number // 2}") for number in range(6)]
    write_rows(data, [row("clean", demo_id=demo, demo_origin_sha256=origin) for demo, origin in pairs])
    split = {"rlds": RldsConfig(name=NAME, shards=1, validation=0.5), "lerobot": None}
    assert "For validation, 4 of the 6 demonstrations" in written(data, "rlds", ExportConfig.model_validate(split))


def test_what_was_not_compared_is_counted(data: Path) -> None:
    leakage = json.loads((data / "leakage.json").read_text())
    leakage["camera"] |= {"not_compared": 3, "verdict": "unknown"}
    (data / "leakage.json").write_text(json.dumps(leakage))
    text = written(data, "rlds")
    distance = cells(text, "axis", "Distance to the LIBERO-Plus test set")
    assert cells(text, "camera", "Distance to the LIBERO-Plus test set")[distance.index("not_compared")] == "3"
    assert "`unknown` means that no row could be compared; `disjoint where compared` means that some could not" in text


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
    assert "the same files that `demos expand` wrote" in written(data, "rlds")
