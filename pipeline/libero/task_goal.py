"""Goals of tasks, as BDDL files define them: placements, and things to open, close, turn on or turn off.

The module also describes a task's things and places in plain words, and checks whether an instruction's relation still
holds.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pipeline.grouping import grouped
from pipeline.libero.bddl import Bddl, Fact
from pipeline.libero.carried import definition_of
from pipeline.types import Floats, Task

PARTS = ("top", "middle", "bottom", "left", "right", "front", "back", "center")
"""Words in the names of regions that denote a drawer, compartment, side or spot."""

NAMES = {
    "akita_black_bowl": "black bowl",
    "black_book": "book",
    "chefmate_8_frypan": "frying pan",
    "cookies": "cookie box",
    "desk_caddy": "caddy",
    "flat_stove": "stove",
    "glazed_rim_porcelain_ramekin": "ramekin",
    "new_salad_dressing": "salad dressing",
    "porcelain_mug": "white mug",
    "red_coffee_mug": "red mug",
    "white_cabinet": "cabinet",
    "white_yellow_mug": "yellow and white mug",
    "wooden_cabinet": "cabinet",
    "wooden_tray": "tray",
    "wooden_two_layer_shelf": "cabinet shelf",
    "yellow_book": "book",
}
"""Kind to the other words that LIBERO's instructions use for it."""

SIDES = ("left", "right", "front", "back", "middle")
"""Words that distinguish things of one kind."""

AXIS_OF_SIDE = {"front": 0, "back": 0, "left": 1, "right": 1}
"""Side to the axis of the working surface along which it tells things apart: 0 for x, 1 for y."""

INSIDE = {"cabinet": "drawer", "caddy": "compartment"}
"""Thing to the word for one of its parts."""

SHELVES = ("wooden_two_layer_shelf",)
"""Kinds of shelves."""

SHELF_LEVELS = {"top": ("onto", "on"), "bottom": ("under", "under"), None: ("onto the top of", "on top of")}
"""Part of a shelf to the words for the direction and the location; `None` is the top of the whole shelf.

LIBERO's facts put things *in* the region above the board or in the region below it.
"""

NEXT_TO_M = 0.17
"""Distance of centres up to which things stand next to each other; in LIBERO it is 0.12 to 0.13 m."""

BETWEEN = 0.25
"""Share of the distance of two things that limits "between".

A place nearer to either thing along the line, or farther off the line, is not between them.
"""

SIDE_SHARE = 0.25
"""Share of the distance of two regions' centres that things of one noun keep, if the instruction names their side.

The distance is measured along the axis of the side.
"""


