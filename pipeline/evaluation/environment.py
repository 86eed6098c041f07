"""Interface to the tasks of all sources: start an episode, observe, act."""

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_serializer
from scipy.spatial.transform import Rotation

from pipeline.axes import AXES, Perturbation
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError, RejectedError
from pipeline.evaluation import held_out, libero_plus
from pipeline.evaluation.actions import Actions, checked_actions
from pipeline.evaluation.goals import CARRIED, find_replacement, resolve_goal
from pipeline.evaluation.policies import VIEWS, StateAngle, Wanted
from pipeline.evaluation.recordings import demonstration
from pipeline.evaluation.results import REJECTED
from pipeline.evaluation.simulator import Picture, Simulator
from pipeline.evaluation.tasks import EvaluationTask, Prompt, libero_states
from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import STEP_LIMITS, SUITES, find_task
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestTask
from pipeline.testset.definitions import SceneFiles
from pipeline.types import Floats, Frame, Frozen, Scene, Task

LEROBOT_SPATIAL = 280
"""lerobot's step limit of ``libero_spatial``; its other limits equal OpenVLA's (``lerobot/envs/libero.py``, 0.6.1)."""


class EpisodeSettings(Frozen, use_attribute_docstrings=True):
    """Settings of all episodes of an evaluation."""

    prompt: Prompt = "clean"
    """wording of test tasks: LIBERO's instruction, or the file's name as in the benchmark's code; ``blank`` gives an
    empty instruction in every task"""
    seed: int = 0
    """seed of held-out perturbations and of random noise"""
    fixture_seed: int = 0
    """seed of LIBERO's reset, to which the number of the initial state is added; OpenVLA uses 0"""
    initial_states: Literal["libero", "demonstration"] = "libero"
    """LIBERO's initial states for evaluation, or the first states of demonstrations, one episode per demonstration;
    own tasks have no LIBERO states and begin in LIBERO's reset instead; test tasks have their own state, and goals
    begin in LIBERO's states"""
    # Fields that were added later are left out of an episode's name if they have their default: names stay equal.
    black: Literal["none", "agentview", "all"] = Field(default="none", exclude_if=lambda views: views == "none")
    """views that are black, to test a policy without them"""
    actions: Actions = Field(default="delta", exclude_if=lambda actions: actions == "delta")
    """actions of the policy: deltas as in LIBERO, or goals in the world (``absolute``), as X-VLA's"""
    plan: Path | None = Field(default=None, exclude_if=lambda file: file is None)
    """training plan: held-out perturbations that are closer to it than their axis's clearance are sampled again.
    Results name the plan by the SHA-256 of its file."""
    look_every: int = Field(default=1, ge=1, exclude_if=lambda steps: steps == 1)
    """number of control steps between two observations of a server that keeps its chunks: the number of actions that
    the server takes from each chunk"""
    state_angle: StateAngle = Field(default="server", exclude_if=lambda angle: angle == "server")
    """range of the angle of the state's axis-angle: ``server`` as the server requests, ``pi`` [0, pi] rad, ``2pi``
    [0, 2 pi] rad as in LIBERO, robosuite and these datasets. vla-eval's servers for lerobot and pi0 cannot request
    ``2pi``"""
    step_limits: Literal["openvla", "lerobot"] = Field(default="openvla", exclude_if=lambda limits: limits == "openvla")
    """source of the step limits: they differ in libero_spatial, 220 (openvla) and 280 (lerobot)"""
    own_step_limit: int | None = Field(default=None, ge=1, exclude_if=lambda limit: limit is None)
    """step limit of the user's own tasks, for which LIBERO has none"""
    demos: Path | None = Field(default=None, exclude=True)
    """folder of demonstrations, ``<suite>/<task>_demo.hdf5``; by default the starter set, which has LIBERO's tasks
    alone. Results name their demonstration by its content."""
    runner: Literal["pipeline", "lerobot-eval"] = Field(default="pipeline", exclude_if=lambda name: name == "pipeline")
    """program that runs the policy: lerobot-eval has its own batches and random numbers, so a policy may act
    differently there than in ``evaluate``"""

    def step_limit(self, suite: str) -> int:
        """Return the step limit of an episode in a suite.

        Raises:
            PipelineError: if the suite is a user's own, and no limit is set.
        """
        if suite not in STEP_LIMITS:
            if self.own_step_limit is None:
                raise PipelineError(
                    f"LIBERO has no step limit for your suite {suite}",
                    where="own_step_limit",
                    expected="a number of control steps, 20 per second; LIBERO's limits are 3 to 14 % above its "
                    "longest demonstrations",
                    remedy="add --own-step-limit N",
                )
            return self.own_step_limit
        lerobots = self.step_limits == "lerobot" and suite == "libero_spatial"
        return LEROBOT_SPATIAL if lerobots else STEP_LIMITS[suite]

    @field_serializer("plan")
    def _name_by_content(self, plan: Path) -> str:
        """Serialise the plan as the SHA-256 of its file."""
        return held_out.sha256_of(plan)


