"""Small objects that can be added to a scene: of no category of the test set's, with nouns that cannot be confused."""

import re
from functools import cache

from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.object_sources import AGAIN, Source, catalogue, converted, offered
from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.types import Task

TEST_CATEGORIES = frozenset(
    {
        *("bag_of_yeast", "bottle_of_alfredo_sauce", "bottle_of_antihistamines", "bottle_of_aspirin"),
        *("bottle_of_baby_oil", "bottle_of_barbecue_sauce", "box_of_shampoo", "box_of_vegetable_juice"),
        *("box_of_yogurt", "boxed_ink_cartridge", "can_of_sardines", "can_of_soda", "canned_food"),
    }
)
"""What LIBERO-Plus's test tasks add (its ``<base>_add_<n>.bddl``, without the ``__1`` that some names end in)."""


ALIKE = ({"bowl", "ramekin", "ashtray"}, {"mug", "glass", "measure", "creamer"}, {"pot", "teapot", "kettle"})
"""Groups of nouns whose objects look alike, judged by looking at the models."""


@cache
def models(sources: tuple[Source, ...]) -> dict[str, ObjectModel]:
    """The objects of these sources, by name, in a fixed order.

    What is not installed is fetched and converted first, which a plan does once, before its first draw.

    Raises:
        PipelineError: when a source cannot be had, or holds what must not be added.
    """
    members = [model for source in sources for model in offered(source)]
    for model in members:
        if model.category in TEST_CATEGORIES:
            raise PipelineError(
                f"{model.name} is of the category {model.category}, which the test set adds to its scenes",
                where=model.mjcf,
                remedy="leave it out",
            )
    return {model.name: model for model in sorted(members, key=lambda model: model.name)}


def find(name: str, sha256: str) -> ObjectModel:
    """The object of that name and content; nothing is fetched or converted, as many workers may ask at once.

    Raises:
        PipelineError: when it is not here, or not the one that was recorded.
    """
    installed = models(("libero", "robosuite")).get(name)
    model = installed or converted(name)
    if model.sha256 != sha256:
        raise PipelineError(
            f"the object {name} is not the one that was planned with",
            where=model.mjcf,
            remedy="rm -rf .venv && bash setup.sh" if installed else f"move its folder away and run {AGAIN}",
        )
    return model


def category_in(model_type: str) -> str:
    """The category of one of LIBERO's types, such as ``bowl`` for ``akita_black_bowl``; itself when it has none."""
    for category, members in catalogue()["libero"].items():
        if any(member.rpartition("/")[2] == model_type for member in members):
            return str(category)
    return model_type


@cache
def taken(task: Task) -> frozenset[str]:
    """Categories that are in a task's scene, and words that its scene and instruction use."""
    scene = bddl.read(task.bddl_file)
    types = [*scene.objects.values(), *scene.fixtures.values()]
    return frozenset(map(category_in, types)) | words_in(" ".join([*types, task.instruction]).replace("_", " "))


def words_in(text: str) -> frozenset[str]:
    """The words of a text in lower case, those that end in s without it too."""
    words = re.findall(r"[a-z]+", text.lower())
    return frozenset({*words, *(word.removesuffix("s") for word in words)})


def goes_with(model: ObjectModel, names: frozenset[str]) -> bool:
    """Whether an object is of another category than everything in ``names``, and cannot be meant by another's noun."""
    return not nouns_of(model.category) & names


def nouns_of(category: str) -> frozenset[str]:
    """A category, its noun, and the nouns of objects that look alike."""
    noun = category.split("_of_")[0].split("_")[-1]
    return frozenset({category, noun}).union(*(alike for alike in ALIKE if noun in alike))
