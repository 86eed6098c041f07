"""What an audit tells of datasets into which test tasks were planted, as they are and after their labels were lost."""

import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import arenas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from checkout import REPOSITORY
from libero.libero.envs import TASK_MAPPING
from scipy.spatial.transform import Rotation
from synthetic import IDS, NAME, episode, loop, records

from pipeline.__main__ import main
from pipeline.axes import AXES
from pipeline.errors import PipelineError
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.formats.tfrecord import framed
from pipeline.libero.arenas import ARENAS, Arena
from pipeline.libero.tasks import find_task
from pipeline.run.export import export
from pipeline.tables import write_table
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Episode, Floats
from pipeline.validation.audit import Audit, audit
from pipeline.validation.camera_pose import moved_to

TASK = find_task("libero_goal", "put_the_bowl_on_the_plate")
OWN_M = np.array([0.6586131746834771, 0.0, 1.6103500240372423])
OWN = Rotation.from_quat([0.3048497438430786, 0.30484986305236816, 0.6380177736282349, 0.6380177736282349])
CENTRE_M = np.array([0.0, 0.0, 0.8])
CLEAN, CAMERA, WORDS, CLEAR, LABELLED, FAR = IDS


def matrix(turn: Rotation, scale: float = 1.0) -> Floats:
    """(4, 4) of LIBERO's tabletop camera moved about the orbit centre, then along the ray."""
    pose = np.eye(4)
    pose[:3, :3] = (turn * OWN).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = CENTRE_M + scale * turn.apply(OWN_M - CENTRE_M)
    return pose


@pytest.fixture(scope="module")
def test() -> TestSet:
    return benchmark.load()