@dataclass(frozen=True)
class Progress:
    """Progress of an episode.

    Attributes:
        steps: number of actions taken, without the settling steps.
        reason: ``running``, ``not_begun``, or the reason why the episode is over.

            * ``success`` and ``step_limit``.
            * ``simulation_unstable`` is a failure. The same holds if LIBERO's or the benchmark's own scene does not
              settle.
            * ``refused`` means that the scene does not accept a held-out perturbation. Such an episode is over before
              its first observation and is no evidence about a policy.
    """

    steps: int = 0
    reason: str = "not_begun"

    @property
    def success(self) -> bool:
        """Return whether the episode reached its goal."""
        return self.reason == "success"

    @property
    def over(self) -> bool:
        """Return whether the episode is not running, also before it begins."""
        return self.reason != "running"


@dataclass
class Episode:
    """State of the episode that an environment runs.

    Attributes:
        task: the evaluation task.
        played: the task whose BDDL goal and instruction the episode has: that of LIBERO, the user's own, or one of
            LIBERO with another goal.
        step_limit: number of actions after which the episode is over.
        perturbations: perturbations of the scene and the frames.
        resolved: results of physics perturbations in this scene, as ``Scene.resolved``.
        looks: number of observations.
        frames: name of a view to its frame, for the views that were rendered since the last action.
    """

    task: EvaluationTask
    played: Task
    step_limit: int
    progress: Progress = Progress()
    perturbations: tuple[Perturbation, ...] = ()
    resolved: Mapping[str, Any] = field(default_factory=dict)
    looks: int = 0
    frames: dict[str, Frame] = field(default_factory=dict)


def not_begun(progress: Progress, task: EvaluationTask) -> PipelineError:
    """Return the error about an episode that is over before its first observation."""
    if progress.reason == REJECTED:
        return PipelineError("the scene rejects the perturbation", where=str(task), remedy="leave this task out")
    return PipelineError(
        f"the scene does not settle ({progress.reason})",
        where=str(task),
        remedy="leave this task out; `evaluate` counts such an episode as a failure",
    )


