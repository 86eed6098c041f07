"""Typed configuration of the experiment: data, arms, training, evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import yaml
from instructions import every_instruction, find_tasks
from pydantic import Field, ValidationError, field_validator, model_validator

from pipeline.axes import axes_of
from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.seeding import digest
from pipeline.types import Frozen

PlusAxis = Literal["robot", "language", "pose", "camera", "noise"]
"""Axes whose test tasks need no asset archive."""

HeldOutAxis = Literal["light", "background", "layout", "camera", "noise"]
"""Axes tested by held-out perturbations of this project.

The test tasks of the first three need the asset archive. All test tasks of camera and noise start in one state of each
task.
"""

MOST_EPISODES = 350
"""Limit of the episodes of a policy's evaluation, about 25 minutes of two cores."""


class TrainingConfig(Frozen):
    """Training settings of all policies.

    Attributes:
        steps: gradient steps, equal for all arms.
        batch_size: frames of a step.
        learning_rate: learning rate of AdamW, which falls to a hundredth along a cosine.
        save_every: steps between two checkpoints, the largest loss of a kill.
        proprioception: ``true`` if policies get the state, ``relative`` for the state relative to the episode's first.
            Policies without it get the two views and the sentence.
    """

    steps: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    learning_rate: float = Field(gt=0)
    save_every: int = Field(ge=1)
    proprioception: bool | Literal["relative"] = True


class EvaluationConfig(Frozen):
    """Evaluation settings of all policies.

    Attributes:
        states: number of LIBERO's initial states of each task, counted from the first.
        libero_plus: axis to the number of LIBERO-Plus's test tasks of each task.
        held_out: axis to the number of held-out perturbations of each task.
        held_out_goals: number of LIBERO's initial states of each scene, counted from the first, with each goal that no
            plan carries to the scene.
        reading_states: number of initial states of each scene, counted from the last, with each instruction.
        rewrite_states: number of LIBERO-Plus's rewrites of each task that begin in different initial states, counted
            from the first. LIBERO-Plus's own tests of rewrites all begin in the first one.
    """

    states: int = Field(ge=1, le=50)
    libero_plus: dict[PlusAxis, int]
    held_out: dict[HeldOutAxis, int] = Field(default_factory=dict)
    held_out_goals: int = Field(default=0, ge=0, le=50)
    reading_states: int = Field(ge=0, le=50)
    rewrite_states: int = Field(default=0, ge=0, le=50)

    @model_validator(mode="after")
    def _rewrites_have_a_state_and_a_text(self) -> Self:
        most = min(self.states, self.libero_plus.get("language", 0))
        if self.rewrite_states > most:
            raise ValueError(f"rewrite_states is {self.rewrite_states}, but at most {most} by states and language")
        return self

    def episodes(self, names: Sequence[str]) -> int:
        """Return the number of episodes of the tasks with these names, without those with black views."""
        instructions = every_instruction(find_tasks(names))
        goals = sum(instruction.kind == "held out" for instruction in instructions)
        return (
            len(names) * (self.states + sum(self.libero_plus.values()) + sum(self.held_out.values()))
            + len(names) * self.rewrite_states
            + goals * self.held_out_goals
            + len(instructions) * self.reading_states
        )


class FurtherEpisodes(Frozen):
    """An arm's episodes, and the perturbed episodes of a run.

    Attributes:
        arm: arm whose episodes come first.
        run: configuration of the run. Only its plan differs from the run of the experiment.
    """

    arm: str
    run: Path

    @cached_property
    def config(self) -> Config:
        return load(self.run)

    @property
    def episodes(self) -> int:
        """Return the number of planned episodes of the run."""
        return sum(self.config.plan.episodes.values())


