"""Episodes as a worker runs them: a policy acts until one is over, and its result is stored."""

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
from pipeline.evaluation.policies import Policy, PolicyConfig
from pipeline.evaluation.results import EpisodeFiles, Row, made_by, versions
from pipeline.evaluation.settings import PolicyError, Settings, Wanted, checked_actions
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.images.mp4 import mp4
from pipeline.seeding import digest
from pipeline.types import Frame

FILM_STEPS = 8
"""A video has a frame of at most so many steps, also where the policy looks less often, or at nothing."""

FAILURES_IN_A_ROW = 3
"""After so many episodes in a row without an action from the policy a worker stops the evaluation."""

FAULTS_NAMED = 3
"""So many episodes without a result are named in the message that counts them."""

SCENE_S, STEP_S = 1800.0, 120.0
"""No scene takes so long to build, and no step with its answer takes so long, on any machine."""


@dataclass(frozen=True)
class Evaluation:
    """What holds for all episodes of an evaluation.

    Attributes:
        identity: of the policy, as it was when the evaluation began.
        folder: of the results.
        videos: of which episodes that are run now a video is kept: what the policy looked at, and the end.
        archive: folder of LIBERO-Plus's asset archive, where there is one.
    """

    settings: Settings
    policy: PolicyConfig
    identity: str
    folder: Path
    videos: Literal["none", "failures", "all"] = "none"
    archive: Path | None = None

    @property
    def files(self) -> EpisodeFiles:
        return EpisodeFiles(self.folder)

    def episode(self, task: EvaluationTask) -> str:
        """Names an episode by what it is made from."""
        return digest("evaluation", asdict(task), self.settings.model_dump(), self.identity)[:16]

    def result(self, task: EvaluationTask) -> Row | None:
        """What is stored of an episode, if this version would make the same."""
        row = self.files.row(self.episode(task))
        return row if row is not None and row.get("made_by") == self.made_by(task) else None

    def made_by(self, task: EvaluationTask) -> str:
        """A short name for what makes a result beside the task, the settings and the policy."""
        contents = []
        if task.source == "libero_plus":
            contents = asset_archive.contents(libero_plus.find(task.suite, task.name), self.archive)
        return made_by(self.identity.startswith("sha256:"), contents)


def roll_out_policy(
    environment: EpisodeEnvironment, policy: Policy, task: EvaluationTask, film: dict[int, Frame] | None = None
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

    def look(wanted: Wanted) -> dict[str, Any]:
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


@dataclass(frozen=True)
class EvaluationJob:
    """Some episodes of one scene, as they are sent to a worker.

    Attributes:
        tasks: what to run, in order.
        device: what renders the evaluation, as OpenGL names it.
    """

    evaluation: Evaluation
    tasks: tuple[EvaluationTask, ...]
    device: str

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
        settings, archive = self.evaluation.settings, self.evaluation.archive
        environment = _environment(settings, archive)
        policy = _policy(self.evaluation.policy, self.evaluation.identity, settings.look_every)
        faults = []
        # A worker that was lost may have left some.
        for task in self._missing():
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
        step_s = max(STEP_S, self.evaluation.policy.timeout_s)
        return sum(SCENE_S + step_s * STEP_LIMITS[task.suite] for task in self.tasks)

    def lost(self) -> list[str]:
        """What to say of its episodes where no worker survives it."""
        return [f"{LOST} ({task})" for task in self._missing()]

    def _missing(self) -> list[EvaluationTask]:
        return [task for task in self.tasks if self.evaluation.result(task) is None]

    def _run(self, task: EvaluationTask, environment: EpisodeEnvironment, policy: Policy) -> None:
        evaluation, episode = self.evaluation, self.evaluation.episode(task)
        film: dict[int, Frame] | None = None if evaluation.videos == "none" else {}
        row = roll_out_policy(environment, policy, task, film)
        if film is not None and row["steps"] and (evaluation.videos == "all" or not row["success"]):
            # The policy did not look at how it ended, which is what one wants to see of a failure.
            film[row["steps"]] = environment.image("agentview")
            # Before the episode's own file: where that exists, nothing is missing.
            evaluation.files.save_video(episode, mp4(list(film.values()), list(film)))
        evaluation.files.save(
            {
                "episode": episode,
                **row,
                "policy": evaluation.policy.name(evaluation.identity),
                "identity": evaluation.identity,
                "seed": evaluation.settings.seed,
                "settings": {**evaluation.settings.model_dump(), **policy.wanted._asdict()},
                "versions": {**versions(), "opengl": self.device},
                "made_by": evaluation.made_by(task),
            }
        )


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


_failures: list[str] = []
"""Of this process's policy, since the last episode that it finished."""


def without_result(faults: Sequence[str]) -> PipelineError:
    """The policy failed in some episodes; the first few are named."""
    more = [f"{len(faults) - FAULTS_NAMED} more"] if len(faults) > FAULTS_NAMED else []
    return PipelineError(
        f"{len(faults)} episodes have no result: {'; '.join([*faults[:FAULTS_NAMED], *more])}",
        remedy="mend the policy and run the same command again: finished episodes are kept",
    )
