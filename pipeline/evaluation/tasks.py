"""The tasks that policies are evaluated on: what names one, LIBERO's initial states, and other goals.

LIBERO's tasks can be asked for another object of their scene, which the instruction and the BDDL goal name then. A
policy that knows a scene by heart does what it always did there. The scene, the initial states and the predicates are
LIBERO's own, so its environment judges the new goal.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from itertools import zip_longest
from typing import Any, Literal

import numpy as np

from pipeline import seeding
from pipeline.axes.language_goal import found, pattern, thing_words, words
from pipeline.catalogue.object_sources import offered
from pipeline.errors import PipelineError
from pipeline.grouping import grouped
from pipeline.libero import bddl
from pipeline.libero.assets import libero_folder
from pipeline.libero.bddl import Bddl
from pipeline.libero.tasks import SUITES, tasks
from pipeline.types import Floats, Task

Source = Literal["libero", "libero_plus", "own", "goals"]

Prompt = Literal["clean", "benchmark", "blank"]
"""What a policy is told: LIBERO's instruction; in test tasks what the benchmark's code takes for it, the name of the
task's file ("turn on the stove view 0 0 100 2 352 initstate 0"); or nothing at all."""


@dataclass(frozen=True, order=True)
class EvaluationTask:
    """One thing to do in one scene; all else is looked up by these.

    Attributes:
        source: ``libero``, ``libero_plus``, ``own`` for held-out perturbations on one or more of this project's axes,
            or ``goals`` for a LIBERO task that asks for another object of its scene.
        suite, base: of the LIBERO task.
        name: of the test task in LIBERO-Plus; else made of what follows, once among the tasks of its source and suite.
        axis, component: what is perturbed, several joined by +; ``clean`` where nothing is. In ``goals`` the component
            is the category of the object that is asked for.
        level: strength, 1 to 5, of all that is drawn; 0 where nothing tells.
        number: which draw (``own``), and which of LIBERO's initial states; 0 in ``libero_plus``.
    """

    source: Source
    suite: str
    base: str
    name: str
    axis: str
    component: str
    level: int
    number: int

    def __str__(self) -> str:
        return f"{self.source}/{self.suite}/{self.name}"

    def for_harness(self) -> dict[str, Any]:
        """As vla-eval takes a task, by a ``name`` that no other has; the task's own is ``task_name``."""
        return {**asdict(self), "name": str(self), "task_name": self.name}

    @classmethod
    def of_harness(cls, task: Mapping[str, Any]) -> EvaluationTask:
        """The task that ``for_harness`` gave, or one of the harness's own LIBERO class, which numbers tasks.

        The harness names tasks by instruction, which 16 tasks of LIBERO-90 share with one of another scene.

        Raises:
            PipelineError: when LIBERO's suite has no task of this number and instruction.
        """
        if "source" in task:
            return cls(**{name: task[name] for name in cls.__dataclass_fields__} | {"name": task["task_name"]})
        listed, number = tasks(task["suite"]), int(task["task_id"])
        if not 0 <= number < len(listed) or listed[number].instruction != task["name"]:
            raise PipelineError(
                f"{task['suite']} has no task {number} {task['name']!r}",
                where="task of the harness",
                expected="LIBERO's own number and instruction of the task",
            )
        return libero_task(listed[number], int(task.get("episode_idx", 0)))


def libero_task(task: Task, number: int) -> EvaluationTask:
    """LIBERO's own task, from its initial state of that number."""
    return EvaluationTask("libero", task.suite, task.name, f"{task.name}_state{number}", "clean", "clean", 0, number)


@cache
def libero_states(task: Task) -> Floats:
    """(50, S) the initial states that LIBERO evaluates a task from: time, qpos, qvel."""
    with np.load(libero_folder() / "init_files" / task.suite / f"{task.name}.pruned_init.npz") as arrays:
        return np.asarray(arrays["states"], np.float64)


def balanced(wanted: Iterable[EvaluationTask], count: int, seed: int) -> list[EvaluationTask]:
    """At most ``count`` tasks: axes in turn, of each axis its components in turn, then levels, then suites.

    A larger subset under the same seed holds the smaller one.
    """
    return sorted(_in_turn(list(wanted), ("axis", "component", "level", "suite"), seed)[:count])


def _in_turn(wanted: list[EvaluationTask], columns: tuple[str, ...], seed: int) -> list[EvaluationTask]:
    """All tasks, one of each value of the first column after the other, of each value by the columns that follow."""
    if not columns:
        return sorted(wanted, key=lambda task: seeding.digest("subset", seed, str(task)))
    column, *rest = columns
    groups = grouped((getattr(task, column), task) for task in wanted)
    names = sorted(groups, key=lambda name: seeding.digest("turn", seed, column, name, str(min(groups[name]))))
    rows = [_in_turn(groups[name], tuple(rest), seed) for name in names]
    return [task for turn in zip_longest(*rows) for task in turn if task is not None]


@dataclass(frozen=True)
class Replacement:
    """Another object in the place of the one that a task's goal puts somewhere.

    Attributes:
        old, new: names in the BDDL file.
        instruction: LIBERO's, with the new object's words.
    """

    old: str
    new: str
    category: str
    instruction: str

    def name(self, task: Task, number: int) -> str:
        """Of the evaluation task that begins in LIBERO's initial state of that number."""
        return f"{task.name}_goal_{self.old}_{self.new}_state{number}"

    def bddl_text(self, task: Task) -> str:
        """The task's file with the new object in its goal; objects and regions stay, and so do initial states."""
        text = task.bddl_file.read_text()
        start = text.index("(:goal")
        return text[:start] + re.sub(rf"\b{self.old}\b", self.new, text[start:])


