"""Whole runs on real demonstrations: both datasets and the manifest agree, and nothing is made twice."""

import errno
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorflow_datasets as tfds
import tf_readback
import yaml
from checkout import REPOSITORY, SCRIPTS, dvc
from dvc.repo import Repo  # type: ignore[import-untyped]
from PIL import Image
from short_demonstrations import STOVE
from short_runs import run_stages, tiny_config
from synthetic import records

from pipeline import stages
from pipeline.axes import from_json
from pipeline.axes.language import BANK_FILE
from pipeline.clients import oft
from pipeline.config import RenderConfig, load
from pipeline.episode_schema import SCHEMA
from pipeline.formats.lerobot import LeRobot, LeRobotConfig
from pipeline.images.jpeg import decode
from pipeline.libero.tasks import find_task
from pipeline.physics.subtasks import subtasks
from pipeline.planning import plan
from pipeline.rendering.renderer import Renderer
from pipeline.run import manifest
from pipeline.run.dataset_basis import episodes_of
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.layout import DATASETS, FINISHED, STATISTICS
from pipeline.run.run import Run
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Task, Trajectory


@pytest.fixture(scope="session")
def rows(finished: Path) -> list[dict[str, Any]]:
    return manifest.read(finished / "manifest.parquet")


def loader(data: Path) -> EpisodeLoader:
    return EpisodeLoader(data, RenderConfig())


def test_every_planned_episode_is_accounted_for(finished: Path, rows: list[dict[str, Any]]) -> None:
    planned = plan.read(finished / "plan.parquet")
    assert [row["episode_id"] for row in rows] == [row.episode_id for row in planned]
    kept = [row for row in rows if row["kept"]]
    assert {row["role"] for row in kept} == {"twin", "perturbed"}
    # The second milk demonstration only waits: its twin is dropped, and every episode sampled on it was replaced.
    reasons = {row["reason"] for row in rows if not row["kept"]}
    assert "goal_not_reached" in reasons
    assert reasons <= {"goal_not_reached", "reserve_not_needed"}
    counts = json.loads((finished / "counts.json").read_text())
    for axis, wanted in {"camera": 3, "noise": 4, "language": 3}.items():
        assert sum(cell["kept"] for cell in counts[axis].values()) == wanted
    assert {name for name in rows[0] if name.endswith("_version")} >= {"mujoco_version", "robosuite_version"}
    for row in rows:
        if row["reason"] == "reserve_not_needed":
            of_others = [row[name] for name in ("replay_mode", "steps", "resolved", "path_m", "gl_device")]
            assert of_others == [None] * 5, "its trajectory may be there for another episode"
        assert (row["rlds_shard"] is None) == (row["lerobot_episode_index"] is None) == (not row["kept"])
    assert sorted(row["lerobot_episode_index"] for row in kept) == list(range(len(kept)))
    assert len({(row["rlds_shard"], row["rlds_index"]) for row in kept}) == len(kept)


def test_lerobot_reads_what_the_manifest_says(finished: Path, rows: list[dict[str, Any]]) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("tiny", root=finished / "lerobot" / "tiny", video_backend="pyav")
    kept = [row for row in rows if row["kept"]]
    assert dataset.meta.total_episodes == len(kept)
    assert dataset.fps == SCHEMA.fps_hz == 20
    assert dataset.meta.total_frames == sum(row["steps"] for row in kept)
    table = dataset.hf_dataset.with_format("numpy")
    starts = np.searchsorted(np.asarray(table["episode_index"]), np.arange(len(kept)))
    for row in kept:
        episode = loader(finished)(row["episode_id"])
        start = int(starts[row["lerobot_episode_index"]])
        stored = table[start : start + row["steps"]]
        assert (stored["episode_index"] == row["lerobot_episode_index"]).all()
        assert np.array_equal(stored["action"], episode.action)
        assert np.array_equal(stored["observation.state"], episode.state)
        first = dataset[start]
        assert first["task"] == row["instruction"]
        for name, view in SCHEMA.views.items():
            shown = np.rint(first[view.lerobot_key].numpy().transpose(1, 2, 0) * 255)
            error = shown - decode(episode.frames[name][0]).astype(float)
            assert 10 * np.log10(255**2 / np.mean(error**2)) > 32, f"{name} of {row['episode_id']}"


