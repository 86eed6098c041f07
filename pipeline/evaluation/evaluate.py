"""Complete evaluation: tasks run in worker processes, with one file per episode and a summary."""

import platform
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline import gl, outputs
from pipeline.axes import AXES
from pipeline.compute.pool import LOST, Job, Workers, run_job
from pipeline.errors import PipelineError
from pipeline.evaluation.actions import PolicyError
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.goals import leave_out_trained_goals
from pipeline.evaluation.model_server import warn_of_requests
from pipeline.evaluation.policies import Policy
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.results import SUMMARY, EpisodeResult, one_setting
from pipeline.evaluation.rollout import roll_out_policy
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.setting_checks import check_policy_settings, check_settings
from pipeline.evaluation.simulator import close_at_exit
from pipeline.evaluation.statistics import summary
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import write
from pipeline.images.mp4 import mp4
from pipeline.types import Frame

EPISODES_A_JOB = 10
"""Largest number of episodes in a job. Smaller jobs spread better over workers; larger jobs build fewer scenes."""

JOBS_A_WORKER = 4
"""Number of jobs per worker below which jobs get smaller, so that all workers end at a similar time."""

FAILURES_IN_A_ROW = 3
"""Number of consecutive episodes without an action from the policy after which a worker stops the evaluation."""

FAULTS_NAMED = 3
"""Number of episodes without a result that are named in the error message."""

SCENE_S, STEP_S = 1800.0, 120.0
"""Upper bounds, for any machine, on the time to build a scene and on the time of a step with the policy's answer."""


def evaluate(evaluation: Evaluation, selection: Selection, run: Workers, workers: int = 1) -> dict[str, Any]:
    """Run the selected episodes that have no result yet.

    ``summary.json`` is of all selected episodes, and ``episodes.csv`` of all episodes of the policy in the folder
    that have their settings.
    If the policy gives no action, its episode has no result, and the evaluation resumes with the next episode.

    Args:
        workers: number of workers that share the episodes. Results do not depend on it.

    Returns:
        The summary.

    Raises:
        PipelineError: if an episode has no result; the summary is written before. If the policy fails in
            ``FAILURES_IN_A_ROW`` consecutive episodes, no summary is written.
    """
    settings = evaluation.settings
    check_policy_settings(evaluation.policy, settings)
    selected = leave_out_trained_goals(select(selection, evaluation.archive), settings.plan)
    check_settings(selection, selected, settings)
    evaluation.check(selected)
    faults = _run_missing(evaluation, selected, run, workers)
    results = {task: evaluation.result(task) for task in selected}
    for task, row in results.items():
        if row is None:
            faults.setdefault(task, "the plan or the archive changed during the evaluation")
    summarised = _write_summary(evaluation, selection, [row for row in results.values() if row is not None])
    if faults:
        raise _without_result([*faults.items()])
    return summarised


def _run_missing(
    evaluation: Evaluation, selected: Sequence[EvaluationTask], run: Workers, workers: int
) -> dict[EvaluationTask, str]:
    """Run the episodes of the selected tasks that have no up-to-date result.

    Returns:
        Task to the fault because of which its episode has no result.
    """
    missing = [task for task in selected if evaluation.result(task) is None]
    if not missing:
        return {}
    settings, policy = evaluation.settings, evaluation.policy
    if policy.kind == "server":
        # Each worker connects for itself. This connection warns once, before the workers start.
        warn_of_requests(policy.address, policy.timeout_s, settings.actions, settings.state_angle)
    device = gl.choose().device
    jobs = [EvaluationJob(evaluation, tasks, device) for tasks in _divide_into_jobs(missing, workers)]
    faults: dict[EvaluationTask, str] = {}
    for job_faults in run(run_job, jobs, "evaluate, episodes"):
        faults |= job_faults
    return faults


