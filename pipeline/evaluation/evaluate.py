"""A whole evaluation: tasks over worker processes, a file for each episode, and a summary."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from pipeline import gl
from pipeline.compute.pool import Expendable, Run
from pipeline.errors import PipelineError
from pipeline.evaluation.policies import PolicyConfig
from pipeline.evaluation.results import EpisodeFiles, Row, refuse_shared_names
from pipeline.evaluation.rollout import EvaluationJob, Videos, current, episode_id, without_result
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.settings import Settings, check_settings
from pipeline.evaluation.statistics import summary
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import replaced
from pipeline.seeding import digest

EPISODES_A_JOB = 10
"""At most so many episodes of one scene are one worker's job: few enough to spread, many enough to build it once."""


JOBS_A_WORKER = 4
"""With few episodes, jobs are made smaller until there are so many, or one worker would end long after the others."""


SCENE_AXES = ("pose", "layout", "light", "background")
"""The axes whose test tasks have a scene each."""


def evaluate(
    selection: Selection,
    settings: Settings,
    policy: PolicyConfig,
    folder: Path,
    run: Run,
    videos: Videos = "none",
    archive: Path | None = None,
    workers: int = 1,
) -> dict[str, Any]:
    """Run what ``folder`` does not hold yet, and write ``summary.json`` of what was selected.

    An episode in which the policy gives no action has no result, and the others are run.

    Args:
        videos: of which episodes that are run now a video is kept: what the policy looked at, and the end.
        archive: folder of LIBERO-Plus's asset archive, where there is one.
        workers: how many share the work. Results do not depend on it.

    Returns:
        The summary.

    Raises:
        PipelineError: after the summary was written, when an episode has no result; before, when the policy fails in
            one episode after the other.
    """
    identity = policy.identity()
    name, files = policy.name(identity), EpisodeFiles(folder)
    check_settings(selection, settings)
    if settings.look_every != 1 and policy.kind != "server":
        raise PipelineError(
            f"only a server is shown one observation in {settings.look_every}", where="look_every", expected="--server"
        )
    refuse_shared_names((row, folder) for row in (*files.rows(), {"policy": name, "identity": identity}))
    wanted = {episode_id(task, settings, identity): task for task in select(selection, archive)}

    def stored() -> dict[str, Row]:
        there = ((row, wanted.get(row["episode"])) for row in files.rows())
        return {row["episode"]: row for row, task in there if task is not None and current(row, task, archive)}

    rows, faults = stored(), list[str]()
    if missing := [task for episode, task in wanted.items() if episode not in rows]:
        device = gl.choose().device
        jobs = [
            EvaluationJob(tasks, settings, policy, identity, folder, device, videos, archive)
            for tasks in _jobs(missing, workers)
        ]
        work = Expendable(EvaluationJob.__call__, EvaluationJob.limit_s, EvaluationJob.lost, EvaluationJob.episodes)
        faults = [fault for of_job in run(work, jobs, "evaluate, episodes") for fault in of_job]
        rows = stored()
        left = [task for episode, task in wanted.items() if episode not in rows]
        unsaid = [task for task in left if not any(fault.endswith(f"({task})") for fault in faults)]
        faults += [f"the plan or the archive changed while it ran ({task})" for task in unsaid]
    found = summary(rows.values()) | {
        "policy": {"name": name, "identity": identity},
        "selection": selection.model_dump(mode="json"),
        "settings": _one_setting(rows.values()) or settings.model_dump(),
    }
    with replaced(folder / "summary.json") as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
    if faults:
        raise without_result(faults)
    return found


def _one_setting(rows: Iterable[Row]) -> dict[str, Any]:
    """What holds for all rows; empty where there is none.

    Raises:
        PipelineError: when a policy looked at other things in some than in others.
    """
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
