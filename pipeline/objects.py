"""Small objects that can be added to a scene, from several sources behind one interface.

``libero`` and ``robosuite`` are installed with the pipeline. ``sweethome3d`` (Debian's package of furniture models, CC0
and CC-BY) and ``own`` (a folder of the user's) are converted once, by ``pipeline.object_sources``, into ``FOLDER``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml
from libero.libero import get_libero_path

from pipeline.assets import package_folder
from pipeline.errors import PipelineError
from pipeline.object_model import ObjectModel
from pipeline.types import Task

Source = Literal["libero", "robosuite", "sweethome3d", "own"]

FOLDER = Path("data/objects")
"""Where converted models lie, one folder each: ``<source>/<name>/model.xml`` and ``about.json``."""
CATALOGUE = Path(__file__).parent / "axes" / "layout_objects.yaml"

TEST_CATEGORIES = frozenset(
    {
        *("bag_of_yeast", "bottle_of_alfredo_sauce", "bottle_of_antihistamines", "bottle_of_aspirin"),
        *("bottle_of_baby_oil", "bottle_of_barbecue_sauce", "box_of_shampoo", "box_of_vegetable_juice"),
        *("box_of_yogurt", "boxed_ink_cartridge", "can_of_sardines", "can_of_soda", "canned_food"),
    }
)
"""What LIBERO-Plus's test tasks add (its ``<base>_add_<n>.bddl``, without the ``__1`` that some names end in)."""


@cache
def models(sources: Sequence[Source]) -> dict[str, ObjectModel]:
    """The objects of these sources, by name, in a fixed order.

    Raises:
        PipelineError: when a source has not been prepared.
    """
    found = [model for source in sources for model in _LISTS[source](source)]
    for model in found:
        if model.category in TEST_CATEGORIES:
            raise PipelineError(
                f"{model.name} is of the category {model.category}, which the test set adds to its scenes",
                where=model.mjcf,
                remedy="leave it out",
            )
    return {model.name: model for model in sorted(found, key=lambda model: model.name)}


def find(name: str, sha256: str) -> ObjectModel:
    """The object of that name and content.

    Raises:
        PipelineError: when it is not here, or not the one that was recorded.
    """
    source: Any = name.split("/")[0]
    model = models((source,)).get(name) if source in _LISTS else None
    if model is None or model.sha256 != sha256:
        raise PipelineError(
            f"the object {name} is {'missing' if model is None else 'not the one that was planned with'}",
            where=FOLDER,
            remedy="prepare the objects again, then run the plan stage again",
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
    text = task.bddl_file.read_text()
    declared = re.findall(r"\(:(?:objects|fixtures)([^()]*)\)", text)
    types = [name for section in declared for name in re.findall(r"-\s+(\w+)", section)]
    words = re.findall(r"[a-z]+", " ".join([*types, task.instruction.lower()]).replace("_", " "))
    return frozenset({*map(category_in, types), *words, *(word.removesuffix("s") for word in words)})


def goes_with(model: ObjectModel, names: frozenset[str]) -> bool:
    """Whether an object is of another category than everything in ``names``, and called by another noun."""
    noun = model.category.split("_of_")[0].split("_")[-1]
    return not {model.category, noun} & names


@cache
def catalogue() -> dict[str, dict[str, Any]]:
    catalogue: dict[str, dict[str, Any]] = yaml.safe_load(CATALOGUE.read_text())
    return catalogue


def _libero(_: Source) -> Iterator[ObjectModel]:
    assets = Path(get_libero_path("assets")).resolve()
    for category, members in catalogue()["libero"].items():
        for member, up in members.items():
            stem = member.rpartition("/")[2]
            mjcf = assets / member / f"{stem}.xml"
            if mjcf.is_file():  # upstream LIBERO lacks LIBERO-PRO's additions
                yield ObjectModel(f"libero/{stem}", "libero", category, "MIT", "LIBERO, LIBERO-PRO", mjcf, up)


def _robosuite(_: Source) -> Iterator[ObjectModel]:
    folder = package_folder("robosuite") / "models" / "assets" / "objects"
    for category, members in catalogue()["robosuite"].items():
        for stem, up in members.items():
            yield ObjectModel(
                f"robosuite/{stem}", "robosuite", category, "MIT", "robosuite", folder / f"{stem}.xml", up
            )


def _prepared(source: Source) -> Iterator[ObjectModel]:
    folders = sorted(path.parent for path in (FOLDER / source).glob("*/about.json"))
    if not folders:
        raise PipelineError(
            f"the objects of {source} have not been prepared",
            where=FOLDER / source,
            remedy="python -m pipeline objects  (or leave this source out of plan.axes.layout.sources)",
        )
    for folder in folders:
        about = json.loads((folder / "about.json").read_text())
        yield ObjectModel(f"{source}/{folder.name}", source, **about, mjcf=folder / "model.xml")


_LISTS = {"libero": _libero, "robosuite": _robosuite, "sweethome3d": _prepared, "own": _prepared}
