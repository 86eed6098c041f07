"""What every axis of perturbation has in common.

An axis is a pair of small frozen models in one file. What is constant about it are their class attributes:

* ``XAxis`` is the axis as configured, its ranges, and draws: ``sample(rng, task, place) -> XPerturbation``.
* ``XPerturbation`` is one draw with every parameter, and acts: ``apply(...)`` on what its layer touches (text: the
  instruction; pixels: a clean frame; render: the MuJoCo model; physics: the scene, and what it holds for the rollout).

``pipeline.axes.Axes`` is the registry, with one line for each axis.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
from pydantic import AfterValidator, Field

from pipeline.libero.tasks import Same
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, Frame, RollOut, Scene, Task
from pipeline.types import Frozen as Frozen

if TYPE_CHECKING:
    import mujoco


class Layer(IntEnum):
    """The cheapest thing that has to be made again when an axis changes; lower is cheaper."""

    TEXT, PIXELS, RENDER, PHYSICS = range(4)


Level = Literal[1, 2, 3, 4, 5]
"""Strength, weakest first."""
LEVELS: tuple[Level, ...] = get_args(Level)


class Nearest(NamedTuple):
    """The distance to the nearest of the benchmark's test tasks, in the axis's own measure, and how many were compared;
    infinite where there is none."""

    distance: float
    compared: int


class Credit(NamedTuple):
    """A ``texture`` or an ``object`` of others' that a perturbation shows; ``attribution`` tells who made it and what
    was changed, where that is more than the licence says."""

    name: str
    kind: str
    licence: str
    attribution: str


class Perturbation(Frozen):
    """One draw: a change on one axis, with all of its parameters; JSON in and out through pydantic.

    Attributes:
        axis: name of the axis, the discriminator when a perturbation is read back.
        component: which of the axis's components was drawn.
        level: strength, 1 to 5, by the ranges that the axis states.
        layer: what has to be made again.
        views: those of ``schemas/episode.json`` whose frames this can change; empty for text.
        measure: what the distance to a test task is.
        unit: of that distance; None where it tells only same from other, not near from far.
        clearance: the least distance to any test task; a draw that comes closer is drawn anew.
        same: what two changes must have in common to be compared, the LIBERO task or the scene that it begins in; None
            where any two can be.
    """

    axis: str
    component: str
    level: Level

    layer: ClassVar[Layer]
    views: ClassVar[frozenset[str]] = frozenset({"image", "wrist_image"})
    measure: ClassVar[str] = "nothing to compare with: the benchmark has no such test"
    unit: ClassVar[str | None] = None
    clearance: ClassVar[float] = 0.0
    same: ClassVar[Same | None] = None

    def distances(self, test: TestSet, task: Task) -> Floats:
        """The distance to each of the axis's test tasks (N,), in their order, for an episode of ``task``.

        NaN where there is nothing to compare, such as the wordings of another task.
        """
        distances = np.full(len(test.of(self.axis)), np.nan)
        if self.same:
            distances[test.places(task, self.axis, self.same)] = self.distances_on(test, task)
        return distances

    def distances_on(self, test: TestSet, task: Task) -> Sequence[float] | Floats:
        """Those of ``distances`` to the test tasks that have the ``same`` in common with ``task``."""
        raise NotImplementedError

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """The distance to the nearest of the test tasks that this could coincide with, for an episode of ``task``."""
        distances = self.distances(test, task)
        compared = distances[~np.isnan(distances)]
        return Nearest(float(compared.min(initial=np.inf)), len(compared))

    def after(self, earlier: Sequence[Perturbation]) -> Self:
        """The same change to a demonstration that an expansion made by ``earlier`` changes.

        Distances count from LIBERO's own scene, so a change of the same thing has to add what was changed before.
        """
        return self

    def in_scene(self, task: Task) -> Self:
        """The same change, with things named alike in all tasks that begin in the scene of ``task``."""
        return self

    def apart(self, others: Sequence[Self]) -> Floats:
        """The distance to each of N draws of this class (N,), as ``distances`` measures it; NaN where there is nothing
        to compare. At least one, all of the ``same`` task or scene, and ``in_scene`` if their tasks differ.

        By default 0 to a draw that is equal, else 1.
        """
        return np.array([float(self != other) for other in others])

    def named_in(self, instruction: str) -> bool:
        """Whether an instruction that the same episode is prompted with has a word for what this adds.

        Such a perturbation is sampled again, as the instruction would no longer mean one thing only.
        """
        return False

    def credits(self) -> frozenset[Credit]:
        """What this shows that has a licence of its own."""
        return frozenset()


class Axis(Frozen):
    """The ranges that an axis draws from.

    Attributes:
        draws: the perturbations that it draws; several are told apart by their ``component``.
        not_held_out: why evaluations have no draws of this axis that plans leave alone; empty where they have.
        levels: the strengths to draw, each as often as the others.
    """

    draws: ClassVar[tuple[type[Perturbation], ...]]
    not_held_out: ClassVar[str] = ""

    levels: Annotated[tuple[Level, ...], Field(min_length=1)] = LEVELS

    def applies(self, task: Task) -> bool:
        """Whether the axis can change anything that ``task`` has; its episodes are spread over the tasks that it can.

        What cannot be known before the scene is built is refused when the perturbation is applied.
        """
        return True

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> Perturbation:
        """One draw for a task that the axis applies to; what is random comes from ``rng`` alone.

        ``place`` is that of an entry in ``entries``, for axes that take the entries of a list; others ignore it.
        """
        raise NotImplementedError

    def entries(self, task: Task) -> Sequence[str]:
        """The list that the axis takes its perturbations of a task from; empty where it samples them from ranges."""
        return ()

    def refuse_tested(self, test: TestSet, task: Task) -> None:
        """Refuse a level of which no draw keeps clear of the test tasks, where the ranges tell.

        Others would fill its place in a plan, and nothing would say so.

        Raises:
            PipelineError: naming component and level.
        """

    def draw_level(self, rng: np.random.Generator) -> Level:
        return pick(rng, self.levels)

    def beside(self, axes: Collection[str]) -> Axis:
        """The axis where episodes are perturbed on these axes together; ValueError where nothing is left to draw."""
        return self

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Strength of one of the axis's test tasks, 1 to 5, by the axis's own ranges; 0 if its parameters do not tell.

        The benchmark's own ``difficulty_level`` is another thing: how many of four models fail.
        """
        return 0

    @classmethod
    def held_out(cls) -> Axis:
        """The ranges of held-out perturbations: the default ones, from which a key of their own keeps draws apart."""
        return cls()

    def offered(self) -> dict[str, int]:
        """How many different things of others' there are to draw from, by kind; what is not installed is fetched."""
        return {}


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
"""Arrays of MuJoCo's model that the render layer can change: each is compared with MuJoCo's own rendering by the tests.

What a scene is made of, such as ``geom_size`` or ``mesh_vert``, is kept from one picture to the next."""


