"""Fewer kept episodes than wanted are reported, with the setting that helps: at the end, in status, report and card."""

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from short_runs import STAGES, run_stages

from pipeline import status
from pipeline.config import load
from pipeline.run import manifest
from pipeline.run.counts import Target, lost_to_workers, shortfalls, targets
from pipeline.run.run import Run


def row(axis: str, reason: str, *, wanted: bool = True, chosen: bool = True) -> dict[str, Any]:
    return {"axis": axis, "reason": reason, "wanted": wanted, "chosen": chosen}


def test_one_of_two_wanted_pose_episodes_is_a_shortfall() -> None:
    rows = [
        row("clean", "kept"),
        row("clean", "goal_not_reached"),
        row("pose", "kept"),
        row("pose", "goal_not_reached"),
        row("pose", "goal_lost", wanted=False),
        row("camera", "kept"),
        row("light", "kept"),
    ]
    found = targets(rows, {"pose": 2, "camera": 1, "light": 3})
    assert found == {
        "clean": Target(2, 2, 1),
        "pose": Target(2, 2, 1),
        "camera": Target(1, 1, 1),
        "light": Target(3, 1, 1),
    }
    pose, light = shortfalls(found)
    assert pose.startswith("pose: 1 of 2 wanted episodes are kept")
    assert "plan.reserve" in pose
    assert light.startswith("light: 1 of 3 wanted episodes are kept")
    assert "plan.reserve" not in light, "no candidate is left that reserves could add"


def test_episodes_that_workers_were_lost_over_are_reported_also_if_reserves_replace_them() -> None:
    rows = [
        row("clean", "worker_lost") | {"trajectory_id": "a"},
        row("camera", "worker_lost") | {"trajectory_id": "a"},
        row("robot", "worker_lost") | {"trajectory_id": "b"},
        row("camera", "kept", wanted=False) | {"trajectory_id": "c"},
    ]
    (sentence,) = lost_to_workers(rows)
    assert sentence.startswith("3 episodes are dropped")
    assert "move the files of 2 trajectories, such as a, out of trajectories/ and frames/" in sentence
    assert lost_to_workers(rows[3:]) == []


def test_episodes_outside_the_dataset_are_neither_wanted_nor_kept() -> None:
    rows = [
        row("clean", "left_out", chosen=False),
        row("pose", "kept"),
        row("pose", "goal_not_reached"),
        row("pose", "left_out", chosen=False),
        row("pose", "goal_lost", chosen=False),
        row("light", "left_out", chosen=False),
        row("camera", "goal_not_reached"),
        row("camera", "kept", wanted=False),
    ]
    found = targets(rows, {"pose": 4, "light": 1, "camera": 1})
    assert found == {"pose": Target(2, 2, 1), "camera": Target(1, 1, 1)}
    assert [sentence.partition(";")[0] for sentence in shortfalls(found)] == ["pose: 1 of 2 wanted episodes are kept"]


@pytest.mark.slow
def test_a_run_that_keeps_fewer_than_wanted_says_so_everywhere(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A finished run whose configuration gets a limit that drops a whole task."""
    clone = shutil.copytree(finished.parent.parent, tmp_path / "clone", symlinks=True)
    monkeypatch.chdir(clone)
    fields = yaml.safe_load((clone / "configs" / "tiny.yaml").read_text())
    # A limit that no episode of the task with the longest path keeps to.
    paths = [row["path_m"] for row in manifest.read(finished / "manifest.parquet") if row["kept"]]
    fields["filter"] = {"path_m": 0.99 * max(paths)}
    monkeypatch.setenv("REMAKE", "1")
    printed = run_stages(clone, fields, [stage for stage in STAGES if stage != "validate"])
    rows = manifest.read(clone / "data" / "tiny" / "manifest.parquet")
    kept = Counter(row["axis"] for row in rows if row["kept"])
    axis, wanted = next((axis, n) for axis, n in fields["plan"]["episodes"].items() if kept[axis] < n)
    sentence = f"{axis}: {kept[axis]} of {wanted} wanted episodes are kept"
    assert sentence in printed
    assert "plan.reserve" in printed
    told = [part for part in status.describe(Run(load(Path("configs/tiny.yaml")))) if isinstance(part, str)]
    assert any(sentence in part for part in told)
    assert not any("all datasets are finished" in part for part in told)
    assert sentence in (clone / "data" / "tiny" / "report.html").read_text()
    card = (clone / "data" / "tiny" / "card" / "rlds" / "README.md").read_text()
    assert f"On the axis {axis}, {kept[axis]} of {wanted} wanted episodes were kept." in card
