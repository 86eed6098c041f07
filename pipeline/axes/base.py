"""What every axis of perturbation has in common.

An axis comes as a pair of small frozen models in one file:

* ``XAxis`` is the axis as configured, its ranges, and draws: ``sample(rng, task, place) -> XPerturbation``.
  Each demonstration numbers its draws from a start of its own, for axes that take the entries of a list in turn.
* ``XPerturbation`` is one drawn change with every parameter, and acts: ``apply(...)`` on what its layer
  touches (text: the instruction; pixels: a clean frame; render and physics: the MuJoCo model).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from pipeline.errors import PipelineError
from pipeline.types import Demo, Floats, Frame, RollOut, Scene, Task

if TYPE_CHECKING:
    import mujoco

    from pipeline.testset.benchmark import TestSet


class Layer(IntEnum):
    """The cheapest thing that has to be made again when an axis changes; lower is cheaper."""

    TEXT = 0
    PIXELS = 1
    RENDER = 2
    PHYSICS = 3


class Frozen(BaseModel):
    """A record that cannot change and refuses fields it does not know, and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Level = Literal[1, 2, 3, 4, 5]
"""Strength, weakest first."""


class Axis(Frozen):
    """The ranges that an axis draws from.

    Attributes:
        levels: the strengths to draw, each as often as the others.
    """

    levels: Annotated[tuple[Level, ...], Field(min_length=1)] = (1, 2, 3, 4, 5)

    def applies(self, task: Task) -> bool:
        """Whether the axis can change anything that ``task`` has; its episodes are spread over the tasks that it can.

        What cannot be known before the scene is built is refused when the perturbation is applied.
        """
        return True

    def draw_level(self, rng: np.random.Generator) -> Level:
        return pick(rng, self.levels)


class Nearest(NamedTuple):
    """How close a perturbation comes to the benchmark's test tasks.

    Attributes:
        distance: to the nearest of them, in the axis's own measure; infinite when there is none to compare with.
        compared: how many it was compared with.
    """

    distance: float
    compared: int


class Perturbation(Frozen):
    """One change on one axis, with all of its parameters; JSON in and out through pydantic.

    Attributes:
        axis: name of the axis, the discriminator when a perturbation is read back.
        component: which of the axis's components was drawn.
        level: strength, 1 to 5, by the ranges that the axis states.
        clearance: the least distance to any test task; a draw that comes closer is drawn anew.
        measure: what the distance is and its unit.
        graded: whether the distance tells near from far, not only same from other.
    """

    axis: str
    component: str
    level: Level

    clearance: ClassVar[float]
    measure: ClassVar[str]
    graded: ClassVar[bool] = True

    layer: ClassVar[Layer]
    views: ClassVar[frozenset[str]]
    """The views of ``schemas/episode.json`` whose frames this can change; empty for text."""

    def distances(self, test: TestSet, task: Task) -> Floats:
        """The distance to each of the axis's test tasks (N,), in their order, for an episode of ``task``.

        NaN where there is nothing to compare, such as the wordings of another task.
        """
        raise NotImplementedError

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """The distance to the nearest of the test tasks that this could coincide with, for an episode of ``task``."""
        distances = self.distances(test, task)
        compared = distances[~np.isnan(distances)]
        return Nearest(float(compared.min(initial=np.inf)), len(compared))


@cache
def on_task(test: TestSet, task: Task, axis: str) -> NDArray[np.intp]:
    """Which of an axis's test tasks perturb ``task``: their places in ``test.of(axis)``."""
    bases = [(tested.suite, tested.base) for tested in test.of(axis)]
    return np.flatnonzero([base == (task.suite, task.name) for base in bases])


class TextPerturbation(Perturbation):
    """Changes the instruction."""

    layer: ClassVar[Layer] = Layer.TEXT
    views: ClassVar[frozenset[str]] = frozenset()

    def apply(self, instruction: str) -> str:
        """The instruction to prompt with in place of ``instruction``."""
        raise NotImplementedError


class PixelPerturbation(Perturbation):
    """Changes clean frames."""

    layer: ClassVar[Layer] = Layer.PIXELS

    def apply(self, frame: Frame, frame_index: int) -> Frame:
        """A changed copy of a frame (H, W, 3), in the simulator's raw orientation, at its place in the episode."""
        raise NotImplementedError