class RenderPerturbation(Perturbation):
    """Changes what a scene looks like and nothing that moves in it.

    Attributes:
        fields: the arrays of the model that ``apply`` may write, of ``FIELDS``; they are put back afterwards.
        paints: whether it writes textures and nothing else.
        sees_otherwise: whether it sees other surfaces: from another place, through another lens, or through what was
            opaque.
    """

    layer: ClassVar[Layer] = Layer.RENDER
    fields: ClassVar[tuple[str, ...]] = ()
    paints: ClassVar[bool]
    sees_otherwise: ClassVar[bool]

    @classmethod
    def __pydantic_init_subclass__(cls, **_: object) -> None:
        if others := {*cls.fields} - {*FIELDS}:
            raise TypeError(
                f"{cls.__name__} writes {sorted(others)}, which pictures would not follow: make it a "
                "PhysicsPerturbation, which changes the scene before it is replayed"
            )
        cls.paints = cls.fields == ("tex_data",)
        cls.sees_otherwise = not {*CAMERA_FIELDS, *OPACITY_FIELDS}.isdisjoint(cls.fields)

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the change into the model's ``fields``."""
        raise NotImplementedError


class PhysicsPerturbation(Perturbation):
    """Changes what happens: the scene before the first step, and so the whole replay.

    What acts in the course of the episode, such as another posture of the controller, is a field of ``Scene``, which is
    stored with the trajectory: ``apply`` sets it, and the environment acts by it wherever the scene is run.
    """

    layer: ClassVar[Layer] = Layer.PHYSICS

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """The changed ``scene``, in which ``demo`` is replayed.

        Args:
            roll_out: gives the states that the demonstration's actions lead to from a scene; costs a whole replay.

        Raises:
            RefusedError: when the change cannot be made here; its reason is written into the manifest.
        """
        raise NotImplementedError

    def fault_of(self, actions: Floats) -> str | None:
        """Return why a replay with these executed actions (K, 7) does not show the change as promised, else ``None``.

        The reason is written into the manifest and the replay is dropped. A tracked replay waits for the hand, so its
        steps are not those of the demonstration.
        """
        return None


def level_from(strength: float) -> int:
    """The level of a strength that reaches the upper end of level k at k."""
    return min(max(math.ceil(round(strength, 6)), 1), 5)


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
    """One number, uniform over the union of ``intervals`` and rounded to four decimals (as it will be recorded).

    Of points alone, each as often as the others; beside intervals, a point never comes.
    """
    lengths = [high - low for low, high in intervals]
    if len(intervals) > 1 and not any(lengths):
        return round(pick(rng, intervals)[0], 4)
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