class EpisodeEnvironment:
    """Environment that runs episodes one after the other.

    Use one environment for many episodes, ordered by task, because it reuses the simulator of a scene. Frames are
    rendered only on request.

    Args:
        archive: folder of LIBERO-Plus's asset archive, for test tasks of light, background and layout.
    """

    def __init__(self, settings: EpisodeSettings = EpisodeSettings(), archive: Path | None = None):  # noqa: B008
        self.settings, self._archive = settings, archive
        self._episode: Episode | None = None
        self._simulator: Simulator | None = None
        self._simulated: tuple[str, ...] = ()
        self._picture = Picture()

    @property
    def episode(self) -> Episode:
        """Return the running or last episode.

        Raises:
            PipelineError: before the first ``reset``.
        """
        if self._episode is None:
            raise PipelineError("no episode has begun", expected="reset before any other use")
        return self._episode

    @property
    def progress(self) -> Progress:
        """Return the progress of the episode, also before the first ``reset``."""
        return Progress() if self._episode is None else self._episode.progress

    @property
    def simulator(self) -> Simulator:
        """Return the simulator of the episode's scene.

        Raises:
            PipelineError: before the first ``reset``.
        """
        if self._simulator is None:
            raise PipelineError("no scene has been built", expected="reset before any other use")
        return self._simulator

    def reset(self, task: EvaluationTask) -> Progress:
        """Start an episode: LIBERO's reset, the initial state, ten settling steps.

        The episode is over at once if the scene is rejected.

        Raises:
            PipelineError: if the task cannot be rebuilt on this machine.
        """
        self._picture.restore()
        self._episode = None
        start = self._find_start(task)
        episode = Episode(task, find_task(task.suite, task.base), self.settings.step_limit(task.suite))
        self._episode = episode
        try:
            start(episode)
            episode.progress = Progress(reason="running")
        except RejectedError as error:
            episode.progress = Progress(reason=REJECTED if task.source == "own" else error.reason)
        return episode.progress

    def _find_start(self, task: EvaluationTask) -> Callable[[Episode], None]:
        """Return the method that starts an episode of a task's source.

        Raises:
            PipelineError: if there is no such source.
        """
        starts: dict[str, Callable[[Episode], None]] = {
            "libero": self._start_libero,
            "own": self._start_libero,
            "libero_plus": self._start_test_task,
            "goals": self._start_goal,
        }
        if task.source not in starts:
            raise PipelineError(
                f"there is no source {task.source!r} of tasks",
                where=str(task),
                expected=" or ".join(starts),
                remedy="select the tasks again with this version",
            )
        return starts[task.source]

    def step(self, action: ArrayLike) -> Progress:
        """Take one control step, 50 ms.

        Args:
            action: (7,) deltas of position and axis-angle in [-1, 1], which the controller clips, and the gripper:
                a number below 0 opens it, other numbers close it. With ``actions`` ``absolute``, the goal of the grip
                site instead of the deltas: position in m and axis-angle in rad, in the world.

        Raises:
            PipelineError: if the action is not seven finite numbers, or if no episode is running.
        """
        command, *further_commands = checked_actions(action, "action").copy()
        if further_commands:
            raise PipelineError("step got several actions", expected="one action, (7,)")
        if self.progress.over:
            raise PipelineError("no episode is running", expected="reset before step, and no step after its end")
        episode = self.episode
        command[6] = -1.0 if command[6] < 0 else 1.0
        steps = episode.progress.steps + 1
        episode.frames = {}
        try:
            self.simulator.step(command, absolute=self.settings.actions == "absolute")
            limited = "step_limit" if steps >= episode.step_limit else "running"
            episode.progress = Progress(steps, "success" if self.simulator.succeeded() else limited)
        except RejectedError as error:
            episode.progress = Progress(steps, error.reason)
        return episode.progress

    @property
    def instruction(self) -> str:
        """Return the instruction that the policy gets."""
        episode = self.episode
        if episode.task.source == "libero_plus":
            return libero_plus.instruction(_find_test(episode.task), self.settings.prompt)
        return "" if self.settings.prompt == "blank" else episode.played.instruction

    def image(self, view: str) -> Frame:
        """Return the (256, 256, 3) uint8 RGB image of ``agentview`` or ``wrist``.

        The image is turned by 180 degrees, as policies expect it.
        """
        frames = self.episode.frames
        if view not in frames:
            if self.settings.black in (view, "all"):
                frames[view] = np.zeros(SCHEMA.frame.shape, np.uint8)
            else:
                frames[view] = self._picture.frame(VIEWS[view], self.simulator.observed, self.progress.steps)
        return frames[view]

    def observation(self, wanted: Wanted) -> dict[str, Any]:
        """Return the observation of a policy in vla-eval's names.

        Returns:
            ``images`` and ``task_description``, and with ``wanted.state`` two states (8,) of the end effector, with
            position (m), axis-angle (rad) and fingers (m): ``states`` in the frame of the hand, and
            ``controller_states`` in the frame of robosuite's controller, which is turned by 90 degrees about the
            approach axis. X-VLA was trained with the latter.
        """
        views: Iterable[str] = ()
        if wanted.images:
            views = VIEWS if wanted.wrist else ("agentview",)
        self.episode.looks += 1
        images = {view: self.image(view) for view in views}
        observation: dict[str, Any] = {"images": images, "task_description": self.instruction}
        if wanted.state:
            state = self.simulator.observed.state.copy()
            angle_rad = float(np.linalg.norm(state[3:6]))
            if wanted.shortest_rotation and angle_rad > np.pi:
                state[3:6] *= (angle_rad - 2 * np.pi) / angle_rad
            observation["states"] = state
            controller = self.simulator.controller
            angles = Rotation.from_matrix(controller.ee_ori_mat).as_rotvec()
            of_controller = np.concatenate([controller.ee_pos, angles, state[6:]])
            observation["controller_states"] = of_controller.astype(np.float32)
        return observation

    def close(self) -> None:
        """Close the renderer and the simulator."""
        self._picture.close()
        if self._simulator is not None:
            self._simulator.close()
        self._simulator, self._simulated = None, ()

    def _start_test_task(self, episode: Episode) -> None:
        """Start an episode of a test task of LIBERO-Plus."""
        test = _find_test(episode.task)
        state = libero_states(episode.played)[0]
        source = AXES[test.axis].test_scene
        if source == "libero":
            self._build(episode.played)
        elif source == "scene files":
            assets = self._find_assets(test)
            files = SceneFiles(*(str(assets / path) for path in libero_plus.scene_files(test)))
            self._build(episode.played, test.name, files)
        else:
            if source == "bddl and models":
                libero_plus.register_objects(test, self._find_assets(test))
            self._build_from(libero_plus.bddl_text(test), episode.played, test.name)
            state = libero_plus.moved_state(test.suite, test.name)
        episode.perturbations = libero_plus.frame_changes(test, self.settings.seed)
        self._start_from_reset(episode, self.settings.fixture_seed, state, libero_plus.posture_rad(test))

    def _start_goal(self, episode: Episode) -> None:
        """Start an episode of a LIBERO task with a replaced goal object, or with the goal of another task."""
        task, base = episode.task, episode.played
        if CARRIED in task.name:
            seed, state = self._find_initial_state(task, base)
            episode.played, _ = resolve_goal(task)
            self._build(episode.played, task.base)
            self._start_from_reset(episode, seed, state)
            return
        replacement = find_replacement(base, task.name)
        self._build_from(replacement.bddl_text(base), base, f"{replacement.old} {replacement.new}")
        episode.played = replace(base, instruction=replacement.instruction)
        self._start_from_reset(episode, *self._find_initial_state(task, base))

    def _start_libero(self, episode: Episode) -> None:
        """Start an episode of a LIBERO task or an own task, with held-out perturbations if the task has any."""
        task, simulator = episode.task, self._build(episode.played)
        seed, recorded = self.settings.fixture_seed, self.settings.initial_states == "demonstration"
        if not recorded:
            seed, state = self._find_initial_state(task, episode.played)
            if task.source == "libero":
                self._start_from_reset(episode, seed, state)
                return
        demo = demonstration(episode.played, task.number, self.settings.demos)
        if not recorded:
            demo = replace(demo, init_state=state, states=None, model_xml=None)

        def nominal() -> Scene:
            """Return the scene without perturbations."""
            scene = recorded_start(demo, demo.model_xml or simulator.place_fixtures(seed))
            # A recording begins with an open gripper. LIBERO restores its own states after its reset, which leaves the
            # gripper without a command.
            return scene if recorded else replace(scene, start=replace(scene.start, gripper=0.0))

        scene = None
        if task.source == "own":
            planned = None if self.settings.plan is None else held_out.planned(self.settings.plan)
            episode.perturbations, scene = held_out.held_out_scene(
                task, self.settings.seed, demo, nominal, planned, self._picture.opened
            )
        if scene is None and not recorded:
            self._start_from_reset(episode, seed, demo.init_state)
            return
        scene = scene or nominal()
        episode.resolved = scene.resolved
        simulator.start_scene(scene)
        self._picture.show(scene.model_xml, episode.perturbations)

    def _start_from_reset(
        self, episode: Episode, seed: int, state: Floats, posture_rad: tuple[float, ...] | None = None
    ) -> None:
        """Start from a state in the model of LIBERO's own reset."""
        self.simulator.start(seed, state, posture_rad)
        self._picture.show(self.simulator.model, episode.perturbations)

    def _find_initial_state(self, task: EvaluationTask, base: Task) -> tuple[int, Floats]:
        """Return the seed of LIBERO's reset, and LIBERO's initial state of a task.

        LIBERO has no initial states of a user's own task, which starts in the state of the reset.

        Args:
            base: the LIBERO task or own task of ``task``, whose scene is built.
        """
        if base.suite not in SUITES:
            seed = self.settings.fixture_seed + task.number
            return seed, self.simulator.state_of_reset(seed)
        states = libero_states(base)
        number = task.number % len(states)
        return self.settings.fixture_seed + number, states[number]

    def _find_assets(self, test: TestTask) -> Path:
        """Return the folder with the files that a test task needs.

        Raises:
            PipelineError: if neither LIBERO's assets nor the archive have the files.
        """
        assets = libero_plus.assets_of(test, self._archive)
        if assets is None:
            raise PipelineError(
                f"the task changes the {test.axis}, which needs the asset archive of LIBERO-Plus",
                where=f"libero_plus/{test.suite}/{test.name}",
                expected=f"test tasks of {', '.join(libero_plus.RUNNABLE)}" if self._archive is None else None,
                remedy="name the unpacked archive: --assets DIR",
            )
        return assets

    def _build_from(self, bddl_text: str, base: Task, scene: str) -> None:
        """Build the simulator of a task from another BDDL text."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / base.bddl_file.name
            file.write_text(bddl_text)
            self._build(replace(base, bddl_file=file), scene)

    def _build(self, task: Task, scene: str = "", files: SceneFiles | None = None) -> Simulator:
        """Build the simulator of a task, unless the current simulator has the same scene.

        Args:
            scene: name of a scene that differs from the task's own.
        """
        simulated = (task.suite, task.name, scene)
        if self._simulator is None or simulated != self._simulated:
            self.close()
            self._simulator, self._simulated = Simulator(task, files), simulated
        return self._simulator


def _find_test(task: EvaluationTask) -> TestTask:
    """Return the benchmark's test task of an evaluation task."""
    return benchmark.load().find(task.suite, task.name)
