"""What a task asks for, as its BDDL file defines it: what goes where, and what is opened, closed, turned on or off."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pipeline.libero.bddl import Bddl, read

PARTS = ("top", "middle", "bottom", "left", "right", "front", "back", "center")
"""Words in the names of regions that say which drawer, compartment, side or spot."""


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


class _Scene:
    """What the names of things and of their regions, such as ``plate_1`` and ``main_table_stove_region``, stand for."""

    def __init__(self, bddl: Bddl):
        self.kinds = {**bddl.objects, **bddl.fixtures}
        self.starts = bddl.places

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
        host = max((thing for thing in self.kinds if f"{name}_".startswith(f"{thing}_")), key=len, default=name)
        return self.kinds.get(host, host), name[len(host) :].split("_")

    def _named(self, words: list[str]) -> Iterator[str]:
        """The kinds that the name of a region names, each by a word of its own."""
        for word in words:
            # LIBERO's regions call the cookies by their box.
            called = "cookies" if word == "box" else word
            kinds = [kind for kind in self.kinds.values() if called in kind.split("_")]
            if kinds:
                yield max(kinds, key=lambda kind: len({*kind.split("_")} & {*words}))
