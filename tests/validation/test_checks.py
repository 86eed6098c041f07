"""Faults that no dataset shows by itself: of the stores, of the manifest's instruction, and of its numbers."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from conftest import BOWL, run_in
from numpy.typing import NDArray
from synthetic import IDS, episode

from pipeline.axes import Axes, to_json
from pipeline.axes.language import LanguagePerturbation, list_rewrites
from pipeline.axes.noise import NoiseAxis
from pipeline.config import PlanConfig, RenderConfig, ReplayConfig
from pipeline.files import write_json
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning import plan
from pipeline.run import manifest
from pipeline.run.counts import by_axis_and_suite
from pipeline.testset.benchmark import TestSet
from pipeline.types import Scene, Trajectory, Verdict
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS
from pipeline.validation.validate import _counts

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
    assert list(CHECKS["motion"](whole)) == []
    for spoilt, what in (
        (replace(MADE, action=np.roll(MADE.action, 1, axis=0)), "has other actions"),
        (replace(MADE, joint_state=np.roll(MADE.joint_state, 1, axis=0)), "has other joint angles"),
        (replace(MADE, action_absolute=moved(0)), "action_absolute has other positions"),
        (replace(MADE, action_absolute=moved(4)), "action_absolute has other orientations"),
        (replace(MADE, action_absolute=moved(6)), "action_absolute has other gripper commands"),
    ):
        (fault,) = CHECKS["motion"](replace(whole, made=spoilt))
        assert (fault.dataset, fault.what) == ("frames", what)


def test_a_rewrite_that_no_bank_has_is_found() -> None:
    (rewrite, *_) = list_rewrites(BOWL)
    strange = LanguagePerturbation(component="paraphrase", level=1, text="move the bowl over to the plate at last")
    for change, found in ((rewrite, []), (strange, [f"rewrite {strange.text!r} is not in the bank"])):
        row = {"suite": BOWL.suite, "task": BOWL.name, "perturbations": to_json([change]), "instruction": change.text}
        assert [fault.what for fault in CHECKS["wording"](case(**row))] == found


Rows = list[dict[str, Any]]


def keep_a_reserve(rows: Rows) -> None:
    rows[-1]["reason"] = "kept"


def drop_without_a_reserve(rows: Rows) -> None:
    rows[1]["reason"] = "goal_lost"


def lose_a_row(rows: Rows) -> None:
    del rows[-1]


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
    """A twin, and two noisy episodes with one in reserve."""
    demos = [DemoEntry(BOWL, "demo_0", "test", "human", "0", steps=100)]
    noisy = PlanConfig(seed=0, axes=Axes(noise=NoiseAxis()), episodes={"noise": 2}, reserve=0.5)
    planned = plan.make(demos, noisy, ReplayConfig(), TestSet(()))
    plan.write(planned, tmp_path / "plan.parquet")
    rows = [asdict(row) | {"reason": "kept" if row.wanted else "reserve_not_needed"} for row in planned]
    if plant is not None:
        plant(rows)
    for row in rows:
        row |= {"kept": row["reason"] == "kept", "chosen": True, "steps": 90}
    table = pa.Table.from_pylist(rows, schema=manifest.schema())
    settings = manifest.Settings(source="starter", replay=ReplayConfig(), render=RenderConfig())
    manifest.write(table, tmp_path / "manifest.parquet", settings)
    write_json(tmp_path / "counts.json", by_axis_and_suite(rows))
    assert [fault.what for fault in _counts(run_in(tmp_path))] == ([] if what is None else [what])
