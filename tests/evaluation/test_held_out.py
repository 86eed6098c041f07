"""No held-out perturbation is near one of a training run's plan: a planted copy is found, in results too."""

import copy
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from episode_results import analyze, result
from short_demonstrations import STOVE

from pipeline.axes import Perturbation, to_json
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.noise import NoiseAxis, NoisePerturbation
from pipeline.axes.robot import RobotPerturbation
from pipeline.errors import PipelineError
from pipeline.evaluation import held_out
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.held_out import OWN_AXES, PlannedPerturbations, sample_perturbation
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import find_task
from pipeline.planning import plan


def planned_row(task: EvaluationTask, *perturbations: Perturbation) -> plan.Row:
    """A row of a plan that a training run would make."""
    fields: dict[str, Any] = dict.fromkeys(plan.Row.__dataclass_fields__, "")
    fields |= {"suite": task.suite, "task": task.base, "episode_id": "planted", "perturbations": to_json(perturbations)}
    return plan.Row(**{**fields, "demo_steps": 1, "rank": 0, "wanted": True, "seed": 0, "variant": 0})


@pytest.mark.parametrize("axis", OWN_AXES)
def test_a_planted_copy_of_a_held_out_perturbation_is_found(axis: str) -> None:
    tasks = select(Selection(source="own", suites=(STOVE.suite,), tasks=("put_the_bowl_on_the_plate",), axes=(axis,)))
    base = find_task(tasks[0].suite, tasks[0].base)
    sampled = [(task.name, sample_perturbation(task, 0), base) for task in tasks]
    (found,) = held_out.compare(sampled, PlannedPerturbations([planned_row(tasks[2], sampled[2][1])])).values()
    assert found["overlaps"] >= 1
    assert found["smallest"] == 0
    assert found["closest"] == (tasks[2].name, "planted")
    planned = PlannedPerturbations([planned_row(tasks[2], sample_perturbation(tasks[2], 1))])
    other = held_out.compare(sampled, planned)[axis]
    assert other["draws"] == 5
    assert other["planned"] == 1
    assert held_out.compare(sampled, PlannedPerturbations([]))[axis]["smallest"] is None


def camera_at(azimuth_deg: float) -> CameraPerturbation:
    return CameraPerturbation(component="spherical", level=1, azimuth_deg=azimuth_deg)


def robot_at(offset_rad: float) -> RobotPerturbation:
    offsets_rad = (offset_rad, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return RobotPerturbation(component="initial_joints", level=1, joint_offsets_rad=offsets_rad)


@pytest.mark.parametrize(
    ("sampled", "near", "far"),
    [(camera_at(20), camera_at(22), camera_at(32)), (robot_at(0.1), robot_at(0.11), robot_at(0.13))],
)
def test_a_planned_perturbation_within_the_clearance_overlaps(
    sampled: Perturbation, near: Perturbation, far: Perturbation
) -> None:
    """Two degrees of azimuth are below the clearance of 5 degrees, and 0.01 rad below that of 0.02 rad."""
    task = EvaluationTask("own", STOVE.suite, STOVE.name, "a", sampled.axis, sampled.component, 1, 0)
    overlaps = []
    for planned_perturbation in (near, far):
        planned = PlannedPerturbations([planned_row(task, planned_perturbation)])
        distance, _ = planned.nearest(sampled, STOVE)
        assert distance > 0
        overlaps.append(planned.overlap(sampled, STOVE))
    assert overlaps == [True, False]


def test_held_out_noise_keeps_clear_of_every_strength_that_plans_have() -> None:
    axis = NoiseAxis()
    effects = [effect for name in ("motion", "gaussian_blur", "zoom", "fog", "glass") for effect in getattr(axis, name)]
    trained = [NoisePerturbation(component=effect.component, effect=effect, level=1, seed=0) for effect in effects]
    tasks = select(Selection(source="own", axes=("noise",), episodes=2))
    planned = PlannedPerturbations([planned_row(tasks[0], one) for one in trained])
    found = held_out.compare(((task.name, sample_perturbation(task, 0), STOVE) for task in tasks), planned)["noise"]
    assert found["overlaps"] == 0
    assert found["smallest"] is not None
    assert found["smallest"] >= found["clearance"]


def test_leakage_of_results_is_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("robot", "light")))
    for task in tasks:
        recorded = json.loads(to_json([sample_perturbation(task, 0)]))
        EpisodeFiles(tmp_path).save(result(task, perturbations=recorded))
    config = tmp_path / "mine.yaml"
    config.write_text(f"name: mine\nfolder: {tmp_path}\nplan:\n  episodes: {{robot: 1}}\n")
    file = tmp_path / "mine" / "plan.parquet"
    file.parent.mkdir()
    plan.write([planned_row(tasks[0], sample_perturbation(tasks[0], 0))], file)
    assert analyze("leakage", str(tmp_path), str(config)) == 1
    printed = json.loads(capsys.readouterr().out)
    assert (printed["robot"]["overlaps"], printed["light"]["overlaps"]) == (1, 0)
    plan.write([planned_row(tasks[0], sample_perturbation(tasks[0], 1))], file)
    assert analyze("leakage", str(tmp_path), str(config)) == 0


