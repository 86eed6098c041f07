"""The configuration's section ``export``: one class and one field for each output format, and which episodes go in."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from itertools import count
from typing import Annotated, Literal

from packaging.version import Version
from pydantic import AfterValidator, Field, field_validator, model_validator

from pipeline.errors import PipelineError
from pipeline.types import Frozen

Count = Annotated[int, Field(ge=1, le=1_000_000)]
"""More than anybody has a use for would fill memory before anything is said."""


def validating(share: float, demonstrations: int) -> int:
    """How many of a task's demonstrations go into ``val``: rounded, a half to the even number; never the only one."""
    return round(share * demonstrations) if demonstrations > 1 else 0


def too_few(share: float, where: str) -> PipelineError:
    """The error that no task, of all or of a suite, has enough demonstrations for a share above 0."""
    least = next(number for number in count(max(2, int(0.5 / share))) if validating(share, number))
    return PipelineError(
        f"no task has enough demonstrations for {share:g} of them to go into the split val",
        where=where,
        expected=f"{least} or more demonstrations of a task, where all that `demos expand` made from one count as one",
        remedy="use more demonstrations, a larger share, or 0",
    )


def known_to_oft(name: str) -> bool:
    """Whether OpenVLA-OFT, which goes by the name, reads a set with LIBERO's constants and cameras."""
    return "libero" in name and "aloha" not in name


def _of_some(share: float) -> float:
    if 0 < share < 0.001:
        raise ValueError("expected 0, or 0.001 to 0.5")
    return share


Share = Annotated[float, Field(ge=0.0, le=0.5), AfterValidator(_of_some)]
LONGEST_NAME = 60
"""Characters of a name that paths contain. A path may join several names; file systems end a name after 255 bytes."""

Name = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_]*)?$", max_length=LONGEST_NAME)]
"""Of a dataset; empty for ``libero_`` and the name of the run, which ``Config`` puts in its place."""


class RldsConfig(Frozen):
    """How the RLDS sets are written.

    Attributes:
        name: what the sets' names begin with; ``libero_`` and the name of the run when left out.
        shards: TFRecord files, over all sets; when left out, so many that each has about 400 MB.
        validation: share of each task's demonstrations whose episodes go into the split ``val`` instead of ``train``.
    """

    name: Name = ""
    shards: Count | None = None
    validation: Share = 0.0


class LeRobotConfig(Frozen):
    """How the LeRobot dataset is written.

    Attributes:
        name: of the dataset; ``libero_`` and the name of the run when left out.
        shards: files of each kind, at least; more where one would have more than 200 MB.
        frames: ``video`` for H.264, ``images`` for the very JPEG files of RLDS, three times as large.
        validation: share of each task's demonstrations whose episodes come last, as the split ``val``.
        language: whether frames also have their task's rewrites and what is being done, in lerobot's language column.
            lerobot before 0.6 cannot read a set with it.
    """

    name: Name = ""
    # Finished datasets are identified by their options, in which the field has its first name.
    shards: Count | None = Field(default=None, serialization_alias="parts")
    frames: Literal["video", "images"] = "video"
    validation: Share = 0.0
    # Left out where it says nothing, as ``lerobot_v21``.
    language: bool = Field(default=False, exclude_if=lambda language: not language)

    @field_validator("language")
    @classmethod
    def _readable(cls, language: bool) -> bool:
        if language and Version(installed := version("lerobot")) < Version("0.6"):
            raise ValueError(
                f"lerobot {installed}, which checks the set here, cannot read language columns; expected 0.6 or later, "
                "which the installation on Python 3.12 or later has"
            )
        return language


CLEAN = "clean"
"""Axis and component of a clean twin in ``where``, as in the manifest; its level is 0."""


