"""One evaluation: the names of its episodes, everything their results depend on, and the results in its folder."""

import json
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from pipeline import gl, identity
from pipeline.axes import to_json
from pipeline.axes.component_names import stored_names
from pipeline.evaluation import held_out, libero_plus, recordings
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.policy_config import PolicyConfig
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

PACKAGES = ("robouse", "opencv-python-headless")
"""Packages on which a result depends in addition to the packages of frames: the starter set, and image resizing."""

CHECKPOINT_PACKAGES = ("lerobot", "torch", "torchvision", "transformers", "diffusers")
"""Packages that compute a checkpoint's actions."""

REMAKE = f"put `{identity.REMAKE}=1` before the command; or evaluate into another folder"
"""Remedy by which a person allows results to be generated again."""


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
            reason = None if row is None else _record(row).describe_mismatch(self.basis(task), PER_TASK)
            if reason is not None:
                outdated[f"episodes, generated with {reason}"] += 1
        identity.require_remake_permission(outdated, self.folder, REMAKE)

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
            # Stored results have this name, a former term for perturbations.
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
        episode = environment.episode
        task, progress = episode.task, episode.progress
        perturbations = episode.perturbations if task.source == "own" else ()
        component = "+".join(perturbation.component for perturbation in perturbations) or task.component
        self.files.save(
            EpisodeResult(
                **asdict(task) | {"component": component},
                episode=self.episode(task),
                prompt=self.settings.prompt,
                instruction=environment.instruction,
                step_limit=episode.step_limit,
                seed=self.settings.seed,
                success=progress.success,
                reason=progress.reason,
                steps=progress.steps,
                looks=episode.looks,
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