WHICH = r".*?(?= and (?:place|put)\b)| (?:at|on|in) the (?:back|front|left|middle|right)(?! of)\b"
"""What says which of several things of a category is meant, after the words for it."""


@cache
def replacements(task: Task) -> tuple[Replacement, ...]:
    """All that can take the place of an object that the task's goal puts somewhere.

    The new object can be moved, carries nothing, is not in the goal yet and is not what names the place, as the plate
    does for a region beside it. It is the only one of its category, and its words mean it alone. It fits where the old
    one goes: one of LIBERO's 130 tasks puts an object of its category on or in a thing of the same kind, or it is no
    larger than an object that one of them puts there.
    """
    known = bddl.read(task.bddl_file)
    named = {word for fact in known.goal for word in fact}
    carrying = {place for thing, place in known.places.items() if thing in known.objects}
    kinds = list(known.objects.values())
    possible = []
    for old in known.targets:
        if [known.objects[target] for target in known.targets].count(known.objects[old]) > 1:
            continue  # "both moka pots" has no words for one of them
        relation, place = next((fact[0], fact[2]) for fact in known.goal if fact[1] == old)
        beside = known.beside(place)
        taken = {*known.receptacles, *carrying, *named, *(beside.things if beside else ())}
        for new, category in known.objects.items():
            if new in taken or kinds.count(category) > 1 or not _fits(category, relation, place, known):
                continue
            if (instruction := _reworded(task, old, category)) is not None:
                possible.append(Replacement(old, new, category, instruction))
    return tuple(possible)


def find_replacement(task: Task, name: str) -> Replacement:
    """The replacement that the name of an evaluation task says; refused when the task has none of that name."""
    named = {one.name(task, 0).rpartition("_")[0]: one for one in replacements(task)}
    asked = name.rpartition("_")[0]
    if asked not in named:
        others = " or ".join(named) or "a task with other objects"
        raise PipelineError(f"{task.suite} has no goal {asked!r}", expected=others)
    return named[asked]


def _fits(category: str, relation: str, place: str, known: Bddl) -> bool:
    """Whether an object of a category can be where a goal puts another one; anywhere on the working surface it can."""
    if place in known.regions:
        return True
    there, sides = _put()[relation, _kind(place, known)], 3 if relation == "in" else 2
    return category in there or any((_size_m(category) <= _size_m(other))[:sides].all() for other in there)


@cache
def _size_m(category: str) -> Floats:
    """(3,) shorter and longer side of an object's footprint, and its height; NaN where its model is not known."""
    model = next((model for model in offered("libero") if model.name == f"libero/{category}"), None)
    size_m = np.full(3, np.nan) if model is None else np.subtract(model.shape.high_m, model.shape.low_m)
    return np.array([*sorted(size_m[:2]), size_m[2]])


@cache
def _put() -> Mapping[tuple[str, str], set[str]]:
    """Relation and kind of place to the categories that LIBERO's tasks put there."""
    there: dict[tuple[str, str], set[str]] = defaultdict(set)
    for known in (bddl.read(task.bddl_file) for suite in SUITES for task in tasks(suite)):
        for fact in known.goal:
            if len(fact) == 3 and fact[1] in known.objects:
                there[fact[0], _kind(fact[2], known)].add(known.objects[fact[1]])
    return there


def _kind(place: str, known: Bddl) -> str:
    """A place by its thing's category: ``basket_contain_region`` for ``basket_1_contain_region``."""
    thing = known.owner(place) or ""
    return known.category(thing) + place.removeprefix(thing)


def _reworded(task: Task, old: str, category: str) -> str | None:
    """The instruction with the words for another category in the place of those for ``old``, and of the phrase that
    says which of several it is: ``between the plate and the ramekin``, ``at the back``.

    `None` if that would be no plain sentence about one thing: the words for ``old`` stand in it twice or not at all, or
    the new words also mean another thing of the scene.
    """
    known = bddl.read(task.bddl_file)
    old_category, new_words = known.objects[old], _words(task.suite, category)
    scene = thing_words(tuple(dict.fromkeys(map(known.category, known.things))), hints=False)
    mentions = [match for match, kinds in found(task.instruction, scene) if old_category in kinds]
    if len(mentions) != 1 or _means_another(new_words, category, known):
        return None
    before, after = task.instruction[: mentions[0].start()], task.instruction[mentions[0].end() :]
    if list(known.objects.values()).count(old_category) > 1:
        after = re.sub(f"^(?:{WHICH})", "", after)
    return f"{before}{new_words}{after}"


def _means_another(text: str, category: str, known: Bddl) -> bool:
    """Whether a thing of another category in the scene is called so too."""
    others = {known.category(thing) for thing in known.things} - {category}
    meant = thing_words(tuple(others), hints=False)
    return pattern(tuple(meant)).fullmatch(text) is not None


@cache
def _words(suite: str, category: str) -> str:
    """What LIBERO's instructions call the only thing of a category, in this suite if they do.

    Raises:
        PipelineError: when no instruction in a scene that has one of it calls it by any of its names.
    """
    for among in ((suite,), SUITES):
        scenes = [(task, bddl.read(task.bddl_file)) for one in among for task in tasks(one)]
        told = [task.instruction for task, known in scenes if list(known.objects.values()).count(category) == 1]
        for name in words().things[category].names:
            for instruction in told:
                if match := pattern((name,)).search(instruction):
                    return match[0]
    raise PipelineError(f"LIBERO's instructions have no words for {category}", where="language_words.yaml")
