"""Preview: the effect of an axis or a combination on a task, as a contact sheet in the manner of the paper's appendix.

Every picture shows the first state of the demonstration without a replay. A single push is shown in its replay, and a
push of a combination at its end. A plan with the same seed samples the same perturbations for the demonstration,
unless several demonstrations of a task share the list of ``language`` or ``goal``.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path

from PIL import Image

from pipeline.axes import AXES, Axis, Perturbation, PhysicsPerturbation, TextPerturbation, carried_task, of_layer
from pipeline.axes.language import LanguageAxis
from pipeline.compute.pool import Workers
from pipeline.config import Config, ReplayConfig
from pipeline.errors import PipelineError, RejectedError
from pipeline.files import replaced
from pipeline.grouping import grouped
from pipeline.libero.demonstrations import Problem
from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import select_tasks
from pipeline.physics.environment import environment_of
from pipeline.physics.reference import Reference
from pipeline.physics.replay import at_reset, compute_settled_state, replay, roll_out
from pipeline.planning.sampler import Sampler
from pipeline.planning.streams import Stream
from pipeline.rendering.render import frames_of
from pipeline.rendering.renderer import LastScene, scene_of_process
from pipeline.report.sheets import Tile, describe, describe_all, lettering, sheet, side_by_side
from pipeline.run.foreign import reject_foreign_files
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Demo, Frame, Scene, Task, Trajectory

VARIANTS, PHYSICS_VARIANTS = 11, 3
"""Numbers of variants: with the original, three rows of four, or one row if each variant is compiled as a scene."""
STRIP_STEPS = (0, 6, 16)
"""Control steps after the end of a push that a strip shows, in addition to its first step."""
AFTER_PUSH_STEPS = 3
"""Control steps from the end of a push to its picture, when the hand is furthest from its path."""
SHOWN_LEVEL = 3
"""Preferred level of the perturbations in an overview: visible but not extreme."""
CANDIDATES = 200
"""Number of the plan's first perturbations from which the variants are chosen; most take under a millisecond."""

SIDE_PX = {1: 256, 2: 192, 3: 144, 4: 128, 5: 112, 6: 96}
"""Width of a frame, by the number of views of a tile."""
REJECTED_GREY = (160, 160, 160)


@dataclass
class StagedTask:
    """A task set up for rendering.

    Attributes:
        replay: settings of a run: settling, and treatment of the demonstration's no-ops.
    """

    demo: Demo
    scene: Scene
    opened: LastScene
    replay: ReplayConfig = field(default_factory=ReplayConfig)

    def frames(self, views: Sequence[str], *perturbations: Perturbation) -> list[Frame]:
        """Render the views, (H, W, 3) each, as a policy sees them under all of the perturbations.

        Raises:
            RejectedError: when a perturbation is impossible in this scene.
        """
        demo, scene = self._start(perturbations)
        for physics in of_layer(perturbations, PhysicsPerturbation):
            scene = physics.apply(scene, demo, partial(roll_out, replay_config=self.replay))
        renderer = self.opened.renderer(scene.model_xml)
        push = scene.start.push
        if push is None:
            state = compute_settled_state(scene, demo.task, self.replay)
        else:
            states = roll_out(scene, demo, self.replay)
            state = states[min(push.first_step + push.steps + AFTER_PUSH_STEPS, len(states) - 1)]
        streams = [Stream(view, perturbations) for view in views]
        return frames_of(renderer, state, renderer.site_alpha, streams, 0)

    def _start(self, perturbations: Sequence[Perturbation]) -> tuple[Demo, Scene]:
        """Return the demonstration and its scene, or those of a reset of the scene that it is carried to."""
        task = self.demo.task
        for perturbation in perturbations:
            task = perturbation.carry(task)
            seed = perturbation.reset_seed
            if seed is not None:
                demo = at_reset(environment_of(task), replace(self.demo, task=task), seed)
                return demo, recorded_start(demo, str(demo.model_xml), settles=self.replay.settle_steps > 0)
        return self.demo, self.scene

    @cached_property
    def _twin(self) -> Trajectory:
        return replay(environment_of(self.demo.task), self.demo, "twin", self.replay)

    def strip(self, perturbation: Perturbation) -> list[tuple[int, list[Frame]]]:
        """Render the agent view at some steps of a pushed replay, without and with the push.

        Raises:
            RejectedError: when the push is impossible in the demonstration, or its replay without one misses the goal.
        """
        twin = self._twin
        if not twin.verdict.kept:
            raise RejectedError(twin.verdict.reason)
        reference = Reference.of(twin.model_xml, twin.states, twin.actions)
        changes = of_layer((perturbation,), PhysicsPerturbation)
        pushed = replay(environment_of(self.demo.task), self.demo, "pushed", self.replay, changes, lambda: reference)
        push = pushed.scene.start.push
        if push is None:
            raise RejectedError(pushed.verdict.reason)
        renderer, stream = self.opened.renderer(pushed.model_xml), Stream("image", ())
        end = push.first_step + push.steps
        steps_and_frames = []
        for step in (push.first_step, *(end + after for after in STRIP_STEPS)):
            frames: list[Frame] = []
            for trajectory in (twin, pushed):
                at = min(step, len(trajectory.actions))
                frames += frames_of(renderer, trajectory.states[at], trajectory.site_alpha[at], [stream], at)
            steps_and_frames.append((step, frames))
        return steps_and_frames


