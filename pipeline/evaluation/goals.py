"""Tasks of the source ``goals``: another goal in the scene of a LIBERO task.

A replaced goal asks for another object of a LIBERO scene, which the instruction and the BDDL goal name. A carried goal
is that of another LIBERO task. A policy that has memorised the scene repeats the original task. The scene, the initial
states and the predicates are LIBERO's own, so LIBERO's environment judges the new goal.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from pipeline.axes.goal import held_out_pairs, level_of_pair
from pipeline.axes.language_goal import compile_pattern, find_words, read_words, thing_words
from pipeline.catalogue.object_sources import offered
from pipeline.errors import PipelineError
from pipeline.evaluation.held_out import planned
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl
from pipeline.libero.carried import carry, definition_of
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.types import Floats, Task

CARRIED = "_task_"
"""Text between the names of a scene's task and of the task whose goal is carried to the scene."""

SELECTING_PHRASE = r".*?(?= and (?:place|put)\b)| (?:at|on|in) the (?:back|front|left|middle|right)(?! of)\b"
"""Pattern of the phrase after the words for a thing that selects one of several things of its category."""


@dataclass(frozen=True)
class Replacement:
    """Replacement of the object that a task's goal puts somewhere.

    Attributes:
        old, new: names of the two objects in the BDDL file.
        category: category of the new object.
        instruction: LIBERO's instruction with the new object's words.
    """

    old: str
    new: str
    category: str
    instruction: str

    def name(self, task: Task, number: int) -> str:
        """Return the name of the evaluation task that begins in LIBERO's initial state with a number."""
        return f"{task.name}_goal_{self.old}_{self.new}_state{number}"

    def bddl_text(self, task: Task) -> str:
        """Return the task's BDDL text with the new object in its goal.

        Objects, regions and initial states do not change.
        """
        facts = []
        for predicate, *arguments in bddl.read(task.bddl_file).goal:
            facts.append((predicate, *(self.new if name == self.old else name for name in arguments)))
        text = task.bddl_file.read_text(encoding="utf-8")
        return bddl.replace_sections(text, {":goal": bddl.goal_text(facts)})


@cache
def list_replacements(task: Task) -> tuple[Replacement, ...]:
    """List the replacements of the objects that a task's goal puts somewhere.

    A new object can be moved and carries nothing. It is not in the goal yet, and the place is not named after it (a
    region next to a plate is named after the plate). It is the only object of its category, and its words mean it
    alone.

    No task of LIBERO asks for the new goal.

    The new object fits in the old object's place if one of LIBERO's 130 tasks puts its category on or in a thing of
    this kind. It also fits if it is no larger than an object that one of these tasks puts there.
    """
    scene = bddl.read(task.bddl_file)
    goal_names: set[str] = set()
    for fact in scene.goal:
        goal_names |= set(fact)
    carrying = {place for thing, place in scene.places.items() if thing in scene.objects}
    categories = list(scene.objects.values())
    target_categories = [scene.objects[target] for target in scene.targets]
    possible: list[Replacement] = []
    for old in scene.targets:
        if target_categories.count(scene.objects[old]) > 1:
            continue  # "both moka pots" has no words for one of them
        relation, place = next((fact[0], fact[2]) for fact in scene.goal if fact[1] == old)
        neighbours = scene.neighbours(place)
        taken = {*scene.receptacles, *carrying, *goal_names, *(neighbours.things if neighbours else ())}
        for new, category in scene.objects.items():
            if new in taken or categories.count(category) > 1 or not _fits(category, relation, place, scene):
                continue
            instruction = _reword(task, old, category)
            if instruction is None:
                continue
            replacement = Replacement(old, new, category, instruction)
            if _read_asked(task, replacement) not in _list_libero_goals():
                possible.append(replacement)
    return tuple(possible)


@cache
def _list_libero_goals() -> frozenset[Hashable]:
    """Return the goals of LIBERO's 130 tasks, each in its scene."""
    listed: list[Task] = []
    for suite in SUITES:
        listed += tasks(suite)
    return frozenset(definition_of(task).asked for task in listed)


def find_replacement(task: Task, name: str) -> Replacement:
    """Return the replacement in the name of an evaluation task.

    Raises:
        PipelineError: if the task has no such replacement.
    """
    replacement_of_goal: dict[str, Replacement] = {}
    for replacement in list_replacements(task):
        goal = replacement.name(task, 0).rpartition("_")[0]
        replacement_of_goal[goal] = replacement
    asked = name.rpartition("_")[0]
    if asked not in replacement_of_goal:
        goals = " or ".join(replacement_of_goal) or "a task with other objects"
        raise PipelineError(
            f"{task.suite} has no goal {asked!r}",
            where=f"goals/{task.suite}/{name}",
            expected=goals,
            remedy="select the goals again with this version, or leave this task out",
        )
    return replacement_of_goal[asked]


def _fits(category: str, relation: str, place: str, scene: Bddl) -> bool:
    """Return whether an object of a category fits in a goal's place; every object fits on the working surface."""
    if place in scene.regions:
        return True
    fitting = _collect_put_categories()[relation, _name_kind(place, scene)]
    if category in fitting:
        return True
    sides = 3 if relation == "in" else 2
    return any((_find_size_m(category) <= _find_size_m(larger))[:sides].all() for larger in fitting)


@cache
def _find_size_m(category: str) -> Floats:
    """Return the (3,) size of an object: shorter and longer side of its footprint, and its height.

    The size is NaN if the object's model is not known.
    """
    model = next((model for model in offered("libero") if model.name == f"libero/{category}"), None)
    size_m = np.full(3, np.nan) if model is None else np.subtract(model.shape.high_m, model.shape.low_m)
    return np.array([*sorted(size_m[:2]), size_m[2]])


