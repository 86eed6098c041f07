"""Base classes of all axes of perturbation.

An axis is a pair of small frozen models in one file. Their class attributes hold the constants of the axis:

* ``XAxis`` holds the configured ranges. ``sample(rng, task, entry_index)`` samples an ``XPerturbation`` from them.
* ``XPerturbation`` is one sampled change with every parameter. Its ``apply(...)`` changes the object of its layer
  (text: the instruction; pixels: a clean frame; render: the MuJoCo model; physics: the scene and its rollout settings).

``pipeline.axes.Axes`` is the registry, with one line for each axis.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from enum import IntEnum
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from pipeline.axes.report_data import CoveragePlots, KeptPerturbation, Measures, ObservedEpisode, Plot, Strips
from pipeline.episode_schema import ALL_VIEWS
from pipeline.libero.tasks import Same
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, Frame, Frozen, RollOut, Scene, Task

if TYPE_CHECKING:
    import mujoco


class Layer(IntEnum):
    """Cheapest output that must be generated again when an axis changes; lower is cheaper."""

    TEXT, PIXELS, RENDER, PHYSICS = range(4)


Level = Literal[1, 2, 3, 4, 5]
"""Strength, weakest first."""
LEVELS: tuple[Level, ...] = get_args(Level)


class Nearest(NamedTuple):
    """Distance to the nearest of the benchmark's test tasks, and the number of test tasks that were compared.

    The distance is in the axis's own measure. It is infinite if no test task was compared.
    """

    distance: float
    compared: int


class Credit(NamedTuple):
    """Third-party ``texture`` or ``object`` that a perturbation shows.

    ``attribution`` names the author and the changes, as far as the licence does not state them.
    """

    name: str
    kind: str
    licence: str
    attribution: str


TestScene = Literal["libero", "bddl", "bddl and models", "scene files"]
"""Source of the scenes of an axis's test tasks.

The scene of LIBERO's own task is ``libero``. The others are a BDDL file of the benchmark, such a file with models of
the benchmark's asset archive, and scene files of this archive in place of LIBERO's."""


class Perturbation(Frozen):
    """One sampled change on one axis, with all of its parameters; pydantic reads and writes it as JSON.

    Attributes:
        axis: name of the axis, the discriminator when a perturbation is read back.
        component: the sampled component of the axis.
        level: strength, 1 to 5, by the ranges that the axis states.
        layer: output that must be generated again.
        views: views of ``schemas/episode.json`` whose frames the change can affect; empty for text.
        measure: definition of the distance to a test task.
        unit: unit of this distance; ``None`` if the distance is only 0 for equal changes and positive for others.
        clearance: least distance to any test task; a perturbation that comes closer is sampled again.
        same: the property that two changes must share to be compared: the LIBERO task, its instruction or its initial
            scene. ``None`` if all changes can be compared.
        can_hide: true if it can hide the hand or the task's things from the agent view.
        changes_objects: true if episodes show other objects than the scene of their task; a rewrite that describes the
            target without its name would be ambiguous.
    """

    axis: str
    component: str
    level: Level

    layer: ClassVar[Layer]
    views: ClassVar[frozenset[str]] = frozenset(ALL_VIEWS)
    measure: ClassVar[str] = "undefined, because the benchmark has no such test"
    unit: ClassVar[str | None] = None
    clearance: ClassVar[float] = 0.0
    same: ClassVar[Same | None] = None
    can_hide: ClassVar[bool] = False
    changes_objects: ClassVar[bool] = False

    def distances(self, test: TestSet, task: Task) -> Floats:
        """Return the distances (N,) to the axis's test tasks, in their order, for an episode of ``task``.

        A distance is NaN if the two cannot be compared, such as wordings of different tasks.
        """
        distances = np.full(len(test.on_axis(self.axis)), np.nan)
        if self.same:
            distances[test.indices(task, self.axis, self.same)] = self.distances_on(test, task)
        return distances

    def distances_on(self, test: TestSet, task: Task) -> Sequence[float] | Floats:
        """Return the ``distances`` to the test tasks that share the property ``same`` with ``task``."""
        raise NotImplementedError

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """Return the distance to the nearest comparable test task, for an episode of ``task``."""
        distances = self.distances(test, task)
        compared = distances[~np.isnan(distances)]
        return Nearest(float(compared.min(initial=np.inf)), len(compared))

    def after(self, earlier: Sequence[Perturbation]) -> Self:
        """Return this change for a demonstration that an expansion generated with the changes ``earlier``.

        Distances count from LIBERO's own scene. A second change of one thing therefore includes the earlier one.
        """
        return self

    def in_scene(self, task: Task) -> Self:
        """Return this change with the names that things have in all tasks with the initial scene of ``task``."""
        return self

    def visible_part(self, task: Task) -> Self:
        """Return this change without the parts that the scene of ``task`` does not show, for descriptions."""
        return self

    def carry(self, task: Task) -> Task:
        """Return ``task`` carried to the scene of this change; by default ``task``, in its own scene."""
        return task

    @property
    def reset_seed(self) -> int | None:
        """Seed of the reset of LIBERO's environment that starts the episode; ``None`` if it starts as recorded."""
        return None

    def distances_to(self, others: Sequence[Self]) -> Floats:
        """Return the distances (N,) to N perturbations of this class, in the measure of ``distances``.

        A distance is NaN if the two cannot be compared. The default is 0 to an equal perturbation, else 1.

        Args:
            others: at least one perturbation, all for the ``same`` task or scene; results of ``in_scene`` if their
                tasks differ.
        """
        return np.array([float(self != perturbation) for perturbation in others])

    def named_in(self, instruction: str) -> bool:
        """Return whether the episode's ``instruction`` has a word for an object that this perturbation adds.

        Such a perturbation is sampled again, because it would make the instruction ambiguous.
        """
        return False

    def credits(self, task: Task) -> frozenset[Credit]:
        """List the textures and objects that an episode of ``task`` shows and that have a licence of their own."""
        return frozenset()

    @property
    def acts_until(self) -> int | None:
        """Control step at which a change ends that acts during the episode, ``None`` for a change from the start on."""
        return None

    def observe(self, episode: ObservedEpisode) -> Measures:
        """Measure the visible effects of this change in a kept ``episode`` that has no other change."""
        return ()