def staged(tasks: Iterable[Task], config: Config) -> StagedTask:
    """Set up the first demonstration of any of the tasks in the configured source.

    Its scenes are rendered in the scene of this process (``scene_of_process``), which the caller closes at the end.

    Raises:
        PipelineError: when the source has no usable demonstration.
    """
    source = config.demos.open()
    problems: list[Problem] = []
    for task in tasks:
        index = source.index([task], 1)
        if index.entries:
            break
        problems += index.problems
    else:
        raise PipelineError(
            f"the source has no usable demonstration ({'; '.join(str(problem.error) for problem in problems)})",
            where="demos",
            remedy="correct the named demonstrations; configs/starter.yaml has demonstrations of LIBERO's own tasks",
        )
    demo = source.load(index.entries[0].demo_id)
    model_xml = demo.model_xml
    if model_xml is None:
        model_xml = environment_of(demo.task).place_fixtures(config.replay.fixture_seed)
    return StagedTask(
        demo, recorded_start(demo, model_xml, settles=config.replay.settle_steps > 0), scene_of_process(), config.replay
    )


def configured(name: str, config: Config) -> Axis:
    """Return the axis with the ranges of the configuration, or else with its default ranges."""
    return config.plan.axes.configured().get(name) or AXES[name]()


def axes_for(name: str, config: Config) -> tuple[Axis, ...]:
    """Return the axes of a name or a combination, such as ``camera+noise``, with the ranges that a plan would use.

    Raises:
        PipelineError: when an axis has nothing to sample together with the others.
    """
    axes = [configured(axis, config) for axis in name.split("+")]
    try:
        return tuple(axis.restrict_for(axes) for axis in axes)
    except ValueError as error:
        raise PipelineError(str(error), where="plan.axes", remedy="choose other axes") from error


def variants(name: str, axis: Axis, demo: Demo, seed: int, test: TestSet) -> list[Perturbation]:
    """Choose perturbations of one axis, as ``combinations`` does for several axes."""
    return [perturbation for (perturbation,) in combinations(name, (axis,), demo, seed, test)]


