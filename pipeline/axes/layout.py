"""Layout, confounding objects: objects on the working surface that the task does not need. Physics layer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, cast

import numpy as np
from pydantic import Field

from pipeline.axes.base import Axis, Credit, PhysicsPerturbation
from pipeline.axes.report_data import BENCHMARK, CoveragePlots, Histogram, KeptPerturbation, ObservedEpisode, Scatter
from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.object_sources import Source
from pipeline.catalogue.objects import find, goes_with, models, nouns_of, taken, words_in
from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS, Arena
from pipeline.libero.tasks import Same
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, Frozen, RollOut, Scene, Task

SHELF = 13
"""Number of models that the objects of one scene are sampled from, as in LIBERO-Plus."""

CAMERA_SIDE_M = 0.19
"""Least x, in the frame of the working surface, at which an object stands on the side of the agent camera."""


class AddedObject(Frozen):
    """Object of ``pipeline.catalogue.objects``, by name and content.

    Attributes:
        licence, attribution: licence and author of the object, stored so that they accompany the data.
    """

    name: str
    category: str
    sha256: str
    licence: str
    attribution: str

    @classmethod
    def of(cls, model: ObjectModel) -> AddedObject:
        """Record a model of the catalogue."""
        return cls(**{field: getattr(model, field) for field in cls.model_fields})


class LayoutPerturbation(PhysicsPerturbation):
    """Objects added to the scene.

    Attributes:
        objects: added objects; their number is the level.
        seed: key of the candidate places. The trajectory's ``resolved`` has the final places.
    """

    axis: Literal["layout"] = "layout"
    component: Literal["objects"] = "objects"
    objects: Annotated[tuple[AddedObject, ...], Field(min_length=1)]
    seed: int

    measure: ClassVar[str] = "infinite if no category is shared with a test task in the same scene, else 0"
    clearance: ClassVar[float] = 1.0
    can_hide: ClassVar[bool] = True
    changes_objects: ClassVar[bool] = True

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """Return the scene with the objects added; see ``pipeline.scenes.placement.place``."""
        # Sampling a plan must not load the simulator.
        from pipeline.scenes.placement import place

        models = [find(added.name, added.sha256) for added in self.objects]
        return place(scene, demo, models, self.seed, roll_out)

    def named_in(self, instruction: str) -> bool:
        """Return whether the instruction has a word for an added object, or for an object that looks like one."""
        words = words_in(instruction)
        return any(nouns_of(added.category) & words for added in self.objects)

    same: ClassVar[Same | None] = "scene"

    def distances_on(self, test: TestSet, task: Task) -> list[float]:
        """Return infinity for each test task in this scene that shares no category with the added objects, else 0.

        The rule is stricter than a distance between positions: every position of a shared category counts as 0 m.
        """
        tested = test.on(task, "layout", "scene")
        return [self._distance_to(_plain(test_task.parameters["category"])) for test_task in tested]

    def distances_to(self, others: Sequence[LayoutPerturbation]) -> Floats:
        """Return infinity for each perturbation that shares no category with this one, else 0 (N,)."""
        return np.array([self._distance_to(perturbation.categories) for perturbation in others])

    @property
    def categories(self) -> set[str]:
        """Categories of the added objects."""
        return {added.category for added in self.objects}

    def _distance_to(self, categories: Iterable[str]) -> float:
        """Return infinity if no added object has one of ``categories``, else 0."""
        return math.inf if self.categories.isdisjoint(categories) else 0.0

    def credits(self, task: Task) -> frozenset[Credit]:
        """List the added objects with their licences."""
        return frozenset(Credit(o.name, "object", o.licence, o.attribution) for o in self.objects)

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Measure the number of added objects and their places."""
        arena = bddl.read(episode.task.bddl_file).arena
        places_m = _on_surface(episode.resolved["layout"]["objects"], arena)
        return _measures([added.name for added in self.objects], places_m, arena)


