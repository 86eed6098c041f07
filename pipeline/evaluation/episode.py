"""One interface to every task: start an episode, look, act."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_serializer

from pipeline.axes import AnyPerturbation, PixelPerturbation, RenderPerturbation, of_layer
from pipeline.axes.base import Frozen
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError, RefusedError
from pipeline.evaluation import disjoint, goals, libero_plus
from pipeline.evaluation.asset_archive import Assets, having
from pipeline.evaluation.drawn_scene import drawn_scene
from pipeline.evaluation.initial_states import libero_states, moved_state
from pipeline.evaluation.libero_plus import Prompt
from pipeline.evaluation.simulator import Observed, Simulator
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.rendering.jpeg import to_policy
from pipeline.rendering.renderer import Renderer
from pipeline.testset.benchmark import TestTask
from pipeline.testset.definitions import SceneFiles
from pipeline.types import Demo, Floats, Frame, Scene, Task

STEP_LIMITS = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
"""Control steps after settling before an episode has failed, as OpenVLA and LIBERO-Plus limit them."""

VIEWS = {"agentview": "agentview", "wrist": "robot0_eye_in_hand"}
"""What policies call the two views, and their cameras in the scene."""


class Settings(Frozen):
    """What holds for all episodes of an evaluation.

    Attributes:
        prompt: the wording of test tasks; ``blank`` says nothing in any task.
        black: which views are black, to see what a policy does without them.
        seed: of held-out draws and of noise that is random.
        fixture_seed: of LIBERO's reset, to which the number of the initial state is added. 0 is what OpenVLA uses.
        initial_states: ``libero`` for the states that LIBERO evaluates from, ``demonstration`` for the one that the
            starter set's demonstration of the task begins in, without settling, as when it is replayed for a dataset.
            Test tasks have a state of their own in both, and ``goals`` begin in LIBERO's.
        plan: a plan that held-out draws keep clear of: what is closer than its axis allows is drawn anew. Results name
            it by the SHA-256 of its file.
    """

    prompt: Prompt | Literal["blank"] = "clean"
    seed: int = 0
    fixture_seed: int = 0
    initial_states: Literal["libero", "demonstration"] = "libero"
    # What came later is left out where it is not used, so that results keep their names.
    black: Literal["none", "agentview", "all"] = Field(default="none", exclude_if=lambda views: views == "none")
    plan: Path | None = Field(default=None, exclude_if=lambda file: file is None)

    @field_serializer("plan")
    def _name_by_content(self, plan: Path) -> str:
        return disjoint.sha256_of(plan)


class Wanted(NamedTuple):
    """What a policy asks to see.

    Attributes:
        wrist: the wrist's view beside the agent view.
        state: position, axis-angle and fingers.
        shortest_rotation: the axis-angle with an angle in [0, pi], as vla-eval has it by default; else in [0, 2 pi], as
            robosuite and OpenVLA's data have it.
        images: any view at all; without them nothing is rendered.
    """

    wrist: bool = True
    state: bool = True
    shortest_rotation: bool = False
    images: bool = True


@dataclass(frozen=True)
class Progress:
    """Where an episode stands.

    Attributes:
        steps: actions taken, without the settling steps.
        success: whether the goal was reached; then the episode is over.
        over: whether it was reached, the limit was, or the simulation became unstable; or the episode cannot begin.
        reason: ``success``, ``step_limit``, ``simulation_unstable``, ``running``, or ``refused`` where the scene does
            not take what was drawn. Such an episode is over before its first look and says nothing of a policy.
    """

    steps: int
    success: bool
    over: bool
    reason: str


class EpisodeEnvironment:
    """Runs episodes one after the other; keep one for many, ordered by task: what is built for a scene is reused.

    Frames are rendered when they are asked for, and only then.

    Args:
        archive: folder of LIBERO-Plus's asset archive, for test tasks of light, background and layout.
    """

    def __init__(self, settings: Settings = Settings(), archive: Path | None = None):  # noqa: B008 - frozen
        self.settings, self._archive = settings, archive
        self._simulator: Simulator | None = None
        self._key: tuple[str, ...] = ()
        self._renderer: Renderer | None = None
        self._rendered: object = None
        self._changes = ExitStack()
        self._looks_changed = False
        self._perturbations: tuple[AnyPerturbation, ...] = ()
        self._running = False

    def reset(self, task: EvaluationTask) -> Progress:
        """Start an episode: LIBERO's reset, the initial state, ten settling steps; over where the scene is refused.

        Raises:
            PipelineError: when the task cannot be rebuilt here.
        """
        self._restore_looks()
        self._running = False
        self.task, self._base = task, find_task(task.suite, task.base)
        self.limit = STEP_LIMITS[task.suite]
        self.resolved: Mapping[str, Any] = {}
        self._perturbations = ()
        self._progress = Progress(0, False, False, "running")
        self._seen: dict[str, Frame] = {}
        try:
            if task.source == "libero_plus":
                self._start_test_task()
            elif task.source == "goals":
                self._start_goal()
            else:
                self._start_libero()
        except RefusedError:
            self._progress = Progress(0, False, True, "refused")
        self._running = True
        return self._progress

    def step(self, action: ArrayLike) -> Progress:
        """Take one control step, 50 ms.

        Args:
            action: (7,) deltas of position and axis-angle in [-1, 1], which the controller clips, and the gripper:
                below 0 opens, else closes.

        Raises:
            PipelineError: when the action is not seven finite numbers, or no episode is running.
        """
        given = _checked(action)
        simulator = self._opened
        if not self._running or self._progress.over:
            raise PipelineError("no episode is running", expected="reset before step, and no step after its end")
        given[6] = -1.0 if given[6] < 0 else 1.0
        steps = self._progress.steps + 1
        self._seen = {}
        try:
            simulator.step(given)
        except RefusedError as error:
            self._progress = Progress(steps, False, True, error.reason)
            return self._progress
        success = simulator.succeeded()
        limit = steps >= self.limit
        reason = "success" if success else "step_limit" if limit else "running"
        self._progress = Progress(steps, success, success or limit, reason)
        return self._progress

    @property
    def progress(self) -> Progress:
        return self._progress

    @property
    def instruction(self) -> str:
        """What the policy is told."""
        if self.settings.prompt == "blank":
            return ""
        if self.task.source == "libero_plus":
            return libero_plus.instruction(self._test, self.settings.prompt)
        return self._base.instruction

    @property
    def observed(self) -> Observed:
        """What LIBERO observed of the last control step."""
        return self._opened.observed

    @property
    def perturbations(self) -> Sequence[AnyPerturbation]:
        """What is changed in this episode."""
        return self._perturbations

    def image(self, view: str) -> Frame:
        """(256, 256, 3) uint8 RGB of ``agentview`` or ``wrist``, turned by 180 degrees as policies expect it."""
        if view not in self._seen:
            black = self.settings.black in (view, "all")
            self._seen[view] = np.zeros(SCHEMA.frame.shape, np.uint8) if black else self._render(view)
        return self._seen[view]

    def observation(self, wanted: Wanted) -> dict[str, Any]:
        """What a policy sees, as vla-eval names it: ``images``, ``states`` (8,) and ``task_description``."""
        views = () if not wanted.images else VIEWS if wanted.wrist else ("agentview",)
        seen: dict[str, Any] = {
            "images": {view: self.image(view) for view in views},
            "task_description": self.instruction,
        }
        if wanted.state:
            seen["states"] = self.observed.state.copy()
            angle_rad = float(np.linalg.norm(seen["states"][3:6]))
            if wanted.shortest_rotation and angle_rad > np.pi:
                seen["states"][3:6] *= (angle_rad - 2 * np.pi) / angle_rad
        return seen

    def close(self) -> None:
        self._close_renderer()
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None
        self._key = ()

    @property
    def _opened(self) -> Simulator:
        if self._simulator is None:
            raise PipelineError("no episode was started", remedy="reset first")
        return self._simulator

    def _start_test_task(self) -> None:
        test = self._test
        posture = libero_plus.postures_rad()[int(test.parameters["id"])] if test.axis == "robot" else None
        if test.axis in ("light", "background"):
            self._build(self._base, test.name, self._assets(test).scene(test))
            state = libero_states(self._base)[0]
        elif test.axis in ("pose", "layout"):
            if test.axis == "layout":
                self._assets(test).register_objects(test)
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / f"{self._base.name}.bddl"
                file.write_text(libero_plus.bddl_text(test))
                self._build(replace(self._base, bddl_file=file), test.name)
            state = moved_state(test.suite, test.name)
        else:
            self._build(self._base)
            state = libero_states(self._base)[0]
        noise = (libero_plus.noise(test, self.settings.seed),) if test.axis == "noise" else ()
        self._perturbations = (libero_plus.camera(test), *noise)
        self._opened.start(self.settings.fixture_seed, state, posture)
        self._show()

    def _start_goal(self) -> None:
        """Start LIBERO's own task with another goal."""
        replacement = goals.find(self._base, self.task.name)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / self._base.bddl_file.name
            file.write_text(replacement.bddl_text(self._base))
            self._build(replace(self._base, bddl_file=file), f"{replacement.old} {replacement.new}")
        self._base = replace(self._base, instruction=replacement.instruction)
        states = libero_states(self._base)
        number = self.task.number % len(states)
        self._opened.start(self.settings.fixture_seed + number, states[number])
        self._show()

    def _start_libero(self) -> None:
        """Start LIBERO's own task, or held-out draws on it.

        Raises:
            RefusedError: see ``drawn_scene``.
        """
        self._build(self._base)
        source = StarterSource()
        demo = source.load(source.index([self._base]).entries[0].demo_id)
        seed = self.settings.fixture_seed
        if self.settings.initial_states == "libero":
            states = libero_states(self._base)
            number = self.task.number % len(states)
            seed, demo = seed + number, replace(demo, init_state=states[number])
        scene = None
        if self.task.source == "own":
            nominal = partial(self._nominal, seed, demo)
            planned = None if self.settings.plan is None else disjoint.planned(self.settings.plan)
            self._perturbations, scene = drawn_scene(self.task, self.settings.seed, demo, nominal, planned)
        self.resolved = scene.resolved if scene else {}
        self._start(demo, seed, scene)

    def _nominal(self, seed: int, demo: Demo) -> Scene:
        return Scene(self._opened.place_fixtures(seed), demo.init_state)

    def _start(self, demo: Demo, seed: int, scene: Scene | None) -> None:
        """Start from a demonstration's initial state, in LIBERO's scene or a changed one."""
        settle = self.settings.initial_states == "libero"
        if scene is None and settle:
            self._opened.start(seed, demo.init_state)
            self._show()
            return
        # A demonstration was recorded from its first state on, by an arm that holds the posture it starts in.
        scene = scene or self._nominal(seed, demo)
        self._opened.start_scene(scene, settle)
        self._show(scene.model_xml)

    @property
    def _test(self) -> TestTask:
        tests = libero_plus.by_name()
        key = (self.task.suite, self.task.name)
        if key not in tests:
            raise PipelineError(f"LIBERO-Plus has no test task {self.task.name!r}", where=self.task.suite)
        return tests[key]

    def _assets(self, test: TestTask) -> Assets:
        assets = having(test, self._archive)
        if assets is None:
            raise PipelineError(
                f"changes the {test.axis}, for which the asset archive of LIBERO-Plus is needed",
                where=str(self.task),
                expected=f"test tasks of {', '.join(libero_plus.RUNNABLE)}" if self._archive is None else None,
                remedy="name the unpacked archive: --assets DIR",
            )
        return assets

    def _build(self, task: Task, scene: str = "", files: SceneFiles | None = None) -> None:
        """Have the simulator of a task, or of another scene of it."""
        key = (task.suite, task.name, scene)
        if key != self._key:
            self.close()
            self._simulator, self._key = Simulator(task, files), key

    def _show(self, model_xml: str | None = None) -> None:
        """Render from here on what the simulator has now.

        Args:
            model_xml: the scene with its images, where the simulator has it without.
        """
        shown = model_xml if model_xml is not None else self._opened.model
        if shown is not self._rendered:
            self._close_renderer()
            self._rendered = shown

    def _render(self, view: str) -> Frame:
        if self._renderer is None:
            model: Any = self._rendered
            self._renderer = Renderer(model)
        if not self._looks_changed:
            looks = of_layer(self._perturbations, RenderPerturbation)
            self._changes.enter_context(self._renderer.perturbed(looks))
            self._looks_changed = True
        observed, model = self.observed, self._renderer.model
        self._renderer.restore(np.concatenate([[0.0], observed.qpos, np.zeros(model.nv)]), observed.site_alpha)
        frame = self._renderer.frame(VIEWS[view])
        for noise in of_layer(self._perturbations, PixelPerturbation):
            if view == "agentview":
                frame = noise.apply(frame, self._progress.steps)
        return to_policy(frame)

    def _restore_looks(self) -> None:
        self._changes.close()
        self._looks_changed = False

    def _close_renderer(self) -> None:
        self._restore_looks()
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _checked(action: ArrayLike) -> Floats:
    """A copy of the action.

    Raises:
        PipelineError: when it is not seven finite numbers.
    """
    try:
        given = np.array(action, np.float64)
    except (TypeError, ValueError) as error:
        raise PipelineError(f"the action is not numbers ({error})", where="action", expected="(7,) numbers") from error
    expected = "(7,): three of position, three of rotation, and the gripper"
    if given.shape != (7,):
        raise PipelineError(f"the action has shape {given.shape}", where="action", expected=expected)
    if not np.isfinite(given).all():
        raise PipelineError("the action has NaN or infinity", where="action", expected=f"finite numbers, {expected}")
    return given