def combinations(
    name: str, axes: Sequence[Axis], demo: Demo, seed: int, test: TestSet
) -> list[tuple[Perturbation, ...]]:
    """Choose episodes of the plan that cover the components of each axis, and the levels of each component.

    The list is empty if no perturbation keeps the clearance to the test set.

    Returns:
        For each episode, one perturbation of each axis.

    Raises:
        PipelineError: when an axis cannot change the task, or no perturbation of a level keeps the clearance.
    """
    for axis, axis_name in zip(axes, name.split("+"), strict=True):
        if not axis.applies(demo.task):
            what = f"the axis {axis_name} cannot change the task {demo.task}"
            raise PipelineError(what, remedy="choose another task or another axis")
        axis.reject_levels_without_clearance(test, demo.task)
    samples = Sampler(name, axes, seed, test).sample(demo.demo_id, demo.task, expanded_by=demo.perturbations)
    left = list(islice(samples, CANDIDATES))
    chosen: list[tuple[Perturbation, ...]] = []
    count = PHYSICS_VARIANTS if left and of_layer(left[0], PhysicsPerturbation) else VARIANTS

    def wish(candidate: tuple[Perturbation, ...]) -> tuple[int, int, int]:
        """Rank a candidate: first rare components, then levels far from the chosen levels, then rare levels."""
        of_component, apart, of_level = 0, 0, 0
        for place, perturbation in enumerate(candidate):
            before = [perturbations[place] for perturbations in chosen]
            levels = [p.level for p in before if p.component == perturbation.component]
            of_component += len(levels)
            apart += min((abs(level - perturbation.level) for level in levels), default=0)
            of_level += sum(p.level == perturbation.level for p in before)
        return of_component, -apart, of_level

    while left and len(chosen) < count:
        chosen.append(min(left, key=wish))
        left.remove(chosen[-1])
    return sorted(chosen, key=lambda perturbations: [(p.component, p.level) for p in perturbations])


def axis_sheet(stage: StagedTask, name: str, config: Config, test: TestSet) -> Image.Image:
    """Render the sheet of an axis or a combination: the original first, then the variants with their parameters.

    A grey tile with the reason replaces a perturbation that is impossible in the scene.

    Args:
        name: an axis, or several axes joined by + in the order in which they apply (``pipeline.axes.axes_of``).
        test: the benchmark's test tasks, to which the plan's perturbations keep a clearance.
    """
    demo, seed = stage.demo, config.plan.seed
    sampled = combinations(name, axes_for(name, config), demo, seed, test)
    changed: set[str] = set()
    for perturbations in sampled:
        changed.update(*(p.views for p in perturbations))
    changed = changed or {"image"}
    views = [view for view in config.render.content.views if view in changed]
    side = SIDE_PX[len(views)]
    original = stage.frames(views)
    tiles = [Tile(side_by_side(original, side), f"original: {demo.task.instruction}")]
    if not sampled:
        tiles.append(_no_perturbation_tile(name, tiles[0].picture.size))
    strips: list[Tile] = []
    for perturbations in sampled:
        strips += _strip(stage, perturbations)
    if strips:
        tiles, sampled, views = strips, [], ["image"]
    for perturbations in sampled:
        caption = describe_all(perturbations, carried_task(demo.task, perturbations))
        try:
            # A perturbation of the instruction alone changes no frame.
            visible = any(p.views for p in perturbations)
            frames = stage.frames(views, *perturbations) if visible else original
            tiles.append(Tile(side_by_side(frames, side), caption))
        except RejectedError as rejected:
            tiles.append(_rejected_tile(rejected, caption, tiles[0].picture.size))
    moment = "replays" if strips else "first state"
    kind = "axes" if "+" in name else "axis"
    return sheet(f"{demo.demo_id}, {moment}; {kind} {name}, seed {seed}; {', '.join(views)}", tiles)


def _strip(stage: StagedTask, perturbations: Sequence[Perturbation]) -> list[Tile]:
    """Render the strip of a push that is the only perturbation; empty for any other perturbation."""
    push = perturbations[0]
    if len(perturbations) > 1 or push.acts_until is None:
        return []
    caption = f"without and with {describe(push, stage.demo.task)}"
    try:
        steps_and_frames = stage.strip(push)
    except RejectedError as rejected:
        return [_rejected_tile(rejected, caption)]
    return [Tile(side_by_side(frames, SIDE_PX[2]), f"step {step}, {caption}") for step, frames in steps_and_frames]


