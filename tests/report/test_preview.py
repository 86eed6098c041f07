"""Contact sheets of real scenes: every layer, both views, rejections, and the sheets of a run."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
import pytest
from arenas import TASKS
from checkout import REPOSITORY
from PIL import Image
from short_demonstrations import BOWL, MILK, PLATE, starter_demo

from pipeline import __main__ as command_line
from pipeline.axes import AXES, Axes, Perturbation, PhysicsPerturbation, RenderPerturbation, components_of, to_json
from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import Axis, Nearest
from pipeline.axes.camera import CameraAxis
from pipeline.axes.disturbance import DisturbanceAxis
from pipeline.axes.language import LanguageAxis
from pipeline.axes.pose import PoseAxis
from pipeline.axes.robot import RobotAxis
from pipeline.compute.pool import loop
from pipeline.config import PlanConfig, load
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError, RejectedError
from pipeline.images.jpeg import decode, encode
from pipeline.libero.demonstrations import DemoEntry
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.planning import plan
from pipeline.planning.streams import streams_of
from pipeline.rendering.render import render
from pipeline.rendering.renderer import scene_of_process
from pipeline.report import preview, sheets
from pipeline.seeding import rng
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Demo, Episode, Frame, RollOut, Scene, Task, Trajectory, Verdict

if TYPE_CHECKING:
    import mujoco

STARTER = load(REPOSITORY / "configs" / "starter.yaml")
VIEWS = tuple(SCHEMA.views)
COOKIES = find_task("libero_spatial", "pick_up_the_black_bowl_on_the_cookie_box_and_place_it_on_the_plate")
NO_TESTS = TestSet(())


@pytest.fixture(scope="module")
def stage() -> Iterator[preview.StagedTask]:
    # Its task has something to move, so that all axes but goal apply.
    yield preview.staged([BOWL], STARTER)
    scene_of_process().close()


class Dimming(RenderPerturbation):
    axis: Literal["dimming"] = "dimming"
    component: Literal["lamp", "window"] = "lamp"
    views: ClassVar[frozenset[str]] = frozenset(VIEWS)
    fields: ClassVar[tuple[str, ...]] = ("light_diffuse",)
    clearance: ClassVar[float] = 0.0

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        return Nearest(np.inf, 0)

    def apply(self, model: mujoco.MjModel) -> None:
        model.light_diffuse[:] *= 1 - self.level / 5


class Lift(PhysicsPerturbation):
    """Lifts the arm, in a scene of its own when it is the window's; too much is rejected."""

    axis: Literal["lift"] = "lift"
    component: Literal["lamp", "window"] = "lamp"
    clearance: ClassVar[float] = 0.0

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        return Nearest(np.inf, 0)

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        if self.level == 5:
            raise RejectedError("too_high")
        state = scene.state.copy()
        state[2] += 0.1 * self.level
        name = "other" if self.component == "window" else "model"
        return replace(scene, state=state, model_xml=scene.model_xml.replace('model="', f'model="{name}', 1))


class StubAxis(Axis):
    """An axis that samples one of the two kinds above."""

    kind: type[Dimming] | type[Lift]

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> Any:
        component = ("lamp", "window")[rng.integers(2)]
        return self.kind.model_validate({"component": component, "level": self.sample_level(rng)})


def tiles(sheet: Image.Image, views: int) -> list[Frame]:
    """The pictures of a sheet with captions of one line, in order."""
    side = preview.SIDE_PX[views]
    width, height = views * side + sheets.GAP_PX, side + 2 * sheets.LINE_PX
    return [
        np.asarray(sheet.crop((left, top, left + views * side, top + side)))
        for top in range(2 * sheets.LINE_PX, sheet.height, height)
        for left in range(sheets.GAP_PX, sheet.width - sheets.GAP_PX, width)
    ]


@pytest.mark.parametrize("name", AXES)
def test_every_axis_changes_no_other_views_than_it_says_and_leaves_the_stage_as_it_was(
    stage: preview.StagedTask, name: str
) -> None:
    if not AXES[name]().applies(stage.demo.task):
        stage = preview.staged([COOKIES], STARTER)
    before = stage.frames(VIEWS)
    for perturbation in reversed(preview.variants(name, preview.configured(name, STARTER), stage.demo, 1, NO_TESTS)):
        try:
            after = stage.frames(VIEWS, perturbation)
            break
        except RejectedError as rejected:
            reason = rejected.reason
    else:
        pytest.fail(f"this scene rejects every perturbation: {reason}")
    changed = {view for view, a, b in zip(VIEWS, before, after, strict=True) if not np.array_equal(a, b)}
    # It may change less, as the wrist sees no walls.
    assert changed <= perturbation.views
    assert bool(changed) == bool(perturbation.views)
    assert all(np.array_equal(a, b) for a, b in zip(before, stage.frames(VIEWS), strict=True))