class Aim(NamedTuple):
    """Place of a thing, in the goal or at the start.

    Attributes:
        relation: ``on``, ``in``, ``next to``, ``between``, or one of ``PARTS`` for a side of the place; `None` if the
            part is enough.
        thing: kind of the thing.
        place: kind of the thing that it is put on, in or next to; `None` if the part is enough.
        part: one of ``PARTS``: part of the place, or the word that distinguishes several places of that kind.
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
    """The part of a task's goal that is not reached at the start, in kinds of things.

    Attributes:
        scene: kinds of all things in the scene, in order of the file.
        aims: moved things with their places in the goal.
        starts: moved things with their places at the start, if the place distinguishes a thing from others of its kind.
        changes: things that change their state.
        pairs: kinds of which two things are moved.
    """

    scene: tuple[str, ...]
    aims: tuple[Aim, ...]
    starts: tuple[Aim, ...]
    changes: tuple[StateChange, ...]
    pairs: tuple[str, ...]


@cache
def read_goal(task: Task) -> TaskGoal:
    """Read the goal of a task.

    Raises:
        PipelineError: when the file cannot be read or does not define a task.
    """
    bddl = definition_of(task)
    scene = _Scene(bddl)
    facts = [fact for fact in bddl.goal if fact not in bddl.start]
    moves = [fact for fact in facts if len(fact) == 3]
    moved = dict.fromkeys(name for _, name, _ in moves)
    counts = Counter(scene.kinds.get(name, name) for name in moved)
    distinguished = [name for name in moved if counts[scene.kinds.get(name, name)] < scene.count(name)]
    starts = [fact for fact in bddl.start if len(fact) == 3 and fact[1] in distinguished]
    return TaskGoal(
        scene=tuple(dict.fromkeys(scene.kinds.values())),
        aims=scene.unique_aims(moves),
        starts=scene.unique_aims(starts),
        changes=tuple(StateChange(fact[0], *scene.part(fact[1])) for fact in facts if len(fact) == 2),
        pairs=tuple(kind for kind, count in counts.items() if count > 1),
    )


def describe_thing(bddl: Bddl, name: str) -> str:
    """Describe a thing or a part of it in plain words.

    For example, wooden_cabinet_1_middle_region is the middle drawer of the cabinet. If several things have one noun, an
    object of the goal has the side in its region's name, or else the side in the instruction: the left book.
    """
    scene = _Scene(bddl)
    kind, part = scene.part(name)
    if part not in SIDES and name in bddl.targets and scene.has_namesakes(name):
        part = _find_side(bddl.language, _noun(kind)) or part
    return _words(kind, part)


def _find_side(instruction: str, noun: str) -> str | None:
    """Return the side that an instruction gives a thing: the left book, or the book on the left.

    The sides of other things do not count, such as that of a compartment in which the book is placed.
    """
    side, word = f"({'|'.join(SIDES)})", noun.split()[-1]
    before = rf"\b{side} (?:\w+ )?{word}\b"
    behind = rf"\b{word} (?:on|in|at) the {side}(?= and\b|,|$)"
    match = re.search(before, instruction) or re.search(behind, instruction)
    return match and match[1]


def describe_thing_at_start(bddl: Bddl, name: str) -> str:
    """Describe an object as ``describe_thing`` does, with its place at the start if it shares its noun and has no side.

    For example, akita_black_bowl_1 is the black bowl next to the ramekin.
    """
    scene, words = _Scene(bddl), describe_thing(bddl, name)
    if not scene.has_namesakes(name) or {*words.split()} & {*SIDES}:
        return words
    aims = scene.unique_aims(fact for fact in bddl.start if len(fact) == 3 and fact[1] == name)
    relations = {aim.relation for aim in aims}
    places = [_words(aim.place, aim.part) for aim in aims if aim.place]
    if places and relations <= {"on", "in", "next to", "between"}:
        return f"{words} {aims[0].relation} {' and '.join(places)}"
    return f"{words} at the table center" if any(aim.part == "center" for aim in aims) else words


def describe_place(bddl: Bddl, fact: Fact) -> tuple[str, str]:
    """Describe the place of a fact of the goal, as a direction and as a location: to the plate, on the plate.

    On the levels of a shelf, both say which: under the cabinet shelf.
    """
    aim = next(_Scene(bddl).aims(*fact), None)
    if aim is None:
        return "to its place", "at its place"
    if aim.place is None or aim.relation in PARTS:
        side = f"to the {aim.relation} of {_words(aim.place)}" if aim.place else f"to the {aim.part}"
        return side, side
    if aim.place in SHELVES and aim.part in SHELF_LEVELS:
        direction, location = SHELF_LEVELS[aim.part]
        return f"{direction} {_words(aim.place)}", f"{location} {_words(aim.place)}"
    place = _words(aim.place, aim.part)
    # LIBERO's bowls have no inside, so its facts put things on bowls; in words, things are in bowls.
    in_bowl = aim.place.endswith("bowl") and not aim.thing.endswith("bowl")
    return f"to {place}", f"{'in' if in_bowl else aim.relation} {place}"


def _words(kind: str, part: str | None = None) -> str:
    """Describe a kind of thing, or a part of it, in plain words with an article."""
    noun = _noun(kind)
    if part and noun in INSIDE:
        return f"the {part} {INSIDE[noun]} of the {noun}"
    return f"the {part} {noun}" if part in SIDES else f"the {noun}"


def _noun(kind: str) -> str:
    """Return the word of LIBERO's instructions for a kind of thing."""
    return NAMES.get(kind, kind.replace("_", " "))


