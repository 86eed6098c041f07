"""The validator passes a good run, and names every planted fault by check, dataset and episode."""

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from faults import rot
from short_demonstrations import BOWL, MILK, STOVE, starter_demo
from short_runs import run_stages, tiny_config

from pipeline.axes.robot import RobotPerturbation
from pipeline.compute.pool import loop
from pipeline.config import RenderConfig, ReplayConfig, load
from pipeline.episode_schema import SCHEMA, STANDARD
from pipeline.files import checksum
from pipeline.formats import rlds_write
from pipeline.formats.lerobot.video import Video
from pipeline.formats.read_back import Copy
from pipeline.formats.tfrecord import METADATA, columns, framed, records
from pipeline.images.jpeg import decode, encode
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.run import manifest
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.run import Run
from pipeline.types import Episode, Task, Trajectory
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS
from pipeline.validation.rerender import choose_rerendered
from pipeline.validation.validate import validate

Tree = dict[str, Any]
Rows = list[dict[str, Any]]


def swap_cameras(tree: Tree) -> None:
    for step in tree["steps"]:
        shown = step["observation"]
        shown["image"], shown["wrist_image"] = shown["wrist_image"], shown["image"]


def flip_gripper(tree: Tree) -> None:
    for step in tree["steps"]:
        step["action"] = step["action"] * np.array([1, 1, 1, 1, 1, 1, -1], np.float32)


def turn_back(tree: Tree) -> None:
    for step in tree["steps"]:
        frame = decode(step["observation"]["image"])
        step["observation"]["image"] = encode(np.ascontiguousarray(frame[::-1, ::-1]), RenderConfig().jpeg_quality)


def freeze(tree: Tree) -> None:
    for step in tree["steps"]:
        step["observation"]["wrist_image"] = tree["steps"][0]["observation"]["wrist_image"]


def change_text(tree: Tree) -> None:
    for step in tree["steps"]:
        step["language_instruction"] = "turn on the microwave"


def truncate(tree: Tree) -> None:
    del tree["steps"][-3:]


def end_early(tree: Tree) -> None:
    tree["steps"][-2]["reward"] = 1.0


def take_credit(tree: Tree) -> None:
    tree["episode_metadata"]["demo_origin"] = "expanded"


def mirror_camera(tree: Tree) -> None:
    tree["episode_metadata"]["image_intrinsics"] = np.abs(tree["episode_metadata"]["image_intrinsics"])


IN_RLDS: dict[tuple[str, Task], Callable[[Tree], None]] = {
    ("camera", STOVE): swap_cameras,
    ("camera", MILK): flip_gripper,
    ("clean", BOWL): turn_back,
    ("noise", BOWL): freeze,
    ("language", STOVE): change_text,
    ("noise", MILK): truncate,
    ("language", BOWL): end_early,
    ("clean", MILK): take_credit,
    ("language", MILK): mirror_camera,
}
"""Axis and task to what is done to the episode's example."""


SEEN_FROM = "camera.agent.extrinsics"
BLACK, CHANGED, LATE = ("noise", STOVE), ("clean", STOVE), ("camera", BOWL)
"""In LeRobot black from one camera that has another place, with another action, and timed late."""

