"""Confounding objects: at rest, out of the way, of other categories, and nothing of the scene itself changed."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from checkout import REPOSITORY
from short_demonstrations import MILK, PLATE, STOVE, starter_demo

from pipeline import seeding
from pipeline.axes.layout import LayoutAxis, LayoutPerturbation
from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.objects import TEST_CATEGORIES, goes_with, models, taken
from pipeline.config import ReplayConfig
from pipeline.errors import PipelineError, RejectedError
from pipeline.libero.arenas import ARENAS, Arena, Region
from pipeline.libero.starts import HOME_RAD, recorded_start
from pipeline.libero.tasks import tasks
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay, roll_out
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.sight import Sight
from pipeline.scenes.placement import CLEARANCE_M, HIDDEN, SEEN_PX, enough_seen, place
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Scene, Task

ROBOT = ("robot0_", "gripper0_")


@pytest.fixture(scope="module")
def environment() -> Environment:
    return Environment(PLATE)


@pytest.fixture(scope="module")
def demo(environment: Environment) -> Demo:
    return replace(starter_demo(PLATE), model_xml=environment.place_fixtures(ReplayConfig().fixture_seed))


@pytest.fixture(scope="module")
def base(demo: Demo) -> Scene:
    assert demo.model_xml is not None
    return recorded_start(demo, demo.model_xml)


@pytest.fixture(scope="module")
def three() -> LayoutPerturbation:
    return LayoutAxis(levels=(3,)).sample(seeding.rng(0, "layout"), PLATE, 0)


@pytest.fixture(scope="module")
def changed(three: LayoutPerturbation, base: Scene, demo: Demo) -> Scene:
    return three.apply(base, demo, roll_out)


def restored(scene: Scene) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(scene.model_xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = scene.state[1 : 1 + model.nq], scene.state[1 + model.nq :]
    mujoco.mj_forward(model, data)
    return model, data


def test_equal_perturbations_give_equal_scenes(
    three: LayoutPerturbation, base: Scene, demo: Demo, changed: Scene
) -> None:
    again = LayoutPerturbation.model_validate_json(three.model_dump_json()).apply(base, demo, roll_out)
    assert again.model_xml == changed.model_xml
    assert again.state.tobytes() == changed.state.tobytes()
    assert again.resolved == changed.resolved


@pytest.mark.slow
def test_the_level_is_the_number_of_objects() -> None:
    for level in (1, 2, 3, 4, 5):
        perturbations = [LayoutAxis(levels=(level,)).sample(seeding.rng(level, key), PLATE, 0) for key in range(20)]
        assert {(one.level, len(one.objects)) for one in perturbations} == {(level, level)}
        assert len({one.seed for one in perturbations}) == 20, "each has places of its own"
        models_of = [models(LayoutAxis().sources)[added.name] for one in perturbations for added in one.objects]
        assert max(model.shape.footprint_m2 for model in models_of) <= 0.12 / level, "the more, the smaller"


def test_added_objects_are_among_what_a_rollout_met(changed: Scene) -> None:
    reference = Reference.of(changed.model_xml, np.stack([changed.state] * 2), np.zeros((1, 7)))
    added = [name for name in reference.poses if name.startswith("layout")]
    assert len(added) == 3
    assert not any(reference.held[name].any() for name in added)


def test_a_model_comes_twice_as_often_as_in_the_test_set() -> None:
    tested: dict[int, list[bool]] = defaultdict(list)
    for test in benchmark.load(REPOSITORY / benchmark.FOLDER).on_axis("layout"):
        names = str(test.parameters["category"]).split(",")
        tested[len(names)].append(len(set(names)) < len(names))
    for level in (1, 2, 3, 4, 5):
        axis, twice = LayoutAxis(levels=(level,)), 0
        for key in range(200):
            added = axis.sample(seeding.rng("twice", key), PLATE, key).objects
            assert len({one.name for one in added}) == len({one.category for one in added})
            twice += len(set(added)) < level
        # Three standard deviations of 200 samples, and of the 106 to 207 test tasks.
        assert twice / 200 == pytest.approx(np.mean(tested[level]), abs=0.12)


def test_regions_are_those_of_the_test_set() -> None:
    """Of the objects that it adds to an arena, 95 % stand in the regions, and as many of them in front."""
    world_m = {"study": -0.2}
    for arena, room in ARENAS.items():
        known = room.regions
        places: Counter[tuple[float, float]] = Counter()
        for test in benchmark.load(REPOSITORY / benchmark.FOLDER).on_axis("layout"):
            if test.parameters["arena"] == arena:
                points = (pair.split(",") for pair in str(test.parameters["positions"]).split(";"))
                places.update((float(x) + world_m.get(arena, 0.0), float(y)) for x, y in points)
        front, back = (
            sum(count for at, count in places.items() if within(region, at)) for region in (known.front, known.back)
        )
        assert front + back >= 0.95 * places.total(), arena
        assert known.front_share == pytest.approx(front / (front + back), abs=0.01), arena


@pytest.mark.parametrize("arena", ["tabletop", "kitchen", "living_room", "floor"])
def test_places_are_on_the_cameras_side_as_often_as_the_test_s(arena: Arena) -> None:
    """At x > 0.19 m, where a place is sampled first; one that does not fit there is sampled in the other region."""
    tested = [
        float(pair.split(",")[0])
        for test in benchmark.load(REPOSITORY / benchmark.FOLDER).on_axis("layout")
        if test.parameters["arena"] == arena
        for pair in str(test.parameters["positions"]).split(";")
    ]
    sampled = []
    for key in range(1000):
        keyed = seeding.rng("side", arena, key)
        first, _ = ARENAS[arena].regions.order(keyed)
        sampled.append(first.sample(keyed)[0])
    assert np.mean(np.array(sampled) > 0.19) == pytest.approx(np.mean(np.array(tested) > 0.19), abs=0.13)


def within(region: Region, at_m: Sequence[float]) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(at_m, region, strict=True))


def test_objects_are_of_no_category_of_the_test_set_the_scene_or_the_instruction() -> None:
    counts: Counter[str] = Counter()
    for task in (task for suite in ("libero_spatial", "libero_goal", "libero_10") for task in tasks(suite)):
        for variant in range(3):
            for added in LayoutAxis().sample(seeding.rng(task.name, variant), task, variant).objects:
                counts[added.category] += 1
                assert added.category not in TEST_CATEGORIES | taken(task)
                assert goes_with(models(("libero", "robosuite"))[added.name], taken(task))
    assert len(counts) >= 15


def test_what_was_there_keeps_its_state_and_its_text_exactly(base: Scene, changed: Scene) -> None:
    model, _ = restored(changed)
    nq, nv = model.nq - 21, model.nv - 18
    np.testing.assert_array_equal(changed.state[: 1 + nq], base.state[: 1 + nq])
    np.testing.assert_array_equal(changed.state[1 + model.nq : 1 + model.nq + nv], base.state[1 + nq :])
    np.testing.assert_array_equal(changed.state[1 + model.nq + nv :], 0.0)
    head, _, tail = base.model_xml.rpartition("</worldbody>")
    assets, _, bodies = head.rpartition("</asset>")
    assert changed.model_xml.startswith(assets)
    assert bodies in changed.model_xml
    assert changed.model_xml.endswith(tail)


def test_the_gripper_and_the_controller_start_as_without_the_objects(changed: Scene) -> None:
    assert changed.start.gripper == -1.0
    assert changed.start.posture_rad == tuple(HOME_RAD)


def test_nothing_of_the_scene_s_physics_changed(base: Scene, changed: Scene) -> None:
    before, after = restored(base)[0], restored(changed)[0]
    for kind, prefix in (("body", "body_"), ("jnt", "jnt_"), ("geom", "geom_"), ("actuator", "actuator_")):
        for name in dir(before):
            was = getattr(before, name)
            if not name.startswith(prefix) or not isinstance(was, np.ndarray) or was.size == 0:
                continue
            if "adr" in name or name.endswith(("id", "num")) or (kind == "body" and "subtree" in name):
                continue  # places in other arrays
            now = getattr(after, name)
            if kind == "geom":
                # By name: the world's own geoms come first in both, then the bodies in the order of the text.
                now = now[after.geom_bodyid < before.nbody]
            np.testing.assert_array_equal(now[: len(was)], was, err_msg=name)
    for name in ("gravity", "timestep", "impratio", "density", "viscosity", "cone", "integrator", "solver"):
        np.testing.assert_array_equal(getattr(after.opt, name), getattr(before.opt, name), err_msg=name)
    assert [before.joint(j).name for j in range(before.njnt)] == [after.joint(j).name for j in range(before.njnt)]


def test_objects_are_at_rest_on_the_table(changed: Scene) -> None:
    model, data = restored(changed)
    start = data.qpos[-21:].reshape(3, 7).copy()
    held = [joint for joint in range(model.njnt) if model.joint(joint).name.startswith(ROBOT)]
    robot = data.qpos[model.jnt_qposadr[held]].copy()
    speeds = []
    for _ in range(100):
        mujoco.mj_step(model, data)
        data.qpos[model.jnt_qposadr[held]], data.qvel[model.jnt_dofadr[held]] = robot, 0.0
        speeds.append(np.abs(data.qvel[-18:].reshape(3, 6)[:, :3]).max())
    assert np.median(speeds) < 1e-3
    assert np.abs(data.qpos[-21:].reshape(3, 7) - start)[:, :3].max() < 2e-4
    np.testing.assert_allclose(start[:, 2], 0.9, atol=0.003)
    for place_, recorded in zip(start, changed.resolved["layout"]["objects"], strict=True):
        assert place_.tolist() == [*recorded["position_m"], *recorded["quaternion_wxyz"]]


def test_objects_touch_the_table_only_and_the_demonstration_passes_them_by(
    base: Scene, demo: Demo, changed: Scene
) -> None:
    model, data = restored(changed)
    added = np.isin(model.geom_bodyid, [model.body(f"layout{number}").id for number in range(3)])
    table = model.body("table").id
    model.geom_margin[added] = CLEARANCE_M
    model.body_margin[model.geom_bodyid[added]] = CLEARANCE_M
    states, nq = roll_out(base, demo), model.nq - 21
    assert len(states) > 50
    for state in states:
        data.qpos[:nq] = state[1 : 1 + nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            one, other = contact.geom
            if added[one] != added[other]:
                assert model.geom_bodyid[other if added[one] else one] == table


def test_objects_stand_in_the_regions_of_the_arena(changed: Scene) -> None:
    known = ARENAS["tabletop"].regions
    for placed in changed.resolved["layout"]["objects"]:
        assert within(known.front, placed["position_m"][:2]) or within(known.back, placed["position_m"][:2])


def test_objects_hide_a_third_of_a_thing_at_most(tmp_path: Path, base: Scene, demo: Demo) -> None:
    """Rendered: posts, which hide more than small objects do; for these, one place was rejected for it."""
    file = tmp_path / "post.xml"
    file.write_text('<mujoco><worldbody><body><geom type="box" size=".05 .03 .14"/></body></worldbody></mujoco>')
    crowded = place(base, demo, [ObjectModel("own/post", "post", "", "", file)] * 4, seed=3, roll_out=roll_out)
    assert crowded.resolved["layout"]["rejected"]["hides_target"]
    before, after = (things_px(scene) for scene in (base, crowded))
    hidden = [1 - after[thing] / before[thing] for thing in before]
    assert 0.05 < max(hidden) < HIDDEN + 0.02


def things_px(scene: Scene) -> dict[str, int]:
    renderer = Renderer(scene.model_xml)
    renderer.restore(scene.state, renderer.model.site_rgba[:, 3].astype(np.float32))
    seen = Sight.of(renderer, PLATE, np.zeros((1, 3))).things_px
    renderer.close()
    return seen


def test_every_object_shows_as_much_as_was_recorded(changed: Scene) -> None:
    renderer = Renderer(changed.model_xml)
    renderer.restore(changed.state, renderer.model.site_rgba[:, 3].astype(np.float32))
    rendered_px = Sight.of(renderer, PLATE, np.zeros((1, 3))).added_px
    renderer.close()
    recorded_px = [placed["seen_px"] for placed in changed.resolved["layout"]["objects"]]
    assert min(rendered_px) >= SEEN_PX
    # At an outline, a ray may meet another thing than is rendered.
    np.testing.assert_allclose(recorded_px, rendered_px, rtol=0.1, atol=10)


@pytest.mark.parametrize(
    ("seen_px", "enough"),
    [([SEEN_PX], True), ([SEEN_PX - 1], False), ([0, 99], True), ([0, 0, 99], False), ([0, 99, 99, 99, 99], True)],
)
def test_one_object_at_most_may_be_hidden(seen_px: list[int], enough: bool) -> None:
    assert enough_seen(seen_px) is enough
    assert Sight({}, 0.0, tuple(seen_px)).faults(Sight({}, 0.0)) == ([] if enough else ["added_objects_not_seen"])


def test_the_demonstration_still_succeeds_among_the_objects(
    environment: Environment, demo: Demo, three: LayoutPerturbation
) -> None:
    # Open-loop, so that nothing makes up for an object that is in the way.
    trajectory = replay(environment, demo, "layout", ReplayConfig(mode="open_loop"), (three,))
    assert trajectory.verdict.kept, trajectory.verdict.reason
    assert np.abs(trajectory.states[-1, -18:]).max() < 0.05, "nothing was knocked over"


def test_impossible_wishes_are_rejected_with_their_reason(tmp_path: Path, base: Scene, demo: Demo) -> None:
    file = tmp_path / "crate.xml"
    file.write_text('<mujoco><worldbody><body><geom type="box" size=".25 .25 .25"/></body></worldbody></mujoco>')
    crate = ObjectModel("own/crate", "crate", "", "", file)
    with pytest.raises(RejectedError) as rejected:
        place(base, demo, [crate] * 5, seed=0, roll_out=roll_out)
    assert rejected.value.reason in ("layout_in_the_way", "layout_out_of_view", "layout_off_the_surface")


def test_an_object_that_has_changed_is_rejected(three: LayoutPerturbation, base: Scene, demo: Demo) -> None:
    stale = three.objects[0].model_copy(update={"sha256": "0" * 64})
    with pytest.raises(PipelineError, match="differs from the planned object"):
        LayoutPerturbation(level=1, objects=(stale,), seed=0).apply(base, demo, roll_out)


def test_distance_to_the_test_set_is_by_category_in_the_same_scene(three: LayoutPerturbation) -> None:
    def test_task(base: Task, category: str) -> TestTask:
        return TestTask(base.suite, base.name, f"{base.name}_add_1", "layout", "objects", {"category": category})

    # All tasks of the goal suite begin in one scene.
    test = TestSet((test_task(STOVE, "canned_food__1,can_of_sardines"), test_task(MILK, "bag_of_yeast")))
    assert three.nearest(test, PLATE) == (float("inf"), 1)
    same = three.objects[0].model_copy(update={"category": "canned_food"})
    nearest = three.model_copy(update={"objects": (*three.objects, same)}).nearest(test, PLATE)
    assert nearest.distance < LayoutPerturbation.clearance
