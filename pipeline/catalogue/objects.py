"""Small objects that can be added to a scene: no category of the test set's, and nouns that cannot be confused."""

import re
from functools import cache

from pipeline.catalogue.object_model import ObjectModel
from pipeline.catalogue.object_sources import AGAIN, Source, catalogue, converted, offered
from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.origins import REINSTALL
from pipeline.types import Task

TEST_CATEGORIES = frozenset(
    {
        *("bag_of_yeast", "bottle_of_alfredo_sauce", "bottle_of_antihistamines", "bottle_of_aspirin"),
        *("bottle_of_baby_oil", "bottle_of_barbecue_sauce", "box_of_shampoo", "box_of_vegetable_juice"),
        *("box_of_yogurt", "boxed_ink_cartridge", "can_of_sardines", "can_of_soda", "canned_food"),
    }
)
"""Categories of objects that LIBERO-Plus's test tasks add.

They come from its ``<base>_add_<n>.bddl``, without the ``__1`` that some names end in.
"""


ALIKE = ({"bowl", "ramekin", "ashtray"}, {"mug", "glass", "measure", "creamer"}, {"pot", "teapot", "kettle"})
"""Groups of nouns whose objects look alike, judged from the models by eye."""


@cache
def models(sources: tuple[Source, ...]) -> dict[str, ObjectModel]:
    """Collect the objects of some sources: name to object, sorted by name.

    Sources that are not installed are fetched and converted first. A plan does this once, before it samples anything.

    Raises:
        PipelineError: when a source cannot be fetched or read, or has an object of the test set's categories.
    """
    members: list[ObjectModel] = []
    for source in sources:
        members += offered(source)
    for model in members:
        if is_of_test_set(model.category):
            raise PipelineError(
                f"{model.name} is of the category {model.category}, which the test set adds to its scenes",
                where=model.mjcf,
                remedy="leave the object out of its source",
            )
    return {model.name: model for model in sorted(members, key=lambda model: model.name)}


def find(name: str, sha256: str) -> ObjectModel:
    """Return the object of the given name and content.

    Nothing is fetched or converted, because many workers may call this function at once.

    Raises:
        PipelineError: when the object is missing, or its content differs from the recorded hash.
    """
    installed = models(("libero", "robosuite")).get(name)
    model = installed or converted(name)
    if model.sha256 != sha256:
        raise PipelineError(
            f"the object {name} differs from the planned object",
            where=model.mjcf,
            remedy=REINSTALL if installed else f"move its folder away and run {AGAIN}",
        )
    return model


def category_in(model_type: str) -> str:
    """Return the category of one of LIBERO's types, such as ``bowl`` for ``akita_black_bowl``.

    A type without a category is its own category.
    """
    for category, members in catalogue()["libero"].items():
        types = [member.rpartition("/")[2] for member in members]
        if model_type in types:
            return str(category)
    return model_type


@cache
def taken(task: Task) -> frozenset[str]:
    """Return the categories in a task's scene, and the words that its scene and instruction use."""
    scene = bddl.read(task.bddl_file)
    types = [*scene.objects.values(), *scene.fixtures.values()]
    categories = frozenset(map(category_in, types))
    text = " ".join([*types, task.instruction]).replace("_", " ")
    return categories | words_in(text)


def words_in(text: str) -> frozenset[str]:
    """Return the words of a text in lower case; words that end in s are included without the s too."""
    words = re.findall(r"[a-z]+", text.lower())
    singulars = [word.removesuffix("s") for word in words]
    return frozenset({*words, *singulars})


def goes_with(model: ObjectModel, names: frozenset[str]) -> bool:
    """Return whether no name in ``names`` is an object's category, its noun, or the noun of a similar object."""
    return not nouns_of(model.category) & names


def nouns_of(category: str) -> frozenset[str]:
    """Return a category, its nouns, and the nouns of objects that look alike.

    ``bottle_of_milk`` has two nouns, because an instruction may ask for the milk.
    """
    nouns = {part.split("_")[-1] for part in category.split("_of_")}
    groups = [alike for alike in ALIKE if nouns & alike]
    return frozenset({category, *nouns}).union(*groups)


def is_of_test_set(category: str) -> bool:
    """Return whether the test set adds objects of a category, by its words.

    ``soda_can`` and ``soda`` are ``can_of_soda``.
    """
    words = set(category.split("_")) - {"of"}
    for tested in TEST_CATEGORIES:
        content = tested.rpartition("_of_")[2]
        if words in (set(tested.split("_")) - {"of"}, set(content.split("_"))):
            return True
    return False
