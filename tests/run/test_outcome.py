"""The manifest's row of an episode says what its own replay and frames came to, and not what another's did."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from short_demonstrations import BOWL

from pipeline.axes import Axes
from pipeline.axes.noise import NoiseAxis
from pipeline.axes.robot import RobotAxis
from pipeline.config import PlanConfig, ReplayConfig
from pipeline.episode_schema import SCHEMA, STANDARD
from pipeline.export_config import ExportConfig, Where
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run import manifest
from pipeline.run.outcome import Outcome, list_failures
from pipeline.run.progress import Progress
from pipeline.stores.frame_store import StoredFrames
from pipeline.testset.benchmark import TestSet
from pipeline.types import Subtask, Verdict

SUBTASKS = (Subtask(0, "approach the bowl"), Subtask(40, "grasp the bowl"))


@pytest.fixture(scope="module")
def run() -> Outcome:
    """A twin, and noise on its frames and another start of the robot, whose frames were rejected; each with one in
    reserve."""
    wanted = PlanConfig(
        seed=0, axes=Axes(noise=NoiseAxis(), robot=RobotAxis()), episodes={"noise": 1, "robot": 1}, reserve=1.0
    )
    rows = plan.make([DemoEntry(BOWL, "demo_0", "", "human", "0", steps=100)], wanted, ReplayConfig(), TestSet(()))
    twin, noise, _, robot, _ = rows
    told = {"mode": "open_loop", "steps": 90, "resolved": "{}", "path_m": 0.5}
    shown = {one.stream_id for row in (twin, noise) for one in streams_of(row.perturbations).values()}
    return Outcome(
        rows,
        {twin.trajectory_id: told, robot.trajectory_id: told | {"mode": "tracked", "steps": 120, "path_m": 0.75}},
        {
            twin.trajectory_id: StoredFrames("", "a GPU", "open_loop", "its actions", shown, subtasks=SUBTASKS),
            robot.trajectory_id: StoredFrames("", "a GPU", "tracked", "others", rejected={"a stream": "too_dark"}),
        },
        STANDARD.views,
        {row.episode_id: Verdict(row.wanted, "kept" if row.wanted else "reserve_not_needed") for row in rows}
        | {robot.episode_id: Verdict(False, "too_dark")},
    )


def table(run: Outcome, where: Where | None = None) -> list[Mapping[str, Any]]:
    rows: list[Mapping[str, Any]] = manifest.build(run, {}, [], where, lambda row: (f"do {row.axis}",)).to_pylist()
    return rows


def test_rendered_episodes_alone_have_labels_and_a_name_of_their_actions(run: Outcome) -> None:
    rendered = {"subtask_starts": [0, 40], "subtask_texts": ["approach the bowl", "grasp the bowl"]}
    for row in table(run):
        actions = "its actions" if row["steps"] == 90 else None
        assert row["actions_sha256"] == actions
        expected = {**rendered, "rewrites": [f"do {row['axis']}"]} if actions else None
        assert manifest.read_labels(row) == expected


def test_each_row_has_what_its_own_trajectory_and_frames_came_to(run: Outcome) -> None:
    names = ("axis", "replay_mode", "steps", "path_ratio", "gl_device")
    nothing = [None] * 4
    assert [[row[name] for name in names] for row in table(run)] == [
        ["clean", "open_loop", 90, 1.0, "a GPU"],
        ["noise", "open_loop", 90, 1.0, "a GPU"],
        ["noise", *nothing],
        ["robot", "tracked", 120, 1.5, None],
        ["robot", *nothing],
    ]


def test_an_episode_without_the_frames_of_a_further_view_is_not_rendered(run: Outcome) -> None:
    (further,) = (view for view, spec in SCHEMA.further_views.items() if spec.camera == "sideview")
    shown = table(replace(run, views=(*STANDARD.views, further)))
    assert [row["steps"] for row in shown] == [row["steps"] for row in table(run)]
    for row in shown:
        assert row["actions_sha256"] is row["gl_device"] is row["subtask_texts"] is row["rewrites"] is None


def test_kept_and_requested_failures_and_rejected_episodes_are_rendered(run: Outcome) -> None:
    twin, rejected, reserve, failure, undecided = run.rows
    verdicts = {twin.trajectory_id: Verdict(True, "kept"), failure.trajectory_id: Verdict(False, "goal_not_reached")}

    def progress(**export: Any) -> Progress:
        reasons = {rejected.episode_id: "too_dark"}
        return Progress(run.rows, verdicts, run.frames, reasons, run.views, ExportConfig(**export))

    assert progress().to_render() == [twin, rejected, reserve]
    assert progress(failures=True, where=Where(axis=("robot",))).to_render() == [twin, rejected, reserve, failure]
    assert progress().undecided() == [undecided]
    assert progress().pending() == [undecided.trajectory_id]


def test_only_what_the_export_names_counts_as_chosen(run: Outcome) -> None:
    assert all(row["chosen"] for row in table(run))
    assert {row["axis"] for row in table(run, Where(axis=("robot",))) if row["chosen"]} == {"robot"}


@pytest.mark.parametrize("change", [{"device": "another"}, {"fingerprint": "another"}, {"replay_mode": "tracked"}])
def test_other_frames_are_another_content(run: Outcome, change: dict[str, str]) -> None:
    """By which a dataset is made again."""
    noise = run.rows[1]
    frames = {name: replace(shown, **change) for name, shown in run.frames.items()}  # type: ignore[arg-type]
    assert replace(run, frames=frames).content(noise.episode_id) != run.content(noise.episode_id)


def test_failures_are_those_that_missed_their_goal_and_are_asked_for(run: Outcome) -> None:
    reasons = ("kept", "goal_not_reached", "reserve_not_needed", "goal_lost", "too_dark")
    judged = {row.episode_id: Verdict(False, reason) for row, reason in zip(run.rows, reasons, strict=True)}

    def asked(**export: Any) -> list[str]:
        return [row.axis for row in list_failures(run.rows, judged, ExportConfig(**export))]

    assert asked() == []
    assert asked(failures=True) == ["noise", "robot"]
    assert asked(failures=True, where=Where(axis=("robot",))) == ["robot"]