EXPECTED = {
    ("jpeg", "rlds", ("camera", STOVE)),
    ("cameras", "rlds", ("camera", STOVE)),
    ("motion", "rlds", ("camera", MILK)),
    ("jpeg", "rlds", ("clean", BOWL)),
    ("jpeg", "rlds", ("noise", BOWL)),
    ("alive", "rlds", ("noise", BOWL)),
    ("instruction", "rlds", ("language", STOVE)),
    ("length", "rlds", ("noise", MILK)),
    ("flags", "rlds", ("noise", MILK)),
    ("flags", "rlds", ("language", BOWL)),
    ("provenance", "rlds", ("clean", MILK)),
    ("geometry", "rlds", ("language", MILK)),
    ("geometry", "lerobot", BLACK),
    ("video", "lerobot", BLACK),
    ("alive", "lerobot", BLACK),
    ("motion", "lerobot", CHANGED),
    ("clock", "lerobot", LATE),
    ("video", "lerobot", LATE),  # Read by the time of the step, the frame is the next step's.
    ("statistics", "lerobot", CHANGED),  # Those that are stated are of the action and the times before.
    ("statistics", "lerobot", LATE),
    ("format", "rlds", None),  # dataset_info.json states the bytes of the shards before.
    ("openvla_oft", "rlds", None),  # Its statistics are not those of the changed actions.
    ("format", "lerobot", None),  # 10 frames a second, says info.json.
    ("place", "manifest", "other"),
    ("wording", "manifest", "other"),
    ("plan", "manifest", "other"),  # Its instruction is not the planned one.
    ("instruction", "rlds", "other"),
    ("instruction", "lerobot", "other"),
    ("counts", "manifest", None),  # counts.json has one camera episode more.
}
"""Check, dataset and episode of all that is to be found, whichever episodes are rendered again."""

OTHER_FRAMES = {
    **{("camera", STOVE): "rlds", ("clean", BOWL): "rlds", ("noise", BOWL): "rlds"},
    **{BLACK: "lerobot", LATE: "lerobot"},
}
"""Episode to the dataset in which its first or its middle frames are not the rendered ones."""


def named(rows: Rows) -> dict[str, tuple[str, Task] | str]:
    """Kept episode to its axis and task; where there is a second one of both, it is called ``other``."""
    names: dict[str, tuple[str, Task] | str] = {}
    for row in rows:
        if row["kept"]:
            name = (row["axis"], next(task for task in (STOVE, BOWL, MILK) if task.name == row["task"]))
            names[row["episode_id"]] = "other" if name in names.values() else name
    return names


def spoil_rlds(data: Path, rows: Rows, names: Mapping[str, tuple[str, Task] | str]) -> None:
    """Write every shard again, with faults in the examples."""
    rewrites = {row["episode_id"]: json.loads(row["rewrites"]) for row in rows if row["kept"]}
    load = EpisodeLoader(data, RenderConfig(), rewrites=rewrites)
    for shard in (data / "rlds").rglob("*.tfrecord-*"):
        ids = [
            columns(record, rlds_write.features(STANDARD))[f"{METADATA}episode_id"][0].decode()
            for record in records(shard)
        ]
        with shard.open("wb") as file:
            for episode_id in ids:
                name = names[episode_id]
                tree = rlds_write._nested_example(load(episode_id))
                if isinstance(name, tuple) and name in IN_RLDS:
                    IN_RLDS[name](tree)
                example = rlds_write._serializer(STANDARD).get_tf_example(
                    rlds_write.features(STANDARD).encode_example(tree)
                )
                file.write(framed(example.SerializeToString()))


