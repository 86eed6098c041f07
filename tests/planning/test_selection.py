"""A reserve takes the place of what is lost before it, and of nothing else."""

from short_demonstrations import BOWL

from pipeline.axes import Axes, to_json
from pipeline.axes.light import LightAxis
from pipeline.axes.robot import RobotPerturbation
from pipeline.config import PlanConfig, ReplayConfig
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning import plan, selection
from pipeline.testset.benchmark import TestSet
from pipeline.types import Verdict


def test_a_reserve_is_replayed_once_frames_before_it_are_rejected() -> None:
    demo = DemoEntry(BOWL, "demo_0", "test", "human", "id", steps=100)
    (row,) = plan.make(
        [demo], PlanConfig(seed=7, axes=Axes(light=LightAxis()), episodes={"light": 1}), ReplayConfig(), TestSet(())
    )[-1:]
    start = RobotPerturbation(component="initial_joints", level=1, joint_offsets_rad=(0.01,) * 7)
    first, second, third = (
        plan.Row(
            **{**vars(row), "axis": "robot", "perturbations": to_json((start,)), "rank": rank}
            | {"trajectory_id": name, "episode_id": name, "wanted": not rank}
        )
        for rank, name in enumerate("abc")
    )
    both, kept = [first, second, third], Verdict(True, "kept")
    assert selection.pending(both, {}) == ["a"]
    assert selection.pending(both, {"a": kept}) == []
    assert selection.pending(both, {"a": kept}, {"a": "worker_lost"}) == ["b"]
    assert selection.pending(both, {"a": kept, "b": kept}, {"a": "worker_lost", "b": "too_dark"}) == ["c"]
    judged = selection.select(both, {"a": kept, "b": kept}, {"a": "worker_lost"})
    assert [verdict.reason for verdict in judged.values()] == ["worker_lost", "kept", "reserve_not_needed"]
