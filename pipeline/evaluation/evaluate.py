"""A whole evaluation: tasks over worker processes, a file for each episode, and a summary."""

from __future__ import annotations

import atexit
import ctypes
import json
import threading
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import mujoco

from pipeline import gl
from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation.episode import EpisodeEnvironment
from pipeline.evaluation.policies import Checkpoint, Policy, PolicyError, Server
from pipeline.evaluation.replays import Replay, TrackedReplay
from pipeline.evaluation.results import EpisodeFiles, summary, versions
from pipeline.evaluation.rollout import roll_out_policy
from pipeline.evaluation.settings import Settings
from pipeline.evaluation.tasks import EvaluationTask, Selection, select
from pipeline.files import replaced
from pipeline.rendering.mp4 import mp4
from pipeline.run.compute import Run
from pipeline.seeding import digest
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

Videos = Literal["none", "failures", "all"]
"""Of which episodes a video is kept."""


class PolicyConfig(Frozen):
    """What acts.

    Attributes:
        kind: ``server`` for a model server's address, ``checkpoint`` for a folder that lerobot saved, ``open_loop`` for
            the demonstrations' own actions, ``tracked`` for their paths, followed by feedback.
        address: of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations.
        label: what results are kept under; the address by default. Give one where the same address will serve another
            policy.
        look_every: a server that answers from a chunk of its own uses one observation in so many.
        timeout_s: how long a server's answer may take.
    """

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    address: str = ""
    label: str = ""
    look_every: int = 1
    timeout_s: float = 120.0

    def open(self) -> Policy:
        match self.kind:
            case "server":
                return Server(self.address, self.timeout_s, self.look_every)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay()
            case "tracked":
                return TrackedReplay()


@lru_cache(maxsize=1)
def _environment(settings: Settings, archive: Path | None) -> EpisodeEnvironment:
    """This process's environment."""
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
def _policy(config: PolicyConfig) -> Policy:
    """This process's policy; a server keeps its connection."""
    return config.open()


_failures: list[str] = []
"""Of this process's policy, since the last episode that it finished."""


def episode_id(task: EvaluationTask, settings: Settings, policy: PolicyConfig) -> str:
    """Names an episode by what it is made from."""
    label = policy.label or f"{policy.kind} {policy.address}"
    return digest("evaluation", asdict(task), settings.model_dump(), label)[:16]


@dataclass(frozen=True)
class EvaluationJob:
    """Some episodes of one scene, as they are sent to a worker.

    Attributes:
        tasks: what to run, in order.
        settings, policy: what holds for all.
        folder: of the results.
        device: what renders the evaluation, as OpenGL names it.
        videos: of which episodes a video is kept.
        archive: folder of LIBERO-Plus's asset archive, where there is one.
    """

    tasks: tuple[EvaluationTask, ...]
    settings: Settings
    policy: PolicyConfig
    folder: Path
    device: str
    videos: Videos
    archive: Path | None = None

    def __call__(self) -> list[str]:
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
        files = EpisodeFiles(self.folder)
        environment, policy = _environment(self.settings, self.archive), _policy(self.policy)
        shared = {
            "policy": self.policy.label or policy.name,
            "seed": self.settings.seed,
            "settings": self.settings.model_dump(),
            "versions": {**versions(), "opengl": device},
        }
        faults = []
        for task in self.tasks:
            episode = episode_id(task, self.settings, self.policy)
            seen: dict[int, Frame] | None = None if self.videos == "none" else {}
            try:
                row = roll_out_policy(environment, policy, task, seen)
            except PolicyError as error:
                faults.append(f"{error.what} ({task})")
                _failures.append(faults[-1])
                if len(_failures) == FAILURES_IN_A_ROW:
                    stopped = without_result(_failures)
                    _failures.clear()
                    raise stopped from error
                continue
            _failures.clear()
            if seen is not None and row["steps"] and (self.videos == "all" or not row["success"]):
                # The policy did not look at how it ended, which is what one wants to see of a failure.
                seen[row["steps"]] = environment.image("agentview")
                # Before the episode's own file: where that exists, nothing is missing.
                files.save_video(episode, mp4(list(seen.values()), list(seen)))
            files.save({"episode": episode, **row, **shared})
        return faults


def without_result(faults: Sequence[str]) -> PipelineError:
    """The policy failed in some episodes; the first few are named."""
    more = [f"{len(faults) - FAULTS_NAMED} more"] if len(faults) > FAULTS_NAMED else []
    return PipelineError(
        f"{len(faults)} episodes have no result: {'; '.join([*faults[:FAULTS_NAMED], *more])}",
        remedy="mend the policy and run the same command again: finished episodes are kept",
    )


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
    faults: list[str] = []
    wanted = {episode_id(task, settings, policy): task for task in select(selection, archive)}
    files = EpisodeFiles(folder)
    missing = [task for episode, task in wanted.items() if not files.path(episode).exists()]
    if missing:
        device = gl.choose().device
        jobs = [
            EvaluationJob(tasks, settings, policy, folder, device, videos, archive) for tasks in _jobs(missing, workers)
        ]
        faults = [fault for of_job in run(EvaluationJob.__call__, jobs, "evaluate") for fault in of_job]
    found = summary(row for row in files.rows() if row["episode"] in wanted)
    found |= {
        "policy": policy.model_dump(),
        "selection": selection.model_dump(mode="json"),
        "settings": settings.model_dump(),
    }
    with replaced(folder / "summary.json") as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
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