def _write_summary(evaluation: Evaluation, selection: Selection, rows: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Write ``summary.json`` of the selected episodes, and ``episodes.csv``; return the summary.

    Args:
        rows: results of the selected episodes.
    """
    summarised = summary(rows) | {
        "policy": {"name": evaluation.policy.name(evaluation.identity), "identity": evaluation.identity},
        "selection": selection.model_dump(mode="json"),
        "settings": one_setting([(row, evaluation.files) for row in rows]) or evaluation.settings.model_dump(),
    }
    outputs.write_json(evaluation.folder / SUMMARY, summarised)
    # Other calls have written results of other tasks; equal settings are those of this call's results. A call without
    # any result does not know them, and leaves a table of the policy as it is.
    of_policy = [row for row in evaluation.files.rows() if row.identity == evaluation.identity]
    if rows or not of_policy:
        evaluation.files.write_table(row for row in of_policy if row.settings == rows[0].settings)
    return summarised


def _divide_into_jobs(missing: Sequence[EvaluationTask], workers: int) -> list[tuple[EvaluationTask, ...]]:
    """Divide tasks into jobs of one scene each, in which the tasks of one axis follow each other.

    Tasks of the robot axis reset the arm to other postures; all other test tasks in a scene share one reset.
    """
    scenes: dict[tuple[str, ...], list[EvaluationTask]] = defaultdict(list)
    for task in missing:
        own_scene = task.source == "libero_plus" and AXES[task.axis].test_scene != "libero"
        moved = task.name.partition("_state")[0] if own_scene or task.source == "goals" else ""
        scenes[task.suite, task.base, moved].append(task)
    for scene in scenes.values():
        scene.sort(key=lambda task: (task.axis, task.number, task.name))
    spread = len(missing) if workers == 1 else max(1, len(missing) // (workers * JOBS_A_WORKER))
    size = min(spread, EPISODES_A_JOB)
    jobs: list[tuple[EvaluationTask, ...]] = []
    for scene in scenes.values():
        jobs += [tuple(scene[start : start + size]) for start in range(0, len(scene), size)]
    return jobs


@dataclass(frozen=True)
class EvaluationJob(Job[dict[EvaluationTask, str]]):
    """Job for a worker: episodes of one scene.

    Attributes:
        device: the device that renders the evaluation, by its OpenGL name.
    """

    evaluation: Evaluation
    tasks: tuple[EvaluationTask, ...]
    device: str

    def __call__(self) -> dict[EvaluationTask, str]:
        """Run the episodes, and write the file of each episode when it is over.

        Returns:
            Task to the policy's fault, for each episode that has no result because of the policy.

        Raises:
            PipelineError: if the policy fails in ``FAILURES_IN_A_ROW`` consecutive episodes, or if this worker renders
                with another device.
        """
        device = gl.choose().device
        if device != self.device:
            raise PipelineError(
                f"this worker renders with {device}, the evaluation with {self.device}",
                where=f"worker on {platform.node()}",
                expected="one device for all frames, as devices differ by some grey levels",
                remedy="start the evaluation and every worker on machines with the same OpenGL device (MUJOCO_GL "
                "selects the back end)",
            )
        settings, archive = self.evaluation.settings, self.evaluation.archive
        environment = _open_environment(settings, archive)
        policy = _open_policy(self.evaluation.policy, self.evaluation.identity, settings)
        faults = {}
        # A lost worker may have finished some episodes of this job.
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

    def size(self) -> int:
        """Return the number of episodes of the job."""
        return len(self.tasks)

    def limit_s(self) -> float:
        """Return the time after which the job counts as hanging, far above the time of scenes and answers."""
        step_s = max(STEP_S, self.evaluation.policy.timeout_s)
        return sum(SCENE_S + step_s * self.evaluation.settings.step_limit(task.suite) for task in self.tasks)

    def lost(self) -> dict[EvaluationTask, str]:
        """Return the fault of each unfinished episode if no worker survives the job."""
        return dict.fromkeys(self._missing(), LOST)

    def _missing(self) -> list[EvaluationTask]:
        """List the tasks that have no result."""
        return [task for task in self.tasks if self.evaluation.result(task) is None]

    def _run(self, task: EvaluationTask, environment: EpisodeEnvironment, policy: Policy) -> None:
        """Run one episode, and write its video and its result."""
        evaluation = self.evaluation
        film: dict[int, Frame] | None = None if evaluation.videos == "none" else {}
        roll_out_policy(environment, policy, task, film)
        progress = environment.progress
        if film is not None and progress.steps and (evaluation.videos == "all" or not progress.success):
            # The policy did not observe the end of the episode, but a viewer wants to see how it failed.
            film[progress.steps] = environment.image("agentview")
            # The video comes before the result: an episode with a result is complete.
            write(evaluation.files.video(evaluation.episode(task)), mp4(list(film.values()), list(film)))
        evaluation.save(environment, policy.wanted)


@lru_cache(maxsize=1)
def _open_environment(settings: EpisodeSettings, archive: Path | None) -> EpisodeEnvironment:
    """Open this process's environment, which stays open until the process ends."""
    environment = EpisodeEnvironment(settings, archive)
    close_at_exit(environment.close)
    return environment


@lru_cache(maxsize=1)
def _open_policy(policy_config: PolicyConfig, identity: str, settings: EpisodeSettings) -> Policy:
    """Open this process's policy.

    Raises:
        PipelineError: if it is not the policy with which the evaluation began.
    """
    policy = policy_config.open(settings)
    # The identity is computed after loading: files that changed before they were loaded still differ now.
    if policy_config.identity() != identity:
        raise PipelineError(
            "the checkpoint has changed since the evaluation began",
            where=policy_config.address,
            expected="one policy for the whole evaluation, such as a folder that no training writes into",
            remedy="run the same command again",
        )
    return policy


_failures: list[tuple[EvaluationTask, str]] = []
"""Failures of this process's policy since its last finished episode."""


def _without_result(faults: Sequence[tuple[EvaluationTask, str]]) -> PipelineError:
    """Return an error that counts the episodes without a result and names the first of them."""
    named = [f"{what} ({task})" for task, what in faults[:FAULTS_NAMED]]
    more = [f"{len(faults) - FAULTS_NAMED} more"] if len(faults) > FAULTS_NAMED else []
    lost = all(what == LOST for _, what in faults)
    remedy = "use fewer workers if memory is short" if lost else "correct the policy"
    return PipelineError(
        f"{len(faults)} episode{'s' * (len(faults) > 1)} without a result: {'; '.join([*named, *more])}",
        remedy=f"{remedy} and run the same command again: finished episodes are kept",
    )
