"""The axes of perturbation, one file each, and the union that reads any recorded perturbation back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, TypeVar, get_args

from pydantic import Field, TypeAdapter, ValidationError

from pipeline.axes.background import BackgroundAxis, BackgroundPerturbation
from pipeline.axes.base import (
    Frozen,
    Perturbation,
    PhysicsPerturbation,
    PixelPerturbation,
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
from pipeline.axes.scene import ScenePerturbation
from pipeline.errors import PipelineError, RefusedError

AnyPerturbation = Annotated[
    CameraPerturbation
    | LightPerturbation
    | BackgroundPerturbation
    | NoisePerturbation
    | LanguagePerturbation
    | LayoutPerturbation
    | Annotated[PosePerturbation | ScenePerturbation, Field(discriminator="component")]
    | RobotPerturbation,
    Field(discriminator="axis"),
]
AnyAxis = CameraAxis | LightAxis | BackgroundAxis | NoiseAxis | LanguageAxis | LayoutAxis | PoseAxis | RobotAxis

Kind = TypeVar("Kind", bound=Perturbation)

_LIST = TypeAdapter(tuple[AnyPerturbation, ...])


class Axes(Frozen):
    """The axes that a run draws from; an axis left out is not drawn.

    They are listed in the order in which their perturbations apply, deepest layer first. Objects are added where a
    demonstration's scene leaves room, then the target and the arm move, and are refused where they meet an object.
    """

    layout: LayoutAxis | None = None
    pose: PoseAxis | None = None
    robot: RobotAxis | None = None
    camera: CameraAxis | None = None
    light: LightAxis | None = None
    background: BackgroundAxis | None = None
    noise: NoiseAxis | None = None
    language: LanguageAxis | None = None


# The union has a union of its own for an axis that has several kinds.
_KINDS: dict[str, tuple[type[Perturbation], ...]] = {
    kinds[0].model_fields["axis"].default: kinds
    for member in get_args(get_args(AnyPerturbation)[0])
    for kinds in [(member,) if isinstance(member, type) else get_args(get_args(member)[0])]
}
_PLACE = {axis: place for place, axis in enumerate(Axes.model_fields)}


def axes_of(name: str) -> tuple[str, ...]:
    """The axes that a name such as ``language+camera`` joins, in the order in which they apply.

    Raises:
        ValueError: when one of them is no axis, or is named twice.
    """
    axes = name.split("+")
    if unknown := [axis for axis in axes if axis not in _PLACE]:
        raise ValueError(
            f"{name!r} names no axis with {unknown[0]!r}, expected {', '.join(_PLACE)}, or some joined by +"
        )
    if len(set(axes)) < len(axes):
        raise ValueError(f"{name!r} names an axis twice, but an episode is perturbed once on each axis")
    return tuple(sorted(axes, key=_PLACE.__getitem__))


def kind_of(axis: str) -> type[Perturbation]:
    """The perturbations of an axis, by its name; of several kinds the first."""
    return _KINDS[axis][0]


def components_of(axis: str) -> tuple[str, ...]:
    """What can stand in the column ``component`` for an axis."""
    return tuple(one for kind in _KINDS[axis] for one in get_args(kind.model_fields["component"].annotation))


def in_order(perturbations: Iterable[Kind]) -> tuple[Kind, ...]:
    """Perturbations in the order in which they apply, whatever order they were listed in."""
    return tuple(sorted(perturbations, key=lambda p: _PLACE[p.axis]))


def to_json(perturbations: Iterable[Perturbation]) -> str:
    """Canonical JSON of a set of perturbations: the same whatever order they were listed in."""
    return f"[{','.join(p.model_dump_json() for p in in_order(perturbations))}]"


def from_json(text: str) -> tuple[AnyPerturbation, ...]:
    """Read perturbations back, in the order in which they apply.

    Raises:
        PipelineError: when they were recorded by a version of this project with other axes or parameters.
    """
    try:
        return _LIST.validate_json(text)
    except ValidationError as error:
        fault = error.errors()[0]
        raise PipelineError(
            f"not perturbations of this version: {'.'.join(map(str, fault['loc'][1:])) or 'the list'}: {fault['msg']}",
            where=f"perturbations {text:.80}",
            remedy="run the plan stage again, or read it with the version that wrote it",
        ) from error


def of_layer(perturbations: Sequence[Perturbation], layer: type[Kind]) -> tuple[Kind, ...]:
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
    "axes_of",
    "components_of",
    "from_json",
    "in_order",
    "kind_of",
    "of_layer",
    "to_json",
]
