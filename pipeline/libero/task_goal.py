"""What a task asks for, as its BDDL file defines it: what goes where, and what is opened, closed, turned on or off.

And what one calls the things and places of it, in plain words, and whether what those words say still holds."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.libero.bddl import Bddl, Fact, read
from pipeline.types import Floats, Task

PARTS = ("top", "middle", "bottom", "left", "right", "front", "back", "center")
"""Words in the names of regions that say which drawer, compartment, side or spot."""

NAMES = {
    "akita_black_bowl": "black bowl",
    "black_book": "book",
    "chefmate_8_frypan": "frying pan",
    "desk_caddy": "caddy",
    "flat_stove": "stove",
    "new_salad_dressing": "salad dressing",
    "porcelain_mug": "white mug",
    "red_coffee_mug": "red mug",
    "white_cabinet": "cabinet",
    "white_yellow_mug": "yellow and white mug",
    "wooden_cabinet": "cabinet",
    "wooden_tray": "tray",
    "wooden_two_layer_shelf": "shelf",
}
"""Kinds that LIBERO's instructions call otherwise."""

SIDES = ("left", "right", "front", "back", "middle")
"""By which things of one kind are told apart."""

INSIDE = {"cabinet": "drawer", "caddy": "compartment"}
"""What a part of a thing is called."""

NEXT_TO_M = 0.17
"""Distance of centres up to which things stand next to each other; in LIBERO it is 0.12 to 0.13 m."""

BETWEEN = 0.25
"""Share of the way between two things that still counts as at one of them, and as beside the line between them."""


class Aim(NamedTuple):
    """Where something is to be, or is at first.

    Attributes:
        relation: ``on``, ``in``, ``next to``, ``between``, or of ``PARTS`` for a side of the place; None where the
            part is enough.
        thing: its kind.
        place: kind of what it is put on, in, next to; None where the part is enough.
        part: which of ``PARTS`` of the place, or which of several places of that kind.
    """

    relation: str | None
    thing: str
    place: str | None
    part: str | None = None


class StateChange(NamedTuple):
    """A state (``open``, ``close``, ``turnon``, ``turnoff``) that a kind of thing, or a part of it, is to be in."""

    state: str
    thing: str
    part: str | None = None


@dataclass(frozen=True)
class TaskGoal:
    """A task's goal, as far as it is not reached at the start, in kinds of things.

    Attributes:
        scene: kinds of all that is there, in order of the file.
        aims: what is moved where.
        starts: where something that is moved is at first, if that distinguishes it from others of its kind.
        changes: what changes its state.
        pairs: kinds of which two are moved.
    """

    scene: tuple[str, ...]
    aims: tuple[Aim, ...]
    starts: tuple[Aim, ...]
    changes: tuple[StateChange, ...]
    pairs: tuple[str, ...]


@cache
def read_goal(bddl_file: Path) -> TaskGoal:
    """The goal of a task.

    Raises:
        PipelineError: when the file cannot be read or does not define a task.
    """
    bddl = read(bddl_file)
    scene = _Scene(bddl)
    facts = [fact for fact in bddl.goal if fact not in bddl.start]
    moves = [fact for fact in facts if len(fact) == 3]
    moved = dict.fromkeys(name for _, name, _ in moves)
    counts = Counter(scene.kinds.get(name, name) for name in moved)
    distinguished = [name for name in moved if counts[scene.kinds.get(name, name)] < scene.count(name)]
    starts = [fact for fact in bddl.start if len(fact) == 3 and fact[1] in distinguished]
    return TaskGoal(
        scene=tuple(dict.fromkeys(scene.kinds.values())),
        aims=tuple(dict.fromkeys(aim for fact in moves for aim in scene.aims(*fact))),
        starts=tuple(dict.fromkeys(aim for fact in starts for aim in scene.aims(*fact))),
        changes=tuple(StateChange(fact[0], *scene.part(fact[1])) for fact in facts if len(fact) == 2),
        pairs=tuple(kind for kind, count in counts.items() if count > 1),
    )


def called(bddl: Bddl, name: str) -> str:
    """What one calls a thing or a part of it: wooden_cabinet_1_middle_region is the middle drawer of the cabinet."""
    return _words(*_Scene(bddl).part(name))