CAMERA_FIELDS = ("cam_fovy", "cam_pos", "cam_quat")
OPACITY_FIELDS = ("geom_matid", "geom_rgba", "mat_rgba")
LIGHT_FIELDS = (
    *("light_active", "light_ambient", "light_attenuation", "light_castshadow", "light_cutoff", "light_diffuse"),
    *("light_dir", "light_directional", "light_exponent", "light_pos", "light_specular"),
    *("mat_emission", "mat_reflectance", "mat_shininess", "mat_specular"),
)
FIELDS = (*CAMERA_FIELDS, *OPACITY_FIELDS, *LIGHT_FIELDS, "tex_data")
"""Arrays of MuJoCo's model that the render layer can change: each is compared with MuJoCo's own drawing by the tests.

What a scene is made of, such as ``geom_size`` or ``mesh_vert``, is kept from one picture to the next."""


class RenderPerturbation(Perturbation):
    """Changes what a scene looks like and nothing that moves in it.

    Attributes:
        fields: the arrays of the model that ``apply`` may write, of ``FIELDS``; they are put back afterwards.

    Raises:
        PipelineError: when a class is made whose ``fields`` has another one.
    """

    layer: ClassVar[Layer] = Layer.RENDER
    fields: ClassVar[tuple[str, ...]]

    @classmethod
    def __pydantic_init_subclass__(cls, **_: object) -> None:
        for field in getattr(cls, "fields", ()):
            if field not in FIELDS:
                raise PipelineError(
                    f"a render perturbation writes {field}, which pictures would not follow",
                    where=f"{cls.__module__}.{cls.__qualname__}",
                    expected=f"fields of {', '.join(FIELDS)}",
                    remedy="make it a PhysicsPerturbation, which changes the scene before it is replayed",
                )

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the change into the model's ``fields``."""
        raise NotImplementedError

    @property
    def paints(self) -> bool:
        """Whether it writes textures and nothing else."""
        return self.fields == ("tex_data",)

    @property
    def sees_otherwise(self) -> bool:
        """Whether it sees other surfaces: from another place, through another lens, or through what was opaque."""
        return not {*CAMERA_FIELDS, *OPACITY_FIELDS}.isdisjoint(self.fields)


class PhysicsPerturbation(Perturbation):
    """Changes what happens: the scene before the first step, and so the whole replay."""

    layer: ClassVar[Layer] = Layer.PHYSICS
    views: ClassVar[frozenset[str]] = frozenset({"image", "wrist_image"})

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """The scene that ``demo`` is replayed in.

        Args:
            scene: what the perturbation changes.
            demo: the demonstration.
            roll_out: gives the states that the demonstration's actions lead to from a scene; costs a whole replay.

        Raises:
            RefusedError: when the change cannot be made here; its reason is written into the manifest.
        """
        raise NotImplementedError


T = TypeVar("T")
Number = TypeVar("Number", bound=float)


def _ordered(intervals: tuple[tuple[Number, Number], ...]) -> tuple[tuple[Number, Number], ...]:
    if not intervals or any(low > high for low, high in intervals):
        raise ValueError(f"expected one or more [low, high] with low <= high, got {[list(i) for i in intervals]}")
    return intervals


Intervals = Annotated[tuple[tuple[Number, Number], ...], AfterValidator(_ordered)]
"""A union of closed intervals, written ``[[low, high], ...]``: ranges with the test set's values cut out."""

Share = Annotated[float, Field(ge=0.0, le=1.0)]
ByLevel = tuple[T, T, T, T, T]
"""One value for each level, weakest first."""
Degrees = Annotated[float, Field(ge=-180.0, le=180.0)]


def draw(rng: np.random.Generator, intervals: Intervals[float]) -> float:
    """One number, uniform over the union of ``intervals`` and rounded to four decimals (as it will be recorded)."""
    lengths = [high - low for low, high in intervals]
    at = rng.uniform(0.0, sum(lengths))
    for (low, _), length in zip(intervals, lengths, strict=True):
        if at <= length:
            return round(low + at, 4)
        at -= length
    return round(intervals[-1][1], 4)


def pick(rng: np.random.Generator, choices: Sequence[T]) -> T:
    """One of ``choices``, each as often as the others."""
    return choices[int(rng.integers(len(choices)))]


def point(rng: np.random.Generator, distance: float) -> tuple[float, float]:
    """A point (x, y) so far from the origin, in any direction, rounded as ``draw`` does."""
    bearing_rad = rng.uniform(-math.pi, math.pi)
    return round(distance * math.cos(bearing_rad), 4), round(distance * math.sin(bearing_rad), 4)
