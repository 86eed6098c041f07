"""A whole evaluation: tasks over worker processes, a file for each episode, and a summary."""

import atexit
import ctypes
import threading
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco

from pipeline import gl
from pipeline.compute.pool import LOST, Expendable, Workers
from pipeline.errors import PipelineError
from pipeline.evaluation import own_draws
from pipeline.evaluation.actions import PolicyError
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.policies import Policy
from pipeline.evaluation.results import one_setting
from pipeline.evaluation.rollout import Evaluation, PolicyConfig, roll_out_policy
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.statistics import summary
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import write, write_json
from pipeline.images.mp4 import mp4
from pipeline.types import Frame

EPISODES_A_JOB = 10
"""At most so many episodes of one scene are one worker's job: few enough to spread, many enough to build it once."""

JOBS_A_WORKER = 4
"""With few episodes, jobs are made smaller until there are so many, or one worker would end long after the others."""

SCENE_AXES = ("pose", "layout", "light", "background")
"""The axes whose test tasks have a scene each."""

FAILURES_IN_A_ROW = 3
"""After so many episodes in a row without an action from the policy a worker stops the evaluation."""

FAULTS_NAMED = 3
"""So many episodes without a result are named in the message that counts them."""

SCENE_S, STEP_S = 1800.0, 120.0
"""No scene takes so long to build, and no step with its answer takes so long, on any machine."""


def evaluate(evaluation: Evaluation, selection: Selection, run: Workers, workers: int = 1) -> dict[str, Any]:
    """Run what the folder does not hold yet, and write ``summary.json`` of what was selected.

    An episode in which the policy gives no action has no result, and the others are run.

    Args:
        workers: how many share the work. Results do not depend on it.

    Returns:
        The summary.

    Raises:
        PipelineError: after the summary was written, when an episode has no result; before, when the policy fails in
            one episode after the other.
    """
    settings, policy = evaluation.settings, evaluation.policy
    if settings.look_every != 1 and policy.kind != "server":
        raise PipelineError(
            f"only a server is shown one observation in {settings.look_every}", where="look_every", expected="--server"
        )
    wanted = select(selection, evaluation.archive)
    check_settings(selection, wanted, settings)
    evaluation.check(wanted)
    faults: dict[EvaluationTask, str] = {}
    if missing := [task for task in wanted if evaluation.result(task) is None]:
        device = gl.choose().device
        jobs = [EvaluationJob(evaluation, tasks, device) for tasks in _jobs(missing, workers)]
        work = Expendable(EvaluationJob.__call__, EvaluationJob.limit_s, EvaluationJob.lost, EvaluationJob.episodes)
        faults = {task: what for of_job in run(work, jobs, "evaluate, episodes") for task, what in of_job.items()}
    results = {task: evaluation.result(task) for task in wanted}
    rows = [row for row in results.values() if row is not None]
    left = [task for task, row in results.items() if row is None]
    faults |= {task: "the plan or the archive changed while it ran" for task in left if task not in faults}
    found = summary(rows) | {
        "policy": {"name": policy.name(evaluation.identity), "identity": evaluation.identity},
        "selection": selection.model_dump(mode="json"),
        "settings": one_setting([(row, evaluation.files) for row in rows]) or settings.model_dump(),
    }
    write_json(evaluation.folder / "summary.json", found)
    if faults:
        raise _without_result([*faults.items()])
    return found


