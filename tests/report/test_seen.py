"""What a policy sees in a run next to the benchmark's test tasks: no kind of test is missing, and figures are right."""

import json
import math
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from checkout import REPOSITORY
from scipy.spatial.transform import Rotation
from short_demonstrations import MILK

from pipeline.axes import AXES, Axis, Perturbation, from_json
from pipeline.axes.disturbance import DisturbancePerturbation
from pipeline.axes.layout import LayoutAxis
from pipeline.axes.pose import Move, PoseAxis, ScenePerturbation
from pipeline.axes.report_data import KeptPerturbation
from pipeline.config import Config, DemosConfig, PlanConfig, ReplayConfig, load
from pipeline.export_config import Where
from pipeline.images.jpeg import encode
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.report import seen
from pipeline.run import manifest
from pipeline.run.run import Run
from pipeline.scenes.look import Look
from pipeline.seeding import rng
from pipeline.stores.frame_store import FrameStore
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Floats, Geometry, Quality, Rendered

KINDS = {("pose", "pose"): "scene"}
"""What this project calls what the benchmark's test tasks do, where the names differ."""
TOLD = [name for name in AXES if name not in ("light", "language")]
"""The axes whose kinds of tests are known by name."""


@pytest.fixture(scope="module")
def test() -> TestSet:
    return benchmark.load(REPOSITORY / benchmark.FOLDER)


def sample_many(name: str, axis: Axis) -> list[Perturbation]:
    """Six of each task of the four suites, by the axis's defaults."""
    tasks = select_tasks([f"{suite}/*" for suite in SUITES[:4]])
    return [
        axis.sample(rng("kinds", name, task.name, n), task, n) for task in tasks if axis.applies(task) for n in range(6)
    ]


@pytest.mark.parametrize("name", TOLD)
def test_the_defaults_sample_every_kind_of_test_at_every_level(name: str, test: TestSet) -> None:
    perturbations = sample_many(name, AXES[name]())
    tested = {KINDS.get((name, task.component), task.component) for task in test.on_axis(name)}
    assert tested <= {one.component for one in perturbations}
    for component in tested:
        assert {one.level for one in perturbations if one.component == component} == {1, 2, 3, 4, 5}, component


def test_a_spread_is_its_percentiles() -> None:
    assert seen.spread(np.arange(101.0)) == (101, 10.0, 50.0, 90.0)
    assert str(seen.spread([2.0])) == "2 (2 to 2)"


def test_a_thing_of_a_pose_test_is_as_far_as_its_nearest_place() -> None:
    entries = DemosConfig(tasks=(f"{MILK.suite}/{MILK.name}",)).index().entries
    plan_config = PlanConfig.model_validate({"seed": 3, "axes": {"pose": {}}, "episodes": {"pose": 2}, "reserve": 0.0})
    rows = plan.make(entries, plan_config, ReplayConfig(), TestSet(()))
    listed = [json.loads(row.perturbations)[0]["moves"] for row in rows if row.role == "perturbed"]
    moves_m = [{move["name"]: np.array([move["dx_m"], move["dy_m"]]) for move in moves} for moves in listed]
    assert np.linalg.norm(moves_m[0]["milk_1"] - moves_m[1]["milk_1"]) > 0.03

    def moved(task: str, number: int, milk: Floats) -> TestTask:
        (milk_x, milk_y), (basket_x, basket_y) = milk, moves_m[0]["basket_1"]
        moves = f"milk_1:{milk_x},{milk_y};basket_1:{basket_x},{basket_y};ketchup_1:1,1"
        return TestTask(MILK.suite, task, f"{task}_{number}", "pose", "pose", {"moves": moves, "level": 1})

    away = np.array([0.006, 0.008])
    test = TestSet(
        (
            moved(MILK.name, 1, moves_m[0]["milk_1"] + away),
            moved(MILK.name, 2, moves_m[1]["milk_1"] + 2 * away),
            moved(MILK.name, 3, moves_m[1]["milk_1"]),
            moved("pick_up_the_ketchup_and_place_it_in_the_basket", 1, away),
        )
    )
    # The milk and the basket of each in turn, and nothing else.
    moving = [change for row in rows for change in from_json(row.perturbations)]
    kept: list[KeptPerturbation[Any]] = [KeptPerturbation(MILK, change, None) for change in moving]
    assert [cm for _, cm in PoseAxis.observe_together(kept, test)] == pytest.approx([1, 0, 2, 0, 0, 0])
    between_cm = 100 * np.linalg.norm(moves_m[0]["milk_1"] + away - moves_m[1]["milk_1"] - [[0, 0], 2 * away], axis=1)
    nearest_cm = [cm for what, cm in PoseAxis.observe_tests(test) if what.endswith("to its nearest placement (cm)")]
    assert nearest_cm == pytest.approx([between_cm.min(), 0, 2, 0, 2, 0])


