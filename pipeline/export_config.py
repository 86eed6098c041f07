"""The configuration's section ``export``: one class and one field for each output format. Light to import."""

from __future__ import annotations

from itertools import count
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from pipeline.errors import PipelineError

Count = Annotated[int, Field(ge=1, le=1_000_000)]
"""More than anybody has a use for would fill memory before anything is said."""


def held_out(share: float, demonstrations: int) -> int:
    """How many of a task's demonstrations a share holds out: rounded, a half to the even number; never the only one."""
    return round(share * demonstrations) if demonstrations > 1 else 0


def too_few(share: float, where: str) -> PipelineError:
    """The error that no task has enough demonstrations for a share above 0."""
    least = next(number for number in count(max(2, int(0.5 / share))) if held_out(share, number))
    return PipelineError(
        f"no task has enough demonstrations to hold {share:g} of them out",
        where=where,
        expected=f"{least} or more demonstrations of a task",
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


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RldsConfig(_Frozen):
    """How the RLDS sets are written.

    Attributes:
        name: what the sets' names begin with.
        shards: TFRecord files, over all sets.
        validation: share of each task's demonstrations whose episodes go into the split ``val`` instead of ``train``.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    shards: Count
    validation: Share = 0.0


class LeRobotConfig(_Frozen):
    """How the LeRobot dataset is written.

    Attributes:
        name: of the dataset.
        parts: files of each kind, written in parallel, at least; more where one would have more than 200 MB.
        frames: ``video`` for H.264, ``images`` for the very JPEG files of RLDS, three times as large.
        validation: share of each task's demonstrations whose episodes come last, as the split ``val``.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    parts: Count
    frames: Literal["video", "images"] = "video"
    validation: Share = 0.0


class LeRobotV21Config(_Frozen):
    """How LeRobot datasets of version 2.1 are written.

    Attributes:
        name: of the dataset, or what the sets' names begin with.
        convention: ``ipec`` for GR00T, starVLA and others: a set for each suite, as IPEC-COMMUNITY's of LIBERO, with
            videos and a gripper of 1 open, 0 closed. ``openpi``: one set, as openpi's configuration of LIBERO reads it.
        validation: share of each task's demonstrations whose episodes go into sets of their own, named ``..._val``.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    convention: Literal["ipec", "openpi"]
    validation: Share = 0.0


class ExportConfig(_Frozen):
    rlds: RldsConfig
    lerobot: LeRobotConfig
    lerobot_v21: LeRobotV21Config | None = None

    def refuse_too_few(self, demonstrations: int) -> None:
        """Refuse a validation split that nothing could be in.

        Args:
            demonstrations: of the task that has most of them.

        Raises:
            PipelineError: when a share holds none of them out.
        """
        for name in ExportConfig.model_fields:
            share: float = getattr(getattr(self, name), "validation", 0.0)
            if share and not held_out(share, demonstrations):
                raise too_few(share, f"export.{name}.validation")
