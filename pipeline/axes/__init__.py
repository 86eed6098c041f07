"""The axes of perturbation, one file each, and the union that reads any recorded perturbation back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, TypeVar

from pydantic import Field, TypeAdapter

from pipeline.axes.background import BackgroundAxis, BackgroundPerturbation
from pipeline.axes.base import (
    Frozen,
    Perturbation,
    PhysicsPerturbation,
    PixelPerturbation,
    RefusedError,
    RenderPerturbation,
    TextPerturbation,
)
from pipeline.axes.camera import CameraAxis, CameraPerturbation
from pipeline.axes.language import LanguageAxis, LanguagePerturbation
from pipeline.axes.layout import LayoutAxis, LayoutPerturbation
from pipeline.axes.light import LightAxis, LightPerturbation
from pipeline.axes.noise import NoiseAxis, NoisePerturbation
from pipeline.axes.pose import PoseAxis, PosePerturbation
from pipeline.axes.robot import RobotAxis, RobotPerturbation

AnyPerturbation = Annotated[
    CameraPerturbation
    | LightPerturbation
    | BackgroundPerturbation
    | NoisePerturbation
    | LanguagePerturbation
    | LayoutPerturbation
    | PosePerturbation
    | RobotPerturbation,
    Field(discriminator="axis"),
]
AnyAxis = CameraAxis | LightAxis | BackgroundAxis | NoiseAxis | LanguageAxis | LayoutAxis | PoseAxis | RobotAxis

Layered = TypeVar("Layered", bound=Perturbation)

_LIST = TypeAdapter(tuple[AnyPerturbation, ...])


class Axes(Frozen):
    """The axes that a run draws from; an axis left out is not drawn."""

    camera: CameraAxis | None = None
    light: LightAxis | None = None
    background: BackgroundAxis | None = None
    noise: NoiseAxis | None = None
    language: LanguageAxis | None = None
    layout: LayoutAxis | None = None
    pose: PoseAxis | None = None
    robot: RobotAxis | None = None


def to_json(perturbations: Iterable[Perturbation]) -> str:
    """Canonical JSON of a set of perturbations: the same whatever order they were listed in."""
    ordered = sorted(perturbations, key=lambda p: (-p.layer, p.axis))
    return f"[{','.join(p.model_dump_json() for p in ordered)}]"


def from_json(text: str) -> tuple[AnyPerturbation, ...]:
    """Read perturbations back, deepest layer first, which is the order they apply in."""
    return _LIST.validate_json(text)


def of_layer(perturbations: Sequence[Perturbation], layer: type[Layered]) -> tuple[Layered, ...]:
    """Those that act on one layer, named by its class."""
    return tuple(p for p in perturbations if isinstance(p, layer))


__all__ = [
    "AnyAxis",
    "AnyPerturbation",
    "Axes",
    "PhysicsPerturbation",
    "PixelPerturbation",
    "RefusedError",
    "RenderPerturbation",
    "TextPerturbation",
    "from_json",
    "of_layer",
    "to_json",
]