def _jobs(missing: Sequence[EvaluationTask], workers: int) -> list[tuple[EvaluationTask, ...]]:
    """Tasks by scene: those of one scene, and of one posture of the arm, follow each other."""
    scenes: dict[tuple[str, ...], list[EvaluationTask]] = defaultdict(list)
    for task in missing:
        own_scene = task.source == "libero_plus" and task.axis in SCENE_AXES
        moved = task.name.partition("_state")[0] if own_scene or task.source == "goals" else ""
        scenes[task.suite, task.base, moved].append(task)
    for scene in scenes.values():
        scene.sort(key=lambda task: (task.axis == "robot", task.number, task.name))
    spread = len(missing) if workers == 1 else max(1, len(missing) // (workers * JOBS_A_WORKER))
    size = min(spread, EPISODES_A_JOB)
    return [tuple(scene[at : at + size]) for scene in scenes.values() for at in range(0, len(scene), size)]


def check_settings(selection: Selection, wanted: Sequence[EvaluationTask], settings: EpisodeSettings) -> None:
    """Have no episode that says a setting which it does not have, and none that is another one again.

    Args:
        wanted: the tasks that the selection names.

    Raises:
        PipelineError: when one would, or the plan cannot be read.
    """
    if settings.seed != selection.seed:
        raise PipelineError(
            f"tasks are drawn under seed {selection.seed}, what perturbs them under {settings.seed}",
            where="seed",
            expected="one seed for both",
        )
    if settings.plan is not None:
        own_draws.sha256_of(settings.plan)
        if not any(task.source == "own" for task in wanted):
            raise PipelineError(
                "no task has held-out perturbations to keep clear of a plan", where="plan", expected="--source own"
            )
    if settings.prompt == "benchmark" and not any(task.source == "libero_plus" for task in wanted):
        raise PipelineError(
            "no task has an instruction of the benchmark", where="prompt", expected="--source libero_plus"
        )
    if settings.step_limits == "lerobot" and not any(task.suite == "libero_spatial" for task in wanted):
        raise PipelineError(
            "lerobot's limits differ in libero_spatial alone, and no task is of it",
            where="step_limits",
            expected="openvla",
        )
    if settings.initial_states == "demonstration":
        if others := {task.source for task in wanted} & {"libero_plus", "goals"}:
            raise PipelineError(
                f"tasks of {' and '.join(sorted(others))} never start where a demonstration does",
                where="initial_states",
                expected="tasks of libero and own",
                remedy="leave --initial-states out",
            )
        starts = Counter(f"{task.suite}/{task.base}" for task in wanted if task.source == "libero")
        if more := [name for name, count in starts.items() if count > 1]:
            raise PipelineError(
                f"{starts[more[0]]} episodes of {more[0]} would be the same: there is one demonstration of it",
                where="initial_states",
                expected="one episode of each task of libero",
                remedy="--episodes 1, or leave --initial-states out",
            )


@dataclass(frozen=True)
class EvaluationJob:
    """Some episodes of one scene, as they are sent to a worker.

    Attributes:
        device: what renders the evaluation, as OpenGL names it.
    """

    evaluation: Evaluation
    tasks: tuple[EvaluationTask, ...]
    device: str

    def __call__(self) -> dict[EvaluationTask, str]:
        """Run the episodes, and write each one's file when it is over.

        Returns:
            What was wrong with the policy, for each episode that has no result because of that.

        Raises:
            PipelineError: when that happens ``FAILURES_IN_A_ROW`` times.
        """
        device = gl.choose().device
        if device != self.device:
            raise PipelineError(
                f"this worker renders with {device}, the evaluation with {self.device}",
                expected="one device for all frames, as devices differ by some grey levels",
            )
        settings, archive = self.evaluation.settings, self.evaluation.archive
        environment = _environment(settings, archive)
        policy = _policy(self.evaluation.policy, self.evaluation.identity, settings.look_every)
        faults = {}
        # A worker that was lost may have left some.
        for task in self._missing():
            try:
                self._run(task, environment, policy)
            except PolicyError as error:
                faults[task] = error.what
                _failures.append((task, error.what))
                if len(_failures) == FAILURES_IN_A_ROW:
                    stopped = _without_result(_failures)
                    _failures.clear()
                    raise stopped from error
            else:
                _failures.clear()
        return faults

    def episodes(self) -> int:
        return len(self.tasks)

    def limit_s(self) -> float:
        """So long it may take before it counts as hanging: far above what scenes and answers take."""
        step_s = max(STEP_S, self.evaluation.policy.timeout_s)
        return sum(SCENE_S + step_s * self.evaluation.settings.step_limit(task.suite) for task in self.tasks)

    def lost(self) -> dict[EvaluationTask, str]:
        """What to say of its episodes where no worker survives it."""
        return dict.fromkeys(self._missing(), LOST)

    def _missing(self) -> list[EvaluationTask]:
        return [task for task in self.tasks if self.evaluation.result(task) is None]

    def _run(self, task: EvaluationTask, environment: EpisodeEnvironment, policy: Policy) -> None:
        evaluation = self.evaluation
        film: dict[int, Frame] | None = None if evaluation.videos == "none" else {}
        roll_out_policy(environment, policy, task, film)
        progress = environment.progress
        if film is not None and progress.steps and (evaluation.videos == "all" or not progress.success):
            # The policy did not look at how it ended, which is what one wants to see of a failure.
            film[progress.steps] = environment.image("agentview")
            # Before the episode's own file: where that exists, nothing is missing.
            write(evaluation.files.video(evaluation.episode(task)), mp4(list(film.values()), list(film)))
        evaluation.save(environment, policy.wanted)


@lru_cache(maxsize=1)
def _environment(settings: EpisodeSettings, archive: Path | None) -> EpisodeEnvironment:
    environment = EpisodeEnvironment(settings, archive)
    if threading.current_thread() is threading.main_thread():
        # Python ends in reverse order, and the first context of OpenGL has registered what ends it.
        gl.prepare()
        mujoco.gl_context.GLContext(1, 1).free()
        atexit.register(environment.close)
    else:
        # Only the thread that rendered may close it, and that of a worker is gone when its process ends: one reference
        # more keeps Python from trying.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(environment))
    return environment


@lru_cache(maxsize=1)
def _policy(config: PolicyConfig, identity: str, look_every: int) -> Policy:
    """This process's policy, which is refused if it is not the one that the evaluation was begun with."""
    policy = config.open(look_every)
    # After it was loaded: files that were others before are others now.
    if config.identity() != identity:
        raise PipelineError(
            "the checkpoint has changed since the evaluation began",
            where=config.address,
            expected="one policy for the whole evaluation, such as a folder that no training writes into",
            remedy="run the same command again",
        )
    return policy


_failures: list[tuple[EvaluationTask, str]] = []
"""Of this process's policy, since the last episode that it finished."""


def _without_result(faults: Sequence[tuple[EvaluationTask, str]]) -> PipelineError:
    named = [f"{what} ({task})" for task, what in faults[:FAULTS_NAMED]]
    more = [f"{len(faults) - FAULTS_NAMED} more"] if len(faults) > FAULTS_NAMED else []
    return PipelineError(
        f"{len(faults)} episodes have no result: {'; '.join([*named, *more])}",
        remedy="mend the policy and run the same command again: finished episodes are kept",
    )