def test_tfds_reads_what_the_manifest_says(finished: Path, rows: list[dict[str, Any]]) -> None:
    kept = [row for row in rows if row["kept"]]
    folders = {suite: finished / "rlds" / f"libero_tiny_{suite}" / "1.0.0" for suite in ("goal", "object")}
    builders = {suite: tfds.builder_from_directory(folder) for suite, folder in folders.items()}
    stored = {shard.name: list(records(shard)) for folder in folders.values() for shard in folder.glob("*.tfrecord-*")}
    assert sum(map(len, stored.values())) == len(kept)
    for row in kept:
        builder = builders[row["suite"].removeprefix("libero_")]
        assert row["rlds_shard"].startswith(builder.info.name)
        record = stored[row["rlds_shard"]][row["rlds_index"]]
        episode = loader(finished)(row["episode_id"])
        read = tf_readback.columns(builder.info.features.deserialize_example_np(record))
        assert read["metadata/episode_id"] == row["episode_id"]
        assert len(read["action"]) == row["steps"]
        assert np.array_equal(read["action"], episode.action)
        assert np.array_equal(read["state"], episode.state)
        assert set(read["language_instruction"].tolist()) == {row["instruction"]}
        assert all(frame in record for frames in episode.frames.values() for frame in frames), "JPEG bytes, unchanged"


def printed_by_code_of(page: str, block: int, run: Path) -> str:
    """Return the output of a page's block of Python, with the tests' run in place of ``data/starter``.

    The tests' run has noise, but no background.
    """
    code = re.findall(r"^```python\n(.*?)^```", (REPOSITORY / page).read_text(), re.MULTILINE | re.DOTALL)[block]
    for starter, tiny in (
        ("data/starter/lerobot/libero_perturbed", str(run / "lerobot" / "tiny")),
        ("data/starter", str(run)),
        ("libero_perturbed_goal", "libero_tiny_goal"),
        ('"background"', '"noise"'),
    ):
        code = code.replace(starter, tiny)
    assert "perturbed" not in code.replace('LeRobotDataset("libero_perturbed"', "")
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_the_readmes_code_prints_an_episode_and_its_labels(finished: Path, rows: list[dict[str, Any]]) -> None:
    printed = printed_by_code_of("README.md", 0, finished)
    kept = [row for row in rows if row["kept"]]
    first = min(kept, key=lambda row: int(row["lerobot_episode_index"]))
    assert all(first[label] in printed for label in ("instruction", "episode_id", "axis", "component", "perturbations"))
    assert "observation.state torch.Size([8])" in printed
    assert "action torch.Size([7])" in printed


@pytest.mark.parametrize("block", [0, 1])
def test_the_code_of_the_page_on_formats_opens_the_datasets(finished: Path, block: int) -> None:
    assert printed_by_code_of("docs/formats.md", block, finished) == ""


def test_the_code_of_the_page_on_formats_traces_an_episode(finished: Path, rows: list[dict[str, Any]]) -> None:
    printed = printed_by_code_of("docs/formats.md", 2, finished)
    row = next(row for row in rows if row["kept"] and row["axis"] == "noise")
    assert json.dumps(json.loads(row["perturbations"]), indent=2) in printed
    assert all(row[label] in printed for label in ("demo_id", "trajectory_id", "mujoco_version"))


def test_the_code_of_the_page_on_clients_lists_the_chosen_episodes(finished: Path, rows: list[dict[str, Any]]) -> None:
    printed = printed_by_code_of("docs/clients.md", 0, finished)
    chosen = [row["lerobot_episode_index"] for row in rows if row["kept"] and row["axis"] in ("clean", "camera")]
    assert json.loads(printed.removeprefix("--dataset.episodes=")) == sorted(chosen)


def test_conventions(finished: Path, rows: list[dict[str, Any]]) -> None:
    """Gripper sign, rotation and frame rate, each against the physics."""
    twin = next(row for row in rows if row["role"] == "twin" and row["task"] == STOVE.name)
    episode = loader(finished)(twin["episode_id"])
    trajectory = TrajectoryStore(finished / "trajectories").load(twin["trajectory_id"])
    assert np.array_equal(episode.action, trajectory.actions.astype(np.float32))
    assert set(np.unique(episode.action[:, 6])) <= {-1, 1}
    assert np.allclose(np.diff(trajectory.states[:, 0]), 1 / SCHEMA.fps_hz)
    # LIBERO's raw frames have their first row at the bottom: turned by 180 degrees, the frame is upright, so the
    # table is below and the wall behind the robot above; and it is a mirror image, as OpenVLA trains on it.
    renderer = Renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    raw = renderer.frame(SCHEMA.views["image"].camera)
    renderer.close()
    shown = decode(episode.frames["image"][0]).astype(float)
    assert np.abs(shown - np.rot90(raw, 2)).mean() < 3 < np.abs(shown - raw).mean()


