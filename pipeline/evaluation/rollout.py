"""Episodes rolled out: a policy acts until it is over, and a worker does so for some episodes of one scene."""

from __future__ import annotations

import atexit
import ctypes
import json
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import mujoco

from pipeline import gl
from pipeline.axes import to_json
from pipeline.compute.pool import LOST
from pipeline.errors import PipelineError
from pipeline.evaluation import asset_archive, libero_plus
from pipeline.evaluation.environment import STEP_LIMITS, EpisodeEnvironment
from pipeline.evaluation.policies import Policy, PolicyConfig, PolicyError, checked_actions
from pipeline.evaluation.results import EpisodeFiles, Row, made_by, versions
from pipeline.evaluation.settings import Settings
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.images.mp4 import mp4
from pipeline.seeding import digest
from pipeline.types import Frame

FILM_STEPS = 8
"""A video has a frame of at most so many steps, also where the policy looks less often, or at nothing."""


def roll_out_policy(
    environment: EpisodeEnvironment,
    policy: Policy,
    task: EvaluationTask,
    film: dict[int, Frame] | None = None,
) -> Row:
    """Run one episode to its end; returns what is recorded of it.

    Args:
        film: where agent views go, by the number of steps before each: of every look, and one whenever
            ``FILM_STEPS`` went by without a look at it.

    Raises:
        PolicyError: when the policy answers with anything but actions.
        PipelineError: when the task cannot be rebuilt.
    """
    progress = environment.reset(task)
    policy.begin(task)
    looks = 0

    def look(wanted: Any) -> dict[str, Any]:
        nonlocal looks
        looks += 1
        observation = environment.observation(wanted)
        if film is not None and wanted.images:
            film[environment.progress.steps] = observation["images"]["agentview"]
        return observation

    def record() -> None:
        steps = environment.progress.steps
        if film is not None and steps - max(film, default=-FILM_STEPS) >= FILM_STEPS:
            film[steps] = environment.image("agentview")

    while not progress.over:
        for action in checked_actions(policy.act(look), policy.name):
            record()
            progress = environment.step(action)
            if progress.over:
                break
    policy.end(progress.success)
    changes = environment.perturbations
    row = asdict(task)
    if task.source == "own" and changes:
        row["component"] = "+".join(change.component for change in changes)
    return {
        **row,
        "success": progress.success,
        "reason": progress.reason,
        "steps": progress.steps,
        "looks": looks,
        "prompt": environment.instruction,
        "perturbations": json.loads(to_json(changes)) if task.source == "own" else [],
    }


FAILURES_IN_A_ROW = 3
"""After so many episodes in a row without an action from the policy a worker stops the evaluation."""


FAULTS_NAMED = 3
"""So many episodes without a result are named in the message that counts them."""


SCENE_S, STEP_S = 1800.0, 120.0
"""No scene takes so long to build, and no step with its answer takes so long, on any machine."""


Videos = Literal["none", "failures", "all"]
"""Of which episodes a video is kept."""


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
def _policy(config: PolicyConfig, identity: str, look_every: int) -> Policy:
    """This process's policy; a server keeps its connection.

    Raises:
        PipelineError: when it is not the one that the evaluation was begun with.
    """
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


_failures: list[str] = []
"""Of this process's policy, since the last episode that it finished."""


def episode_id(task: EvaluationTask, settings: Settings, identity: str) -> str:
    """Names an episode by what it is made from."""
    return digest("evaluation", asdict(task), settings.model_dump(), identity)[:16]


@dataclass(frozen=True)
class EvaluationJob:
    """Some episodes of one scene, as they are sent to a worker.

    Attributes:
        tasks: what to run, in order.
        settings, policy: what holds for all.
        identity: of the policy.
        folder: of the results.
        device: what renders the evaluation, as OpenGL names it.
        videos: of which episodes a video is kept.
        archive: folder of LIBERO-Plus's asset archive, where there is one.
    """

    tasks: tuple[EvaluationTask, ...]
    settings: Settings
    policy: PolicyConfig
    identity: str
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
        environment = _environment(self.settings, self.archive)
        policy = _policy(self.policy, self.identity, self.settings.look_every)
        faults = []
        # A worker that was lost may have left some.
        for task in self._without_result():
            try:
                self._run(task, environment, policy)
            except PolicyError as error:
                faults.append(f"{error.what} ({task})")
                _failures.append(faults[-1])
                if len(_failures) == FAILURES_IN_A_ROW:
                    stopped = without_result(_failures)
                    _failures.clear()
                    raise stopped from error
            else:
                _failures.clear()
        return faults

    def episodes(self) -> int:
        return len(self.tasks)

    def limit_s(self) -> float:
        """So long it may take before it counts as hanging: far above what scenes and answers take."""
        step_s = max(STEP_S, self.policy.timeout_s)
        return sum(SCENE_S + step_s * STEP_LIMITS[task.suite] for task in self.tasks)

    def lost(self) -> list[str]:
        """What to say of its episodes where no worker survives it."""
        return [f"{LOST} ({task})" for task in self._without_result()]

    def _without_result(self) -> list[EvaluationTask]:
        files = EpisodeFiles(self.folder)
        stored = {task: files.row(episode_id(task, self.settings, self.identity)) for task in self.tasks}
        return [task for task, row in stored.items() if row is None or not current(row, task, self.archive)]

    def _run(self, task: EvaluationTask, environment: EpisodeEnvironment, policy: Policy) -> None:
        files, episode = EpisodeFiles(self.folder), episode_id(task, self.settings, self.identity)
        film: dict[int, Frame] | None = None if self.videos == "none" else {}
        row = roll_out_policy(environment, policy, task, film)
        if film is not None and row["steps"] and (self.videos == "all" or not row["success"]):
            # The policy did not look at how it ended, which is what one wants to see of a failure.
            film[row["steps"]] = environment.image("agentview")
            # Before the episode's own file: where that exists, nothing is missing.
            files.save_video(episode, mp4(list(film.values()), list(film)))
        files.save(
            {
                "episode": episode,
                **row,
                "policy": self.policy.name(self.identity),
                "identity": self.identity,
                "seed": self.settings.seed,
                "settings": {**self.settings.model_dump(), **policy.wanted._asdict()},
                "versions": {**versions(), "opengl": self.device},
                "made_by": _made_by(task, self.identity, self.archive),
            }
        )


def _made_by(task: EvaluationTask, identity: str, archive: Path | None) -> str:
    test = libero_plus.by_name().get((task.suite, task.name)) if task.source == "libero_plus" else None
    return made_by(identity.startswith("sha256:"), [] if test is None else asset_archive.contents(test, archive))


def current(row: Row, task: EvaluationTask, archive: Path | None) -> bool:
    """Whether a stored result is what this version would make of its task."""
    return bool(row.get("made_by") == _made_by(task, row["identity"], archive))


def without_result(faults: Sequence[str]) -> PipelineError:
    """The policy failed in some episodes; the first few are named."""
    more = [f"{len(faults) - FAULTS_NAMED} more"] if len(faults) > FAULTS_NAMED else []
    return PipelineError(
        f"{len(faults)} episodes have no result: {'; '.join([*faults[:FAULTS_NAMED], *more])}",
        remedy="mend the policy and run the same command again: finished episodes are kept",
    )
