"""Rollout of one episode: a policy acts in an environment until the episode is over, and the result is stored."""

import json
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from pipeline import gl, identity
from pipeline.axes import to_json
from pipeline.axes.component_names import stored_names
from pipeline.errors import PipelineError
from pipeline.evaluation import held_out, libero_plus, recordings
from pipeline.evaluation.actions import checked_actions
from pipeline.evaluation.checkpoint import Checkpoint, content_of
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.model_server import Server
from pipeline.evaluation.policies import Policy, Wanted
from pipeline.evaluation.reference_policies import Replay, TrackedReplay
from pipeline.evaluation.results import (
    PER_TASK,
    RECORDED,
    EpisodeFiles,
    EpisodeResult,
    one_setting,
    reject_shared_names,
)
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.files import checksum_of, edition
from pipeline.libero.tasks import SUITES, find_task
from pipeline.record import Basis, Record
from pipeline.seeding import digest
from pipeline.testset import benchmark
from pipeline.types import Frame, Frozen

FILM_STEPS = 8
"""Largest number of steps between two frames of a video, even if the policy observes less often or not at all."""

PACKAGES = ("robouse", "opencv-python-headless")
"""Packages on which a result depends in addition to the packages of frames: the starter set, and image resizing."""

CHECKPOINT_PACKAGES = ("lerobot", "torch", "torchvision", "transformers", "diffusers")
"""Packages that compute a checkpoint's actions."""

REMAKE = f"put `{identity.REMAKE}=1` before the command; or evaluate into another folder"
"""Remedy by which a person allows results to be generated again."""


class PolicyConfig(Frozen, use_attribute_docstrings=True):
    """Configuration of the policy that acts."""

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    """a model server, a folder that lerobot saved, the demonstrations' own actions, or their paths, followed by
    feedback"""
    address: str = ""
    """address of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations"""
    label: str = ""
    """name of the policy in the results. A server must have a label, a different one for each policy, because its
    address does not identify the policy."""
    timeout_s: float = Field(default=120.0, gt=0)
    """time limit of a server's answer in seconds"""

    def identity(self) -> str:
        """Return the policy's identity, which is equal for equal policies only.

        The identity is ``sha256:`` and the content of a checkpoint, or ``script:`` and the kind of a replay. For a
        server it is ``claimed:`` and the label, because only the user knows the policy.

        Raises:
            PipelineError: if a server has no label, or if the folder is not a checkpoint.
        """
        match self.kind:
            case "checkpoint":
                return f"sha256:{content_of(Path(self.address))}"
            case "server" if not self.label:
                raise PipelineError(
                    "this server has no label",
                    where=self.address,
                    expected="--label NAME, a different one for each policy: an address does not identify a policy, so "
                    "results of another policy at it would count as results of this policy",
                )
            case "server":
                return f"claimed:{self.label}"
            case _:
                return f"script:{self.kind}"

    def name(self, identity: str) -> str:
        """Return the policy's name in the results: the label, else a name derived from kind, address and identity."""
        scripts = {"open_loop": "replay", "tracked": "tracked replay"}
        return self.label or scripts.get(self.kind) or f"{self.address} {identity.removeprefix('sha256:')[:8]}"

    def open(self, settings: EpisodeSettings) -> Policy:
        """Load the policy, or connect to its server."""
        match self.kind:
            case "server":
                return Server(self.address, self.timeout_s, settings.look_every, settings.actions, settings.state_angle)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay(demos=settings.demos)
            case "tracked":
                return TrackedReplay(settings.demos)


