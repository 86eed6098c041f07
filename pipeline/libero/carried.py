"""Tasks carried to the scene of another task: the goal of one BDDL file in the scene of another.

A thing of the goal is found in the other scene by its category. If a scene has several things of the category, the
thing must stand at the same place in both scenes, because the instruction tells them apart by their places.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl, Fact
from pipeline.libero.tasks import IN_SCENE, find_task
from pipeline.types import Task


class CannotCarryError(ValueError):
    """The goal of a task has no meaning in a scene; the message states why in plain words."""


def carry(task: Task, scene: Task) -> Task:
    """Return ``task`` in the scene of the task ``scene``: instruction and goal of the first, start of the second."""
    return replace(task, bddl_file=scene.bddl_file, goal_file=task.bddl_file)


def file_name(task: Task) -> str:
    """Return the name of a task for files, without suffix; that of a carried task names the scene too."""
    return task.name if task.goal_file is None else f"{task.name}{IN_SCENE}{task.bddl_file.stem}"


def task_named(suite: str, name: str) -> Task:
    """Return the task with the ``file_name`` ``name``.

    Raises:
        PipelineError: when the suite has no such task, or no task of this scene.
    """
    own, _, scene = name.partition(IN_SCENE)
    return carry(find_task(suite, own), find_task(suite, scene)) if scene else find_task(suite, own)


def definition_of(task: Task) -> Bddl:
    """Return the definition of a task: of its file, with the goal of the other file if the task is carried.

    Raises:
        CannotCarryError: if the goal has no meaning in the scene.
        PipelineError: if a file cannot be read or does not define a task.
    """
    return bddl.read(task.bddl_file) if task.goal_file is None else _joined(task.bddl_file, task.goal_file)


def bddl_text(task: Task) -> str:
    """Return the BDDL text of a task, which LIBERO's environment can load.

    For a carried task, this is the scene's text without comments, with the instruction and the goal of the task.
    """
    text = task.bddl_file.read_text(encoding="utf-8")
    if task.goal_file is None:
        return text
    joined = definition_of(task)
    sections = {
        ":language": joined.language,
        ":obj_of_interest": " ".join(joined.of_interest),
        ":goal": bddl.goal_text(joined.goal),
    }
    return bddl.replace_sections(text, sections)


def counterparts(scene: Bddl, task: Bddl) -> dict[str, str]:
    """Map each object and fixture that a task's goal refers to, to the thing of another scene that takes its part.

    Raises:
        CannotCarryError: if the scene has no such thing, or has it at another place or in another state.
    """
    named: dict[str, None] = {}
    for _, *arguments in task.goal:
        named |= dict.fromkeys(filter(None, map(task.owner, arguments)))
    names: dict[str, str] = {}
    for thing in named:
        names[thing] = _counterpart(thing, scene, task, [*named])
    for thing, found in names.items():
        what = _words(task, thing)
        if _states(task, thing, thing) != _states(scene, found, thing):
            raise CannotCarryError(f"the {what} is open, closed or lit where it is not in the demonstration")
        if _supports(task, thing) != _supports(scene, found):
            raise CannotCarryError(f"the {what} stands on or in another thing")
        if _loads(scene, found) - _loads(task, thing):
            raise CannotCarryError(f"something stands on or in the {what}")
    return names


def all_counterparts(task: Task) -> dict[str, str]:
    """Map things and places of a carried task's own scene to their names in the scene that it is carried to.

    In addition to the things of the goal, a thing has a counterpart if one of its category stands at the same place.
    A place of the working surface has one only if the goal names it: scenes give one name to different places.
    """
    if task.goal_file is None:
        raise ValueError(f"{task} is not carried to another scene")
    scene, own = bddl.read(task.bddl_file), bddl.read(task.goal_file)
    names = counterparts(scene, own)
    thing_at = {place: thing for thing, place in scene.scene_names.items()}
    for thing, place in own.scene_names.items():
        if thing not in names and place in thing_at and thing_at[place] not in names.values():
            names[thing] = thing_at[place]
    for _, *arguments in own.goal:
        names |= {region: _renamed(region, scene, own, names) for region in arguments if region in own.regions}
    return names


def _counterpart(thing: str, scene: Bddl, task: Bddl, named: list[str]) -> str:
    """Return the thing of a scene that takes the part of a thing of the goal."""
    category, what = task.category(thing), _words(task, thing)
    here, there = _alike(scene, category), _alike(task, category)
    if not here:
        raise CannotCarryError(f"the scene has no {what}")
    if len(here) == len(there) == 1:
        return here[0]
    if len(here) == len(there) and set(there) <= set(named):
        return here[there.index(thing)]  # The goal is about all things of the category.
    spot = _spot(task, thing)
    at_place = [other for other in here if _spot(scene, other) == spot]
    if len(at_place) != 1:
        raise CannotCarryError(f"no {what} stands at its place in the demonstration, by which the instruction names it")
    return at_place[0]


@cache
def _joined(scene_file: Path, goal_file: Path) -> Bddl:
    """Return the scene of one file with the goal of another."""
    scene, task = bddl.read(scene_file), bddl.read(goal_file)
    names = counterparts(scene, task)
    facts = []
    for predicate, *arguments in task.goal:
        facts.append((predicate, *(_renamed(argument, scene, task, names) for argument in arguments)))
    if all(_holds_at_start(fact, scene) for fact in facts):
        raise CannotCarryError("the goal holds at the start")
    of_interest = tuple(names[name] for name in task.of_interest if name in names)
    return replace(scene, language=task.language, goal=tuple(facts), of_interest=of_interest)


def _renamed(name: str, scene: Bddl, task: Bddl, names: Mapping[str, str]) -> str:
    """Return the name in the scene of a thing or a region of the goal."""
    owner = task.owner(name)
    renamed = name if owner is None else names[owner] + name.removeprefix(owner)
    if name in task.regions and renamed not in scene.regions:
        raise CannotCarryError("the scene has no such place on its surface")
    return renamed


def _holds_at_start(fact: Fact, scene: Bddl) -> bool:
    return fact in scene.start


def _alike(definition: Bddl, category: str) -> list[str]:
    """List the things of a category, sorted by name."""
    things = {**definition.objects, **definition.fixtures}
    return sorted(name for name, kind in things.items() if kind == category)


def _spot(definition: Bddl, thing: str) -> str:
    """Return the place of a thing in words that all scenes share; empty for a thing without a place."""
    return definition.scene_names.get(thing, "").partition(" #")[0]


def _states(definition: Bddl, thing: str, shown_as: str) -> set[tuple[str, str]]:
    """Return the states of a thing and its parts at the start, with the thing called ``shown_as``."""
    states = set()
    for fact in definition.start:
        if len(fact) == 2 and definition.owner(fact[1]) == thing:
            states.add((fact[0], shown_as + fact[1].removeprefix(thing)))
    return states


def _supports(definition: Bddl, thing: str) -> list[str]:
    """List the categories and parts that a thing stands on or in, without the working surface."""
    supports = []
    place = definition.places.get(thing, "")
    while place and place not in definition.regions:
        owner = definition.owner(place)
        if owner is None:
            break
        supports.append(definition.category(owner) + place.removeprefix(owner))
        place = definition.places.get(owner, "")
    return supports


def _loads(definition: Bddl, thing: str) -> Counter[str]:
    """Count the categories of the things that stand on or in a thing; nothing for the working surface."""
    if thing not in definition.places:
        return Counter()
    loads = [other for other, place in definition.places.items() if definition.owner(place) == thing]
    return Counter(map(definition.category, loads))


def _words(definition: Bddl, thing: str) -> str:
    return definition.category(thing).replace("_", " ")
