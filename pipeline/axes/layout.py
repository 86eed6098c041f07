"""Layout, confounding objects: things that the task is not about stand on the working surface. Physics layer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.axes.base import Axis, Credit, Frozen, PhysicsPerturbation
from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.object_sources import Source
from pipeline.catalogue.objects import find, goes_with, models, nouns_of, taken, words_in
from pipeline.errors import PipelineError
from pipeline.libero.tasks import Same
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, RollOut, Scene, Task

SHELF = 13
"""How many models the objects of one scene are drawn from: as many as LIBERO-Plus draws from."""


class AddedObject(Frozen):
    """An object of ``pipeline.catalogue.objects``, by name and content.

    Attributes:
        licence, attribution: what it may be shown under and who made it, so that they go where the data goes.
    """

    name: str
    category: str
    sha256: str
    licence: str
    attribution: str

    @classmethod
    def of(cls, model: ObjectModel) -> AddedObject:
        return cls(**{field: getattr(model, field) for field in cls.model_fields})


class LayoutPerturbation(PhysicsPerturbation):
    """Objects added to the scene.

    Attributes:
        objects: which; as many as the level.
        seed: keys the places that are tried for them. Where they end is in the trajectory's ``resolved``.
    """

    axis: Literal["layout"] = "layout"
    component: Literal["objects"] = "objects"
    objects: Annotated[tuple[AddedObject, ...], Field(min_length=1)]
    seed: int

    measure: ClassVar[str] = "infinite where no category is shared with a test task in the same scene, else 0"
    clearance: ClassVar[float] = 1.0

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        # Drawing a plan must not load the simulator.
        from pipeline.scenes.placement import place

        return place(scene, demo, [find(added.name, added.sha256) for added in self.objects], self.seed, roll_out)

    def named_in(self, instruction: str) -> bool:
        """Whether the instruction has a word for an added object, or for one that looks alike."""
        words = words_in(instruction)
        return any(nouns_of(added.category) & words for added in self.objects)

    same: ClassVar[Same | None] = "scene"

    def distances_on(self, test: TestSet, task: Task) -> list[float]:
        """By category: infinite where a test task in this scene adds nothing of the same category.

        The rule is stricter than a distance between positions: every position of a shared category counts as 0 m.
        """
        return [self._apart_from(_plain(other.parameters["category"])) for other in test.on(task, "layout", "scene")]

    def apart(self, others: Sequence[LayoutPerturbation]) -> Floats:
        return np.array([self._apart_from(added.category for added in other.objects) for other in others])

    def _apart_from(self, categories: Iterable[str]) -> float:
        return math.inf if {added.category for added in self.objects}.isdisjoint(categories) else 0.0

    def credits(self) -> frozenset[Credit]:
        return frozenset(Credit(o.name, "object", o.licence, o.attribution) for o in self.objects)


class LayoutAxis(Axis):
    """How many objects, and where from.

    The level is the number of objects, 1 to 5 as in LIBERO-Plus. An object is never of a category that is in the scene
    already or that the instruction names, nor of one that the test set adds. The same model may come twice, two models
    of one category never: a scene's objects are drawn with replacement from ``SHELF`` models of different categories,
    because that is how often LIBERO-Plus repeats its 13 (in 6, 21, 42 and 60 % of its scenes with 2, 3, 4 and 5).

    Attributes:
        sources: ``libero`` and ``robosuite`` are installed; ``sweethome3d`` (fetched by apt-get, 120 MB) and folders of
            the user's are converted when a plan first draws from them.
        area_m2: the most that the objects take up together, each of them at most its share: the more objects, the
            smaller (0.12 m2 is what the broadest object of all takes up).
    """

    draws: ClassVar = (LayoutPerturbation,)

    sources: Annotated[tuple[Source, ...], Field(min_length=1)] = ("libero", "robosuite")
    area_m2: float = Field(default=0.12, gt=0.0, le=10.0)

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """By the number of added objects."""
        return int(tested.parameters["count"])

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> LayoutPerturbation:
        level = self.draw_level(rng)
        fitting = _fitting(self.sources, task)
        shelf: dict[str, ObjectModel] = {}
        for index in rng.permutation(len(fitting)):
            if fitting[index].shape.footprint_m2 <= self.area_m2 / level and len(shelf) < SHELF:
                shelf.setdefault(fitting[index].category, fitting[index])
        if len(shelf) < level:
            raise PipelineError(
                f"{len(shelf)} categories of objects go with {task}, {level} are wanted",
                where="plan.axes.layout",
                remedy="add sources, widen area_m2 or leave out the higher levels",
            )
        choice = list(shelf.values())
        objects = tuple(AddedObject.of(choice[index]) for index in rng.integers(len(choice), size=level))
        return LayoutPerturbation(level=level, objects=objects, seed=int(rng.integers(2**31)))

    def offered(self) -> dict[str, int]:
        found = models(self.sources).values()
        return {"models": len({one.sha256 for one in found}), "categories": len({one.category for one in found})}


@cache
def _fitting(sources: tuple[Source, ...], task: Task) -> list[ObjectModel]:
    """The objects that are of another category than everything in a task's scene."""
    there = taken(task)
    return [model for model in models(sources).values() if goes_with(model, there)]


def _plain(categories: object) -> list[str]:
    """Category names without the number that some of LIBERO-Plus's end in."""
    return [name.rpartition("__")[0] or name for name in str(categories).split(",")]