def spoil_lerobot(root: Path, index: Mapping[Any, int]) -> None:
    for file in (root / "data").rglob("*.parquet"):
        table = pq.read_table(file)
        found = {name: np.array(table[name].to_pylist(), np.float32) for name in ("action", "timestamp")}
        of = np.array(table["episode_index"])
        found["action"][np.flatnonzero(of == index[CHANGED])[3:4], 0] += 0.001
        # All but the last: there may be no frame behind that.
        found["timestamp"][np.flatnonzero(of == index[LATE])[:-1]] += np.float32(1 / SCHEMA.fps_hz)
        for name, values in found.items():
            place, field = table.schema.get_field_index(name), table.schema.field(name)
            table = table.set_column(place, field, pa.array(list(values), field.type))
        pq.write_table(table, file)
    provenance = root / "meta" / "provenance.parquet"
    rows = pq.read_table(provenance)
    matrices = rows.to_pylist()
    matrices[index[BLACK]][SEEN_FROM][3] += 1.0
    pq.write_table(pa.Table.from_pylist(matrices, schema=rows.schema), provenance)
    key = SCHEMA.views["image"].lerobot_key
    episodes = [
        row for file in (root / "meta" / "episodes").rglob("*.parquet") for row in pq.read_table(file).to_pylist()
    ]
    (row,) = (row for row in episodes if row["episode_index"] == index[BLACK])
    begin, end = (round(row[f"videos/{key}/{name}_timestamp"] * SCHEMA.fps_hz) for name in ("from", "to"))
    video_file = root / "videos" / key / "chunk-000" / f"file-{row[f'videos/{key}/file_index']:03d}.mp4"
    with av.open(str(video_file)) as shown:
        frames = [frame.to_ndarray(format="rgb24") for frame in shown.decode(video=0)]
    with Video(video_file) as made:
        for step, frame in enumerate(frames):
            made.add(np.zeros_like(frame) if begin <= step < end else frame, first=step == 0)
    info = json.loads((root / "meta" / "info.json").read_text())
    (root / "meta" / "info.json").write_text(json.dumps(info | {"fps": 10}))


def spoil_manifest(data: Path, rows: Rows, other: str) -> None:
    for row in rows:
        if row["episode_id"] == other:
            row["rlds_shard"] = next(r["rlds_shard"] for r in rows if r["kept"] and r["suite"] != row["suite"])
            row["instruction"] = "STUDY_SCENE1_" + row["instruction"]
    file = data / "manifest.parquet"
    manifest.write(pa.Table.from_pylist(rows, schema=pq.read_schema(file)), file, manifest.settings(file))
    counts = json.loads((data / "counts.json").read_text())
    counts["camera"]["libero_goal"]["kept"] += 1
    (data / "counts.json").write_text(json.dumps(counts))


def test_a_good_run_passes(finished: Path) -> None:
    report = json.loads((finished / "validation.json").read_text())
    assert {check: found["findings"] for check, found in report.items()} == {check: [] for check in report}
    kept = sum(row["kept"] for row in manifest.read(finished / "manifest.parquet"))
    assert {report[check]["checked"] for check in ("motion", "video", "gripper", "place", "provenance")} == {kept}
    assert report["depth"]["checked"] == report["boxes"]["checked"] == 0, "the run has neither"
    # The clean episode of each of three tasks, and one of each of three axes.
    assert report["rendered"]["checked"] == 6
    assert not (finished / ".work").exists()


def found_of_gripper(trajectory: Trajectory, sign: float = 1.0) -> list[str]:
    """Check a copy of a trajectory whose commands of the gripper are multiplied by ``sign``."""
    action = trajectory.actions.astype(np.float32)
    state = np.zeros((len(action), 8), np.float32)
    state[:, 6:] = trajectory.states[:-1, 8:10]
    joints = np.zeros((len(action), 7), np.float32)
    made = Episode(trajectory.trajectory_id, {}, state, joints, action, action, "", {}, {})
    commanded = action * np.array([1, 1, 1, 1, 1, 1, sign], np.float32)
    copy = Copy("rlds", replace(made, action=commanded), [], {}, {}, {})
    return [fault.what for fault in CHECKS["gripper"].find(Case({}, made, trajectory, [copy], None))]


def test_gripper_sign_is_held_against_the_fingers(whole: dict[Task, Trajectory]) -> None:
    """On whole demonstrations: in the last second of one, fingers hardly move."""
    for trajectory in whole.values():
        assert found_of_gripper(trajectory) == []
        (flipped,) = found_of_gripper(trajectory, sign=-1.0)
        assert "against changes of the gripper's command" in flipped
        assert "gripper command" in found_of_gripper(trajectory, sign=0.5)[0]


