"""Faults that no dataset shows by itself: of the stores, of the manifest's instruction, and of its numbers."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from short_demonstrations import BOWL
from short_runs import run_in
from synthetic import IDS, episode

from pipeline.axes import Axes, to_json
from pipeline.axes.language import LanguagePerturbation, list_rewrites
from pipeline.axes.noise import NoiseAxis
from pipeline.config import PlanConfig, RenderConfig, ReplayConfig
from pipeline.files import write_json
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run import manifest
from pipeline.run.counts import by_axis_and_suite
from pipeline.testset.benchmark import TestSet
from pipeline.types import Jpeg, Quality, Rendered, Scene, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS
from pipeline.validation.validate import _counts, _unlike_plan, _unlike_stores

MADE = episode(IDS[0])


def case(**row: Any) -> Case:
    """An episode that has the motion of its replay, and lies in no dataset."""
    states = np.zeros((len(MADE) + 1, 10))
    states[:-1, 1:8] = MADE.joint_state
    none = np.zeros((len(states), 0), np.float32)
    actions = MADE.action.astype(float)
    replay = Trajectory("", "open_loop", Scene("", states[0]), states, actions, none, Verdict(True, "kept"))
    return Case(row, MADE, replay, [], None)


def moved(entry: int) -> NDArray[np.float32]:
    """The absolute actions, of which one entry is moved by 0.1 mm or 0.1 mrad at one step."""
    goals = MADE.action_absolute.copy()
    goals[5, entry] += 1e-4
    return goals


def test_frames_of_another_motion_than_the_replays_are_found() -> None:
    whole = case()
    assert list(CHECKS["motion"].find(whole)) == []
    for spoilt, what in (
        (replace(MADE, action=np.roll(MADE.action, 1, axis=0)), "has other actions"),
        (replace(MADE, joint_state=np.roll(MADE.joint_state, 1, axis=0)), "has other joint angles"),
        (replace(MADE, action_absolute=moved(0)), "action_absolute has other positions"),
        (replace(MADE, action_absolute=moved(4)), "action_absolute has other orientations"),
        (replace(MADE, action_absolute=moved(6)), "action_absolute has other gripper commands"),
    ):
        (fault,) = CHECKS["motion"].find(replace(whole, episode=spoilt))
        assert (fault.dataset, fault.what) == ("frames", what)


def test_a_rewrite_that_no_bank_has_is_found() -> None:
    (rewrite, *_) = list_rewrites(BOWL)
    strange = LanguagePerturbation(component="paraphrase", level=1, text="move the bowl over to the plate at last")
    for change, found in ((rewrite, []), (strange, [f"rewrite {strange.text!r} is not in the bank"])):
        row = {"suite": BOWL.suite, "task": BOWL.name, "perturbations": to_json([change]), "instruction": change.text}
        assert [fault.what for fault in CHECKS["wording"].find(case(**row))] == found


def test_results_that_do_not_follow_from_the_replay_are_found() -> None:
    stated = {
        # Of the actions' bytes, in float32.
        "actions_sha256": hashlib.sha256(MADE.action.tobytes()).hexdigest(),
        "resolved": "{}",
        "exceeds_step_limit": False,
    }
    assert list(CHECKS["results"].find(case(suite=BOWL.suite, **stated))) == []
    for column, other in (("actions_sha256", "0" * 64), ("resolved", '{"robot": 1}'), ("exceeds_step_limit", True)):
        (fault,) = CHECKS["results"].find(case(suite=BOWL.suite, **{**stated, column: other}))
        assert (fault.dataset, fault.what) == ("manifest", f"{column} is {other!r}")


Rows = list[dict[str, Any]]


def keep_a_reserve(rows: Rows) -> None:
    rows[-1]["reason"] = "kept"


def drop_without_a_reserve(rows: Rows) -> None:
    rows[1]["reason"] = "goal_lost"


def lose_a_row(rows: Rows) -> None:
    del rows[-1]


def write_plan(folder: Path) -> Rows:
    """Plan a clean twin, and two noisy episodes with one in reserve; return the rows of a manifest."""
    demos = [DemoEntry(BOWL, "demo_0", "test", "human", "0", steps=100)]
    noisy = PlanConfig(seed=0, axes=Axes(noise=NoiseAxis()), episodes={"noise": 2}, reserve=0.5)
    planned = plan.make(demos, noisy, ReplayConfig(), TestSet(()))
    plan.write(planned, folder / "plan.parquet")
    return [asdict(row) | {"reason": "kept" if row.wanted else "reserve_not_needed"} for row in planned]


def write_manifest(folder: Path, rows: Rows) -> None:
    table = pa.Table.from_pylist(rows, schema=manifest.schema())
    settings = manifest.Settings(source="starter", replay=ReplayConfig(), render=RenderConfig())
    manifest.write(table, folder / "manifest.parquet", settings)


PLANNED_VALUES = {"rank": 9, "seed": 9, "demo_steps": 1, "twin_id": "other", "level": "5", "wanted": False}


@pytest.mark.parametrize(("column", "other"), [*PLANNED_VALUES.items(), ("chosen", False)])
def test_a_value_other_than_the_planned_one_is_found(column: str, other: object, tmp_path: Path) -> None:
    rows = [row | {"kept": False, "chosen": True} for row in write_plan(tmp_path)]
    write_manifest(tmp_path, rows)
    assert list(_unlike_plan(run_in(tmp_path))) == []
    rows[0][column] = other
    write_manifest(tmp_path, rows)
    (fault,) = _unlike_plan(run_in(tmp_path))
    assert (fault.episode, fault.what) == (rows[0]["episode_id"], f"{column} is {other!r}")


@pytest.mark.parametrize(
    ("row_number", "column", "other"),
    [
        (1, "steps", 1),
        (1, "replay_mode", "tracked"),
        (1, "path_ratio", 99.0),
        (1, "gl_device", "another"),
        (1, "resolved", '{"pose": {}}'),
        (1, "touched_steps", 1),
        (1, "reason", "goal_lost"),
        (0, "kept", False),
        (3, "steps", len(MADE)),
    ],
    ids=["steps", "mode", "path", "device", "scene", "touch", "reason", "kept", "steps of a reserve without replay"],
)
def test_results_other_than_the_stored_ones_are_found_also_of_a_dropped_row(
    row_number: int, column: str, other: object, tmp_path: Path
) -> None:
    rows = write_plan(tmp_path)
    run, (trajectory_id,) = run_in(tmp_path), {row["trajectory_id"] for row in rows}
    quality = Quality(0.0, 0.0, 0, 2.0, 0.0, 0.0, 0.0, 0.0)
    run.trajectories.save(replace(case().trajectory, trajectory_id=trajectory_id, quality=quality))
    streams: dict[str, Sequence[Jpeg]] = {}
    for row in rows:
        for view, stream in streams_of(row["perturbations"]).items():
            streams[stream.stream_id] = MADE.frames[view]
    motion = (MADE.state, MADE.joint_state, MADE.action, MADE.action_absolute)
    run.frames.save(trajectory_id, Rendered("open_loop", *motion, streams), "llvmpipe")
    results = {"gl_device": "llvmpipe", "steps": len(MADE), "replay_mode": "open_loop", "path_ratio": 1.0}
    results |= {"resolved": "{}", **asdict(quality)}
    for row in rows:
        needed = row["reason"] == "kept"
        row |= {"kept": needed, "chosen": True} | (results if needed else dict.fromkeys(results))
    clean = {"where": {"level": [0]}}
    for row in rows[1:3]:
        row |= {"kept": False, "reason": "left_out"}
    write_manifest(tmp_path, rows)
    assert list(_unlike_stores(run_in(tmp_path, export=clean))) == []
    rows[row_number][column] = other
    write_manifest(tmp_path, rows)
    (fault,) = _unlike_stores(run_in(tmp_path, export=clean))
    assert (fault.episode, fault.what) == (rows[row_number]["episode_id"], f"{column} is {other!r}")


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (None, None),
        (keep_a_reserve, f"3 episodes of noise for {BOWL.suite}/{BOWL.name}"),
        (drop_without_a_reserve, f"1 episodes of noise for {BOWL.suite}/{BOWL.name}"),
        (lose_a_row, "3 rows"),
    ],
)
def test_a_manifest_that_does_not_follow_from_the_plan_is_found(
    plant: Callable[[Rows], None] | None, what: str | None, tmp_path: Path
) -> None:
    rows = write_plan(tmp_path)
    if plant is not None:
        plant(rows)
    for row in rows:
        row |= {"kept": row["reason"] == "kept", "chosen": True, "steps": 90}
    write_manifest(tmp_path, rows)
    write_json(tmp_path / "counts.json", by_axis_and_suite(rows))
    assert [fault.what for fault in _counts(run_in(tmp_path))] == ([] if what is None else [what])