@pytest.fixture(scope="module")
def datasets(test: TestSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes in three formats: one with a test camera, whose label hides it, one with a test instruction, and one
    whose label names a test task's noise."""
    tested = next(one for one in test.on_axis("camera") if one.component == "spherical")
    moved = Rotation.from_euler("z", float(tested.parameters["azimuth_deg"]), degrees=True) * Rotation.from_euler(
        "y", -float(tested.parameters["elevation_deg"]), degrees=True
    )
    noise = test.on(TASK, "noise")[0]
    effect = {name: value for name, value in noise.parameters.items() if name != "severity"}
    blurred = {"axis": "noise", "component": noise.component, "level": 1, "seed": 0}
    blurred |= {"effect": effect}
    poses = dict.fromkeys(IDS, matrix(Rotation.identity()))
    poses |= {CAMERA: matrix(moved), CLEAR: matrix(Rotation.from_euler("x", 40, degrees=True), 1.5)}
    texts = dict.fromkeys(IDS, TASK.instruction)
    texts |= {WORDS: str(test.on(TASK, "language")[0].parameters["text"])}

    def load(episode_id: str) -> Episode:
        made = episode(episode_id)
        labels = json.dumps([blurred]) if episode_id == LABELLED else "[]"
        said = {"suite": TASK.suite, "task": TASK.name, "perturbations": labels}
        seen = {"image": replace(made.geometry["image"], extrinsics=poses[episode_id].astype(np.float32))}
        return replace(
            made,
            instruction=texts[episode_id],
            provenance={**made.provenance, **said},
            geometry={**made.geometry, **seen},
        )

    out = tmp_path_factory.mktemp("planted")
    known = {one: EpisodeFacts("libero_goal", "planted", "", texts[one], len(episode(one))) for one in IDS}
    for dataset in (
        Rlds(out, RldsConfig(name=NAME, shards=2)),
        LeRobot(out, LeRobotConfig(name=NAME, shards=1)),
        LeRobotV21(out, LeRobotV21Config(name=NAME, convention="ipec")),
    ):
        export(dataset, Episodes(known, load), loop)
    return out


@pytest.mark.parametrize(("name", "moved"), [("rlds", 2), ("lerobot", 2), ("lerobot_v21", 2)])
def test_planted_tasks_are_found_whatever_the_labels_say(datasets: Path, test: TestSet, name: str, moved: int) -> None:
    found = audit(datasets / name, test)
    assert (found.episodes, found.unlabelled, found.unknown) == (6, 0, {})
    assert {axis: (one.rows, one.overlaps, one.closest) for axis, one in found.axes.items()} == {
        "camera": (moved, 1, CAMERA),
        "language": (1, 1, WORDS),
        "noise": (1, 1, LABELLED),
    }
    assert found.axes["camera"].smallest == pytest.approx(0.0, abs=1e-3)


def precede_in_rlds(folder: Path, text: str) -> None:
    """Replace the instruction of the first step by other words of equal length."""
    for shard in folder.rglob("*.tfrecord-*"):
        changed = []
        for record in records(shard):
            before, name, after = record.partition(b"steps/language_instruction")
            changed.append(before + name + after.replace(text.encode(), b"x" * len(text.encode()), 1))
        shard.write_bytes(b"".join(map(framed, changed)))


def precede_in_lerobot(folder: Path, text: str) -> None:
    (file,) = folder.rglob("meta/episodes/*/*.parquet")
    rows = pq.read_table(file).to_pylist()
    rows[IDS.index(WORDS)]["tasks"] = [TASK.instruction, text]
    pq.write_table(pa.Table.from_pylist(rows, schema=pq.read_schema(file)), file)


def precede_in_version_21(folder: Path, text: str) -> None:
    (file,) = folder.rglob("episodes.jsonl")
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    rows[IDS.index(WORDS)]["tasks"] = [TASK.instruction, text]
    file.write_text("".join(f"{json.dumps(row)}\n" for row in rows))


@pytest.mark.parametrize(
    ("name", "precede"),
    [("rlds", precede_in_rlds), ("lerobot", precede_in_lerobot), ("lerobot_v21", precede_in_version_21)],
)
def test_a_test_instruction_is_found_behind_another_text_of_the_episode(
    name: str, precede: Callable[[Path, str], None], datasets: Path, test: TestSet, tmp_path: Path
) -> None:
    edited = tmp_path / "edited"
    shutil.copytree(datasets / name, edited)
    precede(edited, str(test.on(TASK, "language")[0].parameters["text"]))
    language = audit(edited, test).axes["language"]
    assert (language.rows, language.overlaps, language.closest) == (1, 1, WORDS)


def test_what_lost_its_labels_is_known_by_its_instruction_and_by_a_manifest(
    datasets: Path, test: TestSet, tmp_path: Path
) -> None:
    edited = tmp_path / "edited"
    shutil.copytree(datasets / "lerobot", edited)
    provenance = next(edited.rglob("provenance.parquet"))
    manifest = tmp_path / "manifest.parquet"
    write_table(pq.read_table(provenance), manifest)
    provenance.unlink()
    found = audit(edited, test)
    assert {axis: (one.overlaps, one.closest) for axis, one in found.axes.items()} == {"language": (1, WORDS)}
    assert (found.unlabelled, found.without_camera, found.unknown["robot"]) == (6, 6, 6)
    found = audit(edited, test, manifest)
    assert {axis: one.overlaps for axis, one in found.axes.items()} == {"language": 1, "noise": 1}
    assert (found.unlabelled, found.without_camera) == (0, 0)


def test_episodes_without_labels_hide_all_axes_but_those_that_instructions_and_cameras_show() -> None:
    result = Audit(9, {}, unlabelled=6, without_camera=2, without_task=0, without_instruction=1, unplaced={})
    hidden = dict.fromkeys(AXES, 6) | {"camera": 2, "language": 1}
    assert result.unknown == hidden


def write_instructions(texts: Sequence[str], folder: Path) -> None:
    """Write what an audit reads of a LeRobot dataset that has one episode for each instruction, and no labels."""
    meta = folder / "meta" / "episodes" / "chunk-000"
    meta.mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"total_episodes": len(texts)}))
    rows = [{"episode_index": index, "tasks": [text]} for index, text in enumerate(texts)]
    pq.write_table(pa.Table.from_pylist(rows), meta / "file-000.parquet")


def test_a_set_of_instructions_alone(test: TestSet, tmp_path: Path) -> None:
    tested = str(test.on(TASK, "language")[3].parameters["text"])
    texts = [TASK.instruction, f" {tested.upper()}!", "fold the towel and hang it over the chair by the window"]
    write_instructions(texts, tmp_path)
    found = audit(tmp_path, test)
    language = found.axes["language"]
    assert (language.rows, language.overlaps, language.closest, language.smallest) == (2, 1, "episode 1", 0.0)
    assert found.without_task == 2


def test_a_packed_rewrite_identifies_its_task(test: TestSet, tmp_path: Path) -> None:
    """The text is no instruction of LIBERO."""
    packed = yaml.safe_load((REPOSITORY / "pipeline" / "axes" / "language_bank.yaml").read_text())
    (text, *_), *_ = packed[TASK.suite][TASK.name].values()
    write_instructions([text], tmp_path)
    found = audit(tmp_path, test)
    assert found.without_task == 0
    # Only the test instructions of this task are compared with the text.
    assert found.axes["language"].comparisons == len(test.on(TASK, "language"))


