"""The configuration's section ``export``: one class and one field for each output format. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=1)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RldsConfig(_Frozen):
    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    shards: Count


class LeRobotConfig(_Frozen):
    """How the LeRobot dataset is written.

    Attributes:
        name: of the dataset.
        parts: pieces written in parallel, then merged.
        frames: ``video`` for H.264, ``images`` for the very JPEG files of RLDS, three times as large.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    parts: Count
    frames: Literal["video", "images"] = "video"


class ExportConfig(_Frozen):
    rlds: RldsConfig
    lerobot: LeRobotConfig