class _Scene:
    """Meaning of the names of things and regions in a task, such as ``plate_1`` and ``main_table_stove_region``."""

    def __init__(self, bddl: Bddl):
        self.kinds = {**bddl.objects, **bddl.fixtures}
        self.starts = bddl.places
        self._owner = bddl.owner

    def count(self, name: str) -> int:
        """Return the number of things that have the kind of a thing."""
        return list(self.kinds.values()).count(self.kinds.get(name, ""))

    def has_namesakes(self, name: str) -> bool:
        """Return whether other things of the scene have the noun of a thing."""
        noun = _noun(self.kinds.get(name, name))
        return any(_noun(kind) == noun for other, kind in self.kinds.items() if other != name)

    def part(self, name: str) -> tuple[str, str | None]:
        """Return the kind of a thing, and the word of ``PARTS`` that distinguishes it from others of its kind.

        For a region, return the kind of the thing that it belongs to, and the word of ``PARTS`` in its name.
        """
        kind, words = self._region(name)
        if self.count(name) > 1:
            words = self._region(self.starts.get(name, ""))[1]
        return kind, next((word for word in words if word in PARTS), None)

    def aims(self, relation: str, name: str, place: str) -> Iterator[Aim]:
        """Yield the aims of a fact about two names; a region of the working surface is described by its neighbours."""
        kind = self.kinds.get(name, name)
        host, part = self.part(place)
        if not host.endswith(("table", "floor")):
            yield Aim(relation, kind, host, part if relation == "in" or place in self.kinds else None)
            return
        words = self._region(place)[1]
        neighbours = [neighbour for neighbour in self._named(words) if neighbour not in (kind, host)]
        phrases = (("between", "between"), ("next", "next to"))
        relation_to_neighbour = next((phrase for word, phrase in phrases if word in words), part)
        if neighbours and relation_to_neighbour:
            for neighbour in neighbours:
                yield Aim(relation_to_neighbour, kind, neighbour)
        elif part:
            yield Aim(None, kind, None, part)

    def unique_aims(self, facts: Iterable[Fact]) -> tuple[Aim, ...]:
        """Return the aims of some facts, in their order and without duplicates."""
        aims: dict[Aim, None] = {}
        for fact in facts:
            aims |= dict.fromkeys(self.aims(*fact))
        return tuple(aims)

    def _region(self, name: str) -> tuple[str, list[str]]:
        """Return the kind of the thing that a name begins with, and the remaining words of the name."""
        host = self._owner(name) or name
        return self.kinds.get(host, host), name[len(host) :].split("_")

    def _named(self, words: list[str]) -> Iterator[str]:
        """Yield a kind for each word of a region's name that names a kind."""
        for word in words:
            # LIBERO's regions call the cookies by their box.
            noun = "cookies" if word == "box" else word
            kinds = [kind for kind in self.kinds.values() if noun in kind.split("_")]
            if kinds:
                yield max(kinds, key=lambda kind: len({*kind.split("_")} & {*words}))


@cache
def _alike(task: Task, thing: str) -> tuple[str, ...]:
    """Return the other objects that have the category of ``thing``."""
    objects = definition_of(task).objects
    same_category = [name for name, category in objects.items() if category == objects[thing]]
    return tuple(name for name in same_category if name != thing)


@cache
def _anchors(task: Task, thing: str) -> tuple[str, ...]:
    """Return the thing that an object starts next to, or the two things that it starts between, by its region's name.

    Return no things if the object starts elsewhere.
    """
    scene = definition_of(task)
    neighbours = scene.neighbours(scene.places.get(thing, ""))
    if neighbours is None or neighbours.relation not in ("next to", "between"):
        return ()
    return neighbours.things


def instruction_holds(task: Task, xy_m: Callable[[str], Floats]) -> bool:
    """Return whether the instruction still describes the objects of the task.

    Each target must stand in the place that the instruction names. If the instruction names a side, such as that of the
    left bowl, objects with this noun must keep their order along the axis of the side.

    Args:
        task: the task.
        xy_m: function that returns the position (2,) of an object.
    """
    targets = definition_of(task).targets
    return all(_relation_holds(task, target, xy_m) for target in targets) and _sides_hold(task, xy_m)