def test_a_camera_without_a_known_task_is_compared_in_the_arena_where_it_is_nearest(
    datasets: Path, test: TestSet, tmp_path: Path
) -> None:
    edited = tmp_path / "edited"
    shutil.copytree(datasets / "lerobot_v21", edited)
    (lines,) = edited.rglob("episodes.jsonl")
    episodes = [json.loads(line) for line in lines.read_text().splitlines()]
    lines.write_text("".join(f"{json.dumps({**one, 'tasks': ['fold the towel']})}\n" for one in episodes))
    (provenance,) = edited.rglob("provenance.parquet")
    write_table(pq.read_table(provenance).drop_columns(["suite", "task"]), provenance)
    found = audit(edited, test)
    assert found.without_task == len(IDS)
    camera = found.axes["camera"]
    assert (camera.overlaps >= 1, camera.closest) == (True, CAMERA)
    assert camera.smallest == pytest.approx(0.0, abs=1e-3)


def test_an_episode_without_a_text_and_one_of_an_unknown_suite_are_counted(
    datasets: Path, test: TestSet, tmp_path: Path
) -> None:
    """An editor left one episode's list of tasks empty; another is of a suite that only its maker has."""
    edited = tmp_path / "edited"
    shutil.copytree(datasets / "lerobot_v21", edited)
    (lines,) = edited.rglob("episodes.jsonl")
    rows = [json.loads(line) for line in lines.read_text().splitlines()]
    rows[IDS.index(CLEAR)]["tasks"] = []
    lines.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    (provenance,) = edited.rglob("provenance.parquet")
    listed = pq.read_table(provenance).to_pylist()
    moved = {"axis": "pose", "component": "scene", "level": 1, "moves": [{"name": "bowl_1", "dx_m": 0.01, "dy_m": 0}]}
    goal = {"axis": "goal", "component": "other_scene", "level": 2, "scene": "put_the_cup_away", "start": 3}
    for row in listed:
        if row["episode_id"] == LABELLED:
            row["suite"] = "my_kitchen"
            row["perturbations"] = json.dumps([goal, moved, *json.loads(row["perturbations"])])
    write_table(pa.Table.from_pylist(listed), provenance)
    found = audit(edited, test)
    assert (found.episodes, found.without_instruction, found.without_task) == (6, 1, 1)
    assert found.unknown == {"goal": 1, "language": 1, "pose": 1}
    # The noise of the unknown suite's episode is the same in every task, and still found.
    assert {axis: one.closest for axis, one in found.axes.items() if one.overlaps} == {
        "camera": CAMERA, "language": WORDS, "noise": LABELLED,
    }  # fmt: skip
    assert "pose" not in found.axes


def test_what_is_labelled_as_of_another_suite_is_not_taken_for_a_test_task(
    datasets: Path, test: TestSet, tmp_path: Path
) -> None:
    """Where its tasks are not defined, as at a reader of the dataset: its instructions are no rewrites of LIBERO's."""
    edited = tmp_path / "edited"
    shutil.copytree(datasets / "lerobot_v21", edited)
    (provenance,) = edited.rglob("provenance.parquet")
    listed = pq.read_table(provenance).to_pylist()
    rewrite = {"axis": "language", "component": "paraphrase", "level": 1, "text": "lay it down"}
    for row in listed:
        row["suite"] = "my_kitchen"
        if row["episode_id"] == WORDS:
            row["perturbations"] = json.dumps([rewrite])
    write_table(pa.Table.from_pylist(listed), provenance)
    found = audit(edited, test)
    assert found.without_task == len(IDS)
    assert [*found.axes] == ["noise"]
    assert found.unknown == {"language": 1}


@pytest.mark.parametrize("arena", get_args(Arena))
def test_the_agent_views_are_liberos(arena: Arena) -> None:
    class Recorder:
        """Stands for the arena that LIBERO sets up its cameras in."""

        def set_camera(self, camera_name: str, pos: list[float], quat: list[float]) -> None:
            if camera_name == "agentview":
                self.pose = pos, quat

    name = arena if arena in ("tabletop", "floor") else f"{arena}_tabletop"
    recorder, room = Recorder(), ARENAS[arena]
    TASK_MAPPING[f"libero_{name}_manipulation"]._setup_camera(None, recorder)
    for ours, liberos in zip((room.camera_m, room.camera_quat_wxyz), recorder.pose, strict=True):
        np.testing.assert_allclose(ours, liberos, atol=1e-6)


