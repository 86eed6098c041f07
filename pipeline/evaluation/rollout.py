"""One episode: a policy acts in an environment until it is over, and the result is stored."""

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
from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation import libero_plus, own_draws
from pipeline.evaluation.actions import checked_actions
from pipeline.evaluation.environment import EpisodeEnvironment, EpisodeSettings
from pipeline.evaluation.policies import Checkpoint, Policy, Server, Wanted, content_of
from pipeline.evaluation.reference_policies import Replay, TrackedReplay
from pipeline.evaluation.results import PER_TASK, EpisodeFiles, EpisodeResult, refuse_shared_names
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.seeding import digest
from pipeline.testset import benchmark
from pipeline.types import Frame

FILM_STEPS = 8
"""A video has a frame of at most so many steps, also where the policy looks less often, or at nothing."""

PACKAGES = ("robouse", "opencv-python-headless")
"""What a result depends on beside the packages of frames: the starter set, and what resizes pictures."""

CHECKPOINT_PACKAGES = ("lerobot", "torch", "torchvision", "transformers", "diffusers")
"""What computes a checkpoint's actions."""

REMAKE = f"`{identity.REMAKE}=1` before the command; or evaluate into another folder"
"""How a person allows that results are made anew."""

RECORDED = ("pipeline", "vla-eval")
"""The versions of a result that do not decide whether it counts."""


class PolicyConfig(Frozen, use_attribute_docstrings=True):
    """What acts."""

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    """a model server, a folder that lerobot saved, the demonstrations' own actions, or their paths, followed by
    feedback"""
    address: str = ""
    """of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations"""
    label: str = ""
    """name of the policy in the results. A server must have one, another for each policy: nothing else tells what is
    behind its address."""
    timeout_s: float = Field(default=120.0, gt=0)
    """seconds that a server's answer may take"""

    def identity(self) -> str:
        """What is the same for the same policy alone: ``sha256:`` and the content of a checkpoint, ``script:`` and the
        kind of a replay, or ``claimed:`` and the label, where nobody but the user knows.

        Raises:
            PipelineError: when a server has no label, or a folder no checkpoint.
        """
        match self.kind:
            case "checkpoint":
                return f"sha256:{content_of(Path(self.address))}"
            case "server" if not self.label:
                raise PipelineError(
                    "this server has no label",
                    where=self.address,
                    expected="--label NAME, another for each policy: an address does not tell what is behind it, and "
                    "results of another policy there would be taken for this one's",
                )
            case "server":
                return f"claimed:{self.label}"
            case _:
                return f"script:{self.kind}"

    def name(self, identity: str) -> str:
        """In the results: the label, or what has this identity."""
        scripts = {"open_loop": "replay", "tracked": "tracked replay"}
        return self.label or scripts.get(self.kind) or f"{self.address} {identity.removeprefix('sha256:')[:8]}"

    def open(self, look_every: int) -> Policy:
        match self.kind:
            case "server":
                return Server(self.address, self.timeout_s, look_every)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay()
            case "tracked":
                return TrackedReplay()


@dataclass(frozen=True)
class Evaluation:
    """What holds for all episodes of an evaluation.

    Attributes:
        identity: of the policy, as it was when the evaluation began.
        videos: of which episodes that are run now a video is kept: what the policy looked at, and the end.
        archive: folder of LIBERO-Plus's asset archive, where there is one.
    """

    settings: EpisodeSettings
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

    def result(self, task: EvaluationTask) -> EpisodeResult | None:
        """What is stored of an episode, if this version would make the same."""
        row = self.files.row(self.episode(task))
        return row if row is not None and _deciding(row) == self.versions(task) else None

    def check(self, tasks: Iterable[EvaluationTask]) -> None:
        """Refuse a folder that has another policy of this name, or results of other versions that nobody allowed to
        make anew, or files of another kind.

        Raises:
            PipelineError: when it has. Nothing was changed.
        """
        self.files.refuse_other_folder()
        known = [(row.policy, row.identity, self.folder) for row in self.files.rows()]
        refuse_shared_names([*known, (self.policy.name(self.identity), self.identity, self.folder)])
        rows = ((task, self.files.row(self.episode(task))) for task in tasks)
        differing = (_differences(_deciding(row), self.versions(task)) for task, row in rows if row is not None)
        outdated = Counter(f"episodes, made with {reason}" for reason in differing if reason)
        identity.refuse_unasked(outdated, self.folder, REMAKE)

    def versions(self, task: EvaluationTask) -> dict[str, str]:
        """What makes a result beside the task, the settings and the policy, by name."""
        packages = (*PACKAGES, *(CHECKPOINT_PACKAGES if self.policy.kind == "checkpoint" else ()))
        found = {**identity.made_with("pixels"), **identity.made_with("evaluation"), **_installed(packages)}
        found["OpenGL"] = gl.choose().device
        if task.source == "libero_plus":
            contents = libero_plus.contents(benchmark.load().find(task.suite, task.name), self.archive)
            found |= {"files of the benchmark": digest(contents)[:16]} if contents else {}
        if task.source == "own":
            found["draws"] = own_draws.first_draws(task, self.settings.seed)
        return found

    def save(self, environment: EpisodeEnvironment, wanted: Wanted) -> None:
        """Write the result of the episode that ended in an environment, of a policy that asked to see ``wanted``."""
        task, progress = environment.task, environment.progress
        own = environment.perturbations if task.source == "own" else ()
        component = "+".join(change.component for change in own) or task.component
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
                perturbations=json.loads(to_json(own)),
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


def _deciding(row: EpisodeResult) -> dict[str, str]:
    return {name: value for name, value in row.versions.items() if name not in RECORDED}


def _differences(then: dict[str, str], now: dict[str, str]) -> str:
    """See ``identity.differences``; in the same words for all tasks."""
    own = [f"other {name}" for name in PER_TASK if then.get(name) != now.get(name)]
    common = [{name: value for name, value in each.items() if name not in PER_TASK} for each in (then, now)]
    return ", ".join(filter(None, [*own, identity.differences(*common)]))


@cache
def _installed(packages: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def roll_out_policy(
    environment: EpisodeEnvironment, policy: Policy, task: EvaluationTask, film: dict[int, Frame] | None = None
) -> None:
    """Run one episode to its end, which the environment knows.

    Args:
        film: where agent views go, by the number of steps before each: of every look, and one whenever
            ``FILM_STEPS`` went by without a look at it.

    Raises:
        PolicyError: when the policy answers with anything but actions.
        PipelineError: when the task cannot be rebuilt.
    """
    progress = environment.reset(task)
    policy.begin(task)

    def look(wanted: Wanted) -> dict[str, Any]:
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
