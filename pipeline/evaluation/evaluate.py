"""A whole evaluation: tasks over worker processes, a file for each episode, and a summary."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any

from pipeline import gl
from pipeline.compute.pool import Expendable, Workers
from pipeline.errors import PipelineError
from pipeline.evaluation.results import Row, refuse_shared_names
from pipeline.evaluation.rollout import Evaluation, EvaluationJob, without_result
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.settings import check_settings
from pipeline.evaluation.statistics import summary
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import write_json
from pipeline.seeding import digest

EPISODES_A_JOB = 10
"""At most so many episodes of one scene are one worker's job: few enough to spread, many enough to build it once."""

JOBS_A_WORKER = 4
"""With few episodes, jobs are made smaller until there are so many, or one worker would end long after the others."""

SCENE_AXES = ("pose", "layout", "light", "background")
"""The axes whose test tasks have a scene each."""


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
    settings, policy, folder = evaluation.settings, evaluation.policy, evaluation.folder
    acting = {"policy": policy.name(evaluation.identity), "identity": evaluation.identity}
    check_settings(selection, settings)
    if settings.look_every != 1 and policy.kind != "server":
        raise PipelineError(
            f"only a server is shown one observation in {settings.look_every}", where="look_every", expected="--server"
        )
    refuse_shared_names((row, folder) for row in (*evaluation.files.rows(), acting))
    wanted = select(selection, evaluation.archive)
    faults: list[str] = []
    if missing := [task for task in wanted if evaluation.result(task) is None]:
        device = gl.choose().device
        jobs = [EvaluationJob(evaluation, tasks, device) for tasks in _jobs(missing, workers)]
        work = Expendable(EvaluationJob.__call__, EvaluationJob.limit_s, EvaluationJob.lost, EvaluationJob.episodes)
        faults = [fault for of_job in run(work, jobs, "evaluate, episodes") for fault in of_job]
    results = {task: evaluation.result(task) for task in wanted}
    rows = [row for row in results.values() if row is not None]
    left = [f"({task})" for task, row in results.items() if row is None]
    unsaid = [task for task in left if not any(fault.endswith(task) for fault in faults)]
    faults += [f"the plan or the archive changed while it ran {task}" for task in unsaid]
    found = summary(rows) | {
        "policy": {"name": acting["policy"], "identity": evaluation.identity},
        "selection": selection.model_dump(mode="json"),
        "settings": _one_setting(rows) or settings.model_dump(),
    }
    write_json(folder / "summary.json", found)
    if faults:
        raise without_result(faults)
    return found


def _jobs(missing: Sequence[EvaluationTask], workers: int) -> list[tuple[EvaluationTask, ...]]:
    """Tasks by scene: those of one scene, and of one posture of the arm, follow each other."""
    scenes: dict[tuple[str, ...], list[EvaluationTask]] = defaultdict(list)
    for task in missing:
        own_scene = task.source == "libero_plus" and task.axis in SCENE_AXES
        moved = task.name.partition("_state")[0] if own_scene or task.source == "goals" else ""
        scenes[task.suite, task.base, moved].append(task)
    spread = len(missing) if workers == 1 else max(1, len(missing) // (workers * JOBS_A_WORKER))
    size = min(spread, EPISODES_A_JOB)
    jobs = []
    for scene in scenes.values():
        ordered = iter(sorted(scene, key=lambda task: (task.axis == "robot", task.number, task.name)))
        while job := tuple(islice(ordered, size)):
            jobs.append(job)
    return jobs


def _one_setting(rows: Iterable[Row]) -> dict[str, Any]:
    """What holds for all rows; empty where there is none. Refuses a policy that looked at other things in some."""
    seen = {digest(row["settings"]): row for row in rows}
    if len(seen) > 1:
        one, other, *_ = seen.values()
        differing = {key: (value, other["settings"].get(key)) for key, value in one["settings"].items()}
        raise PipelineError(
            f"episodes of {one['policy']!r} were seen in different ways: "
            + ", ".join(f"{key} {value} and {then}" for key, (value, then) in differing.items() if value != then),
            where=f"{one['episode']} and {other['episode']}",
            expected="one policy under one label",
            remedy="evaluate the server as it is now under another --label into another folder",
        )
    return next(iter(seen.values()))["settings"] if seen else {}
