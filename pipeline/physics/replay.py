"""Replay of demonstrations through LIBERO's environment at 20 Hz: a Demo in, a Trajectory with a verdict out.

``roll_out`` returns the states of a scene before it is replayed, for perturbations that need them.
``compute_settled_state`` returns the first of these states, for previews.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from pipeline.axes import PhysicsPerturbation
from pipeline.config import ReplayConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import RejectedError
from pipeline.libero.starts import LEFT_OUT_STEPS, kept_actions, recorded_start
from pipeline.machine_code import fixed_machine_code
from pipeline.physics.environment import Environment, UnusableSceneError, environment_of
from pipeline.physics.reference import Reference
from pipeline.physics.tracking import Route, follow
from pipeline.types import Demo, Floats, Scene, Start, Task, Trajectory, Verdict


def replay(
    environment: Environment,
    demo: Demo,
    trajectory_id: str,
    replay_config: ReplayConfig,
    perturbations: Sequence[PhysicsPerturbation] = (),
    reference: Callable[[], Reference | None] = lambda: None,
) -> Trajectory:
    """Replay a demonstration in the configured mode, once its first state, or a perturbed state, has settled.

    If the demonstration's scene or state cannot be simulated, return a dropped trajectory instead of raising an error.

    Args:
        environment: the environment of the demonstration's task.
        demo: the demonstration.
        trajectory_id: the result's id.
        replay_config: mode, settling and no-op rule of the replay.
        perturbations: changes to apply before the first step.
        reference: returns the reference that tracking follows. If it returns ``None``, the replay is open-loop, also
            in mode ``tracked``; the result states its mode.

    Raises:
        PipelineError: when NumPy does not compute with the fixed machine code.
    """
    fixed_machine_code()
    try:
        scene, rejected = _apply_perturbations(environment, demo, replay_config, perturbations)
    except UnusableSceneError as error:
        print(f"dropped {demo.demo_id}, {error.reason}: {error}", file=sys.stderr)
        return _without_simulation(demo, trajectory_id, error)
    if rejected:
        mode = "tracked" if replay_config.mode == "tracked" and reference() is not None else "open_loop"
        # The first state alone is stored.
        start = _execute(environment, scene, trajectory_id, 0, perturbations, mode, lambda: iter(()))
        return replace(start, verdict=rejected)

    run = partial(_execute, environment, scene, trajectory_id, replay_config.settle_steps, perturbations)
    if replay_config.mode == "tracked" or (replay_config.mode == "auto" and needs_tracking(scene)):
        followed = reference()
        if followed is not None:
            return run("tracked", partial(_start_tracking, environment, followed))
    recorded = demo.actions[kept_actions(demo.actions, replay_config.noops)]
    open_loop = run("open_loop", lambda: iter(recorded))
    if replay_config.mode != "auto" or open_loop.verdict.kept:
        return open_loop
    followed = reference()
    if followed is None:
        return open_loop
    return run("tracked", partial(_start_tracking, environment, followed))


def needs_tracking(scene: Scene) -> bool:
    """Return whether a scene must be tracked: recorded actions do not work against a push, even if they succeed."""
    return scene.start.push is not None


def _without_simulation(demo: Demo, trajectory_id: str, error: UnusableSceneError) -> Trajectory:
    """Return the dropped trajectory of a demonstration whose scene or state cannot be simulated."""
    return Trajectory(
        trajectory_id,
        mode="open_loop",
        scene=Scene(demo.model_xml or "", demo.init_state, {"fault": str(error)}),
        states=demo.init_state[None],
        actions=np.empty((0, 7)),
        site_alpha=np.empty((1, 0), np.float32),
        verdict=Verdict(False, error.reason),
    )


def _execute(
    environment: Environment,
    scene: Scene,
    trajectory_id: str,
    settle_steps: int,
    perturbations: Sequence[PhysicsPerturbation],
    mode: str,
    start_actions: Callable[[], Iterator[Floats]],
) -> Trajectory:
    """Restore a scene, let it settle, execute actions and judge the result.

    Args:
        environment: the environment of the scene's task.
        scene: the scene to start in.
        trajectory_id: the result's id.
        settle_steps: number of control steps before the first action.
        perturbations: changes that the executed actions must show.
        mode: the result's mode.
        start_actions: returns the actions (7,); called once the scene has settled.
    """
    environment.restore(scene)
    # If the scene does not settle, store only the initial state.
    states, alphas = [environment.state], [environment.site_alpha]
    actions, succeeded = [], []
    rejected = None
    try:
        environment.settle(settle_steps)
        states, alphas = [environment.state], [environment.site_alpha]
        for action in start_actions():
            environment.step(action)
            actions.append(action)
            states.append(environment.state)
            alphas.append(environment.site_alpha)
            succeeded.append(environment.succeeded())
    except RejectedError as error:
        rejected = Verdict(False, error.reason)
    stacked_states, executed = np.stack(states), np.array(actions).reshape(-1, 7)
    verdict = rejected or judge(stacked_states, np.array(succeeded, bool))
    fault = _find_fault(perturbations, executed) if verdict.kept else None
    if fault is not None:
        verdict = Verdict(False, fault)
    return Trajectory(trajectory_id, mode, scene, stacked_states, executed, np.stack(alphas), verdict)


def _find_fault(perturbations: Sequence[PhysicsPerturbation], actions: Floats) -> str | None:
    """Return the first reason for which a perturbation drops the executed actions (K, 7), else ``None``."""
    faults = (perturbation.fault_of(actions) for perturbation in perturbations)
    return next((fault for fault in faults if fault), None)


def _start_tracking(environment: Environment, reference: Reference) -> Iterator[Floats]:
    """Return the actions that follow a reference from the environment's present state, computed one by one."""
    poses = {name: environment.pose(name) for name in (*reference.poses, *reference.places)}
    return follow(Route.through(reference, environment.hand, poses), lambda: environment.hand, environment.pose)