@pytest.mark.parametrize(
    "scene", ["libero_goal/put_the_bowl*", "libero_10/KITCHEN*", "libero_10/LIVING*", "libero_10/STUDY*"]
)
def test_an_added_object_is_as_far_from_the_camera_as_in_the_world(scene: str) -> None:
    """LIBERO's cameras are in the world, whose origin is not that of every working surface."""
    task = select_tasks([scene])[0]
    room = ARENAS[bddl.read(task.bddl_file).arena]
    place_m = np.array([room.surface_x_m + 0.1, -0.2])
    layout = LayoutAxis(levels=(1,)).sample(rng("layout", 1), task, 0)
    episode: Any = SimpleNamespace(
        task=task, resolved={"layout": {"objects": [{"position_m": [*place_m, 1.0]}]}}, model=None
    )
    shown = dict(layout.observe(episode))
    assert not shown["objects on the camera's side"]
    across_m = math.dist(room.camera_m[:2], place_m)
    expected_m = math.hypot(across_m, room.camera_xz_m[1])
    assert shown["distance from an added object to the camera (m)"] == pytest.approx(expected_m, abs=0.01)


def test_what_a_test_shows_is_measured_in_its_own_scene() -> None:
    """0.3 m along x is on the camera's side, from 0.19 m on; the camera stands 0.36 m further, and 0.71 m above."""
    places = {"positions": "0.3,0;-0.1,0.2", "category": "ketchup,ketchup", "arena": "tabletop"}
    added = [*LayoutAxis.observe_tests(TestSet((TestTask(MILK.suite, MILK.name, "a", "layout", "objects", places),)))]
    assert [shown for what, shown in added if what == "objects on the camera's side"] == [True, False]
    away_m = [shown for what, shown in added if what == "distance from an added object to the camera (m)"]
    assert away_m == pytest.approx([math.hypot(0.36, 0.71), math.hypot(0.76, 0.2, 0.71)])
    moved: dict[str, str | int] = {"moves": "milk_1:0.03,-0.04;basket_1:1,1", "level": 2}
    moves = TestSet((TestTask(MILK.suite, MILK.name, "b", "pose", "pose", moved),))
    ((what, shift_cm),) = PoseAxis.observe_tests(moves)
    assert what == "displacement of the target in libero_object, level 2 (cm)"
    assert shift_cm == pytest.approx(5)


def test_a_look_has_the_speeds_of_the_hand_and_of_the_fastest_object() -> None:
    """The hand slides at 0.3 m/s and turns about itself, a finger is 4 cm from the other, one of two things moves."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
        <body><joint type="slide" axis="0 0 1"/><joint axis="1 0 0"/><geom size="0.1"/><site name="gripper0_grip_site"/>
        <body><joint name="gripper0_finger_joint1" type="slide"/><geom size="0.1"/></body>
        <body><joint name="gripper0_finger_joint2" type="slide"/><geom size="0.1"/></body></body>
        <body pos="1 0 0"><freejoint/><geom size="0.1"/></body><body pos="2 0 0"><freejoint/><geom size="0.1"/></body>
        </worldbody></mujoco>"""
    )
    at, moving = model.qpos0.copy(), np.zeros(model.nv)
    at[2:4], moving[:2], moving[-6:] = (0.03, -0.01), (0.3, 2.0), (0.3, 0.4, 0, 5, 5, 5)
    measured = seen.clean_measures(Look.of(model, np.hstack([0.0, at, moving])))
    assert [*measured.values()] == pytest.approx([40, 30, 50])


def look_at(*position_m: float) -> Look:
    """A hand at rest."""
    return Look(np.array(position_m), Rotation.identity(), gripper_mm=80.0, hand_cm_s=0.0, object_cm_s=0.0)


def test_looks_are_apart_in_centimetres() -> None:
    assert look_at(0.01, 0.02, -0.02).moved_cm(look_at(0.0, 0.0, 0.0)) == pytest.approx(3)


def test_a_push_is_measured_when_it_ends() -> None:
    """The hand is 1 cm further away after each step; the push begins before step 8 and lasts 4 steps."""
    push = DisturbancePerturbation(
        level=3, body="robot0_right_hand", wrench=(0, 50, 0, 0, 0, 0), first_step=8, steps=4, away_steps=5
    )
    episode: Any = SimpleNamespace(
        look=lambda step: look_at(0.01 * step, 0.0, 1.0), twin_look=lambda step: look_at(0.0, 0.0, 1.0)
    )
    ((_, away_cm),) = push.observe(episode)
    assert away_cm == pytest.approx(12)