class LayoutAxis(Axis):
    """Number and sources of added objects.

    The level is the number of objects, 1 to 5 as in LIBERO-Plus. No object has a category that is in the scene already,
    that the instruction names, or that the test set adds. A scene may repeat a model, but never has two models of one
    category. A scene's objects are sampled with replacement from ``SHELF`` models of different categories. LIBERO-Plus
    repeats its 13 models as often: in 6, 21, 42 and 60 % of its scenes with 2, 3, 4 and 5 objects.

    Attributes:
        levels: Numbers of added objects to sample, 1 to 5, each entry with equal probability; all five by default.
        sources: Sources of the objects; by default ``libero`` and ``robosuite``, which setup installs. ``sweethome3d``
            (fetched by apt-get, 120 MB) and the user's folders are converted when a plan first uses them.
        area_m2: Largest area of all added objects together, in m2; 0.12 by default, the area of the broadest object.
            Each object has at most an equal share of it.
    """

    kinds: ClassVar = (LayoutPerturbation,)
    colour: ClassVar = "#7d9a1f"
    dimension: ClassVar = "layout"
    test_name: ClassVar = "confounding objects"
    test_scene: ClassVar = "bddl and models"

    sources: Annotated[tuple[Source, ...], Field(min_length=1)] = ("libero", "robosuite")
    area_m2: float = Field(default=0.12, gt=0.0, le=10.0)

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the level, which is the number of added objects."""
        return int(tested.parameters["count"])

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> LayoutPerturbation:
        level = self.sample_level(rng)
        fitting = _fitting(self.sources, task)
        shelf: dict[str, ObjectModel] = {}
        for index in rng.permutation(len(fitting)):
            model = fitting[index]
            if model.shape.footprint_m2 <= self.area_m2 / level and len(shelf) < SHELF:
                shelf.setdefault(model.category, model)
        if len(shelf) < level:
            raise PipelineError(
                f"{len(shelf)} categories of objects can be added to {task}, but {level} are needed",
                where="plan.axes.layout",
                remedy="add sources, increase area_m2, or leave out the higher levels",
            )
        choice = list(shelf.values())
        objects = tuple(AddedObject.of(choice[index]) for index in rng.integers(len(choice), size=level))
        return LayoutPerturbation(level=level, objects=objects, seed=int(rng.integers(2**31)))

    def offered(self) -> dict[str, int]:
        """Count the distinct models and categories of ``sources``."""
        listed = models(self.sources).values()
        hashes = {model.sha256 for model in listed}
        categories = {model.category for model in listed}
        return {"models": len(hashes), "categories": len(categories)}

    @classmethod
    def observe_tests(cls, test: TestSet) -> Iterator[tuple[str, float]]:
        """Measure the number of added objects and their places in each test task."""
        for tested in test.on_axis("layout"):
            parameters = tested.parameters
            models = str(parameters["category"]).split(",")
            yield from _measures(models, _test_places_m(tested), cast(Arena, parameters["arena"]))

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[LayoutPerturbation]], test: TestSet) -> CoveragePlots:
        """Describe plots of the places and the number of the added objects."""
        tested = test.on_axis("layout")
        tested_at = np.array([place for task in tested for place in _test_places_m(task)])
        placed_at = []
        for item in kept:
            placed = item.resolved["objects"] if item.resolved else ()
            placed_at += [*_on_surface(placed, bddl.read(item.task.bddl_file).arena)]
        categories: set[str] = set()
        for item in kept:
            categories |= item.perturbation.categories
        places = {BENCHMARK: np.unique(tested_at.reshape(-1, 2), axis=0), "layout": np.array(placed_at)}
        number = {
            BENCHMARK: np.array([float(task.parameters["count"]) for task in tested]),
            "layout": np.array([len(item.perturbation.objects) for item in kept], float),
        }
        return CoveragePlots(
            f"{len(tested):,} test tasks. The kept episodes add objects of {len(categories)} categories. A run stops "
            "if a test task adds an object of such a category to the same scene.",
            [
                Scatter("Positions of added objects", places, "x from the surface's centre (m)", "y (m)", equal=True),
                Histogram("Number of added objects", number, np.arange(0.5, 7.0), "objects"),
            ],
        )


def _test_places_m(tested: TestTask) -> Floats:
    """Return the places (N, 2) of the objects that a test task adds, in the frame of the working surface."""
    pairs = str(tested.parameters["positions"]).split(";")
    return np.array([pair.split(",") for pair in pairs if pair], float).reshape(-1, 2)


def _on_surface(placed: Sequence[Mapping[str, Any]], arena: Arena) -> Floats:
    """Return the places (N, 2) of recorded objects in the frame of the working surface."""
    places_m = np.array([thing["position_m"][:2] for thing in placed], float).reshape(-1, 2)
    return places_m - [ARENAS[arena].surface_x_m, 0.0]


def _measures(models: Sequence[str], xy_m: Floats, arena: Arena) -> Iterator[tuple[str, float]]:
    """Measure a scene with added objects, by their models and their places (N, 2) in the frame of the surface."""
    for number in range(1, 6):
        yield f"scenes with {number} added object{'s' * (number > 1)}", len(models) == number
    if len(models) > 1:
        yield f"scenes with {len(models)} added objects and a repeated model", len(set(models)) < len(models)
    x_m, z_m = ARENAS[arena].camera_xz_m
    for place in xy_m:
        yield "objects on the camera's side", bool(place[0] > CAMERA_SIDE_M)
        away_m = float(np.hypot(np.linalg.norm(place - [x_m, 0.0]), z_m))
        yield "distance from an added object to the camera (m)", away_m


@cache
def _fitting(sources: tuple[Source, ...], task: Task) -> list[ObjectModel]:
    """List the objects whose category differs from all categories in a task's scene."""
    in_scene = taken(task)
    return [model for model in models(sources).values() if goes_with(model, in_scene)]


def _plain(categories: object) -> list[str]:
    """List category names without the number at the end of some names of LIBERO-Plus."""
    return [name.rpartition("__")[0] or name for name in str(categories).split(",")]