def _apply_perturbations(
    environment: Environment, demo: Demo, replay_config: ReplayConfig, perturbations: Sequence[PhysicsPerturbation]
) -> tuple[Scene, Verdict | None]:
    """Return the perturbed scene in which the replay starts.

    Returns:
        The scene; and ``None``, or a verdict with the reason for which a perturbation cannot be applied.

    Raises:
        UnusableSceneError: if the recorded scene cannot be restored.
    """
    model_xml = demo.model_xml or environment.place_fixtures(replay_config.fixture_seed)
    scene = recorded_start(demo, model_xml, settles=replay_config.settle_steps > 0)
    # Restore the scene first: perturbations compile it too, and would raise other errors.
    environment.restore(scene)
    try:
        for perturbation in perturbations:
            scene = perturbation.apply(scene, demo, partial(roll_out, replay_config=replay_config))
    except RejectedError as error:
        return scene, Verdict(False, error.reason)
    return scene, None


def judge(states: Floats, succeeded: NDArray[np.bool_]) -> Verdict:
    """Judge a replay: the task's goal must hold after the last executed action.

    Args:
        states: (K+1, S) states before each executed action and after the last.
        succeeded: (K,) LIBERO's success check after each executed action.
    """
    if len(succeeded) < SCHEMA.min_steps:
        return Verdict(False, "too_short")
    if not np.isfinite(states).all():
        return Verdict(False, "simulation_unstable")
    if succeeded[-1]:
        return Verdict(True, "kept")
    return Verdict(False, "goal_lost" if succeeded.any() else "goal_not_reached")


def roll_out(scene: Scene, demo: Demo, replay_config: ReplayConfig = ReplayConfig()) -> Floats:  # noqa: B008 - frozen
    """Execute the demonstration's actions from ``scene``, once it has settled, and return the states (K+1, S).

    Args:
        scene: the scene to start in.
        demo: the demonstration.
        replay_config: settling and no-op rule of the later replay.

    Raises:
        RejectedError: ``simulation_unstable``.
    """
    actions = demo.actions[kept_actions(demo.actions, replay_config.noops)]
    return _states_from(scene, demo.task, actions, replay_config)


def at_reset(environment: Environment, demo: Demo, seed: int) -> Demo:
    """Return the demonstration as if recorded from another reset; LIBERO's recordings begin with an open gripper."""
    model_xml = environment.reset(seed)
    environment.settle(LEFT_OUT_STEPS)
    return replace(demo, init_state=environment.state, states=None, model_xml=model_xml)


def compute_settled_state(scene: Scene, task: Task, replay_config: ReplayConfig) -> Floats:
    """Return the state (S,) in which ``scene`` has settled, which the first frame of a replay shows.

    Raises:
        RejectedError: ``simulation_unstable``.
    """
    return np.asarray(_states_from(scene, task, np.empty(0), replay_config)[0])


def _states_from(scene: Scene, task: Task, actions: Floats, replay_config: ReplayConfig) -> Floats:
    """Execute actions from a settled scene and return the states (K+1, S), cached by the scene's content."""
    # A scene cannot be hashed; these are the parts of it that a replay depends on.
    parts = scene.model_xml, scene.state.tobytes(), scene.start
    return _states(task, parts, actions.tobytes(), replay_config.settle_steps)


@lru_cache(maxsize=4)
def _states(task: Task, scene_parts: tuple[str, bytes, Start], actions: bytes, settle_steps: int) -> Floats:
    """Execute actions (the bytes of (K, 7) float64) from a settled scene and return the states (K+1, S)."""
    model_xml, state, start = scene_parts
    environment = environment_of(task)
    environment.restore(Scene(model_xml, np.frombuffer(state), start=start))
    environment.settle(settle_steps)
    states = [environment.state]
    for action in np.frombuffer(actions).reshape(-1, 7):
        environment.step(action)
        states.append(environment.state)
    return np.stack(states)
