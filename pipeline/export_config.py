"""The configuration's section ``export``: one class and one field for each output format, and which episodes go in."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from itertools import count
from typing import Annotated, Literal, get_args

from packaging.version import Version
from pydantic import AfterValidator, Field, field_validator, model_validator

from pipeline.errors import PipelineError
from pipeline.types import Frozen

Count = Annotated[int, Field(ge=1, le=1_000_000)]
"""A number of files. Its limit is above any use: larger numbers would fill memory before any message appears."""


def validating(share: float, demonstrations: int) -> int:
    """Return the number of a task's demonstrations in ``val``: rounded half to even, and 0 for a single one."""
    return round(share * demonstrations) if demonstrations > 1 else 0


def too_few(share: float, where: str) -> PipelineError:
    """Return the error that no task, in total or in a suite, has enough demonstrations for a share above 0."""
    least = next(number for number in count(max(2, int(0.5 / share))) if validating(share, number))
    return PipelineError(
        f"no task has enough demonstrations for {share:g} of them to go into the split val",
        where=where,
        expected=f"{least} or more demonstrations of a task, where all that `demos expand` made from one count as one",
        remedy="use more demonstrations, a larger share, or 0",
    )


def known_to_oft(name: str) -> bool:
    """Return whether OpenVLA-OFT, which decides by the name, reads a set with LIBERO's constants and cameras."""
    return "libero" in name and "aloha" not in name


def _of_some(share: float) -> float:
    if 0 < share < 0.001:
        raise ValueError("expected 0, or 0.001 to 0.5")
    return share


Share = Annotated[float, Field(ge=0.0, le=0.5), AfterValidator(_of_some)]
LONGEST_NAME = 60
"""Largest length of a name in paths. A path may join several names; file systems limit a name to 255 bytes."""

Name = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_]*)?$", max_length=LONGEST_NAME)]
"""Name of a dataset; ``Config`` replaces an empty name by ``libero_`` and the name of the run."""


class RldsConfig(Frozen):
    """Options of the RLDS sets.

    Attributes:
        name: what the sets' names begin with; ``libero_`` and the name of the run when left out.
        shards: TFRecord files, over all sets; when left out, so many that each has about 400 MB.
        validation: share of each task's demonstrations whose episodes go into the split ``val`` instead of ``train``.
    """

    name: Name = ""
    shards: Count | None = None
    validation: Share = 0.0


class LeRobotConfig(Frozen):
    """Options of the LeRobot dataset.

    Attributes:
        name: of the dataset; ``libero_`` and the name of the run when left out.
        shards: files of each kind, at least; more where one would have more than 200 MB.
        frames: ``video`` for H.264, ``images`` for the very JPEG files of RLDS, three times as large.
        validation: share of each task's demonstrations whose episodes come last, as the split ``val``.
        language: whether frames also have their task's rewrites and what is being done, in lerobot's language column.
            lerobot before 0.6 cannot read a set with it.
    """

    name: Name = ""
    # The identity of finished datasets depends on their options, which contain the field under its first name.
    shards: Count | None = Field(default=None, serialization_alias="parts")
    frames: Literal["video", "images"] = "video"
    validation: Share = 0.0
    # Excluded at its default, as ``lerobot_v21``.
    language: bool = Field(default=False, exclude_if=lambda language: not language)

    @field_validator("language")
    @classmethod
    def _readable(cls, language: bool) -> bool:
        if not language:
            return language
        installed = version("lerobot")
        if Version(installed) < Version("0.6"):
            raise ValueError(
                f"lerobot {installed}, which checks the set here, cannot read language columns; expected 0.6 or later, "
                "which the installation on Python 3.12 or later has"
            )
        return language


CLEAN = "clean"
"""Axis and component of a clean twin in ``where``, as in the manifest; its level is 0."""


class Where(Frozen):
    """Filter of the kept episodes: an episode is written if its value is listed in each field that is not left out.

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
        """Return whether an episode is written, by its columns of the plan."""
        return (
            (self.axis is None or axis in self.axis)
            and (self.component is None or set(component.split("+")) <= set(self.component))
            and (self.level is None or set(map(int, level.split("+"))) <= set(self.level))
            and (self.suite is None or suite in self.suite)
        )


class LeRobotV21Config(Frozen):
    """Options of LeRobot datasets of version 2.1.

    Attributes:
        name: of the dataset, or what the sets' names begin with; ``libero_`` and the name of the run when left out.
        convention: ``ipec`` for GR00T, starVLA and others: a set for each suite, as IPEC-COMMUNITY's of LIBERO, with
            videos and a gripper of 1 open, 0 closed. ``openpi``: one set, as openpi's configuration of LIBERO reads it.
        validation: share of each task's demonstrations whose episodes go into sets of their own, named ``..._val``.
    """

    name: Name = ""
    convention: Literal["ipec", "openpi"]
    validation: Share = 0.0


Options = RldsConfig | LeRobotConfig | LeRobotV21Config
"""Options of one format."""
_OPTIONAL = tuple(kind | None for kind in get_args(Options))


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
    # Excluded at their defaults, so that datasets keep the identity that they had before these fields were added.
    lerobot_v21: LeRobotV21Config | None = Field(default=None, exclude_if=lambda options: options is None)
    where: Where | None = Field(default=None, exclude_if=lambda where: where is None)
    failures: bool = Field(default=False, exclude_if=lambda asked: not asked)

    @model_validator(mode="after")
    def _some_format(self) -> ExportConfig:
        if not self.formats:
            names = [name for name, field in type(self).model_fields.items() if field.annotation in _OPTIONAL]
            raise ValueError(f"no format is left, expected one of {', '.join(names[:-1])} and {names[-1]}")
        return self

    @property
    def formats(self) -> dict[str, Options]:
        """Return the options of each requested format, by its name."""
        return {name: options for name, options in self if isinstance(options, Options)}

    @property
    def name(self) -> str:
        """Return the common name of a run's datasets."""
        return (self.lerobot or next(iter(self.formats.values()))).name

    def named(self, name: str) -> ExportConfig:
        """Return a copy in which each dataset without a name has the given one."""
        formats = {}
        for format_name, options in self.formats.items():
            if not options.name:
                formats[format_name] = options.model_copy(update={"name": name})
        return self.model_copy(update=formats)

    def of_failures(self) -> ExportConfig:
        """Return the options for failures: under another name, without a validation split, and otherwise unchanged."""
        formats = {}
        for format_name, options in self.formats.items():
            changes = {"name": f"{options.name}_failures", "validation": 0.0}
            formats[format_name] = options.model_copy(update=changes)
        return self.model_copy(update=formats)

    def refuse_too_few(self, demonstrations: Mapping[str, int]) -> None:
        """Reject a validation split that would stay empty.

        RLDS has a set for each suite. OpenVLA-OFT, when it validates, reads the split ``val`` of each set.

        Args:
            demonstrations: suite to the largest number of demonstrations among its tasks.

        Raises:
            PipelineError: when a share puts no demonstration into ``val``.
        """
        suites = self.where.suite if self.where else None
        written = [number for suite, number in demonstrations.items() if suites is None or suite in suites]
        for name, options in self.formats.items():
            least = min if name == "rlds" else max
            if options.validation and not validating(options.validation, least(written, default=0)):
                raise too_few(options.validation, f"export.{name}.validation")
