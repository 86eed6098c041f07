"""The reader makes of our RLDS what OpenVLA-OFT's loader would, and the check catches what would mislead it."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline import seeding
from pipeline.clients import oft
from pipeline.compute.pool import loop
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.formats import exact_statistics, rlds_write
from pipeline.formats.episodes import EpisodeFacts, Episodes
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.formats.rlds_layout import datasets
from pipeline.run.export import export
from pipeline.types import Episode, Geometry, Jpeg

NAME = "libero_tiny"
LENGTHS = {"a": 30, "b": 8, "c": 19}


def episode(name: str) -> Episode:
    """Fingers that close from step 5 on, as they are told; every frame has its step in its grey level."""
    steps = LENGTHS[name]
    rng = seeding.rng("test_oft", name)
    closing = np.arange(steps) >= 5
    action = rng.uniform(-0.9, 0.9, (steps, 7)).astype(np.float32)
    action[:, 2] = 0.0
    action[:, 6] = np.where(closing, 1, -1)
    state = rng.normal(size=(steps, 8)).astype(np.float32)
    gap = 0.04 - 0.002 * np.cumsum(closing)
    state[:, 6], state[:, 7] = gap, -gap
    frames = {
        view: [frame(8 * t + offset) for t in range(steps)] for view, offset in (("image", 0), ("wrist_image", 4))
    }
    return Episode(
        episode_id=name,
        frames=frames,
        state=state,
        joint_state=rng.normal(size=(steps, 7)).astype(np.float32),
        action=action,
        action_absolute=action,
        instruction=f"Put the bowl {name} on the plate",
        provenance={
            column: dict[str, Any](string="", int64=0, float32=0.0)[dtype]
            for column, dtype in SCHEMA.provenance.items()
        }
        | {"episode_id": name},
        geometry={view: Geometry(np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32)) for view in SCHEMA.views},
    )


def frame(grey: int) -> Jpeg:
    return Jpeg(cv2.imencode(".jpg", np.full((256, 256, 3), grey, np.uint8))[1].tobytes())


def grey(jpeg: bytes) -> int:
    with Image.open(io.BytesIO(jpeg)) as image:
        return round(float(np.asarray(image).mean()))


def write(data: Path, load: Callable[[str], Episode] = episode) -> Path:
    """A run's data folder with one dataset and its statistics; the writer's own check is the caller's to disarm."""
    known = {name: EpisodeFacts("libero_tiny") for name in LENGTHS}
    export(Rlds(data, RldsConfig(name="libero", shards=2)), Episodes(known, load), loop)
    episodes = [load(name) for name in LENGTHS]
    figures = exact_statistics.openvla([(made.action, made.state) for made in episodes])
    (data / "dataset_statistics.json").write_text(json.dumps({NAME: figures}))
    return data


