"""The typed configuration of the experiment: data, arms, training, evaluation."""

from __future__ import annotations

from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, ValidationError, field_validator, model_validator

from pipeline.axes import axes_of
from pipeline.axes.base import Frozen
from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.seeding import digest

PlusAxis = Literal["robot", "language", "pose", "camera", "noise"]
"""The axes whose test tasks need no asset archive."""

MOST_EPISODES = 350
"""Of a policy's evaluation: 25 minutes of two cores."""


class TrainingConfig(Frozen):
    """How each policy is trained.

    Attributes:
        steps: gradient steps, the same for all arms.
        batch_size: frames of a step.
        learning_rate: AdamW's, which falls to a hundredth along a cosine.
        save_every: steps between two checkpoints; what a kill costs at most.
        proprioception: whether policies get the state; without it they see the two views and the sentence.
    """

    steps: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    learning_rate: float = Field(gt=0)
    save_every: int = Field(ge=1)
    proprioception: bool = True


class EvaluationConfig(Frozen):
    """What each policy is evaluated on.

    Attributes:
        states: LIBERO's initial states of each task, from the first.
        libero_plus: axis to LIBERO-Plus's test tasks of each task.
        reading_states: initial states of the first task, from the last, in which the policy is told each instruction.
    """

    states: int = Field(ge=1, le=50)
    libero_plus: dict[PlusAxis, int]
    reading_states: int = Field(ge=0, le=50)

    def episodes(self, tasks: int) -> int:
        return tasks * (self.states + sum(self.libero_plus.values())) + (tasks + 1) * self.reading_states


class Experiment(Frozen):
    """The whole experiment.

    Attributes:
        data: a run configuration, which says what the episodes of all arms are made from and perturbed by.
        demonstrations: of each task, each of which gives an arm one episode.
        spare: so many more are made by ``demos expand``, for those whose clean replay fails.
        arms: name to what its episodes are perturbed by, names of the run's ``plan.episodes``. The first arm is the one
            that the others are compared with.
        frame_px: height and width of the frames that policies see.
        policy: options of lerobot's ACT.
        seeds: one policy of each arm is trained from each.
        decisions: date to what was decided then, and on what.
    """

    data: Path
    demonstrations: int = Field(ge=1)
    spare: int = Field(default=0, ge=0)
    arms: dict[str, tuple[str, ...]] = Field(min_length=1)
    seeds: tuple[int, ...] = Field(min_length=1)
    frame_px: int = Field(ge=32, le=256)
    policy: dict[str, Any]
    training: TrainingConfig
    evaluation: EvaluationConfig
    decisions: dict[date, str] = Field(default_factory=dict)

    @field_validator("arms")
    @classmethod
    def _canonical(cls, arms: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        return {arm: tuple("+".join(axes_of(name)) for name in names) for arm, names in arms.items()}

    @model_validator(mode="after")
    def _matches_run(self) -> Experiment:
        planned = self.run.plan.episodes
        if self.run.demos.root is None:
            raise ValueError(f"{self.data} has no demos.root to make the demonstrations in")
        for arm, names in self.arms.items():
            if unknown := [name for name in names if name not in planned]:
                expected = ", ".join(planned)
                raise ValueError(f"{self.data} plans no episodes of {unknown[0]!r} for {arm}, but of {expected}")
            if uneven := [name for name in names if planned[name] % len(self.tasks)]:
                raise ValueError(f"{planned[uneven[0]]} episodes of {uneven[0]!r} are not as many of each task")
            perturbed = sum(planned[name] for name in names)
            if 3 * perturbed > 2 * self.episodes:
                raise ValueError(
                    f"{arm} has {perturbed} perturbed of {self.episodes} episodes; a third must stay clean: lower "
                    f"plan.episodes in {self.data}, or raise demonstrations"
                )
        if (wanted := self.evaluation.episodes(len(self.tasks))) > MOST_EPISODES:
            raise ValueError(f"{wanted} episodes of evaluation, expected at most {MOST_EPISODES}")
        return self

    @cached_property
    def run(self) -> Config:
        return load(self.data)

    @property
    def tasks(self) -> tuple[str, ...]:
        """``<suite>/<task>`` of each."""
        return self.run.demos.tasks

    @property
    def episodes(self) -> int:
        """Of each arm."""
        return self.demonstrations * len(self.tasks)

    def dataset_name(self, arm: str) -> str:
        """Says what a dataset is made from, so that another configuration makes another."""
        run = self.run.model_dump(mode="json", include={"demos", "plan", "replay", "render"}, by_alias=True)
        return f"{arm}_{digest(run, self.demonstrations, self.spare, self._names(arm), self.frame_px)[:8]}"

    def policy_name(self, arm: str, seed: int) -> str:
        """The same of a policy.

        Raises:
            PipelineError: when the experiment has no such seed.
        """
        if seed not in self.seeds:
            raise PipelineError(f"no seed {seed}", where="seeds", expected=" or ".join(map(str, self.seeds)))
        training = self.training.model_dump(exclude={"save_every"}, exclude_defaults=True)
        return f"{arm}_seed{seed}_{digest(self.dataset_name(arm), self.policy, training, seed)[:8]}"

    def _names(self, arm: str) -> tuple[str, ...]:
        if arm not in self.arms:
            raise PipelineError(f"no arm {arm!r}", where="arms", expected=" or ".join(self.arms))
        return self.arms[arm]


def read(path: Path) -> Experiment:
    """Read and validate the experiment. One with a ``base``, another file, gives only what differs from it.

    Sections are joined with those of the base, but for ``arms``, which take their place.

    Raises:
        PipelineError: naming the file and every field that is wrong.
    """
    try:
        settings = yaml.safe_load(path.read_text())
        if isinstance(settings, dict) and (base := settings.pop("base", None)):
            of_base = yaml.safe_load((path.parent / base).read_text())
            parts = {name: part for name, part in settings.items() if isinstance(part, dict) and name != "arms"}
            parts = {name: of_base.get(name, {}) | part for name, part in parts.items()}
            settings = of_base | settings | parts
        return Experiment.model_validate(settings)
    except (OSError, yaml.YAMLError) as error:
        raise PipelineError(f"cannot read the experiment ({error})", where=path) from error
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, fault['loc'])) or 'top level'}: {fault['msg']}" for fault in error.errors()]
        raise PipelineError("the experiment is not valid:\n    " + "\n    ".join(faults), where=path) from error
