"""The typed configuration of an experiment: data, arms, training, evaluation."""

from __future__ import annotations

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

PLUS_AXES = Literal["camera", "robot", "noise", "pose"]
"""The axes whose test tasks need no asset archive. ACT reads no text, so language is none of them."""

OWN_AXES = Literal["layout", "pose", "robot", "camera", "light", "background", "noise"]


class TrainingConfig(Frozen):
    """How each policy is trained.

    Attributes:
        steps: gradient steps, the same for all arms.
        batch_size: frames of a step.
        learning_rate: AdamW's, which falls to a hundredth along a cosine; that of the policy's preset when left out.
            Weights with a rate of their own, as ACT's ``optimizer_lr_backbone``, start from it and fall alike.
        mixed_precision: accelerate's. On processors that multiply in bf16, a step takes two thirds of the time.
        save_every: steps between two checkpoints; what a kill costs at most.
        at_once: policies trained at the same time, which share the cores: one thread wastes less than two.
    """

    steps: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    learning_rate: float | None = Field(default=None, gt=0)
    mixed_precision: Literal["no", "bf16"] = "no"
    save_every: int = Field(ge=1)
    at_once: int = Field(default=1, ge=1)


class EvaluationConfig(Frozen):
    """What each policy is evaluated on, beside LIBERO's own initial states.

    Attributes:
        episodes: at least so many of each axis, as far as the test tasks go, and of LIBERO's initial states.
        libero_plus: axes evaluated on LIBERO-Plus's test tasks.
        held_out: axes evaluated on draws that keep clear of the plan's.
        redrawn: axes evaluated on new draws of what the plan draws from, where it leaves too little to hold out.
        initial_states: ``demonstration`` starts where the starter set's demonstration does.
    """

    episodes: int = Field(ge=1)
    libero_plus: tuple[PLUS_AXES, ...] = ()
    held_out: tuple[OWN_AXES, ...] = ()
    redrawn: tuple[OWN_AXES, ...] = ()
    initial_states: Literal["libero", "demonstration"] = "libero"


class Experiment(Frozen):
    """A whole experiment.

    Attributes:
        data: an ordinary run configuration, which makes the episodes of all arms.
        demonstrations: so many of each task are made by ``demos expand`` into the run's ``demos.root`` first; none
            when left out.
        arms: name to what its episodes are perturbed by, axes or combinations of the run's ``plan.episodes``; clean
            twins make up for the others. The first arm is the one that the others are compared with.
        frame_px: height and width of the frames that policies see.
        policy: options of lerobot's policy, among them its ``type``.
        seeds: one policy of each arm is trained from each.
    """

    data: Path
    demonstrations: int | None = Field(default=None, ge=1)
    arms: dict[str, tuple[str, ...]] = Field(min_length=1)
    frame_px: int = Field(ge=32, le=256)
    policy: dict[str, Any]
    training: TrainingConfig
    seeds: tuple[int, ...] = Field(min_length=1)
    evaluation: EvaluationConfig

    @field_validator("arms")
    @classmethod
    def _canonical(cls, arms: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        return {arm: tuple("+".join(axes_of(name)) for name in names) for arm, names in arms.items()}

    @model_validator(mode="after")
    def _matches_run(self) -> Experiment:
        if unknown := {name for names in self.arms.values() for name in names} - self.run.plan.episodes.keys():
            raise ValueError(f"{self.data} has no episodes of {', '.join(sorted(unknown))}")
        if self.demonstrations is not None and self.run.demos.root is None:
            raise ValueError(f"demonstrations: {self.data} has no demos.root to make them in")
        if self.run.export.lerobot is None or self.run.export.lerobot.frames != "images":
            raise ValueError(f"{self.data} does not export lerobot with images; write frames: images there")
        return self

    @cached_property
    def run(self) -> Config:
        return load(self.data)

    @property
    def lerobot(self) -> Path:
        """Root of the run's LeRobot dataset."""
        assert self.run.export.lerobot is not None
        return self.run.data / "lerobot" / self.run.export.lerobot.name

    @property
    def tasks(self) -> tuple[str, ...]:
        """``<suite>/<task>`` of each."""
        return self.run.demos.tasks

    def dataset_name(self, arm: str) -> str:
        """Says what a dataset is made from, so that another configuration makes another."""
        made_from = (
            self.run.model_dump(mode="json", exclude={"compute", "folder"}, by_alias=True),
            self.demonstrations,
            self.arms[arm],
        )
        return f"{arm}_{digest(*made_from, self.frame_px)[:8]}"

    def policy_name(self, arm: str, seed: int) -> str:
        """The same of a policy."""
        training = self.training.model_dump(exclude={"save_every", "at_once"})
        return f"{arm}_seed{seed}_{digest(self.dataset_name(arm), self.policy, training, seed)[:8]}"


def read(path: Path) -> Experiment:
    """Read and validate an experiment.

    Raises:
        PipelineError: naming the file and every field that is wrong.
    """
    try:
        return Experiment.model_validate(yaml.safe_load(path.read_text()))
    except (OSError, yaml.YAMLError) as error:
        raise PipelineError(f"cannot read the experiment ({error})", where=path) from error
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, fault['loc'])) or 'top level'}: {fault['msg']}" for fault in error.errors()]
        raise PipelineError("the experiment is not valid:\n    " + "\n    ".join(faults), where=path) from error
