"""One episode made again from its row of the manifest is the dataset's, byte for byte; what differs is named."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from checkout import REPOSITORY
from short_demonstrations import BOWL

from pipeline.__main__ import main
from pipeline.errors import PipelineError
from pipeline.formats.tfrecord import framed, records
from pipeline.run import manifest
from pipeline.tables import write_table
from pipeline.validation.regenerate import regenerate


def perturbed(data: Path) -> dict[str, Any]:
    """The one noisy episode of the plate."""
    (row,) = (
        row
        for row in manifest.read(data / "manifest.parquet")
        if row["kept"] and row["axis"] == "noise" and row["task"] == BOWL.name
    )
    return row


def changed(data: Path, change: dict[str, Any]) -> None:
    """Change columns of the episode's row."""
    file, episode_id = data / "manifest.parquet", perturbed(data)["episode_id"]
    rows = [row | (change if row["episode_id"] == episode_id else {}) for row in manifest.read(file)]
    manifest.write(pa.Table.from_pylist(rows, schema=pq.read_schema(file)), file, manifest.settings(file))


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """What a user of the datasets has: the manifest and RLDS, and nothing of the run."""
    data = tmp_path / "published"
    shutil.copytree(finished / "rlds", data / "rlds")
    shutil.copy(finished / "manifest.parquet", data)
    return data


def test_identical_from_the_manifest_and_the_demonstration(copy: Path, short_demos: Path, tmp_path: Path) -> None:
    row = perturbed(copy)
    told = ["--manifest", copy / "manifest.parquet", "--out", tmp_path / "out", "--demos", short_demos]
    done = subprocess.run(
        [sys.executable, "-m", "pipeline", "dataset", "regenerate", row["episode_id"], *map(str, told)],
        cwd=REPOSITORY,
        # As a user calls it: what renders is found out there.
        env={name: value for name, value in os.environ.items() if "GL" not in name},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "episode_id": row["episode_id"],
        "identical": True,
        "reason": "kept",
        "versions": {},
        "gl_device": {},
        "differs": {},
    }
    (shard,) = (tmp_path / "out" / "rlds").rglob("*.tfrecord-*")
    stored = next((copy / "rlds").rglob(row["rlds_shard"]))
    assert list(records(shard)) == [list(records(stored))[row["rlds_index"]]]


def test_says_what_differs(copy: Path, short_demos: Path, tmp_path: Path) -> None:
    row = perturbed(copy)
    changed(copy, {"mujoco_version": "3.3.0", "gl_device": "another"})
    # The dataset's instruction, of the same length, wherever the record has it: in the steps and among the rewrites.
    shard = next((copy / "rlds").rglob(row["rlds_shard"]))
    stored = list(records(shard))
    text = row["instruction"].encode()
    stored[row["rlds_index"]] = stored[row["rlds_index"]].replace(text, text.upper())
    shard.write_bytes(b"".join(framed(data) for data in stored))
    found = regenerate(row["episode_id"], copy / "manifest.parquet", tmp_path / "out", short_demos)
    assert found["identical"] is False
    assert found["versions"] == {"mujoco": {"manifest": "3.3.0", "here": row["mujoco_version"]}}
    assert found["gl_device"] == {"manifest": "another", "here": row["gl_device"]}
    steps = row["steps"]
    differs = found["differs"]
    assert differs.keys() == {"language_instruction", "episode_metadata/rewrites"}
    assert differs["language_instruction"] == f"{steps} of {steps} steps, the first at step 0"


def test_without_the_dataset_it_is_only_made_and_says_so(
    copy: Path, short_demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(copy / "rlds")
    told = ["--manifest", copy / "manifest.parquet", "--out", tmp_path / "out", "--demos", short_demos]
    command = ["pipeline", "dataset", "regenerate", perturbed(copy)["episode_id"], *told]
    monkeypatch.setattr(sys, "argv", [*map(str, command)])
    assert main() == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out.splitlines()[-1])
    assert (found["identical"], found["reason"], found["differs"]) == (None, "kept", {})
    assert "no RLDS dataset is next to" in shown.err
    assert list((tmp_path / "out" / "rlds").rglob("*.tfrecord-*"))


def test_impossible_requests_are_rejected(copy: Path, short_demos: Path, tmp_path: Path) -> None:
    file, out = copy / "manifest.parquet", tmp_path / "out"
    dropped = next(row["episode_id"] for row in manifest.read(file) if row["reason"] == "goal_not_reached")
    made = perturbed(copy)["episode_id"]
    with pytest.raises(PipelineError, match="no kept episode 'none'"):
        regenerate("none", file, out, short_demos)
    with pytest.raises(PipelineError, match="was dropped: goal_not_reached"):
        regenerate(dropped, file, out, short_demos)
    with pytest.raises(PipelineError, match="demonstrations have the source hdf5"):
        regenerate(made, file, out)
    changed(copy, {"demo_sha256": "0" * 64})
    with pytest.raises(PipelineError, match="not the one that the episode was generated from"):
        regenerate(made, file, out, short_demos)
    assert not list(out.glob("*")), "the call can be repeated"
    write_table(pq.read_table(file).drop_columns("level"), tmp_path / "older.parquet")
    with pytest.raises(PipelineError, match="lacks the columns level"):
        regenerate(made, tmp_path / "older.parquet", out, short_demos)
    out.mkdir()
    (out / "mine").touch()
    with pytest.raises(PipelineError, match="is not empty"):
        regenerate(made, file, out, short_demos)