def test_language_has_no_held_out_perturbations_and_names_the_alternative() -> None:
    with pytest.raises(PipelineError, match="language has no held-out perturbations") as caught:
        select(Selection(source="own", axes=("language",)))
    assert "--source libero_plus --axis language" in str(caught.value)


@pytest.mark.slow
def test_perturbations_that_a_plan_has_are_sampled_again(tmp_path: Path) -> None:
    task = select(Selection(source="own", suites=(STOVE.suite,), tasks=(STOVE.name,), axes=("camera",), levels=(3,)))[0]
    file = tmp_path / "plan.parquet"
    plan.write([planned_row(task, sample_perturbation(task, 0))], file)
    settings = EpisodeSettings(plan=file)
    assert settings.model_dump()["plan"] == held_out.sha256_of(file)
    assert "plan" not in EpisodeSettings().model_dump()
    environment = EpisodeEnvironment(settings)
    environment.reset(task)
    (used,) = environment.episode.perturbations
    assert used == sample_perturbation(task, 0, attempt=1)
    plan.write(
        [planned_row(task, sample_perturbation(task, 0, attempt=attempt)) for attempt in range(20)],
        tmp_path / "all.parquet",
    )
    environment.settings = EpisodeSettings(plan=tmp_path / "all.parquet")
    progress = environment.reset(task)
    assert (progress.over, progress.success, progress.reason) == (True, False, "refused")
    environment.close()


def pixels_of(
    things: Sequence[str], cameras: Sequence[Perturbation], environment: EpisodeEnvironment
) -> list[dict[str, int]]:
    """Map each thing to its pixels in the agent view from each of some cameras, by MuJoCo's own segmentation."""
    model = copy.copy(environment.simulator.model)
    nominal = model.cam_pos.copy(), model.cam_quat.copy()
    data = mujoco.MjData(model)
    state = environment.simulator.state
    data.qpos[:], data.qvel[:] = state[1 : 1 + model.nq], state[1 + model.nq :]
    counts = []
    with mujoco.Renderer(model, 256, 256) as renderer:
        renderer.enable_segmentation_rendering()
        for camera in cameras:
            assert isinstance(camera, CameraPerturbation)
            model.cam_pos[:], model.cam_quat[:] = nominal
            camera.apply(model)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "agentview")
            number, kind = np.moveaxis(renderer.render(), -1, 0)
            roots = model.body_rootid[model.geom_bodyid[number[kind == mujoco.mjtObj.mjOBJ_GEOM]]]
            counts.append({thing: int((roots == model.body(f"{thing}_main").id).sum()) for thing in things})
    return counts


@pytest.mark.slow
def test_a_held_out_camera_that_does_not_show_what_the_task_is_about_is_sampled_again() -> None:
    """The first sample of this task has the right plate outside of the frame, and was evaluated."""
    name = "LIVING_ROOM_SCENE5_put_the_white_mug_on_the_left_plate_and_put_the_yellow_and_white_mug_on_the_right_plate"
    (task,) = select(Selection(source="own", suites=("libero_10",), tasks=(name,), axes=("camera",), levels=(5,)))
    environment = EpisodeEnvironment()
    progress = environment.reset(task)
    assert progress.reason == "running"
    (used,) = environment.episode.perturbations
    environment.image("agentview")  # which sets OpenGL up
    things = ("porcelain_mug_1", "white_yellow_mug_1", "plate_1", "plate_2")
    first_px, used_px = pixels_of(things, (sample_perturbation(task, 0), used), environment)
    assert first_px["plate_2"] == 0
    assert min(used_px.values()) >= 20
    assert used != sample_perturbation(task, 0)
    assert (used.axis, used.level) == ("camera", 5)
    assert used in [sample_perturbation(task, 0, attempt) for attempt in range(held_out.ATTEMPTS)]
    environment.close()