def test_the_fingers_follow_the_sign_of_the_gripper(whole: dict[Task, Trajectory]) -> None:
    """Four commands of 1 bring the open fingers together, and four of -1 part the closed fingers."""
    assert (SCHEMA.action.gripper.open, SCHEMA.action.gripper.close) == (-1, 1)
    closed, opened = 0, 0
    for trajectory in whole.values():
        # A state begins with the time and seven joints of the arm; the two fingers follow.
        command, width_m = trajectory.actions[:, 6], trajectory.states[:, 8] - trajectory.states[:, 9]
        for t in range(len(command) - 4):
            if (command[t : t + 4] == 1).all() and width_m[t] > 0.06:
                assert width_m[t + 4] < width_m[t]
                closed += 1
            if (command[t : t + 4] == -1).all() and width_m[t] < 0.03:
                assert width_m[t + 4] > width_m[t]
                opened += 1
    assert closed > 0
    assert opened > 0


def test_twins_share_what_does_not_differ(finished: Path, rows: list[dict[str, Any]]) -> None:
    load = loader(finished)
    for row in rows:
        if not row["kept"] or row["role"] == "twin":
            continue
        episode, twin = load(row["episode_id"]), load(row["twin_id"])
        (change,) = from_json(row["perturbations"])
        for view in SCHEMA.views:
            same = list(episode.frames[view]) == list(twin.frames[view])
            assert same == (view not in change.views), f"{row['axis']}: {view}"
        assert (episode.instruction == twin.instruction) == (row["axis"] != "language")
        assert np.array_equal(episode.action, twin.action)


def test_paths_are_compared_with_the_twins(finished: Path, rows: list[dict[str, Any]]) -> None:
    """By the positions of the hand in the stored states of both."""
    kept = {row["episode_id"]: row for row in rows if row["kept"]}
    lengths = {}
    for episode_id in kept:
        hand_m = loader(finished)(episode_id).state[:, :3]
        lengths[episode_id] = np.linalg.norm(np.diff(hand_m, axis=0), axis=1).sum()
    for episode_id, row in kept.items():
        expected = lengths[episode_id] / lengths[row["twin_id"]] if row["twin_id"] in kept else None
        # A path ends with the state after the last action, which no step of an episode shows.
        assert row["path_ratio"] == (expected if expected is None else pytest.approx(expected, rel=0.05))
    assert {row["path_ratio"] for row in kept.values() if row["role"] == "twin"} == {1.0}
    assert all(row["path_ratio"] is None for row in rows if row["reason"] == "goal_not_reached")


def test_statistics_and_sheets(finished: Path, rows: list[dict[str, Any]]) -> None:
    found = json.loads((finished / "dataset_statistics.json").read_text())
    assert set(found) == {"libero_tiny_goal", "libero_tiny_object"}
    figures = found["libero_tiny_goal"]
    kept = [row for row in rows if row["kept"] and row["suite"] == "libero_goal"]
    assert figures["num_transitions"] == sum(row["steps"] for row in kept)
    assert figures["num_trajectories"] == len(kept)
    actions = np.concatenate([loader(finished)(row["episode_id"]).action for row in kept]).astype(np.float64)
    assert np.allclose(figures["action"]["mean"][:6], actions[:, :6].mean(0))
    assert np.allclose(figures["action"]["q99"][:6], np.quantile(actions[:, :6], 0.99, axis=0))
    # OFT turns LIBERO's -1 open, +1 close into 1 open, 0 close before it measures.
    assert figures["action"]["mean"][6] == pytest.approx((actions[:, 6] < 0).mean())
    assert figures["action"]["mask"] == [True] * 6 + [False]
    for axis in ("camera", "noise", "language"):
        with Image.open(finished / "sheets" / f"{axis}.png") as sheet:
            assert sheet.width > 300