class Where(Frozen):
    """Which of the kept episodes are written: those whose value is listed, for each field that is not left out.

    A clean twin has the axis and the component ``clean`` and the level 0.

    Attributes:
        axis: names as in ``plan.episodes``.
        component, level: of an episode of several axes, all have to be listed.
        suite: LIBERO's.
    """

    axis: tuple[str, ...] | None = Field(default=None, min_length=1)
    component: tuple[str, ...] | None = Field(default=None, min_length=1)
    level: tuple[Annotated[int, Field(ge=0, le=5)], ...] | None = Field(default=None, min_length=1)
    suite: tuple[str, ...] | None = Field(default=None, min_length=1)

    def takes(self, axis: str, component: str, level: str, suite: str) -> bool:
        """Whether an episode is written, by its columns of the plan."""
        return (
            (self.axis is None or axis in self.axis)
            and (self.component is None or set(component.split("+")) <= set(self.component))
            and (self.level is None or set(map(int, level.split("+"))) <= set(self.level))
            and (self.suite is None or suite in self.suite)
        )


class LeRobotV21Config(Frozen):
    """How LeRobot datasets of version 2.1 are written.

    Attributes:
        name: of the dataset, or what the sets' names begin with; ``libero_`` and the name of the run when left out.
        convention: ``ipec`` for GR00T, starVLA and others: a set for each suite, as IPEC-COMMUNITY's of LIBERO, with
            videos and a gripper of 1 open, 0 closed. ``openpi``: one set, as openpi's configuration of LIBERO reads it.
        validation: share of each task's demonstrations whose episodes go into sets of their own, named ``..._val``.
    """

    name: Name = ""
    convention: Literal["ipec", "openpi"]
    validation: Share = 0.0


class ExportConfig(Frozen):
    """The output formats, and which of the kept episodes they get.

    Attributes:
        rlds, lerobot: null leaves a format out.
        lerobot_v21: the same episodes for clients that read LeRobot's older version.
        where: a subset of the kept episodes; all of them when left out.
        failures: write replays that missed their goal too, into sets of their own below ``failures/``.
    """

    rlds: RldsConfig | None = RldsConfig()
    lerobot: LeRobotConfig | None = LeRobotConfig()
    # Left out where they say nothing, so that what was finished before they were added stays what it is.
    lerobot_v21: LeRobotV21Config | None = Field(default=None, exclude_if=lambda options: options is None)
    where: Where | None = Field(default=None, exclude_if=lambda where: where is None)
    failures: bool = Field(default=False, exclude_if=lambda asked: not asked)

    @model_validator(mode="after")
    def _some_format(self) -> ExportConfig:
        if not self.formats:
            raise ValueError("no format is left, expected one of rlds, lerobot and lerobot_v21")
        return self

    @property
    def formats(self) -> dict[str, RldsConfig | LeRobotConfig | LeRobotV21Config]:
        """Name to options of each format that is asked for."""
        formats = {"rlds": self.rlds, "lerobot": self.lerobot, "lerobot_v21": self.lerobot_v21}
        return {name: options for name, options in formats.items() if options is not None}

    @property
    def name(self) -> str:
        """What the datasets of a run are called together."""
        return (self.lerobot or next(iter(self.formats.values()))).name

    def named(self, name: str) -> ExportConfig:
        """With a name for each dataset that has none."""
        unnamed = {one: options for one, options in self.formats.items() if not options.name}
        return self.model_copy(update={one: o.model_copy(update={"name": name}) for one, o in unnamed.items()})

    def of_failures(self) -> ExportConfig:
        """How failures are written: as the other episodes, under another name, and without a validation split."""
        formats = {
            one: options.model_copy(update={"name": f"{options.name}_failures", "validation": 0.0})
            for one, options in self.formats.items()
        }
        return self.model_copy(update=formats)

    def refuse_too_few(self, demonstrations: Mapping[str, int]) -> None:
        """Refuse a validation split that nothing could be in.

        RLDS has a set for each suite, and OpenVLA-OFT, when it validates, asks each for its ``val``.

        Args:
            demonstrations: suite to the number of those of its task that has most of them.

        Raises:
            PipelineError: when a share holds none of them out.
        """
        asked = self.where.suite if self.where else None
        written = [number for suite, number in demonstrations.items() if asked is None or suite in asked]
        for name, options in self.formats.items():
            least = min if name == "rlds" else max
            if options.validation and not validating(options.validation, least(written, default=0)):
                raise too_few(options.validation, f"export.{name}.validation")