@cache
def _collect_put_categories() -> Mapping[tuple[str, str], set[str]]:
    """Return relation and kind of a place to the categories of the objects that LIBERO's tasks put there."""
    categories: dict[tuple[str, str], set[str]] = defaultdict(set)
    for suite in SUITES:
        for task in tasks(suite):
            scene = bddl.read(task.bddl_file)
            for fact in scene.goal:
                if len(fact) == 3 and fact[1] in scene.objects:
                    categories[fact[0], _name_kind(fact[2], scene)].add(scene.objects[fact[1]])
    return categories


def _name_kind(place: str, scene: Bddl) -> str:
    """Name a place by its thing's category: ``basket_contain_region`` for ``basket_1_contain_region``."""
    thing = scene.owner(place) or ""
    return scene.category(thing) + place.removeprefix(thing)


def _reword(task: Task, old: str, category: str) -> str | None:
    """Return the instruction with the words for another category in place of the words for ``old``.

    The new words also replace the phrase that selects one of several objects: ``between the plate and the ramekin``,
    ``at the back``.

    Return `None` if the result would not be a plain sentence about one thing: the words for ``old`` are in it twice or
    not at all, or the new words also mean another thing of the scene.
    """
    scene = bddl.read(task.bddl_file)
    old_category, new_words = scene.objects[old], _find_words(task.suite, category)
    scene_words = thing_words(tuple(dict.fromkeys(map(scene.category, scene.things))), hints=False)
    mentions = [match for match, kinds in find_words(task.instruction, scene_words) if old_category in kinds]
    if len(mentions) != 1 or _means_another(new_words, category, scene):
        return None
    before, after = task.instruction[: mentions[0].start()], task.instruction[mentions[0].end() :]
    if list(scene.objects.values()).count(old_category) > 1:
        after = re.sub(f"^(?:{SELECTING_PHRASE})", "", after)
    return f"{before}{new_words}{after}"


def _means_another(text: str, category: str, scene: Bddl) -> bool:
    """Return whether a text also means a thing of another category in the scene."""
    other_categories = {scene.category(thing) for thing in scene.things} - {category}
    other_words = thing_words(tuple(other_categories), hints=False)
    return compile_pattern(tuple(other_words)).fullmatch(text) is not None


@cache
def _find_words(suite: str, category: str) -> str:
    """Find the words of LIBERO's instructions for the only thing of a category, in this suite if possible.

    Raises:
        PipelineError: if no instruction in a scene with one thing of the category has any of its names.
    """
    for suites in ((suite,), SUITES):
        instructions: list[str] = []
        for name in suites:
            for task in tasks(name):
                categories = list(bddl.read(task.bddl_file).objects.values())
                if categories.count(category) == 1:
                    instructions.append(task.instruction)
        for thing_name in read_words().things[category].names:
            for instruction in instructions:
                match = compile_pattern((thing_name,)).search(instruction)
                if match:
                    return match[0]
    raise PipelineError(
        f"LIBERO's instructions have no words for {category}",
        where=f"language_words.yaml, things.{category}.names",
        expected="a name that an instruction of LIBERO has, in a scene with one thing of this category",
        remedy="add this name",
    )


def _read_asked(task: Task, replacement: Replacement) -> Hashable:
    """Return the goal that a replacement asks for, as ``Bddl.asked``."""
    return bddl.parse(replacement.bddl_text(task), str(replacement)).asked


def list_carried_tasks(scene: Task, number: int) -> list[EvaluationTask]:
    """List the held-out goals of other tasks in the scene of a task, in LIBERO's initial state with a number.

    Goals that a replacement asks for as well are left out.
    """
    replaced = {_read_asked(scene, replacement) for replacement in list_replacements(scene)}
    listed = []
    for task, place in sorted(held_out_pairs(scene.suite), key=str):
        if place == scene and definition_of(carry(task, scene)).asked not in replaced:
            name = f"{scene.name}{CARRIED}{task.name}_state{number}"
            strength = level_of_pair(task, scene)
            listed.append(
                EvaluationTask("goals", task.suite, scene.name, name, "goal", "other_scene", strength, number)
            )
    return listed


def find_carried_task(task: EvaluationTask) -> Task | None:
    """Return the LIBERO task that an evaluation task of the source ``goals`` carries to another scene.

    Return ``None`` for a replaced goal.
    """
    if CARRIED not in task.name:
        return None
    return find_task(task.suite, task.name.removeprefix(task.base + CARRIED).rpartition("_state")[0])


def resolve_goal(task: EvaluationTask) -> tuple[Task, Hashable]:
    """Return the LIBERO task of an evaluation task of the source ``goals``, and the goal that it asks for in its scene.

    Raises:
        PipelineError: if there is no such goal.
    """
    base = find_task(task.suite, task.base)
    asked = find_carried_task(task)
    if asked is not None:
        carried_task = carry(asked, base)
        return carried_task, definition_of(carried_task).asked
    replacement = find_replacement(base, task.name)
    return replace(base, instruction=replacement.instruction), _read_asked(base, replacement)


def leave_out_trained_goals(wanted: list[EvaluationTask], plan: Path | None) -> list[EvaluationTask]:
    """Leave out goals that a training plan carries to the same scenes, and print their number."""
    goals = set() if plan is None else planned(plan).goals
    kept = [task for task in wanted if task.source != "goals" or resolve_goal(task)[1] not in goals]
    if len(kept) < len(wanted):
        print(f"left out, because the plan trains on them: {len(wanted) - len(kept)} of {len(wanted)} goals")
    return kept
