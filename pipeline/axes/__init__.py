"""The axes of perturbation: one file each, and the registry, ``Axes``, with one line for each."""

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import reduce
from operator import or_
from typing import Annotated, Any, TypeVar, get_args

from pydantic import Field, TypeAdapter, ValidationError

from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import Axis as Axis
from pipeline.axes.base import Perturbation as Perturbation
from pipeline.axes.base import PhysicsPerturbation as PhysicsPerturbation
from pipeline.axes.base import PixelPerturbation as PixelPerturbation
from pipeline.axes.base import RenderPerturbation as RenderPerturbation
from pipeline.axes.base import TextPerturbation as TextPerturbation
from pipeline.axes.camera import CameraAxis
from pipeline.axes.disturbance import DisturbanceAxis
from pipeline.axes.goal import GoalAxis
from pipeline.axes.language import LanguageAxis
from pipeline.axes.layout import LayoutAxis
from pipeline.axes.light import LightAxis
from pipeline.axes.noise import NoiseAxis
from pipeline.axes.pose import PoseAxis
from pipeline.axes.robot import RobotAxis
from pipeline.errors import RUN_AGAIN, PipelineError
from pipeline.libero.tasks import find_task
from pipeline.testset.benchmark import TestTask
from pipeline.types import Frozen, Task


class Axes(Frozen):
    """Axes that a run samples from; an axis that is left out is not sampled.

    They are listed in the order in which their perturbations apply, deepest layer first. Objects are added first, at
    free places of a demonstration's scene. Then the target and the arm move, and are rejected if they touch an object.

    Attributes:
        goal: Tasks carried out in the scenes of other tasks.
        layout: Objects that are added to the scene.
        pose: Displaced and turned objects of the scene.
        robot: Posture in which the arm starts, or to which the controller pulls it.
        disturbance: Pushes on the hand during the episode.
        camera: Pose of the agent view's camera.
        light: Colour, direction, gloss and shadows of the lamps.
        background: Materials of the room and of the working surface.
        noise: Corruptions of the frames.
        language: Rewrites of the instruction.
    """

    goal: GoalAxis | None = None
    layout: LayoutAxis | None = None
    pose: PoseAxis | None = None
    robot: RobotAxis | None = None
    disturbance: DisturbanceAxis | None = None
    camera: CameraAxis | None = None
    light: LightAxis | None = None
    background: BackgroundAxis | None = None
    noise: NoiseAxis | None = None
    language: LanguageAxis | None = None

    def configured(self) -> dict[str, Axis]:
        """Return the configured axes by name."""
        return {name: axis for name, axis in self if axis is not None}


AXES: Mapping[str, type[Axis]] = {name: get_args(field.annotation)[0] for name, field in Axes.model_fields.items()}
"""Name to class of every axis, in the order in which the axes apply."""

_PLACE = {name: place for place, name in enumerate(AXES)}


def _read_by(tag: str, kinds: Sequence[Any]) -> Any:
    """Return the union of ``kinds``, discriminated by the field ``tag``; a single kind stays as it is."""
    if len(kinds) == 1:
        return kinds[0]
    return Annotated[reduce(or_, kinds), Field(discriminator=tag)]


_LIST: TypeAdapter[tuple[Perturbation, ...]] = TypeAdapter(
    tuple[_read_by("axis", [_read_by("component", axis.kinds) for axis in AXES.values()]), ...]  # type: ignore[misc, arg-type]
)

Kind = TypeVar("Kind", bound=Perturbation)


def axes_of(name: str) -> tuple[str, ...]:
    """Split a name such as ``language+camera`` into its axes, in the order in which they apply.

    Raises:
        ValueError: when a part names no axis, or names an axis for the second time.
    """
    axes = name.split("+")
    unknown = [axis for axis in axes if axis not in AXES]
    if unknown:
        similar = get_close_matches(unknown[0], AXES, n=1)
        suggestion = f"; did you mean {similar[0]}?" if similar else ""
        raise ValueError(
            f"{unknown[0]!r} in {name!r} is no axis, expected {', '.join(AXES)}, or several joined by +{suggestion}"
        )
    if len(set(axes)) < len(axes):
        raise ValueError(f"{name!r} names an axis twice, but an episode is perturbed once on each axis")
    return tuple(sorted(axes, key=_PLACE.__getitem__))


def task_of(suite: str, name: str, perturbations: str) -> Task:
    """Return the task that an episode carries out: the named one, which a perturbation may carry to another scene.

    Args:
        perturbations: JSON list, as in the columns of the plan and the manifest.
    """
    return carried_task(find_task(suite, name), from_json(perturbations))


def carried_task(task: Task, perturbations: Iterable[Perturbation]) -> Task:
    """Return the task that an episode of ``task`` with these perturbations carries out."""
    for perturbation in perturbations:
        task = perturbation.carry(task)
    return task


def level_of_test(tested: TestTask) -> int:
    """Return the strength of a test task, 1 to 5, by the ranges of its axis; 0 if its parameters do not state it."""
    return AXES[tested.axis].level_of_test(tested)


def components_of(axis: str) -> tuple[str, ...]:
    """List the values that the column ``component`` can have for an axis."""
    components: list[str] = []
    for kind in AXES[axis].kinds:
        components += get_args(kind.model_fields["component"].annotation)
    return tuple(components)


def in_order(perturbations: Iterable[Kind]) -> tuple[Kind, ...]:
    """Sort perturbations into the order in which they apply."""
    return tuple(sorted(perturbations, key=lambda p: _PLACE[p.axis]))


def to_json(perturbations: Iterable[Perturbation]) -> str:
    """Write perturbations as canonical JSON, which does not depend on the order of ``perturbations``."""
    return f"[{','.join(p.model_dump_json() for p in in_order(perturbations))}]"


def from_json(text: str) -> tuple[Perturbation, ...]:
    """Read perturbations from JSON, in the order in which they apply.

    Raises:
        PipelineError: when a version of this project with other axes or parameters recorded them.
    """
    try:
        return _LIST.validate_json(text)
    except ValidationError as error:
        fault = error.errors()[0]
        raise PipelineError(
            f"not perturbations of this version: {'.'.join(map(str, fault['loc'][1:])) or 'the list'}: {fault['msg']}",
            where=f"perturbations {text:.80}",
            expected="perturbations that this version samples",
            remedy=f"{RUN_AGAIN}, which plans again; or read the file with the version that wrote it",
        ) from error


def of_layer(perturbations: Iterable[Perturbation], layer: type[Kind]) -> tuple[Kind, ...]:
    """Return the perturbations that act on one layer, given by the layer's class."""
    return tuple(p for p in perturbations if isinstance(p, layer))