class Axis(Frozen):
    """Ranges that an axis samples from.

    Attributes:
        kinds: classes of the perturbations that it samples; the field ``component`` discriminates between them.
        colour: colour of the axis in plots.
        dimension: the paper's dimension whose test tasks this axis has; empty if the benchmark tests no such change.
        test_name: the paper's name of these test tasks, if they are only a part of the dimension; else empty.
        test_scene: source of the scenes of these test tasks.
        audited: part of an unlabelled data set that shows the perturbations of the axis.
        not_held_out: reason why evaluations have no held-out perturbations of this axis; empty if they have some.
        former_fields: former name of a field to its name; configurations may use either.
        levels: Levels to sample, 1 (weak) to 5 (strong), each entry with equal probability; all five by default.
    """

    kinds: ClassVar[tuple[type[Perturbation], ...]]
    colour: ClassVar[str] = "#a3384d"
    dimension: ClassVar[str] = ""
    test_name: ClassVar[str] = ""
    test_scene: ClassVar[TestScene] = "libero"
    audited: ClassVar[Literal["instructions", "cameras", "nothing"]] = "nothing"
    not_held_out: ClassVar[str] = ""
    former_fields: ClassVar[Mapping[str, str]] = {}

    levels: Annotated[tuple[Level, ...], Field(min_length=1)] = LEVELS

    @model_validator(mode="before")
    @classmethod
    def _rename_former_fields(cls, raw: Any) -> Any:
        """Give fields with a former name their name."""
        if not isinstance(raw, Mapping):
            return raw
        for former, name in cls.former_fields.items():
            if former in raw and name in raw:
                raise ValueError(f"{former} is the former name of {name}: give {name} alone")
        return {cls.former_fields.get(name, name): value for name, value in raw.items()}

    def applies(self, task: Task) -> bool:
        """Return whether the axis can change ``task``; its episodes are spread over all tasks that it can change.

        Obstacles that show only once the scene is built reject the perturbation when it is applied.
        """
        return True

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> Perturbation:
        """Sample one perturbation of a task that the axis applies to, with randomness from ``rng`` alone.

        Args:
            entry_index: index into ``entries``, for axes that take the entries of a list; other axes ignore it.
        """
        raise NotImplementedError

    def sample_after(
        self, rng: np.random.Generator, task: Task, entry_index: int, earlier: Sequence[Perturbation]
    ) -> Perturbation:
        """Sample one perturbation, as ``sample``, of a demonstration that an expansion generated.

        Args:
            earlier: changes with which the expansion generated it; empty for other demonstrations.
        """
        return self.sample(rng, task, entry_index).after(earlier)

    def entries(self, task: Task) -> Sequence[str]:
        """List the entries that the axis takes its perturbations of a task from; empty if it samples from ranges."""
        return ()

    def levels_set_shares(self, task: Task) -> bool:
        """Return whether each level of a task's perturbations is as frequent as in ``levels``."""
        return True

    @property
    def keeps_clearance(self) -> bool:
        """Return whether perturbations keep their clearance to the test tasks."""
        return True

    def reject_levels_without_clearance(self, test: TestSet, task: Task) -> None:
        """Reject levels without any perturbation that keeps its clearance, as far as the ranges show this.

        Otherwise, perturbations of other levels would silently take their place in a plan.

        Raises:
            PipelineError: naming component and level.
        """

    def sample_level(self, rng: np.random.Generator) -> Level:
        """Sample one of ``levels`` with equal probability."""
        return pick(rng, self.levels)

    @classmethod
    def changes_objects(cls) -> bool:
        """Return whether an episode of the axis can show other objects than the scene of its task."""
        return any(kind.changes_objects for kind in cls.kinds)

    def restrict_for(self, axes: Collection[Axis]) -> Axis:
        """Return the axis restricted for episodes that are perturbed on all of ``axes`` together.

        Raises:
            ValueError: when nothing is left to sample.
        """
        return self

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the strength of a test task of the axis, 1 to 5, by the axis's own ranges.

        Return 0 if the parameters do not state it. The benchmark's ``difficulty_level`` differs: it is the number of
        models, of four, that fail.
        """
        return 0

    @classmethod
    def held_out(cls) -> Axis:
        """Return the ranges of held-out perturbations: the default ranges, sampled under keys that no plan has."""
        return cls()

    def offered(self) -> dict[str, int]:
        """Count the distinct third-party things to sample from, by kind; missing sources are fetched."""
        return {}

    @classmethod
    def name(cls) -> str:
        """Return the name of the axis, which all its perturbations have."""
        return str(cls.kinds[0].model_fields["axis"].default)

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[Any]], test: TestSet) -> CoveragePlots:
        """Describe plots of the perturbations of kept episodes, next to the test tasks.

        There is a plot of the level and one of each numeric parameter, unless an axis describes others.
        """
        parameters = []
        for parameter, field in cls.kinds[0].model_fields.items():
            if field.annotation in (int, float) and all(parameter in kind.model_fields for kind in cls.kinds):
                parameters.append(parameter)
        plots: list[Plot] = []
        for parameter in ("level", *parameters):
            values = np.array([getattr(item.perturbation, parameter) for item in kept], float)
            plots.append(Strips(parameter.replace("_", " "), {"episodes": {cls.name(): values}}, parameter))
        return CoveragePlots(f"{len(test.on_axis(cls.name())):,} test tasks.", plots)

    @classmethod
    def observe_tests(cls, test: TestSet) -> Measures:
        """Measure the visible effects of the axis in the test tasks, under the names of ``Perturbation.observe``.

        Measures that need a simulator are not computed here: ``benchmarks/test_tasks_seen.py`` has stored them.
        """
        return ()

    @classmethod
    def observe_together(cls, kept: Sequence[KeptPerturbation[Any]], test: TestSet) -> Measures:
        """Measure the axis's perturbations of all kept episodes together, also of episodes with several changes.

        The items of ``kept`` have no ``resolved``.
        """
        return ()


class TextPerturbation(Perturbation):
    """Change of the instruction."""

    layer: ClassVar[Layer] = Layer.TEXT
    views: ClassVar[frozenset[str]] = frozenset()

    def apply(self, instruction: str) -> str:
        """Return the instruction that replaces ``instruction`` in the prompt."""
        raise NotImplementedError


class PixelPerturbation(Perturbation):
    """Change of clean frames."""

    layer: ClassVar[Layer] = Layer.PIXELS

    def apply(self, frame: Frame, frame_index: int) -> Frame:
        """Return a changed copy of a frame (H, W, 3), in the simulator's raw orientation.

        Args:
            frame_index: index of the frame in its episode.
        """
        raise NotImplementedError


CAMERA_FIELDS = ("cam_fovy", "cam_pos", "cam_quat")
OPACITY_FIELDS = ("geom_matid", "geom_rgba", "mat_rgba")
LIGHT_FIELDS = (
    *("light_active", "light_ambient", "light_attenuation", "light_castshadow", "light_cutoff", "light_diffuse"),
    *("light_dir", "light_directional", "light_exponent", "light_pos", "light_specular"),
    *("mat_emission", "mat_reflectance", "mat_shininess", "mat_specular"),
)
FIELDS = (*CAMERA_FIELDS, *OPACITY_FIELDS, *LIGHT_FIELDS, "tex_data")
"""Arrays of MuJoCo's model that the render layer can change; the tests compare each with MuJoCo's own rendering.