class Experiment(Frozen):
    """Settings of the whole experiment.

    Attributes:
        data: a run configuration with the demonstrations and perturbations of all arms.
        demonstrations: demonstrations of each task; each gives an arm one episode.
        spare: additional demonstrations from ``demos expand``, as some clean replays fail.
        arms: arm to the names of its perturbations in the run's ``plan.episodes``. All other arms are compared with the
            first one.
        further: additional arm to its episodes.
        frame_px: height and width of the frames that policies see.
        policy: options of lerobot's ACT.
        seeds: training seeds; one policy of each arm is trained with each seed.
        decisions: date to the decision of that day, with its grounds.
    """

    data: Path
    demonstrations: int = Field(ge=1)
    spare: int = Field(default=0, ge=0)
    arms: dict[str, tuple[str, ...]] = Field(min_length=1)
    further: dict[str, FurtherEpisodes] = Field(default_factory=dict)
    seeds: tuple[int, ...] = Field(min_length=1)
    frame_px: int = Field(ge=32, le=256)
    policy: dict[str, Any]
    training: TrainingConfig
    evaluation: EvaluationConfig
    decisions: dict[date, str] = Field(default_factory=dict)

    @field_validator("arms")
    @classmethod
    def _canonical(cls, arms: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        canonical: dict[str, tuple[str, ...]] = {}
        for arm, names in arms.items():
            canonical[arm] = tuple("+".join(axes_of(name)) for name in names)
        return canonical

    @model_validator(mode="after")
    def _matches_run(self) -> Experiment:
        planned = self.run.plan.episodes
        if self.run.demos.root is None:
            raise ValueError(f"{self.data} has no demos.root for the demonstrations")
        for arm, names in self.arms.items():
            unknown = [name for name in names if name not in planned]
            if unknown:
                expected = ", ".join(planned)
                raise ValueError(f"{self.data} plans no episodes of {unknown[0]!r} for {arm}, but of {expected}")
            uneven = [name for name in names if planned[name] % len(self.tasks)]
            if uneven:
                raise ValueError(
                    f"{planned[uneven[0]]} episodes of {uneven[0]!r} cannot be divided equally among the tasks"
                )
            perturbed = sum(planned[name] for name in names)
            if 3 * perturbed > 2 * self.episodes:
                raise ValueError(
                    f"{arm} has {perturbed} perturbed of {self.episodes} episodes; a third must stay clean: lower "
                    f"plan.episodes in {self.data}, or raise demonstrations"
                )
        for arm, further in self.further.items():
            if arm in self.arms:
                raise ValueError(f"{arm} is an arm of `arms` and of `further`")
            if further.arm not in self.arms:
                raise ValueError(f"{arm} adds episodes to an unknown arm {further.arm!r}")
            for section in ("demos", "replay", "filter", "render"):
                if getattr(further.config, section) != getattr(self.run, section):
                    raise ValueError(f"{further.run} and {self.data} differ in {section}")
            if further.config.plan.seed == self.run.plan.seed:
                raise ValueError(f"{further.run} and {self.data} have the same plan.seed, which repeats episodes")
        wanted = self.evaluation.episodes(self.tasks)
        if wanted > MOST_EPISODES:
            raise ValueError(f"{wanted} episodes of evaluation, expected at most {MOST_EPISODES}")
        return self

    @cached_property
    def run(self) -> Config:
        return load(self.data)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Return ``<suite>/<task>`` of each task."""
        return self.run.demos.tasks

    @property
    def episodes(self) -> int:
        """Return the number of episodes of each of ``arms``."""
        return self.demonstrations * len(self.tasks)

    @property
    def every_arm(self) -> tuple[str, ...]:
        """Return the names of all arms."""
        return (*self.arms, *self.further)

    def episodes_of(self, arm: str) -> int:
        """Return the number of episodes of an arm."""
        return self.episodes + (self.further[arm].episodes if arm in self.further else 0)

    def dataset_name(self, arm: str) -> str:
        """Return a dataset's name, which contains a digest of all settings that the dataset depends on."""
        run = _episode_settings(self.run)
        settings: list[Any] = [run, self.demonstrations, self.spare, self.mixtures(arm), self.frame_px]
        if arm in self.further:
            settings.append(_episode_settings(self.further[arm].config))
        return f"{arm}_{digest(*settings)[:8]}"

    def policy_name(self, arm: str, seed: int) -> str:
        """Return a policy's name, which contains a digest of all settings that the policy depends on.

        Raises:
            PipelineError: if the experiment does not have the seed.
        """
        if seed not in self.seeds:
            raise PipelineError(f"no seed {seed}", where="seeds", expected=" or ".join(map(str, self.seeds)))
        training = self.training.model_dump(exclude={"save_every"}, exclude_defaults=True)
        return f"{arm}_seed{seed}_{digest(self.dataset_name(arm), self.policy, training, seed)[:8]}"

    def mixtures(self, arm: str) -> tuple[str, ...]:
        """Return the perturbations that an arm has from the run of the experiment.

        Raises:
            PipelineError: if the experiment does not have the arm.
        """
        if arm not in self.every_arm:
            raise PipelineError(f"no arm {arm!r}", where="arms", expected=" or ".join(self.every_arm))
        return self.arms[self.further[arm].arm if arm in self.further else arm]


def _episode_settings(run: Config) -> dict[str, Any]:
    """Return the settings of a run that its episodes depend on."""
    return run.model_dump(mode="json", include={"demos", "plan", "replay", "render"}, by_alias=True)


def read(path: Path) -> Experiment:
    """Read and validate the experiment.

    A file with a ``base``, another file, has only the differences from it. Its sections are merged with those of the
    base, but ``arms`` and ``further`` replace those of the base.

    Raises:
        PipelineError: names the file and every invalid field.
    """
    try:
        return Experiment.model_validate(_with_base(path))
    except (OSError, yaml.YAMLError) as error:
        raise PipelineError(f"cannot read the experiment ({error})", where=path) from error
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, fault['loc'])) or 'top level'}: {fault['msg']}" for fault in error.errors()]
        raise PipelineError("the experiment is not valid:\n    " + "\n    ".join(faults), where=path) from error


def _with_base(path: Path) -> Any:
    """Read a file's settings, merged with those of its base."""
    settings = yaml.safe_load(path.read_text())
    base = settings.pop("base", None) if isinstance(settings, dict) else None
    if not base:
        return settings
    settings_of_base = _with_base(path.parent / base)
    sections: dict[str, Any] = {}
    for name, section in settings.items():
        if isinstance(section, dict) and name not in ("arms", "further"):
            sections[name] = settings_of_base.get(name, {}) | section
    return settings_of_base | settings | sections