@pytest.mark.parametrize("name", ["camera", "noise", "language"])
def test_variants_cover_components_and_levels(stage: preview.StagedTask, name: str) -> None:
    axis = preview.configured(name, STARTER)
    sampled = preview.variants(name, axis, stage.demo, 1, NO_TESTS)
    assert sampled == preview.variants(name, axis, stage.demo, 1, NO_TESTS)
    assert sampled != preview.variants(name, axis, stage.demo, 2, NO_TESTS) or name == "language"
    assert len({p.model_dump_json() for p in sampled}) == preview.VARIANTS
    counts = Counter(p.component for p in sampled)
    kinds = get_args(type(sampled[0]).model_fields["component"].annotation)
    assert set(counts) == set(kinds)
    assert max(counts.values()) - min(counts.values()) <= 1
    assert {p.level for p in sampled} == {1, 2, 3, 4, 5}


@pytest.mark.parametrize("name", ["language", "pose", "camera"])
def test_the_preview_of_an_axis_shows_the_plans_perturbations(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the benchmark's tasks, which the plan keeps clear of: the last displacement is sampled again."""
    monkeypatch.chdir(REPOSITORY)
    for count in ("CANDIDATES", "VARIANTS", "PHYSICS_VARIANTS"):
        monkeypatch.setattr(preview, count, 12)
    test, demo, axis = benchmark.load(), starter_demo(MILK), preview.configured(name, STARTER)
    config = PlanConfig.model_validate({"seed": 5, "axes": {name: axis}, "episodes": {name: 12}, "reserve": 0})
    entry = DemoEntry(MILK, demo.key, demo.source, demo.origin, demo.sha256, len(demo.actions))
    rows = [row for row in plan.make([entry], config, STARTER.replay, test) if row.role == "perturbed"]
    shown = preview.variants(name, axis, demo, 5, test)
    assert {to_json([perturbation]) for perturbation in shown} == {row.perturbations for row in rows}


def test_the_preview_of_a_combination_shows_the_plans_perturbations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    name = "camera+noise+language"
    monkeypatch.setattr(preview, "CANDIDATES", 12)
    monkeypatch.setattr(preview, "VARIANTS", 12)
    test, demo = benchmark.load(), starter_demo(MILK)
    config = PlanConfig.model_validate({"seed": 5, "episodes": {name: 12}, "reserve": 0})
    entry = DemoEntry(MILK, demo.key, demo.source, demo.origin, demo.sha256, len(demo.actions))
    rows = [row for row in plan.make([entry], config, STARTER.replay, test) if row.role == "perturbed"]
    shown = preview.combinations(name, preview.axes_for(name, STARTER), demo, 5, test)
    assert {to_json(perturbations) for perturbations in shown} == {row.perturbations for row in rows}


def test_a_sheet_of_a_combination_covers_its_components_and_changes_pictures_together(
    stage: preview.StagedTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[Perturbation, ...]] = []
    frames = preview.StagedTask.frames

    def recorded(self: preview.StagedTask, views: Any, *perturbations: Perturbation) -> list[Frame]:
        shown.append(perturbations)
        return frames(self, views, *perturbations)

    monkeypatch.setattr(preview.StagedTask, "frames", recorded)
    sheet = preview.axis_sheet(stage, "light+noise", STARTER, NO_TESTS)
    nothing, *sampled = shown
    assert (nothing, len(sampled)) == ((), preview.VARIANTS)
    assert {(light.axis, noise.axis) for light, noise in sampled} == {("light", "noise")}
    assert {noise.component for _, noise in sampled} == set(components_of("noise"))
    assert {light.component for light, _ in sampled} == set(components_of("light"))
    assert sheet.width == 4 * (2 * preview.SIDE_PX[2] + sheets.GAP_PX) + sheets.GAP_PX
    light, noise = sampled[0]
    both, lit, noisy = (frames(stage, VIEWS, *changes) for changes in ((light, noise), (light,), (noise,)))
    assert not np.array_equal(both[0], lit[0])
    assert not np.array_equal(both[0], noisy[0])
    np.testing.assert_array_equal(both[1], lit[1], "noise leaves the wrist view")


def test_a_combination_without_anything_left_is_an_error() -> None:
    descriptions = Axes(language=LanguageAxis(components=("common_sense",)))
    config = STARTER.model_copy(update={"plan": STARTER.plan.model_copy(update={"axes": descriptions})})
    with pytest.raises(
        PipelineError, match=r"with layout, axes\.language\.components must contain distraction or paraphrase"
    ):
        preview.axes_for("layout+language", config)


def test_a_sheet_of_both_views(stage: preview.StagedTask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview, "configured", lambda name, config: StubAxis(kind=Dimming))
    original, *variants = tiles(preview.axis_sheet(stage, "dimming", STARTER, NO_TESTS), 2)
    # Two components at five levels are all that there is.
    brightness = [variant.mean() for variant in variants[:10]]
    assert brightness[0] < original.mean()
    for component in (brightness[:5], brightness[5:]):
        assert component == sorted(component, reverse=True)
    assert (variants[10] == 255).all()


def test_perturbations_that_a_scene_rejects_are_grey(
    stage: preview.StagedTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "configured", lambda name, config: StubAxis(kind=Lift, levels=(1, 5)))
    monkeypatch.setattr(preview, "PHYSICS_VARIANTS", 4)
    captions: list[str] = []

    def tile(picture: Image.Image, caption: str) -> sheets.Tile:
        captions.append(caption)
        return sheets.Tile(picture, caption[:20])

    monkeypatch.setattr(preview, "Tile", tile)
    sheet = preview.axis_sheet(stage, "lift", STARTER, NO_TESTS)
    assert captions[1:] == [
        "lamp, level 1",
        "rejected, too_high: lamp, level 5",
        "window, level 1",
        "rejected, too_high: window, level 5",
    ]
    original, *variants = tiles(sheet, 2)
    assert [(variant == preview.REJECTED_GREY).all() for variant in variants[:4]] == [False, True, False, True]
    # Both lifts are the same, whether the scene's model was compiled again or not.
    assert not np.array_equal(variants[0], original)
    assert np.array_equal(variants[0], variants[2])


def test_the_original_is_the_same_after_a_state_with_a_lit_burner(stage: preview.StagedTask) -> None:
    (before,) = stage.frames(["image"])
    renderer = stage.opened.renderer(stage.scene.model_xml)
    renderer.restore(stage.scene.state, np.full(renderer.model.nsite, 1.0, np.float32))
    np.testing.assert_array_equal(stage.frames(["image"])[0], before)


def test_the_original_is_what_a_run_renders(stage: preview.StagedTask) -> None:
    environment = Environment(BOWL)
    environment.restore(stage.scene)
    environment.settle(10)
    begun = Trajectory(
        trajectory_id="begun",
        mode="open_loop",
        scene=stage.scene,
        states=np.stack([environment.state] * 2),
        actions=np.zeros((1, 7)),
        site_alpha=np.stack([environment.site_alpha] * 2),
        verdict=Verdict(True, "kept"),
    )
    environment.close()
    shown = stage.frames(VIEWS)
    streams = streams_of("[]")
    rendered = render(begun, BOWL, list(streams.values()), STARTER.render, stage.opened)
    stage.opened.close()
    for view, frame in zip(VIEWS, shown, strict=True):
        compressed = decode(rendered.streams[streams[view].stream_id][0])
        assert np.abs(compressed.astype(int) - frame).mean() < 2


@pytest.mark.slow
def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sheet"
    monkeypatch.chdir(REPOSITORY)
    monkeypatch.setattr(
        "sys.argv", ["pipeline", "preview", "libero_goal/put_the_bowl_on_the_p*", "language", "--out", str(out)]
    )
    assert command_line.main() == 0
    assert f"libero_goal/{BOWL.name}" in capsys.readouterr().out
    with Image.open(out) as sheet:
        assert sheet.format == "PNG"
        assert sheet.width == 4 * (preview.SIDE_PX[1] + sheets.GAP_PX) + sheets.GAP_PX


@pytest.mark.slow
def test_the_command_shows_all_axes_next_to_the_twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "axes.jpg"
    monkeypatch.chdir(REPOSITORY)
    monkeypatch.setattr("sys.argv", ["pipeline", "preview", f"{BOWL.suite}/{BOWL.name}", "all", "--out", str(out)])
    assert command_line.main() == 0
    side = SCHEMA.frame.shape[1]
    pitch = side + sheets.GAP_PX
    with Image.open(out) as sheet:
        assert sheet.format == "JPEG"
        assert sheet.width == 5 * pitch + sheets.GAP_PX
        row = np.asarray(sheet).astype(int)[2 * sheets.LINE_PX :][:side, sheets.GAP_PX :]
    twin, layout, pose = (row[:, left : left + side] for left in (0, pitch, 2 * pitch))
    assert [np.abs(tile - twin).mean() > 2 for tile in (layout, pose)] == [True, True]


def test_an_overview_shows_a_perturbation_of_a_middle_level_that_the_scene_accepts(
    stage: preview.StagedTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "configured", lambda name, config: StubAxis(kind=Lift, levels=(1, 5)))
    monkeypatch.setattr(preview, "PHYSICS_VARIANTS", 6)
    captions: list[str] = []

    def tile(picture: Image.Image, caption: str) -> sheets.Tile:
        captions.append(caption)
        return sheets.Tile(picture, caption)

    monkeypatch.setattr(preview, "Tile", tile)
    preview.overview(stage, STARTER, NO_TESTS)
    assert captions[0] == f"clean twin: {BOWL.instruction}"
    # Levels 1 and 5 are as far from 3; level 5, which comes first, is rejected.
    assert captions[1:] == ["lift: lamp, level 1"] * len(Axes.model_fields)
    monkeypatch.setattr(preview, "configured", lambda name, config: StubAxis(kind=Lift, levels=(5,)))
    captions.clear()
    preview.overview(stage, STARTER, NO_TESTS)
    rejected = {f"rejected, too_high: lift: {component}, level 5" for component in ("lamp", "window")}
    assert len(captions) == 1 + len(Axes.model_fields)
    assert set(captions[1:]) <= rejected
    # No paraphrase of the task is of level 5, as no task of libero_90 has rewrites.
    monkeypatch.setattr(
        preview, "configured", lambda name, config: LanguageAxis(components=("paraphrase",), levels=(5,))
    )
    captions.clear()
    preview.overview(stage, STARTER, NO_TESTS)
    assert captions == [f"clean twin: {BOWL.instruction}"]


@pytest.mark.slow
def test_the_sheets_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview, "VARIANTS", 2)
    tasks = tuple(f"{task.suite}/{task.name}" for task in (BOWL, MILK))
    config = STARTER.model_copy(
        update={
            "demos": STARTER.demos.model_copy(update={"tasks": tasks}),
            "plan": STARTER.plan.model_copy(update={"axes": Axes(language=LanguageAxis())}),
        }
    )
    preview.for_run(config, tmp_path / "previews", loop)
    assert {folder.name for folder in (tmp_path / "previews").iterdir()} == {BOWL.suite, MILK.suite}
    for folder in (tmp_path / "previews").iterdir():
        with Image.open(folder / "language.png") as sheet:
            assert np.asarray(sheet).std() > 20


