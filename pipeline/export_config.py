"""The configuration's section ``export``: the options of each requested format, and the filter of episodes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, create_model, field_validator, model_validator

from pipeline.axes import axes_of
from pipeline.axes.component_names import ComponentName
from pipeline.episode_schema import STANDARD, Content
from pipeline.formats.base import Format, FormatOptions, Options
from pipeline.formats.episodes import count_for_validation, too_few
from pipeline.formats.lerobot import LeRobotOpenpi, LeRobotV21
from pipeline.formats.registry import FORMATS
from pipeline.types import Frozen

FAILURES = "failures"
"""Folder of a run with the datasets of replays that missed their goal."""

CLEAN = "clean"
"""Axis and component of a clean twin in ``where``, as in the manifest; its level is 0."""


class Where(Frozen):
    """Filter of the kept episodes: an episode is written if every stated field lists its value.

    A clean twin has the axis and the component ``clean`` and the level 0.

    Attributes:
        axis: Axes and combinations to write, as in ``plan.episodes``; by default all of them.
        component: Components to write; by default all of them. An episode of several axes is written if all its
            components are listed.
        level: Levels to write, 0 to 5; by default all of them. An episode of several axes is written if all its levels
            are listed.
        suite: Suites to write; by default all of them.
    """

    axis: tuple[str, ...] | None = Field(default=None, min_length=1)
    component: tuple[ComponentName, ...] | None = Field(default=None, min_length=1)
    level: tuple[Annotated[int, Field(ge=0, le=5)], ...] | None = Field(default=None, min_length=1)
    suite: tuple[str, ...] | None = Field(default=None, min_length=1)

    @field_validator("axis")
    @classmethod
    def _in_the_order_of_the_plan(cls, axis: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return axis and tuple("+".join(axes_of(name)) if "+" in name else name for name in axis)

    def takes(self, axis: str, component: str, level: str, suite: str) -> bool:
        """Return whether an episode is written, by its columns of the plan."""
        filters: tuple[tuple[Collection[object] | None, set[object]], ...] = (
            (self.axis, {axis}),
            (self.component, {*component.split("+")}),
            (self.level, {*map(int, level.split("+"))}),
            (self.suite, {suite}),
        )
        return all(listed is None or values.issubset(listed) for listed, values in filters)


def _field(kind: type[Format[Any]]) -> tuple[Any, Any]:
    """Return the type and the default of a format's field."""
    if kind.by_default:
        return kind.options_type | None, kind.options_type()
    # Excluded at its default, so that datasets keep the identity that they had before the format was added.
    return kind.options_type | None, Field(default=None, exclude_if=lambda options: options is None)


if TYPE_CHECKING:
    _Formats = Frozen
else:
    _Formats = create_model("_Formats", __base__=Frozen, **{kind.name: _field(kind) for kind in FORMATS})
    """A field for each format of the registry, with its options; ``None`` leaves the format out."""


class ExportConfig(_Formats):
    """The output formats, and the filter of the kept episodes.

    Attributes:
        rlds: Options of the RLDS datasets; ``null`` leaves the format out.
        lerobot: Options of the LeRobot dataset; ``null`` leaves the format out.
        lerobot_v21: Options of additional datasets for clients that read LeRobot v2.1; left out by default.
        lerobot_openpi: Options of an additional dataset of this version in openpi's convention; left out by default.
        hdf5: Options of additional HDF5 files in LIBERO's own layout; left out by default.
        where: Filter of the kept episodes; by default all of them are written.
        failures: True also writes replays that missed their goal, into separate datasets below ``failures/``; false by
            default.
    """

    # Excluded at their defaults, as formats that were added later.
    where: Where | None = Field(default=None, exclude_if=lambda where: where is None)
    failures: bool = Field(default=False, exclude_if=lambda asked: not asked)

    @model_validator(mode="after")
    def _some_format(self) -> ExportConfig:
        if not self.formats:
            names = [kind.name for kind in FORMATS]
            raise ValueError(f"no format is left, expected one of {', '.join(names[:-1])} and {names[-1]}")
        return self

    @model_validator(mode="after")
    def _no_format_twice(self) -> ExportConfig:
        v21, openpi = self.options_for(LeRobotV21), self.options_for(LeRobotOpenpi)
        if v21 is not None and openpi is not None and v21.convention == openpi.convention:
            raise ValueError(
                "lerobot_v21 with the convention openpi has the content of lerobot_openpi: remove one of them"
            )
        return self

    @property
    def formats(self) -> dict[str, FormatOptions]:
        """Return the options of each requested format, by its name."""
        options = {kind.name: getattr(self, kind.name) for kind in FORMATS}
        return {name: requested for name, requested in options.items() if requested is not None}

    def options_for(self, kind: type[Format[Options]]) -> Options | None:
        """Return the options of a format; ``None`` if it is not requested."""
        options: Options | None = getattr(self, kind.name)
        return options

    def datasets(self, folder: Path, content: Content = STANDARD) -> list[Format[Any]]:
        """List the requested datasets of a run in ``folder`` whose episodes have this content."""
        formats = self.formats
        return [kind(folder, formats[kind.name], content) for kind in FORMATS if kind.name in formats]

    def failure_datasets(self, folder: Path, content: Content) -> list[Format[Any]]:
        """List the datasets of failures of a run in ``folder``; the list is empty if failures are not requested."""
        if not self.failures:
            return []
        return self.of_failures().datasets(folder / FAILURES, content.including("outcome"))

    @property
    def name(self) -> str:
        """Return the common name of a run's datasets."""
        return (self.formats.get("lerobot") or next(iter(self.formats.values()))).name

    def named(self, name: str) -> ExportConfig:
        """Return a copy in which each dataset without a name has the given one."""
        formats = {}
        for format_name, options in self.formats.items():
            if not options.name:
                formats[format_name] = options.model_copy(update={"name": name})
        return self.model_copy(update=formats)

    def of_failures(self) -> ExportConfig:
        """Return the options for failures, which differ in the name and have no validation split."""
        formats = {}
        for format_name, options in self.formats.items():
            changes = {"name": f"{options.name}_failures", "validation": 0.0}
            formats[format_name] = options.model_copy(update=changes)
        return self.model_copy(update=formats)

    def reject_too_few(self, demonstrations: Mapping[str, int]) -> None:
        """Reject a validation split that would stay empty.

        Args:
            demonstrations: suite to the largest number of demonstrations among its tasks.

        Raises:
            PipelineError: when a share puts no demonstration into ``val``.
        """
        suites = self.where.suite if self.where else None
        written = [number for suite, number in demonstrations.items() if suites is None or suite in suites]
        for dataset in self.datasets(Path()):
            least = min if dataset.splits_each_suite else max
            share = dataset.options.validation
            if share and not count_for_validation(share, least(written, default=0)):
                raise too_few(share, f"export.{dataset.name}.validation")