def test_openvla_oft_would_train_on_all_of_it(finished: Path, rows: list[dict[str, Any]]) -> None:
    found = oft.check_all(finished / "rlds", finished / STATISTICS)
    assert [dataset["violations"] for dataset in found.values()] == [[], []]
    kept = [row for row in rows if row["kept"]]
    assert sum(dataset["chunks"] for dataset in found.values()) == sum(row["steps"] - 7 for row in kept)
    recipe = yaml.safe_load((finished / "finetune" / "finetune.yaml").read_text())
    assert recipe["dataset"]["mixtures"]["value"] == {"libero_tiny": dict.fromkeys(found, 1.0)}


def test_lerobots_own_training_runs_on_it_without_a_network(finished: Path, tmp_path: Path) -> None:
    """Two steps by the recipe's command, with proxies that no one answers and without any downloaded weights."""
    command = yaml.safe_load((finished / "finetune" / "finetune.yaml").read_text())["clients"]["lerobot_act"]["command"]
    quick_options = {"--batch_size=8": "--batch_size=1", "--steps=100000": "--steps=2 --num_workers=0 --log_freq=1"}
    for given, quick in quick_options.items():
        assert given in command
        command = command.replace(given, quick)
    program, *words = shlex.split(command.replace("$DATA", str(finished)))
    assert program == "lerobot-train"
    empty, nobody = tmp_path / "empty", "http://127.0.0.1:9"
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("HF_", "TORCH_"))},
        **dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "http_proxy", "https_proxy"), nobody),
        **dict.fromkeys(("HOME", "HF_HOME", "TORCH_HOME", "XDG_CACHE_HOME"), str(empty)),
    }
    trained = tmp_path / "trained"
    arguments = [str(SCRIPTS / program), *words, "--output_dir", str(trained), "--policy.device=cpu"]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "step:2" in done.stderr
    assert "loss:nan" not in done.stderr
    assert [*trained.rglob("model.safetensors")]