def stills(steps: int) -> Episode:
    """Frames with the step in their grey level."""
    frames = [encode(np.full((256, 256, 3), 8 * step, np.uint8), STARTER.render.jpeg_quality) for step in range(steps)]
    nothing = np.zeros((steps, 7), np.float32)
    return Episode("", {"image": frames}, nothing, nothing, nothing, nothing, "", {}, {})


def of_run(name: str, twin: str, change: Perturbation | None = None, reason: str = "kept") -> dict[str, Any]:
    """A row of the manifest."""
    changes = [change] if change else []
    row = {"episode_id": name, "twin_id": twin, "role": "perturbed" if change else "twin", "kept": reason == "kept"}
    row |= {"axis": change.axis if change else "clean", "perturbations": to_json(changes), "reason": reason}
    return row | {"component": "", "level": "1", "suite": BOWL.suite, "task": BOWL.name}


def shown_next_to_twins(rows: list[dict[str, Any]], folder: Path) -> dict[str, list[int]]:
    """Axis to the steps of its twin and its episode on the only pair of its sheet."""
    lengths = {"twin": 10, "push": 20, "view": 20}
    sheets.write(rows, lambda name: stills(lengths[name]), folder)
    found = {}
    for file in folder.iterdir():
        with Image.open(file) as sheet:
            assert sheet.width == 2 * (sheets.PAIR_SIDE_PX + sheets.GAP_PX)
            middles = [sheets.GAP_PX + share * sheets.PAIR_SIDE_PX // 2 for share in (1, 3)]
            found[file.stem] = [round(np.asarray(sheet)[100, middle].mean() / 8) for middle in middles]
    return found


VIEW = CameraAxis().sample(rng("sheets"), BOWL, 0)
START = RobotAxis().sample(rng("sheets"), BOWL, 0)
PUSH = DisturbanceAxis(first_step=((9, 9),), steps=((4, 4),)).sample(rng("sheets"), BOWL, 0)


@pytest.mark.parametrize("reason", ["kept", "left_out"])
def test_sheets_show_the_pairs_of_a_run_whose_twin_is_there(reason: str, tmp_path: Path) -> None:
    rows = [of_run("twin", "twin", reason=reason), of_run("view", "twin", VIEW)]
    rows += [of_run("gone", "gone", reason="goal_not_reached"), of_run("alone", "gone", VIEW)]
    assert shown_next_to_twins(rows, tmp_path / "sheets") == {"camera": [3, 7]}
    assert shown_next_to_twins(rows[2:], tmp_path / "none") == {}


@pytest.mark.parametrize(("change", "steps"), [(START, [0, 0]), (PUSH, [9, 13])])
def test_sheets_show_a_start_at_once_and_a_push_when_it_ends(
    change: Perturbation, steps: list[int], tmp_path: Path
) -> None:
    rows = [of_run("twin", "twin"), of_run("push", "twin", change)]
    assert shown_next_to_twins(rows, tmp_path / "sheets") == {change.axis: steps}


def test_a_caption_names_the_coverings_that_the_scene_shows() -> None:
    """As many as the textures of LIBERO's arenas: only kitchens have cupboards, and some tasks work on the floor."""
    axis = BackgroundAxis(components=("theme",), sources=("procedural",))
    theme = axis.sample(rng("caption"), MILK, 0)
    named = {arena: sheets.describe(theme, task) for arena, task in TASKS.items()}
    counts = {arena: caption.count("texture") for arena, caption in named.items()}
    assert counts == {"tabletop": 3, "floor": 2, "kitchen": 4, "living_room": 3, "study": 3}
    assert [arena for arena, caption in named.items() if "cupboard" in caption] == ["kitchen"]


def test_a_value_is_not_parted_from_its_name() -> None:
    lines = sheets._wrapped("level 3: azimuth_deg\N{NO-BREAK SPACE}12.5, elevation_deg\N{NO-BREAK SPACE}7", 120)
    assert lines == ["level 3:", "azimuth_deg 12.5,", "elevation_deg 7"]


def test_a_sheet_of_a_large_run_shows_every_component_suite_and_level() -> None:
    """The first sixteen rows of this plan are of one suite, one component and one task."""
    combinations = itertools.product(range(3), range(4), range(1, 6), range(10), range(2))
    rows = [
        {"component": f"component {component}", "suite": f"suite {suite}", "level": level, "task": f"{suite}.{task}"}
        for component, suite, level, task, _ in combinations
    ]
    shown = sheets.spread(rows, 16)
    counts = {column: Counter(row[column] for row in shown) for column in ("component", "suite", "level", "task")}
    assert {column: sorted(count.values()) for column, count in counts.items()} == {
        "component": [5, 5, 6],
        "suite": [4, 4, 4, 4],
        "level": [3, 3, 3, 3, 4],
        "task": [1] * 16,
    }
    few = sheets.spread(rows[:3], 16)
    assert sorted(map(str, few)) == sorted(map(str, rows[:3]))


@pytest.mark.slow
def test_an_axis_without_a_perturbation_for_the_first_task_is_reported_on_its_sheet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever half a millimetre puts the plate, a test has it within 5 mm."""
    monkeypatch.chdir(REPOSITORY)
    captions: list[str] = []

    def tile(picture: Image.Image, caption: str) -> sheets.Tile:
        captions.append(caption)
        return sheets.Tile(picture, caption)

    monkeypatch.setattr(preview, "Tile", tile)
    still = PoseAxis(components=("target",), levels=(1,), step_m=0.0005, turn_deg=0)
    axes = Axes(pose=still, language=LanguageAxis())
    config = STARTER.model_copy(
        update={
            "demos": STARTER.demos.model_copy(update={"tasks": (str(PLATE),)}),
            "plan": STARTER.plan.model_copy(update={"axes": axes}),
        }
    )
    preview.for_run(config, tmp_path / "previews", loop)
    assert {file.name for file in (tmp_path / "previews" / PLATE.suite).iterdir()} == {"pose.png", "language.png"}
    assert captions.count("no perturbation of pose keeps its clearance to the test set in this task") == 1