def overview(stage: StagedTask, config: Config, test: TestSet) -> Image.Image:
    """Render one sheet of all axes: the agent view of the clean twin, then one perturbation of each axis that applies.

    The perturbation of an axis is one of the plan's first that is possible in the scene, with the level nearest to
    ``SHOWN_LEVEL``. A rewritten instruction is printed in place of the unchanged view.

    Args:
        test: the benchmark's test tasks, to which the plan's perturbations keep a clearance.
    """
    demo = stage.demo
    tiles = [Tile(Image.fromarray(stage.frames(["image"])[0]), f"clean twin: {demo.task.instruction}")]
    for name in AXES:
        axis = configured(name, config)
        without_rewrites = isinstance(axis, LanguageAxis) and not axis.list_clear_rewrites(demo.task, test)
        if axis.applies(demo.task) and not without_rewrites:
            sampled = variants(name, axis, demo, config.plan.seed, test)
            tiles.append(_typical(stage, sampled) if sampled else _no_perturbation_tile(name))
    return sheet(f"{demo.task}: first frame of the agent view, one perturbation of each axis", tiles, 5)


def _typical(stage: StagedTask, sampled: Sequence[Perturbation]) -> Tile:
    for perturbation in sorted(sampled, key=lambda p: (abs(p.level - SHOWN_LEVEL), -p.level)):
        caption = f"{perturbation.axis}: {perturbation.component.replace('_', ' ')}, level {perturbation.level}"
        try:
            (frame,) = stage.frames(["image"], perturbation)
        except RejectedError as rejected:
            last = rejected, caption
        else:
            for text in of_layer((perturbation,), TextPerturbation):
                return Tile(lettering(text.apply(stage.demo.task.instruction), SIDE_PX[1]), caption)
            return Tile(Image.fromarray(frame), caption)
    return _rejected_tile(*last)


def _no_perturbation_tile(name: str, size_px: tuple[int, int] = (SIDE_PX[1], SIDE_PX[1])) -> Tile:
    caption = f"no perturbation of {name} keeps its clearance to the test set in this task"
    return Tile(Image.new("RGB", size_px, REJECTED_GREY), caption)


def _rejected_tile(why: RejectedError, caption: str, size_px: tuple[int, int] = (SIDE_PX[1], SIDE_PX[1])) -> Tile:
    return Tile(Image.new("RGB", size_px, REJECTED_GREY), f"rejected, {why.reason}: {caption}")


def for_run(config: Config, folder: Path, workers: Workers) -> None:
    """Write a sheet for every configured axis that applies, on the first task of each suite of the run.

    The path of a sheet is ``<folder>/<suite>/<axis>.png``.

    Raises:
        PipelineError: if the folder has files that no stage generated; they stay.
    """
    by_suite = grouped((task.suite, task) for task in select_tasks(config.demos.tasks))
    test = benchmark.load()
    with replaced(folder) as temporary:
        jobs = [(tasks, config, temporary / suite, test) for suite, tasks in by_suite.items()]
        try:
            workers(_render_all, jobs, "previews")
        finally:
            scene_of_process().close()
        reject_foreign_files(folder.parent, [folder.name])  # Stored since the stage began.


def _render_all(job: tuple[list[Task], Config, Path, TestSet]) -> None:
    tasks, config, folder, test = job
    # The folder exists if another worker was lost while it rendered these sheets.
    folder.mkdir(parents=True, exist_ok=True)
    stage = staged(tasks, config)
    # The deepest layer comes last: an axis that adds objects opens a scene for each perturbation. Any later axis would
    # have to open the demonstration's scene again.
    for name, axis in reversed(config.plan.axes.configured().items()):
        if axis.applies(stage.demo.task):
            axis_sheet(stage, name, config, test).save(folder / f"{name}.png")
