"""One interface to every task: start an episode, look, act."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pipeline.axes import AnyPerturbation
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError, RefusedError
from pipeline.evaluation import goals, libero_plus, own_draws
from pipeline.evaluation.asset_archive import Assets, having
from pipeline.evaluation.libero_plus import moved_state
from pipeline.evaluation.own_draws import drawn_scene
from pipeline.evaluation.results import REFUSED
from pipeline.evaluation.settings import VIEWS, Settings, Wanted
from pipeline.evaluation.simulator import Observed, Picture, Simulator
from pipeline.evaluation.tasks import EvaluationTask, libero_states
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import find_task
from pipeline.testset.benchmark import TestTask
from pipeline.testset.definitions import SceneFiles
from pipeline.types import Demo, Floats, Frame, Scene, Task

STEP_LIMITS = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
"""Control steps after settling before an episode has failed, as OpenVLA and LIBERO-Plus limit them."""


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
        self._picture = Picture()
        self._perturbations: tuple[AnyPerturbation, ...] = ()
        self._running = False

    def reset(self, task: EvaluationTask) -> Progress:
        """Start an episode: LIBERO's reset, the initial state, ten settling steps; over where the scene is refused.

        Raises:
            PipelineError: when the task cannot be rebuilt here.
        """
        self._picture.restore()
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
            self._progress = Progress(0, False, True, REFUSED)
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
            if self.settings.black in (view, "all"):
                self._seen[view] = np.zeros(SCHEMA.frame.shape, np.uint8)
            else:
                steps = self._progress.steps
                self._seen[view] = self._picture.frame(view, self.observed, self._perturbations, steps)
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
        self._picture.close()
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
        self._picture.show(self._opened.model)

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
        self._picture.show(self._opened.model)

    def _start_libero(self) -> None:
        """Start LIBERO's own task, or held-out draws on it.

        Raises:
            RefusedError: see ``drawn_scene``.
        """
        self._build(self._base)
        demo = StarterSource().of(self._base)
        seed = self.settings.fixture_seed
        if self.settings.initial_states == "libero":
            states = libero_states(self._base)
            number = self.task.number % len(states)
            seed, demo = seed + number, replace(demo, init_state=states[number])
        scene = None
        if self.task.source == "own":
            nominal = partial(self._nominal, seed, demo)
            planned = None if self.settings.plan is None else own_draws.planned(self.settings.plan)
            self._perturbations, scene = drawn_scene(self.task, self.settings.seed, demo, nominal, planned)
        self.resolved = scene.resolved if scene else {}
        self._start(demo, seed, scene)

    def _nominal(self, seed: int, demo: Demo) -> Scene:
        scene = recorded_start(demo, self._opened.place_fixtures(seed))
        # A recording had the gripper open; LIBERO's reset, after which its own states are put in, leaves it without a
        # command.
        return scene if self.settings.initial_states == "demonstration" else replace(scene, gripper=0.0)

    def _start(self, demo: Demo, seed: int, scene: Scene | None) -> None:
        """Start from a demonstration's initial state, in LIBERO's scene or a changed one."""
        if scene is None and self.settings.initial_states == "libero":
            self._opened.start(seed, demo.init_state)
            self._picture.show(self._opened.model)
            return
        scene = scene or self._nominal(seed, demo)
        self._opened.start_scene(scene)
        self._picture.show(scene.model_xml)

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