@pytest.mark.parametrize("arena", get_args(Arena))
def test_a_pose_is_read_back_as_the_change_that_made_it(arena: Arena) -> None:
    own_m, own_wxyz = ARENAS[arena].camera_m, ARENAS[arena].camera_quat_wxyz
    own = Rotation.from_quat(np.roll(own_wxyz, -1))
    rng = np.random.default_rng(5)
    for azimuth, elevation, yaw, pitch in rng.uniform(-25, 25, (20, 4)):
        scale = rng.uniform(0.8, 2.0)
        turn = Rotation.from_euler("z", azimuth, degrees=True) * Rotation.from_euler("y", -elevation, degrees=True)
        in_place = Rotation.from_euler("y", -pitch, degrees=True) * Rotation.from_euler("z", yaw, degrees=True)
        pose = np.eye(4)
        pose[:3, :3] = (in_place * turn * own).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = CENTRE_M + scale * turn.apply(np.array(own_m) - CENTRE_M)
        found = moved_to(pose.astype(np.float32), arena)
        assert found is not None
        parameters = found.azimuth_deg, found.elevation_deg, found.yaw_deg, found.pitch_deg, found.distance_scale
        np.testing.assert_allclose(parameters, (azimuth, elevation, yaw, pitch, scale), atol=2e-3)


def test_the_command_ends_with_1_where_something_overlaps(
    datasets: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["pipeline", "dataset", "audit", str(datasets / "rlds")])
    assert main() == 1
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["axes"]["camera"]["overlaps"] == 1


SEQUENCE = {"pythonClassName": "tensorflow_datasets.core.features.sequence_feature.Sequence"}


@pytest.mark.parametrize(
    "feature",
    [
        {"pythonClassName": "downloaded.Feature"},
        {"python_class_name": "downloaded.Feature", "text": {}},
        SEQUENCE | {"jsonFeature": {"json": json.dumps({"feature": {"type": "downloaded.Feature", "content": {}}})}},
    ],
)
def test_code_that_a_dataset_names_is_not_run(
    feature: dict[str, Any], datasets: Path, test: TestSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TFDS imports the module of each feature's class, and a module may be a file of a downloaded dataset."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "downloaded.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()")
    (source,) = {file.parent for file in datasets.rglob("features.json")}
    version = shutil.copytree(source, tmp_path / "set" / "1.0.0")
    content = json.loads((version / "features.json").read_text())
    content["featuresDict"]["features"]["extra"] = feature
    legacy = {"type": "downloaded.Feature", "content": "{}"}
    for written in (content, legacy, {"unknown": 1}):
        (version / "features.json").write_text(json.dumps(written))
        with pytest.raises(PipelineError, match="cannot be read"):
            audit(tmp_path / "set", test)
        assert not (tmp_path / "ran").exists()
        assert str(tmp_path) in sys.path


@pytest.mark.parametrize(
    ("name", "lost", "read", "stated"),
    [
        ("rlds", "**/*.tfrecord-00001-of-00002", 3, 6),
        ("rlds", "**/*.tfrecord-*", 0, 6),
        ("lerobot", "**/meta/episodes/**/*.parquet", 0, 6),
    ],
)
def test_a_dataset_without_all_of_its_files_is_rejected(
    datasets: Path, test: TestSet, tmp_path: Path, name: str, lost: str, read: int, stated: int
) -> None:
    """As after a partial download: what is left must not pass for the whole."""
    copy = shutil.copytree(datasets / name, tmp_path / name)
    files = list(copy.glob(lost))
    assert files
    for file in files:
        file.unlink()
    with pytest.raises(PipelineError, match=f"has {read} episodes, and its description states {stated}"):
        audit(copy, test)


def test_a_folder_without_a_dataset_is_rejected(tmp_path: Path, test: TestSet) -> None:
    with pytest.raises(PipelineError, match="no dataset below this folder"):
        audit(tmp_path, test)


@pytest.mark.parametrize("places", [ARENAS, arenas.TASKS])
def test_what_is_known_of_arenas_is_known_of_all(places: Mapping[str, object]) -> None:
    assert places.keys() == set(get_args(Arena))