def where(bddl: Bddl, fact: Fact) -> tuple[str, str]:
    """How one says to which place, and at which, a fact of the goal puts something: to the plate, on the plate."""
    aim = next(_Scene(bddl).aims(*fact), None)
    if aim is None:
        return "to its place", "at its place"
    if aim.place is None or aim.relation in PARTS:
        there = f"to the {aim.relation} of {_words(aim.place)}" if aim.place else f"to the {aim.part}"
        return there, there
    place = _words(aim.place, aim.part)
    # LIBERO has no inside of bowls.
    into = aim.place.endswith("bowl") and not aim.thing.endswith("bowl")
    return f"to {place}", f"{'in' if into else aim.relation} {place}"


def _words(kind: str, part: str | None = None) -> str:
    noun = NAMES.get(kind, kind.replace("_", " "))
    if part and noun in INSIDE:
        return f"the {part} {INSIDE[noun]} of the {noun}"
    return f"the {part} {noun}" if part in SIDES else f"the {noun}"


class _Scene:
    """What the names of things and of their regions, such as ``plate_1`` and ``main_table_stove_region``, stand for."""

    def __init__(self, bddl: Bddl):
        self.kinds = {**bddl.objects, **bddl.fixtures}
        self.starts = bddl.places
        self._owner = bddl.owner

    def count(self, name: str) -> int:
        """How many there are of the kind of a thing."""
        return list(self.kinds.values()).count(self.kinds.get(name, ""))

    def part(self, name: str) -> tuple[str, str | None]:
        """A thing's kind and which of several it is; for a region, the kind that has it and which part it is."""
        kind, words = self._region(name)
        if self.count(name) > 1:
            words = self._region(self.starts.get(name, ""))[1]
        return kind, next((word for word in words if word in PARTS), None)

    def aims(self, relation: str, name: str, place: str) -> Iterator[Aim]:
        """A fact about two names in kinds; a region of the working surface by what it lies beside."""
        kind = self.kinds.get(name, name)
        host, part = self.part(place)
        if not host.endswith(("table", "floor")):
            yield Aim(relation, kind, host, part if relation == "in" or place in self.kinds else None)
            return
        words = self._region(place)[1]
        beside = [other for other in self._named(words) if other not in (kind, host)]
        phrases = (("between", "between"), ("next", "next to"))
        relation_beside = next((phrase for word, phrase in phrases if word in words), part)
        if beside and relation_beside:
            yield from (Aim(relation_beside, kind, other) for other in beside)
        elif part:
            yield Aim(None, kind, None, part)

    def _region(self, name: str) -> tuple[str, list[str]]:
        """The kind of what a name begins with, and the words that are left of it."""
        host = self._owner(name) or name
        return self.kinds.get(host, host), name[len(host) :].split("_")

    def _named(self, words: list[str]) -> Iterator[str]:
        """The kinds that the name of a region names, each by a word of its own."""
        for word in words:
            # LIBERO's regions call the cookies by their box.
            called = "cookies" if word == "box" else word
            kinds = [kind for kind in self.kinds.values() if called in kind.split("_")]
            if kinds:
                yield max(kinds, key=lambda kind: len({*kind.split("_")} & {*words}))


@cache
def _alike(task: Task, thing: str) -> tuple[str, ...]:
    """The other objects of the category of ``thing``."""
    objects = read(task.bddl_file).objects
    return tuple(name for name, category in objects.items() if category == objects[thing] and name != thing)


@cache
def _anchors(task: Task, thing: str) -> tuple[str, ...]:
    """The one thing that an object starts next to, or the two that it starts between, by its region's name."""
    known = read(task.bddl_file)
    named = known.beside(known.places.get(thing, ""))
    return named.things if named is not None and named.relation in ("next to", "between") else ()


def relation_holds(task: Task, target: str, xy_m: Callable[[str], Floats]) -> bool:
    """Whether the target still stands where the instruction's words place it.

    Next to something: within ``NEXT_TO_M`` of it, and no like object nearer to it. Between two things: its foot on the
    line between them in the middle half, and off that line by at most a quarter of its length.
    """
    own = xy_m(target)
    match _anchors(task, target):
        case (anchor,):
            away = np.linalg.norm(own - xy_m(anchor))
            nearest_alike = min(
                (np.linalg.norm(xy_m(other) - xy_m(anchor)) for other in _alike(task, target)), default=math.inf
            )
            return bool(away <= min(NEXT_TO_M, nearest_alike))
        case (first, second):
            line = xy_m(second) - xy_m(first)
            dx, dy = own - xy_m(first)
            along, beside = np.array([dx * line[0] + dy * line[1], dx * line[1] - dy * line[0]]) / (line @ line)
            return bool(BETWEEN <= along <= 1 - BETWEEN and abs(beside) <= BETWEEN)
    return True