@dataclass(frozen=True)
class Evaluation:
    """Settings, policy and folder of an evaluation, shared by all its episodes.

    Attributes:
        identity: identity of the policy when the evaluation began.
        videos: kind of episodes of which this evaluation keeps a video. A video shows the policy's observations and the
            end of the episode.
        archive: folder of LIBERO-Plus's asset archive, if there is one.
    """

    settings: EpisodeSettings
    policy: PolicyConfig
    identity: str
    folder: Path
    videos: Literal["none", "failures", "all"] = "none"
    archive: Path | None = None

    @property
    def files(self) -> EpisodeFiles:
        """Return the files of the evaluation's folder."""
        return EpisodeFiles(self.folder)

    def episode(self, task: EvaluationTask) -> str:
        """Compute the name of an episode, a digest of its inputs."""
        stored = asdict(task) | {"component": stored_names(task.component)}
        return digest("evaluation", stored, self.settings.model_dump(), self.identity)[:16]

    def result(self, task: EvaluationTask) -> EpisodeResult | None:
        """Return the stored result of an episode if it is up to date, else `None`."""
        row = self.files.row(self.episode(task))
        return row if row is not None and _record(row).matches(self.basis(task)) else None

    def test_results(self) -> list[EpisodeResult]:
        """Read the up-to-date results on test tasks of this policy under these settings, of any selection.

        Raises:
            PipelineError: if a file is not a result of this version, or if the policy used other views or states in
                some of the results.
        """
        results: list[EpisodeResult] = []
        for row in self.files.rows():
            if row.source != "libero_plus":
                continue
            task, *_ = row.trial
            if row.episode == self.episode(task) and _record(row).matches(self.basis(task)):
                results.append(row)
        one_setting([(row, self.files) for row in results])
        return results

    def check(self, tasks: Iterable[EvaluationTask]) -> None:
        """Reject a folder that this evaluation must not write into.

        Raises:
            PipelineError: if the folder has files of another kind, or results of another policy with this name, or
                results of other versions that nobody allowed to generate again. No file is changed.
        """
        self.files.reject_other_folder()
        policies = [(row.policy, row.identity, self.folder) for row in self.files.rows()]
        reject_shared_names([*policies, (self.policy.name(self.identity), self.identity, self.folder)])
        outdated: Counter[str] = Counter()
        for task in tasks:
            row = self.files.row(self.episode(task))
            reason = None if row is None else _record(row).why_not(self.basis(task), PER_TASK)
            if reason is not None:
                outdated[f"episodes, generated with {reason}"] += 1
        identity.reject_unasked(outdated, self.folder, REMAKE)

    def basis(self, task: EvaluationTask) -> Basis:
        """Return everything that the result of an episode depends on."""
        return Basis.of(self.episode(task), self.versions(task))

    def versions(self, task: EvaluationTask) -> dict[str, str]:
        """Return name to version of everything that decides a result besides task, settings and policy."""
        packages = (*PACKAGES, *CHECKPOINT_PACKAGES) if self.policy.kind == "checkpoint" else PACKAGES
        versions = {**identity.made_with("pixels"), **identity.made_with("evaluation"), **_installed(packages)}
        versions["OpenGL"] = gl.choose().device
        if task.source == "libero_plus":
            contents = libero_plus.contents(benchmark.load().find(task.suite, task.name), self.archive)
            if contents:
                versions["files of the benchmark"] = digest(contents)[:16]
        if task.source == "own":
            versions["draws"] = held_out.digest_first_perturbations(task, self.settings.seed)
        base, demos = find_task(task.suite, task.base), self.settings.demos
        if task.suite not in SUITES:
            versions["definition of the task"] = checksum_of(edition(base.bddl_file))[:16]
        if demos is not None and self._uses_demonstration(task):
            versions["demonstration"] = recordings.content_of(base, task.number, demos)[:16]
        return versions

    def _uses_demonstration(self, task: EvaluationTask) -> bool:
        """Return whether a result depends on a demonstration of the task."""
        starts = task.source == "own" or self.settings.initial_states == "demonstration"
        return starts or self.policy.kind in ("open_loop", "tracked")

    def save(self, environment: EpisodeEnvironment, wanted: Wanted) -> None:
        """Write the result of the episode that ended in an environment.

        Args:
            wanted: the parts of an observation that the policy asked for.
        """
        task, progress = environment.task, environment.progress
        perturbations = environment.perturbations if task.source == "own" else ()
        component = "+".join(perturbation.component for perturbation in perturbations) or task.component
        self.files.save(
            EpisodeResult(
                **asdict(task) | {"component": component},
                episode=self.episode(task),
                prompt=self.settings.prompt,
                instruction=environment.instruction,
                step_limit=environment.step_limit,
                seed=self.settings.seed,
                success=progress.success,
                reason=progress.reason,
                steps=progress.steps,
                looks=environment.looks,
                perturbations=json.loads(to_json(perturbations)),
                policy=self.policy.name(self.identity),
                identity=self.identity,
                settings={**self.settings.model_dump(), **wanted._asdict()},
                versions={
                    **self.versions(task),
                    **_installed(("vla-eval",)),
                    "pipeline": identity.versions()["pipeline"],
                },
            )
        )


def _record(row: EpisodeResult) -> Record:
    """Return the record of a stored result."""
    deciding = {name: value for name, value in row.versions.items() if name not in RECORDED}
    return Record(Basis.of(row.episode, deciding))


@cache
def _installed(packages: tuple[str, ...]) -> dict[str, str]:
    """Return package to version, for packages that are installed."""
    versions = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


def roll_out_policy(
    environment: EpisodeEnvironment, policy: Policy, task: EvaluationTask, film: dict[int, Frame] | None = None
) -> None:
    """Run one episode to its end; the environment has the result.

    Args:
        film: dictionary that receives agent views: number of steps before a view to the view. It receives the view of
            every observation, and a view after each ``FILM_STEPS`` steps without an observation.

    Raises:
        PolicyError: if the policy's answer is not actions.
        PipelineError: if the task cannot be rebuilt.
    """
    progress = environment.reset(task)
    policy.begin(task)

    def look(wanted: Wanted) -> dict[str, Any]:
        """Return an observation, and add its agent view to the film."""
        observation = environment.observation(wanted)
        if film is not None and wanted.images:
            film[environment.progress.steps] = observation["images"]["agentview"]
        return observation

    while not progress.over:
        for action in checked_actions(policy.act(look), policy.name):
            steps = environment.progress.steps
            if film is not None and steps - max(film, default=-FILM_STEPS) >= FILM_STEPS:
                film[steps] = environment.image("agentview")
            progress = environment.step(action)
            if progress.over:
                break
    policy.end(progress.success)