def check_all(data: Path) -> dict[str, dict[str, Any]]:
    return oft.check_all(data / "rlds", data / "dataset_statistics.json")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def statistics(data: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((data / "dataset_statistics.json").read_text())[NAME]
    return found


def test_a_trajectory_becomes_whole_chunks(data: Path, statistics: dict[str, Any]) -> None:
    (folder,) = datasets(data / "rlds")
    read = list(oft.read(folder))
    assert [found.name for found in read] == list(LENGTHS)
    for found in read:
        source = episode(found.name)
        trained = oft.trajectory(found, statistics)
        assert trained is not None
        assert trained.prompt == source.instruction.lower()
        assert len(trained) == len(source) - 7
        assert trained.actions.shape == (len(source) - 7, 8, 7)
        assert trained.proprio.shape == (len(source) - 7, 8)
        low, high = np.array(statistics["action"]["q01"]), np.array(statistics["action"]["q99"])
        for t in range(len(trained)):
            for ahead in range(8):
                for dimension, value in enumerate(source.action[t + ahead, :6]):
                    width = high[dimension] - low[dimension]
                    scaled = 2 * (value - low[dimension]) / width - 1 if width else 0.0
                    assert trained.actions[t, ahead, dimension] == pytest.approx(min(max(scaled, -1), 1), abs=1e-5)
                assert trained.actions[t, ahead, 6] == (t + ahead < 5), "1 open, 0 close, not normalised"
            assert [grey(trained.frames[view][t]) for view in ("image_primary", "image_wrist")] == [8 * t, 8 * t + 4]


def test_what_cannot_be_trained_on_is_passed_by(statistics: dict[str, Any]) -> None:
    source = episode("b")
    stored = oft.Recorded("b", source.action, source.state, source.frames, [source.instruction] * len(source))
    assert oft.trajectory(stored, statistics) is not None
    assert oft.trajectory(replace(stored, instructions=[""] * len(source)), statistics) is None
    assert oft.trajectory(replace(stored, action=source.action[:7]), statistics) is None


def test_normalising_clips_at_the_percentiles_and_flattens_constants() -> None:
    figures = {"q01": [-1, 0, 5], "q99": [3, 1, 5], "min": [-2, 0, 5], "max": [4, 1, 5], "mask": [True, False, True]}
    values = np.array([[-2, 0.3, 5], [1, 0.6, 5], [4, 9, 5]], np.float32)
    expected = np.array([[-1, 0.3, 0], [0, 0.6, 0], [1, 9, 0]], np.float32)
    np.testing.assert_allclose(oft.normalise(values, figures), expected, atol=1e-6)


def test_check_finds_nothing_wrong(data: Path) -> None:
    found = check_all(data)[NAME]
    assert found.pop("clipped_share") < 0.1
    assert found == {
        "episodes": 3,
        "steps": 57,
        "chunks": 23 + 1 + 12,
        "passed_by": 0,
        "statistics_difference": 0.0,
        "violations": [],
    }


def spoilt(change: Callable[[Episode], Episode], name: str) -> Episode:
    return change(episode(name)) if name == "c" else episode(name)


def first(made: Episode, steps: int) -> Episode:
    return replace(
        made,
        action=made.action[:steps],
        action_absolute=made.action_absolute[:steps],
        state=made.state[:steps],
        joint_state=made.joint_state[:steps],
        frames={view: frames[:steps] for view, frames in made.frames.items()},
    )


def unreadable(made: Episode) -> Episode:
    small = Jpeg(cv2.imencode(".jpg", np.zeros((128, 128, 3), np.uint8))[1].tobytes())
    return replace(made, frames={**made.frames, "wrist_image": [small, *made.frames["wrist_image"][1:]]})


def cut_short(made: Episode) -> Episode:
    """The first frame ends within the header of its file."""
    head = Jpeg(made.frames["image"][0][:100])
    return replace(made, frames={**made.frames, "image": [head, *made.frames["image"][1:]]})


FAULTS: dict[str, Callable[[Episode], Episode]] = {
    "c: has no instruction": lambda made: replace(made, instruction=" "),
    "c: has 7 steps, fewer than a chunk of 8": partial(first, steps=7),
    "c: action leaves": lambda made: replace(made, action=made.action * 2),
    "c: state is not finite": lambda made: replace(made, state=np.full_like(made.state, np.nan)),
    "c: wrist_image: 1 of 19 frames": unreadable,
    "c: image: 1 of 19 frames": cut_short,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_check_catches_a_bad_episode(fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rlds_write, "check", lambda *_: None)
    found = check_all(write(tmp_path, partial(spoilt, FAULTS[fault])))[NAME]
    assert found["violations"][0].startswith(fault)
    assert (found["episodes"], found["passed_by"]) == (3, 1)


def turned(name: str) -> Episode:
    made = episode(name)
    return replace(made, action=made.action * np.array([1] * 6 + [-1], np.float32))


def test_check_catches_a_gripper_of_the_wrong_sign(tmp_path: Path) -> None:
    (violation,) = check_all(write(tmp_path, turned))[NAME]["violations"]
    assert "the command's sign is wrong" in violation


def test_check_catches_statistics_of_something_else(data: Path, statistics: dict[str, Any]) -> None:
    (folder,) = datasets(data / "rlds")
    off = json.loads(json.dumps(statistics))
    off["proprio"]["q99"][3] += 1e-6
    found = oft.check(folder, {NAME: off})
    assert found["statistics_difference"] == pytest.approx(1e-6)
    assert len(found["violations"]) == 1
    off["proprio"]["q99"][3] = float("nan")
    assert oft.check(folder, {NAME: off})["violations"] == [
        "dataset_statistics.json differs from the data by up to inf"
    ]
    assert oft.check(folder, {NAME: statistics | {"num_trajectories": 4}})["statistics_difference"] == 1


def test_damage_is_found(data: Path, tmp_path: Path) -> None:
    write(tmp_path)
    (folder,) = datasets(tmp_path / "rlds")
    shard = sorted(folder.glob("*.tfrecord-*"))[1]
    whole = shard.read_bytes()
    for damaged in (whole[:-9], whole[:5], whole[:2] + b"\x01" + whole[3:], whole[:5000] + b"!" + whole[5001:]):
        shard.write_bytes(damaged)
        with pytest.raises(PipelineError, match=rf"{shard.name}: record \d is damaged"):
            list(oft.read(folder))


def test_errors_say_what_is_missing(data: Path, tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="no RLDS dataset"):
        check_all(tmp_path)
    (tmp_path / "rlds").symlink_to(data / "rlds")
    with pytest.raises(PipelineError, match=r"dataset_statistics\.json: the file is missing"):
        check_all(tmp_path)
    (tmp_path / "dataset_statistics.json").write_text("{}")
    (found,) = check_all(tmp_path).values()
    assert found["violations"] == ["dataset_statistics.json lacks this dataset"]
