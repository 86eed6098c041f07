"""Checks of an evaluation's settings against its policy and its tasks, before the first episode."""

from collections import Counter
from collections.abc import Sequence

from pipeline.errors import PipelineError
from pipeline.evaluation import held_out, recordings
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.selection import Selection
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.tasks import SUITES, find_task
from pipeline.types import Task


def check_policy_settings(policy: PolicyConfig, settings: EpisodeSettings) -> None:
    """Reject settings that the kind of policy does not have.

    Raises:
        PipelineError: if a setting is rejected.
    """
    if settings.look_every != 1 and policy.kind != "server":
        raise PipelineError(
            f"only a server can observe every {settings.look_every} steps",
            where="look_every",
            expected="--server",
            remedy="leave --look-every out",
        )
    if settings.state_angle != "server" and policy.kind != "server":
        raise PipelineError(
            "only a server has another range of angles",
            where="state_angle",
            expected="--server",
            remedy="leave --state-angle out",
        )
    if settings.actions == "absolute" and policy.kind in ("open_loop", "tracked"):
        raise PipelineError(
            "the replays of demonstrations execute deltas",
            where="actions",
            expected="--server or --checkpoint",
            remedy="leave --actions out",
        )


def check_settings(selection: Selection, wanted: Sequence[EvaluationTask], settings: EpisodeSettings) -> None:
    """Reject settings that do not apply to the selected tasks, and settings that would duplicate episodes.

    Args:
        wanted: the selected tasks.

    Raises:
        PipelineError: if a setting is rejected, or if the plan cannot be read.
    """
    if settings.seed != selection.seed:
        raise PipelineError(
            f"task selection uses seed {selection.seed}, but perturbations use seed {settings.seed}",
            where="seed",
            expected="one seed for both",
            remedy="leave the seed out of the settings",
        )
    if settings.plan is not None:
        held_out.sha256_of(settings.plan)
        if not any(task.source in ("own", "goals") for task in wanted):
            raise PipelineError(
                "no task has held-out perturbations to compare with a plan",
                where="plan",
                expected="--source own or --source goals",
                remedy="leave the plan out",
            )
    if settings.prompt == "benchmark" and not any(task.source == "libero_plus" for task in wanted):
        raise PipelineError(
            "no task has an instruction of the benchmark",
            where="prompt",
            expected="--source libero_plus",
            remedy="leave --prompt out",
        )
    if settings.step_limits == "lerobot" and not any(task.suite == "libero_spatial" for task in wanted):
        raise PipelineError(
            "lerobot's step limits differ only in libero_spatial, and no task of this suite is selected",
            where="step_limits",
            expected="openvla",
            remedy="leave --step-limits out",
        )
    if settings.initial_states == "demonstration":
        _check_demonstration_starts(wanted, settings)
    _check_own_tasks(wanted, settings)


def _check_demonstration_starts(wanted: Sequence[EvaluationTask], settings: EpisodeSettings) -> None:
    """Reject tasks that do not start in a demonstration's first state, and tasks with too few demonstrations.

    Raises:
        PipelineError: if a task is rejected.
    """
    unsupported = {task.source for task in wanted} & {"libero_plus", "goals"}
    if unsupported:
        raise PipelineError(
            f"tasks of {' and '.join(sorted(unsupported))} do not start in the first state of a demonstration",
            where="initial_states",
            expected="tasks of libero and own",
            remedy="leave --initial-states out",
        )
    starts = Counter((task.suite, task.base) for task in wanted if task.source == "libero")
    for (suite, name), episodes in starts.items():
        count = recordings.count_of(find_task(suite, name), settings.demos)
        if episodes > count:
            raise PipelineError(
                f"{episodes - count} of {episodes} episodes of {suite}/{name} would be repetitions, because it has "
                f"{count} demonstration{'s' if count > 1 else ''}",
                where="initial_states",
                expected="at most one episode of each demonstration",
                remedy=f"set --episodes {count}, or leave --initial-states out",
            )


def _check_own_tasks(wanted: Sequence[EvaluationTask], settings: EpisodeSettings) -> None:
    """Reject settings that do not fit the user's own tasks.

    Raises:
        PipelineError: if own tasks lack a step limit or demonstrations, or if no selected task needs such a setting.
    """
    own_tasks = [task for task in wanted if task.suite not in SUITES]
    if not own_tasks:
        if settings.own_step_limit is not None:
            raise PipelineError(
                "LIBERO's suites have their own step limits, and no task of yours is selected",
                where="own_step_limit",
                expected="a suite of your own, by --suite",
                remedy="leave --own-step-limit out",
            )
        return
    if settings.own_step_limit is None and settings.demos is not None:
        steps: dict[Task, int] = {}
        for suite, name in sorted({(task.suite, task.base) for task in own_tasks}):
            own_task = find_task(suite, name)
            steps[own_task] = recordings.longest_steps(own_task, settings.demos)
        longest = max(steps, key=lambda task: steps[task])
        raise PipelineError(
            f"LIBERO has no step limit for your suite {longest.suite}",
            where="own_step_limit",
            expected=f"more than the {steps[longest]} steps of the longest demonstration of {longest.name}; LIBERO's "
            "limits are 3 to 14 % above its longest demonstrations",
            remedy="add --own-step-limit N",
        )
    settings.step_limit(own_tasks[0].suite)
    for suite, name in {(task.suite, task.base) for task in own_tasks if task.source == "own"}:
        recordings.count_of(find_task(suite, name), settings.demos)