The geometry of a scene, such as ``geom_size`` or ``mesh_vert``, is kept from one frame to the next."""


class RenderPerturbation(Perturbation):
    """Change of a scene's appearance that leaves all motion as it is.

    Attributes:
        fields: arrays of the model that ``apply`` may write, a subset of ``FIELDS``; they are restored afterwards.
        changes_only_textures: true if it writes textures and nothing else.
        shows_other_surfaces: true if it shows other surfaces: from another place, through another lens, or behind a
            surface that was opaque.
        casts_shadows: true if lamps may cast shadows that LIBERO's own lamps do not cast; they take longer to render.
    """

    layer: ClassVar[Layer] = Layer.RENDER
    can_hide: ClassVar[bool] = True
    fields: ClassVar[tuple[str, ...]] = ()
    casts_shadows: ClassVar[bool]
    changes_only_textures: ClassVar[bool]
    shows_other_surfaces: ClassVar[bool]

    @classmethod
    def __pydantic_init_subclass__(cls, **_: object) -> None:
        unsupported = {*cls.fields} - {*FIELDS}
        if unsupported:
            raise TypeError(
                f"{cls.__name__} writes {sorted(unsupported)}, which frames would not show: derive it from "
                "PhysicsPerturbation, which changes the scene before the replay"
            )
        cls.casts_shadows = "light_castshadow" in cls.fields
        cls.changes_only_textures = cls.fields == ("tex_data",)
        cls.shows_other_surfaces = not {*CAMERA_FIELDS, *OPACITY_FIELDS}.isdisjoint(cls.fields)

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the change into the model's ``fields``."""
        raise NotImplementedError