def test_a_knob_may_move_the_fingers_against_the_command() -> None:
    """From this posture the knob closes the open fingers, and then opens the closed ones."""
    offsets_rad = (-0.225396, -0.001354, -0.137521, -0.274138, -0.095243, -0.016973, 0.075971)
    posture = RobotPerturbation(component="controller_posture", level=4, joint_offsets_rad=offsets_rad)
    environment = Environment(STOVE)
    pressed = replay(environment, starter_demo(STOVE), "pressed", ReplayConfig(mode="open_loop"), [posture])
    environment.close()
    assert pressed.verdict.kept
    gap_m, command = pressed.states[:, 8] - pressed.states[:, 9], pressed.actions[:, 6]
    assert -(np.sign(command) * np.diff(gap_m)).sum() < -0.04, "all in all, the fingers move against the command"
    assert found_of_gripper(pressed) == []
    assert found_of_gripper(pressed, sign=-1.0) != []


def record_as_written(data: Path) -> None:
    """As if a writer had made the faults."""
    for name in ("rlds", "lerobot"):
        file = data / f"{name}.json"
        written = {path for path in (data / name).rglob("*") if path.is_file()}
        files = {path.relative_to(data / name).as_posix(): checksum(path) for path in sorted(written)}
        file.write_text(json.dumps(json.loads(file.read_text()) | {"files": files}))


def test_planted_faults_stop_the_run_and_nothing_else_is_found(
    finished: Path, short_demos: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    rows = manifest.read(data / "manifest.parquet")
    names = named(rows)
    (other,) = (episode_id for episode_id, name in names.items() if name == "other")
    spoil_rlds(data, rows, names)
    index = {names[row["episode_id"]]: row["lerobot_episode_index"] for row in rows if row["kept"]}
    spoil_lerobot(data / "lerobot" / "tiny", index)
    spoil_manifest(data, rows, other)
    record_as_written(data)
    killed = data / ".work" / "validate" / "of a killed run"
    killed.mkdir(parents=True)
    with pytest.raises(
        AssertionError, match=r"(?s)number of findings of each check: counts 1, .*try: read data/tiny/validation\.json"
    ):
        run_stages(tmp_path, tiny_config(short_demos), ["validate"])
    report = json.loads((data / "validation.json").read_text())
    found = {
        (check, finding["dataset"], names.get(finding["episode"]))
        for check, result in report.items()
        for finding in result["findings"]
    }
    again = {names[episode_id] for episode_id in choose_rerendered(rows)}
    assert ("clean", BOWL) in again
    assert found == EXPECTED | {("rendered", dataset, name) for name, dataset in OTHER_FRAMES.items() if name in again}
    assert not (data / ".work").exists()


def test_what_is_missing_or_cannot_be_read_is_a_finding(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    (data / "lerobot" / "tiny" / "meta" / "info.json").unlink()
    cut, short = sorted((data / "rlds").rglob("*.tfrecord-*"))
    cut.write_bytes(cut.read_bytes()[:-1])
    *others, _ = records(short)
    short.write_bytes(b"".join(map(framed, others)))
    record_as_written(data)
    rows = [row for row in manifest.read(data / "manifest.parquet") if row["kept"]]
    rotten = min((data / "frames" / rows[0]["trajectory_id"]).iterdir())
    rot(rotten)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pipeline.validation.validate.choose_rerendered", lambda rows: [])  # Tested above, and slow.
    report = validate(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    told = sorted((finding["dataset"], finding["what"]) for finding in report["readable"]["findings"])
    assert [dataset for dataset, _ in told] == ["lerobot", "rlds", "rlds"]
    assert re.search(rf"{cut.name}: record \d+ is damaged", told[1][1])
    assert told[2][1] == f"{short.name} has {len(others)} records"
    assert report["stored"]["findings"]
    assert all(str(rotten) in finding["what"] for finding in report["stored"]["findings"])
    gone = {
        max((row["rlds_index"], row["episode_id"]) for row in rows if row["rlds_shard"] == shard.name)[1]
        for shard in (cut, short)
    }
    assert {finding["episode"] for finding in report["ids"]["findings"]} == gone