def test_an_expanded_demonstrations_displacement_is_measured_too() -> None:
    moves, source_moves = (Move(name="milk_1", dx_m=0.02, dy_m=0.0),), (Move(name="milk_1", dx_m=0.01, dy_m=-0.04),)
    scene = ScenePerturbation(level=2, moves=moves, source_moves=source_moves)
    episode: Any = SimpleNamespace(task=MILK)
    ((what, moved_cm),) = scene.observe(episode)
    assert what == "displacement of the target in libero_object, level 2 (cm)"
    assert moved_cm == pytest.approx(5)


def test_noise_is_measured_in_the_view_that_it_changes(tmp_path: Path) -> None:
    """By frames of one grey each: the twin's, also where the noisy episode shows them, and one that is 20 lighter."""
    demos, wanted = {"tasks": [f"{MILK.suite}/{MILK.name}"]}, {"episodes": {"noise": 1}, "reserve": 0.0}
    config = Config.model_validate({"name": "seen", "folder": tmp_path, "demos": demos, "plan": wanted})
    rows = plan.make(config.demos.index().entries, config.plan, config.replay, TestSet(()))
    plan.write(rows, config.run_folder / "plan.parquet")
    clean, lighter = (
        encode(np.full((256, 256, 3), level, np.uint8), config.render.jpeg_quality) for level in (100, 120)
    )
    twins, noisy = (streams_of(row.perturbations) for row in rows)
    view = Geometry(np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32))
    state, motion = np.zeros((1, 8), np.float32), np.zeros((1, 7), np.float32)
    rendered = Rendered(
        "open_loop",
        *(state, motion, motion, motion),
        streams={**{one.stream_id: [clean] for one in twins.values()}, noisy["image"].stream_id: [lighter]},
        geometry={one.geometry.stream_id: view for one in (*twins.values(), *noisy.values())},
        quality=Quality(**dict.fromkeys((each.name for each in fields(Quality)), 0)),
    )
    FrameStore(config.run_folder / "frames", config.render).save(rows[0].trajectory_id, rendered, "a GPU")
    ((_, levels),) = seen._Seen(Run(config), {rows[0].episode_id: rows[0]}).measure(rows[1])
    assert levels == pytest.approx(20, abs=1)


def test_a_finished_run_is_measured(finished: Path, test: TestSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(finished.parents[1])
    config = load(Path("configs/tiny.yaml"))
    measures = {(one.axis, one.what): one for one in seen.measure(Run(config), test)}
    rows = [row for row in manifest.read(finished / "manifest.parquet") if row["kept"]]
    frames = FrameStore(finished / "frames", config.render)
    # The same by another way: what the datasets say of the fingers before the first action.
    widths_mm = [
        1000 * float(np.subtract(*frames.motion(row["trajectory_id"])[1][0, 6:]))
        for row in rows
        if row["role"] == "twin"
    ]
    gripper = measures["clean", "width of the gripper in the first observation (mm)"]
    assert isinstance(gripper.ours, seen.Spread)
    assert gripper.ours.middle == pytest.approx(float(np.median(widths_mm)), abs=0.01)
    assert isinstance(gripper.tested, seen.Spread)
    assert gripper.tested.number == 40
    assert 77 < gripper.tested.middle < 78
    noisy = {row["component"] for row in rows if row["axis"] == "noise"}
    assert {what.split()[0] for (axis, what), one in measures.items() if axis == "noise" and one.ours} == noisy
    words = measures["language", "words in the instruction"]
    assert words.ours is not None
    assert words.ours.number == sum(row["axis"] == "language" for row in rows)
    assert words.tested is not None
    assert words.tested.number == 1537
    assert measures["layout", "objects on the camera's side"].ours is None
    assert measures["layout", "scenes with 5 added objects"].tested == seen.MeasuredShare(829, round(207 / 829, 4))
    assert measures["layout", "scenes with 2 added objects and a repeated model"].tested == seen.MeasuredShare(
        151, round(9 / 151, 4)
    )
    for suite in SUITES[:4]:
        assert measures["pose", f"distance of a test object in {suite} to its nearest placement (cm)"].tested


def test_twins_that_are_left_out_are_still_compared_with(
    finished: Path, test: TestSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(finished.parents[1])
    config = load(Path("configs/tiny.yaml"))
    chosen = config.export.model_copy(update={"where": Where(axis=("noise",))})
    whole, subset = (seen.measure(Run(one), test) for one in (config, config.model_copy(update={"export": chosen})))
    noise = [one for one in whole if one.axis == "noise"]
    assert any(one.ours for one in noise)
    assert [one for one in subset if one.axis == "noise"] == noise