def _sides_hold(task: Task, xy_m: Callable[[str], Floats]) -> bool:
    """Return whether objects that the instruction tells apart by their side keep their order, ``SIDE_SHARE`` apart."""
    centres_m = definition_of(task).centres_m
    for axis, names in _rows_of_namesakes(task):
        for first, second in combinations(names, 2):
            before_m = centres_m[second][axis] - centres_m[first][axis]
            # Things at one place along the axis are not told apart by it.
            if before_m > 0 and xy_m(second)[axis] - xy_m(first)[axis] < SIDE_SHARE * before_m:
                return False
    return True


@cache
def _rows_of_namesakes(task: Task) -> tuple[tuple[int, tuple[str, ...]], ...]:
    """Return the objects that share a noun and have a side, in ascending order along the axis of the side.

    Return no objects if the instruction names no side.

    Returns:
        Axis of the working surface, and names of objects.
    """
    scene = definition_of(task)
    if not {*scene.language.split()} & {*SIDES}:
        return ()
    placed = [(_noun(kind), name) for name, kind in scene.objects.items() if name in scene.centres_m]
    rows: list[tuple[int, tuple[str, ...]]] = []
    for names in grouped(placed).values():
        words = " ".join(describe_thing(scene, name) for name in names).split()
        for axis in sorted({AXIS_OF_SIDE[word] for word in words if word in AXIS_OF_SIDE}):
            rows.append((axis, tuple(sorted(names, key=lambda name: scene.centres_m[name][axis]))))
    return tuple(rows)


def _relation_holds(task: Task, target: str, xy_m: Callable[[str], Floats]) -> bool:
    """Return whether the target still stands next to the thing, or between the things, that the instruction names.

    Next to a thing: within ``NEXT_TO_M`` of the thing, and no object of the target's category nearer to it. Between two
    things: projected onto the line between the things, the target is in the line's middle half. Its distance from the
    line is at most a quarter of the line's length.

    Args:
        task: the task.
        target: name of an object.
        xy_m: function that returns the position (2,) of an object.
    """
    anchors = _anchors(task, target)
    if not anchors:
        return True
    anchors_m = [xy_m(anchor) for anchor in anchors]
    if len(anchors_m) == 1:
        distances_alike_m = [np.linalg.norm(xy_m(name) - anchors_m[0]) for name in _alike(task, target)]
        if np.linalg.norm(xy_m(target) - anchors_m[0]) > min(distances_alike_m, default=math.inf):
            return False
    return _is_at(anchors_m, xy_m(target))


def has_lookalike_in_place(task: Task) -> bool:
    """Return whether another object of a target's category also begins in the place that the instruction names.

    An instruction with the place then fits both objects. The centres of the regions are compared.
    """
    centres_m = {name: np.array(centre_m) for name, centre_m in definition_of(task).centres_m.items()}
    for target in definition_of(task).targets:
        anchors = _anchors(task, target)
        if not anchors or not centres_m.keys() >= {*anchors}:
            continue
        anchors_m = [centres_m[anchor] for anchor in anchors]
        lookalikes_m = [centres_m[name] for name in _alike(task, target) if name in centres_m]
        if any(_is_at(anchors_m, xy_m) for xy_m in lookalikes_m):
            return True
    return False


def _is_at(anchors_m: Sequence[Floats], xy_m: Floats) -> bool:
    """Return whether a position is next to one thing, or between two things.

    Args:
        anchors_m: positions (2,) of the one or two things.
        xy_m: the position (2,).
    """
    if len(anchors_m) == 1:
        return bool(np.linalg.norm(xy_m - anchors_m[0]) <= NEXT_TO_M)
    first_m, second_m = anchors_m
    line = second_m - first_m
    dx, dy = xy_m - first_m
    along, across = np.array([dx * line[0] + dy * line[1], dx * line[1] - dy * line[0]]) / (line @ line)
    return bool(BETWEEN <= along <= 1 - BETWEEN and abs(across) <= BETWEEN)