class PhysicsPerturbation(Perturbation):
    """Change of the scene before the first step, and so of the whole replay.

    A change that acts during the episode, such as another posture of the controller, is a field of ``Scene``.
    ``apply`` sets this field, the trajectory stores it, and the environment applies it wherever the scene is run.
    """

    layer: ClassVar[Layer] = Layer.PHYSICS

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """Return the changed ``scene``, in which ``demo`` is replayed.

        Args:
            roll_out: returns the states that the demonstration's actions lead to from a scene; costs a whole replay.

        Raises:
            RejectedError: when the change is impossible in this scene; its reason is written into the manifest.
        """
        raise NotImplementedError

    def fault_of(self, actions: Floats) -> str | None:
        """Return why a replay with these executed actions (K, 7) does not show the planned change, else ``None``.

        The reason is written into the manifest and the replay is dropped. A tracked replay waits for the hand, so its
        steps differ from the demonstration's.
        """
        return None


def level_from(strength: float) -> int:
    """Return the level of ``strength``, on a scale where level k ends at k."""
    return min(max(math.ceil(round(strength, 6)), 1), 5)


T = TypeVar("T")
Number = TypeVar("Number", bound=float)


def _ordered(intervals: tuple[tuple[Number, Number], ...]) -> tuple[tuple[Number, Number], ...]:
    """Check that there are intervals, that each has ``low <= high``, and that no two overlap."""
    given = [list(interval) for interval in intervals]
    if not intervals or any(low > high for low, high in intervals):
        raise ValueError(f"expected one or more [low, high] with low <= high, got {given}")
    for (_, end), (begin, _) in pairwise(sorted(intervals)):
        if begin < end:
            raise ValueError(f"expected intervals that do not overlap, got {given}")
    return intervals


Intervals = Annotated[tuple[tuple[Number, Number], ...], AfterValidator(_ordered)]
"""Union of closed intervals, written ``[[low, high], ...]``: ranges without the test set's values."""

Share = Annotated[float, Field(ge=0.0, le=1.0)]
ByLevel = tuple[T, T, T, T, T]
"""One value for each level, weakest first."""
Degrees = Annotated[float, Field(ge=-180.0, le=180.0)]


def sample_number(rng: np.random.Generator, intervals: Intervals[float]) -> float:
    """Sample one number, uniform over the union of ``intervals``, rounded to four decimals (as it is recorded).

    If all intervals are points, each has equal probability. A point next to longer intervals is never sampled.
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
    """Sample one of ``choices``, each with equal probability."""
    return choices[int(rng.integers(len(choices)))]


def sample_point(rng: np.random.Generator, distance: float) -> tuple[float, float]:
    """Sample a point (x, y) at ``distance`` from the origin, in any direction, rounded as in ``sample_number``."""
    bearing_rad = rng.uniform(-math.pi, math.pi)
    return round(distance * math.cos(bearing_rad), 4), round(distance * math.sin(bearing_rad), 4)
