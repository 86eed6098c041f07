"""Several perturbations of one scene: one order whatever order they are listed in, and each sees those before it."""

from dataclasses import replace

import numpy as np
import pytest
from short_demonstrations import PLATE, starter_demo

from pipeline import seeding
from pipeline.axes import AXES, Perturbation, PhysicsPerturbation, from_json, in_order, of_layer, to_json
from pipeline.axes.layout import LayoutAxis, LayoutPerturbation
from pipeline.axes.pose import PosePerturbation
from pipeline.axes.robot import RobotPerturbation
from pipeline.errors import RejectedError
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.physics.replay import roll_out
from pipeline.scenes.compiled import CompiledScene
from pipeline.types import Demo, Floats, Scene

MOVED = PosePerturbation(component="target", level=2, moved="plate_1", dx_m=0.01, dy_m=-0.02, dyaw_deg=5)
COOKIES = find_task("libero_spatial", "pick_up_the_black_bowl_on_the_cookie_box_and_place_it_on_the_plate")
"""A task that every axis can change."""

TURNED = RobotPerturbation(
    component="initial_joints", level=1, joint_offsets_rad=(0.05, 0.03, 0.04, 0.05, 0.02, 0.03, 0.05)
)


@pytest.fixture(scope="module")
def demo() -> Demo:
    """Cut short: objects are then only kept off the first steps' path, which leaves room for the target to hit one."""
    environment = Environment(PLATE)
    whole = starter_demo(PLATE)
    return replace(whole, actions=whole.actions[:3], model_xml=environment.place_fixtures(4))


@pytest.fixture(scope="module")
def base(demo: Demo) -> Scene:
    assert demo.model_xml is not None
    return Scene(demo.model_xml, demo.init_state)


@pytest.fixture(scope="module")
def crowded(base: Scene, demo: Demo) -> Scene:
    """The scene with two objects added."""
    return added().apply(base, demo, roll_out)


def added() -> LayoutPerturbation:
    return LayoutAxis(levels=(2,)).sample(seeding.rng(0, "layout"), PLATE, 0)


def applied(listed: list[Perturbation], scene: Scene, demo: Demo) -> Scene:
    """As a replay does it, from what the plan records."""
    for perturbation in of_layer(from_json(to_json(listed)), PhysicsPerturbation):
        scene = perturbation.apply(scene, demo, roll_out)
    return scene


def pose_of(body: str, scene: Scene) -> Floats:
    compiled = CompiledScene(scene)
    address = int(compiled.model.joint(f"{body}_joint0").qposadr[0])
    return np.array(compiled.data.qpos[address : address + 7])


def test_axes_stand_in_the_order_of_their_layers() -> None:
    perturbations = [axis().sample(seeding.rng(1, name), COOKIES, 0) for name, axis in AXES.items()]
    assert [p.axis for p in perturbations] == list(AXES)
    assert [p.axis for p in perturbations][:4] == ["goal", "layout", "pose", "robot"]
    assert [p.layer for p in perturbations] == sorted((p.layer for p in perturbations), reverse=True)
    assert in_order(perturbations[::-1]) == from_json(to_json(perturbations[::-1])) == tuple(perturbations)


def test_the_listed_order_does_not_matter_and_every_change_is_there(base: Scene, crowded: Scene, demo: Demo) -> None:
    one = applied([added(), MOVED, TURNED], base, demo)
    other = applied([TURNED, MOVED, added()], base, demo)
    assert one.model_xml == other.model_xml == crowded.model_xml
    assert one.state.tobytes() == other.state.tobytes()
    assert one.resolved == other.resolved
    assert one.resolved.keys() == {"layout", "pose", "robot"}
    assert np.allclose((pose_of("plate_1", one) - pose_of("plate_1", base))[:3], [0.01, -0.02, 0], atol=1e-12)
    for body in ("layout0", "layout1"):
        assert np.array_equal(pose_of(body, one), pose_of(body, crowded)), "objects stay where they came to rest"
    arm = slice(1, 8)
    assert np.allclose(one.state[arm] - base.state[arm], TURNED.joint_offsets_rad, atol=1e-12)


def test_a_target_cannot_be_moved_onto_an_added_object(base: Scene, crowded: Scene, demo: Demo) -> None:
    dx_m, dy_m, *_ = pose_of("layout0", crowded) - pose_of("plate_1", crowded)
    onto = PosePerturbation(
        component="target", level=5, moved="plate_1", dx_m=round(dx_m, 4), dy_m=round(dy_m, 4), dyaw_deg=0
    )
    with pytest.raises(RejectedError, match="object_in_collision"):
        onto.apply(crowded, demo, roll_out)
    onto.apply(base, demo, roll_out)


def test_an_arm_cannot_start_in_an_added_object(base: Scene, crowded: Scene, demo: Demo) -> None:
    """The object is put where the turned hand will be, which is clear of it as it was recorded."""
    there = CompiledScene(TURNED.apply(base, demo, roll_out))
    hand_m = there.data.body("gripper0_eef").xpos.copy()
    compiled = CompiledScene(crowded)
    state = crowded.state.copy()
    address = 1 + int(compiled.model.joint("layout0_joint0").qposadr[0])
    state[address : address + 3] = hand_m
    recorded_m = CompiledScene(base).data.body("gripper0_eef").xpos
    state[address : address + 3] += (hand_m - recorded_m) / np.linalg.norm(hand_m - recorded_m) * 0.1
    with pytest.raises(RejectedError, match="robot_in_collision"):
        TURNED.apply(replace(crowded, state=state), demo, roll_out)
    TURNED.apply(crowded, demo, roll_out)
