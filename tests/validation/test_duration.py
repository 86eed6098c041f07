"""The estimate of a run's time: what it follows, and that the stages' own speed is what `doctor` finds."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from checkout import REPOSITORY
from short_demonstrations import BOWL

from pipeline.compute_config import ComputeConfig
from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.export_config import ExportConfig, Where
from pipeline.run.machine import Speed
from pipeline.run.work_time import REFERENCE
from pipeline.validation.needs import in_words, lengths, needed_mb, needed_s

STARTER = load(REPOSITORY / "configs" / "starter.yaml")


def planned(**episodes: int) -> Config:
    plan = {"episodes": {name.replace("_", "+"): number for name, number in episodes.items()}}
    return Config.model_validate({"name": "estimate", "demos": {"tasks": ["libero_goal/*"]}, "plan": plan})


def test_what_costs_frames_and_physics_is_counted() -> None:
    """Of 10 demonstrations and 100 episodes: twins alone, noise on their frames, one view, two views, own physics."""
    language, noise, camera, light, robot = (
        needed_s(planned(**{axis: 100}), REFERENCE) for axis in ("language", "noise", "camera", "light", "robot")
    )
    assert language["render"] < noise["render"] < camera["render"] < light["render"]
    assert language["replay"] == noise["replay"] == light["replay"]
    assert robot["replay"] == pytest.approx(11 * language["replay"])
    assert robot["render"] == pytest.approx(11 * language["render"], rel=0.01)
    assert {one["export"] for one in (noise, camera, light, robot)} == {language["export"]}
    joint = needed_s(planned(camera_robot=100), REFERENCE)
    assert joint == robot


def test_maps_are_rendered_where_something_else_is_seen_and_only_what_is_exported_counts() -> None:
    config = planned(noise=100, camera=100)
    maps = config.model_copy(update={"render": config.render.model_copy(update={"extras": ("depth",)})})
    assert needed_s(maps, REFERENCE)["render"] > 1.3 * needed_s(config, REFERENCE)["render"]
    some = config.model_copy(update={"export": ExportConfig(where=Where(axis=("noise",)))})
    assert needed_s(some, REFERENCE)["render"] == needed_s(config, REFERENCE)["render"]
    # 100 of 210 episodes, each demonstration as often as the others.
    assert needed_s(some, REFERENCE)["export"] == pytest.approx(100 / 210 * needed_s(config, REFERENCE)["export"])
    assert needed_mb(some)["rlds"] == pytest.approx(100 / 210 * needed_mb(config)["rlds"])
    assert needed_mb(some)["frames"] == needed_mb(config)["frames"]


def test_room_is_asked_for_reserves_too() -> None:
    """Each that is replayed is another trajectory: as many again as the episodes that are wanted."""

    def trajectories_mb(robot: int, reserve: float) -> float:
        config = planned(noise=1, robot=robot)
        plan = config.plan.model_copy(update={"reserve": reserve})
        return needed_mb(config.model_copy(update={"plan": plan}))["trajectories"]

    assert trajectories_mb(100, 1.0) == pytest.approx(trajectories_mb(200, 0.0))


def test_the_estimate_of_the_default_run_is_near_its_measured_time() -> None:
    measured_s = 5.9 * 60  # On two cores, docs/cost.md.
    assert 0.6 < sum(needed_s(STARTER, REFERENCE).values()) / 2 / measured_s < 1.5


def test_it_follows_the_machine() -> None:
    here = needed_s(STARTER, REFERENCE)
    config = STARTER.model_copy(update={"compute": ComputeConfig(cluster="local", workers=8)})
    gpu = needed_s(config, Speed(REFERENCE.step_s, 0.0015, gpus=1))
    slow = needed_s(STARTER, Speed(REFERENCE.step_s * 2, REFERENCE.frame_s))
    assert gpu["render"] < 0.15 * here["render"], "what is left of a frame is its JPEG"
    assert slow["replay"] == pytest.approx(2 * here["replay"])
    assert {stage: gpu[stage] == here[stage] for stage in here} == {stage: stage != "render" for stage in here}
    # 9,438 frames, as the stage counts them; those with shadows take longer.
    assert 9438 / 2118 < gpu["GPU"] < 1.5 * 9438 / 2118
    assert needed_s(config, Speed(REFERENCE.step_s, 0.0030, gpus=1))["GPU"] == pytest.approx(2 * gpu["GPU"])


@pytest.mark.parametrize(("cluster", "gpus", "frames_per_s"), [("local", 1, 2118), ("local", 4, 853), ("loop", 1, 853)])
def test_a_gpu_renders_faster_for_more_workers(cluster: str, gpus: int, frames_per_s: int) -> None:
    """Frames of two views of 10 demonstrations and of 10,000 episodes, without shadows."""
    camera = planned(camera=10_000)
    config = camera.model_copy(update={"compute": ComputeConfig(cluster=cluster, workers=8)})
    steps = lengths(config.demos).values()
    frames = 2 * sum(map(sum, steps)) + 10_000 * np.mean([np.mean(task) for task in steps])
    estimate_s = needed_s(config, Speed(REFERENCE.step_s, 0.0015, gpus=gpus))["GPU"]
    assert estimate_s == pytest.approx(frames / frames_per_s / gpus, rel=0.01)


def test_time_of_a_gpu_is_not_divided_by_workers() -> None:
    assert in_words({"GPU": 600.0}, 16) == in_words({"GPU": 600.0}, 1).replace("1 worker", "16 workers")


def test_own_tasks_without_demonstrations_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "tasks" / "mine"
    own.mkdir(parents=True)
    shutil.copy(BOWL.bddl_file, own / "bowl.bddl")
    config = Config.model_validate(
        {"name": "estimate", "demos": {"root": "demos", "tasks": ["mine/*"]}, "plan": {"episodes": {"camera": 1}}}
    )
    with pytest.raises(PipelineError, match="none of your own tasks has a demonstration"):
        needed_s(config, REFERENCE)


def test_it_is_told_by_worker() -> None:
    stages_s = {"replay": 600.0, "render": 36000.0, "rest": 60.0}
    assert in_words(stages_s, 1) == "about 10.2 h with 1 worker: replay 10 min, render 10.0 h, rest 60 s"
    assert in_words(stages_s, 10) == "about 62 min with 10 workers: replay 60 s, render 60 min, rest 60 s"
