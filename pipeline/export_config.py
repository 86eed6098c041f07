"""The configuration's section ``export``: one class and one field for each output format. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=1, le=1_000_000)]
"""More than anybody has a use for would fill memory before anything is said."""
Share = Annotated[float, Field(ge=0.0, le=0.5)]


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
        parts: pieces written in parallel, then merged.
        frames: ``video`` for H.264, ``images`` for the very JPEG files of RLDS, three times as large.
        validation: share of each task's demonstrations whose episodes come last, as the split ``val``.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    parts: Count
    frames: Literal["video", "images"] = "video"
    validation: Share = 0.0


class ExportConfig(_Frozen):
    rlds: RldsConfig
    lerobot: LeRobotConfig