@pytest.mark.parametrize("stage", ["replay", "manifest", "validate"])
def test_a_full_disk_leaves_what_a_stage_wrote_before(
    stage: str, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clone = Path(shutil.copytree(finished.parent.parent, tmp_path / "clone", symlinks=True))
    report, write = json.loads((finished / "validation.json").read_text()), Path.write_bytes

    def half(file: Path, content: bytes) -> None:
        write(file, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(file))

    shutil.rmtree(clone / "data" / "tiny" / FINISHED)  # Or validate would have nothing to do.
    monkeypatch.chdir(clone)
    monkeypatch.setattr(Path, "write_bytes", half)
    # How long it takes is no subject here.
    monkeypatch.setattr("pipeline.validation.validate.validate", lambda *_: report)
    with pytest.raises(OSError, match="No space left"):
        stages.STAGES[stage].work(Run(load(Path("configs/tiny.yaml"))))
    for file in finished.glob("*.json"):
        assert (clone / "data" / "tiny" / file.name).read_bytes() == file.read_bytes(), file.name


@pytest.mark.slow
def test_lerobot_v21_is_made_checked_and_described_where_it_is_asked_for(
    finished: Path, short_demos: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    assert not (data / "lerobot_v21").exists()
    manifest_before = (data / "manifest.parquet").read_bytes()
    config = tiny_config(short_demos)
    config["export"]["lerobot_v21"] = {"name": "libero_tiny", "convention": "ipec"}
    printed = run_stages(tmp_path, config, ["exports", "manifest", "validate", "recipe", "card"])
    assert "lerobot is up to date" in printed, "v3.0 stays"
    assert (data / "manifest.parquet").read_bytes() == manifest_before
    sets = {folder.name for folder in (data / "lerobot_v21").iterdir()}
    assert sets == {"libero_tiny_goal", "libero_tiny_object"}
    assert "libero_tiny_goal" in (data / "finetune" / "starvla_data_config.py").read_text()
    assert "`observation.images.wrist_image`" in (data / "card" / "lerobot_v21" / "README.md").read_text()
    # DVC starts the exports where a dataset is lost, as their output is missing; v3.0 keeps its record.
    seen_by_dvc = (data / "lerobot.json").read_bytes()
    run_stages(tmp_path, config, ["inputs"])
    assert json.loads((data / DATASETS).read_text()).keys() == {"rlds.json", "lerobot.json", "lerobot_v21.json"}
    next((data / "lerobot_v21").rglob("*.mp4")).unlink()
    run_stages(tmp_path, config, ["inputs"])
    assert not (data / "lerobot_v21.json").exists()
    assert not (data / DATASETS).exists()
    assert (data / "lerobot.json").read_bytes() == seen_by_dvc


def contents(folder: Path) -> dict[str, str]:
    """Map every file below a folder to its SHA-256."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    return {file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def stages_to_run(clone: Path) -> set[str]:
    """As `dvc status` says."""
    with Repo(str(clone)) as repository:
        return {stage.split(":")[-1] for stage in repository.status()}


def test_dvc_runs_nothing_twice_and_only_what_a_change_concerns(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clone = tmp_path / "clone"
    shutil.copytree(finished.parent.parent, clone, symlinks=True)
    monkeypatch.chdir(clone)
    before = contents(clone / "data" / "tiny")
    first = dvc(clone, "repro")
    assert first.returncode == 0, first.stdout + first.stderr
    assert first.stdout.count("up to date") == len([one for one in stages.STAGES.values() if one.outputs or one.record])
    assert contents(clone / "data" / "tiny") == before, "what the command `run` made is up to date for DVC too"
    assert stages_to_run(clone) == {"inputs"}
    again = dvc(clone, "repro")
    assert again.returncode == 0
    started = [line for line in again.stdout.splitlines() if line.startswith("Running stage")]
    assert started == ["Running stage 'inputs':"], "the user's files are listed each time, and nothing else runs"
    file = clone / "configs" / "tiny.yaml"
    original = file.read_text()
    cases: list[tuple[tuple[str, ...], Any, set[str]]] = [
        # The report quotes the whole configuration, but for where it ran.
        (("export", "rlds", "shards"), 3, {"exports", "manifest", "validate", "recipe", "card", "report"}),
        (
            ("export", "lerobot", "frames"),
            "images",
            {"exports", "manifest", "validate", "recipe", "card", "report"},
        ),
        (
            ("export", "where"),
            {"level": [0, 1]},
            {"exports", "manifest", "validate", "recipe", "card", "report"},
        ),
        (
            ("export", "lerobot_v21"),
            {"name": "tiny", "convention": "ipec"},
            {"exports", "manifest", "validate", "recipe", "card", "report"},
        ),
        (("render", "jpeg_quality"), 90, {"render", "summary", "card", "report"}),
        (("compute", "workers"), 5, set()),
        (("plan", "seed"), 8, {"plan", "summary", "card", "report"}),
        # What is written out as the default is, is no change.
        (("replay", "noops"), "drop", set()),
    ]
    for keys, value, expected in cases:
        config = yaml.safe_load(original)
        section = config
        for key in keys[:-1]:
            section = section.setdefault(key, {})
        section[keys[-1]] = value
        file.write_text(yaml.safe_dump(config))
        stages.write_inputs(Run(load(file)))
        assert stages_to_run(clone) == expected | {"inputs", "doctor"}, keys


def test_every_format_gets_rewrites_and_subtasks(
    finished: Path, rows: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(finished.parents[1])
    config = load(Path("configs/tiny.yaml"))
    plain = LeRobot(config.run_folder, config.export.options_for(LeRobot) or LeRobotConfig())
    # Where lerobot is older, reading a configuration rejects it.
    told = LeRobot(config.run_folder, plain.options.model_copy(update={"language": True}))
    episodes, given = (episodes_of(target, Run(config)) for target in (plain, told))
    assert {one.content for one in given.facts.values()} == {one.content for one in episodes.facts.values()}
    bank = yaml.safe_load(BANK_FILE.read_text())
    for row in (row for row in rows if row["kept"]):
        episode, before = given.load(row["episode_id"]), episodes.load(row["episode_id"])
        assert (before.rewrites, before.subtasks) == (episode.rewrites, episode.subtasks)
        classes = bank[row["suite"]][row["task"]]
        assert {*episode.rewrites} == {text for texts in classes.values() for text in texts}
        trajectory = TrajectoryStore(finished / "trajectories").load(row["trajectory_id"])
        assert episode.subtasks == subtasks(trajectory, find_task(row["suite"], row["task"]))
        assert episode.subtasks or row["task"] != STOVE.name
