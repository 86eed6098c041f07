"""The axes of perturbation: one file each, and the registry, ``Axes``, with one line for each."""

from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from operator import or_
from typing import Annotated, Any, TypeVar, get_args

from pydantic import Field, TypeAdapter, ValidationError

from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import Axis as Axis
from pipeline.axes.base import Frozen
from pipeline.axes.base import Perturbation as Perturbation
from pipeline.axes.base import PhysicsPerturbation as PhysicsPerturbation
from pipeline.axes.base import PixelPerturbation as PixelPerturbation
from pipeline.axes.base import RenderPerturbation as RenderPerturbation
from pipeline.axes.base import TextPerturbation as TextPerturbation
from pipeline.axes.camera import CameraAxis
from pipeline.axes.disturbance import DisturbanceAxis
from pipeline.axes.language import LanguageAxis
from pipeline.axes.layout import LayoutAxis
from pipeline.axes.light import LightAxis
from pipeline.axes.noise import NoiseAxis
from pipeline.axes.pose import PoseAxis
from pipeline.axes.robot import RobotAxis
from pipeline.errors import PipelineError
from pipeline.testset.benchmark import TestTask


class Axes(Frozen):
    """The axes that a run draws from; an axis left out is not drawn.

    They are listed in the order in which their perturbations apply, deepest layer first. Objects are added where a
    demonstration's scene leaves room, then the target and the arm move, and are refused where they meet an object.
    """

    layout: LayoutAxis | None = None
    pose: PoseAxis | None = None
    robot: RobotAxis | None = None
    disturbance: DisturbanceAxis | None = None
    camera: CameraAxis | None = None
    light: LightAxis | None = None
    background: BackgroundAxis | None = None
    noise: NoiseAxis | None = None
    language: LanguageAxis | None = None

    def drawn(self) -> dict[str, Axis]:
        """Those that are drawn from, by name."""
        return {name: axis for name, axis in self if axis is not None}


AXES: Mapping[str, type[Axis]] = {name: get_args(field.annotation)[0] for name, field in Axes.model_fields.items()}
"""Every axis by its name, in the order in which they apply."""

_PLACE = {name: place for place, name in enumerate(AXES)}


def _read_by(tag: str, kinds: Sequence[Any]) -> Any:
    """The type of what is one of several kinds, told apart by a field."""
    return Annotated[reduce(or_, kinds), Field(discriminator=tag)] if len(kinds) > 1 else kinds[0]


_LIST: TypeAdapter[tuple[Perturbation, ...]] = TypeAdapter(
    tuple[_read_by("axis", [_read_by("component", axis.draws) for axis in AXES.values()]), ...]  # type: ignore[misc, arg-type]
)

Kind = TypeVar("Kind", bound=Perturbation)


def axes_of(name: str) -> tuple[str, ...]:
    """The axes that a name such as ``language+camera`` joins, in the order in which they apply.

    Raises:
        ValueError: when one of them is no axis, or is named twice.
    """
    axes = name.split("+")
    if unknown := [axis for axis in axes if axis not in AXES]:
        raise ValueError(f"{name!r} names no axis with {unknown[0]!r}, expected {', '.join(AXES)}, or some joined by +")
    if len(set(axes)) < len(axes):
        raise ValueError(f"{name!r} names an axis twice, but an episode is perturbed once on each axis")
    return tuple(sorted(axes, key=_PLACE.__getitem__))


def level_of_test(tested: TestTask) -> int:
    """Strength of a test task, 1 to 5, by the ranges of its axis; 0 if its parameters do not tell."""
    return AXES[tested.axis].level_of_test(tested)


def components_of(axis: str) -> tuple[str, ...]:
    """What can stand in the column ``component`` for an axis."""
    return tuple(one for kind in AXES[axis].draws for one in get_args(kind.model_fields["component"].annotation))


def in_order(perturbations: Iterable[Kind]) -> tuple[Kind, ...]:
    """Perturbations in the order in which they apply, whatever order they were listed in."""
    return tuple(sorted(perturbations, key=lambda p: _PLACE[p.axis]))


def to_json(perturbations: Iterable[Perturbation]) -> str:
    """Canonical JSON of a set of perturbations: the same whatever order they were listed in."""
    return f"[{','.join(p.model_dump_json() for p in in_order(perturbations))}]"


def from_json(text: str) -> tuple[Perturbation, ...]:
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


def of_layer(perturbations: Iterable[Perturbation], layer: type[Kind]) -> tuple[Kind, ...]:
    """Those that act on one layer, named by its class."""
    return tuple(p for p in perturbations if isinstance(p, layer))
