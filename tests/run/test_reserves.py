"""Where frames are rejected, a reserve takes the place of the episode, also one that has to be replayed first."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from checkout import copy_of, dvc, in_a_clone
from kills import contents
from short_demonstrations import BOWL
from short_runs import run_stages, tiny_config

from pipeline import gl
from pipeline.compute.pool import loop
from pipeline.config import Config, load
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run import manifest
from pipeline.run.render_job import RenderJob
from pipeline.run.run import Run
from pipeline.validation.validate import validate

SEED = 2
"""Under it, the camera of the first candidate of layout and camera together shows nothing of the added object."""

LATER = ("render", "exports", "manifest")
"""Stages after ``replay``."""

TRIED = ("configuration.json", "machine.json", ".finished/trial.json", ".finished/speed.json")
"""Files of a run on a machine that was tried, so that another run needs no trial."""


def reserved(demos: Path) -> dict[str, object]:
    """One episode of each, which has a replay of its own, and two in reserve."""
    return tiny_config(demos) | {
        "demos": {"source": "hdf5", "root": str(demos), "tasks": [f"{BOWL.suite}/{BOWL.name}"]},
        "plan": {
            "seed": SEED,
            "axes": {
                "layout": {"levels": [1]},
                "camera": {"levels": [5], "components": ["orientation"], "clear_by": "off"},
            },
            "episodes": {"layout": 1, "layout+camera": 1},
            "reserve": 2.0,
        },
    }


def reject_frames_of_first_candidate(clone: Path, fields: dict[str, object]) -> None:
    """Store what a render stage stores where no worker survives the frames of the first candidate of ``layout``."""
    config = Config.model_validate(fields)
    data = clone / config.run_folder
    for row in plan.read(data / "plan.parquet"):
        if row.axis == "layout" and row.rank == 0:
            streams = tuple(streams_of(row.perturbations).values())
            folders = data / "trajectories", data / "frames"
            RenderJob(row, streams, *folders, config.render, gl.choose().device).lost()


def made(clone: Path, target: str) -> list[str]:
    """Run a DVC target; returns the stages that were started."""
    done = dvc(clone, "repro", target)
    assert done.returncode == 0, done.stdout + done.stderr
    prefix = "Running stage '"
    return [line.removeprefix(prefix)[:-2] for line in done.stdout.splitlines() if line.startswith(prefix)]


def remains(rows: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Axis to the reasons of its candidates, by rank."""
    of_axis: dict[str, list[str]] = {}
    for row in sorted(rows, key=lambda row: row["rank"]):
        of_axis.setdefault(row["axis"], []).append(row["reason"])
    return of_axis


def test_a_reserve_is_replayed_where_frames_are_rejected_and_a_rerun_changes_nothing(
    finished: Path, short_demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clone = tmp_path / "clone"
    fields = reserved(short_demos)
    in_a_clone(fields, clone)
    for name in TRIED:
        copy_of(f"data/tiny/{name}", finished.parent.parent, clone)
    run_stages(clone, fields, ["inputs", "doctor", "plan", "leakage", "replay"])
    replayed = set((clone / "data/tiny/trajectories").glob("*.npz"))
    assert len(replayed) == 3, "the twin and the first candidates"
    reject_frames_of_first_candidate(clone, fields)
    run_stages(clone, fields, LATER)
    rows = manifest.read(clone / "data/tiny/manifest.parquet")
    lost = ["worker_lost", "kept", "reserve_not_needed"]
    unseen = ["added_objects_not_seen", "kept", "reserve_not_needed"]
    assert remains(rows) == {"clean": ["kept"], "layout": lost, "layout+camera": unseen}
    exported = Counter(row["axis"] for row in rows if row["rlds_shard"] and row["lerobot_episode_index"] is not None)
    assert exported == {"clean": 1, "layout": 1, "layout+camera": 1}

    assert made(clone, "manifest")[-1] == "manifest", "DVC has called no stage yet"
    before = contents(clone)
    assert made(clone, "manifest") == ["inputs"]
    assert contents(clone) == before

    # As a kill leaves it, after the rejections were stored and before the reserves had their frames: one of these has
    # no trajectory either.
    reserves = sorted(set((clone / "data/tiny/trajectories").glob("*.npz")) - replayed)
    assert len(reserves) == 2
    reserves[0].unlink()
    for reserve in reserves:
        for file in (clone / "data/tiny/frames" / reserve.stem).iterdir():
            file.unlink()
    (clone / "data/tiny/frames/index.parquet").unlink()
    made(clone, "manifest")
    assert contents(clone) == before

    # A replay stage that starts again, as after an edit of its code, leaves the reserves to the stage that needs them.
    run_stages(clone, fields, ["replay"])
    assert all(reserve.exists() for reserve in reserves)

    monkeypatch.chdir(clone)
    report = validate(Run(load(Path("configs/tiny.yaml"))), loop)
    assert not any(found["findings"] for found in report.values())
