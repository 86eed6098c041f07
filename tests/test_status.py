"""The time left, in which shared work counts once, and the lines about the stages that would run."""

from collections.abc import Mapping
from dataclasses import replace

from short_demonstrations import BOWL

from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.episode_schema import STANDARD
from pipeline.export_config import ExportConfig
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run.progress import Progress
from pipeline.stages import STAGES
from pipeline.status import DATASETS_CHANGE, EXPORTS_AND_LATER, NEW_PLAN, NO_PLAN, _in_lines, not_made
from pipeline.stores.frame_store import StoredFrames
from pipeline.testset.benchmark import TestSet
from pipeline.types import Verdict


def test_what_is_left_is_counted_in_trajectories_and_streams() -> None:
    entries = DemosConfig(tasks=(f"{BOWL.suite}/{BOWL.name}",)).index().entries
    wanted = {"seed": 3, "axes": {"camera": {}, "language": {}, "robot": {}}}
    episodes = {"camera": 9, "language": 4, "robot": 1}
    rows = plan.make(
        entries, PlanConfig.model_validate({**wanted, "episodes": episodes, "reserve": 0}), ReplayConfig(), TestSet(())
    )
    assert len(rows) == 15
    twin = rows[0].trajectory_id
    verdicts = {twin: Verdict(True, "kept")}

    def progress(rows: list[plan.Row], frames: Mapping[str, StoredFrames]) -> Progress:
        return Progress(rows, verdicts if frames else {}, frames, {}, STANDARD.views, ExportConfig())

    assert not_made(progress(rows, {}), rows) == {"replay": 1.0, "render": 1.0}
    streams = {stream.stream_id for stream in streams_of(rows[0].perturbations).values()}
    # Both views of the twin and of the robot's start, and a moved agent view for each camera, which is all 9 change.
    frames = {twin: StoredFrames("", "", "open_loop", "", streams)}
    left = not_made(progress(rows, frames), rows)
    assert left["replay"] == 0.5
    moved = {one.stream_id for row in rows if row.axis == "camera" for one in streams_of(row.perturbations).values()}
    assert left["render"] == (len(moved - streams) + 2) / (len(moved | streams) + 2)
    alone = [replace(row, trajectory_id=twin) for row in rows if row.axis == "language"]
    assert not_made(progress(alone, frames), alone) == {"replay": 0.0, "render": 0.0}


def test_stages_that_run_because_of_earlier_stages_share_a_line() -> None:
    assert list(_in_lines(dict.fromkeys(STAGES, NO_PLAN))) == [f"all stages: {NO_PLAN}"]
    planned = {"plan": "changed plan.seed", **dict.fromkeys(EXPORTS_AND_LATER, NEW_PLAN)}
    assert list(_in_lines(planned)) == ["plan: changed plan.seed", f"exports and later stages: {NEW_PLAN}"]
    later = EXPORTS_AND_LATER[EXPORTS_AND_LATER.index("manifest") :]
    stale = {"export_rlds": "a file is missing", **dict.fromkeys(later, DATASETS_CHANGE)}
    assert list(_in_lines(stale)) == [
        "export_rlds: a file is missing",
        f"manifest and later stages: {DATASETS_CHANGE}",
    ]
    assert list(_in_lines({"card": "no record", "report": "no record"})) == ["card: no record", "report: no record"]
