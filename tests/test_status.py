"""The time left: what several episodes share is made once."""

from collections.abc import Mapping
from dataclasses import replace

from conftest import BOWL

from pipeline.config import DemosConfig, PlanConfig, ReplayConfig
from pipeline.episode_schema import STANDARD
from pipeline.export_config import ExportConfig
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.run.progress import Progress
from pipeline.status import not_made
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
