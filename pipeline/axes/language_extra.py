"""Search for requests beyond a rewrite's task: another thing to move, another state, or a second thing of one kind.

Like ``language_goal.py``, this module reads words and parses no grammar. A rewrite may mention a thing that the goal
does not name (``leave the wine``, ``the rack is reserved``). In the classes of rewrites that call all things by their
names, it may not do so with the thing's name and an article. A rewrite asks for a thing that stands after a verb that
moves things, is joined to a thing of the goal, or stands before its destination.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from pipeline.axes.language_goal import Mention, Reading, read_words, thing_words
from pipeline.libero.carried import definition_of
from pipeline.libero.task_goal import read_goal
from pipeline.types import Task

_JOINED = re.compile(r"(?:,? (?:and|as well as|plus|along with|together with)|,)(?: (?:then|also))?(?: (?:the|a|its))?")
"""Text between two things that are requested together."""

_GOES = re.compile(r" (?:(?:too|also) )?(?:goes|go|belongs?|should|must|has to|needs? to|into|onto|to the)\b")
"""Text after a thing that states its destination."""

_STAYS = re.compile(r" (?:is|are|was|were|stays?|remains?|can|will|would|do|does)\b")
"""Text after a thing that excludes it from the request."""

_NOT = re.compile(r"\b(?:not|t|never|without|neither|nor|instead of)(?: \w+)?$")
"""Text before a verb that takes the request back; ``t`` is the rest of ``don't``."""

_TOLD = re.compile(r"\b(?:i|we|they|may|might|would like to|want to|going to|about to|not|never|t) $")
"""Text before a verb that does not make a request."""

_ONTO = re.compile(r"(?: \w+)? (?:on|onto|upon|on top of|in|into)(?: the)?(?: \w+)? ")
"""Text between a thing and a second thing of its kind that it is put on."""

_ELSEWHERE = re.compile(r"\b(?:a|an|my|our|your|his|her|their|some|any) $")
"""Text before a word that means no thing of the scene, such as ``our barbecue``."""


@dataclass(frozen=True)
class Surroundings:
    """Parts of a task's scene that its goal does not ask for.

    Attributes:
        scene: kinds of all things in the scene.
        of_goal: kinds that the goal names.
        movable: kinds of objects that the goal does not name.
        doubled: kinds with two or more objects in the scene, of which the task moves one and none is its destination.
        states: states that the goal does not ask for, with the kinds that can be in them.
    """

    scene: tuple[str, ...]
    of_goal: frozenset[str]
    movable: frozenset[str]
    doubled: frozenset[str]
    states: dict[str, tuple[str, ...]]


@cache
def surroundings(task: Task) -> Surroundings:
    """Read the parts of a task's scene that its goal does not ask for.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    goal, bddl = read_goal(task), definition_of(task)
    located = (*goal.aims, *goal.starts)
    things = {aim.thing for aim in located} | {change.thing for change in goal.changes}
    places = {aim.place for aim in located if aim.place}
    objects = list(bddl.objects.values())
    asked = {change.state for change in goal.changes} | {*task.instruction.lower().split()}
    states = {}
    for state, wording in read_words().states.items():
        kinds = tuple(kind for kind in wording.of if kind in goal.scene)
        if kinds and state not in asked:
            states[state] = kinds
    moved_only = things - places - {*goal.pairs}
    return Surroundings(
        scene=goal.scene,
        of_goal=frozenset(things | places),
        movable=frozenset(objects) - things - places,
        doubled=frozenset(kind for kind in moved_only if objects.count(kind) > 1),
        states=states,
    )


def extra_request(text: str, task: Task, hints: bool) -> str | None:
    """Return a request of ``text`` beyond the task's goal, or ``None`` if there is none.

    Args:
        hints: true if things may be described, as for ``changed_goal``; else other things may not be named at all.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    around = surroundings(task)
    reading = Reading(text, around.scene, hints=False)
    for number, mention in enumerate(reading.mentions):
        kinds = {*mention.kinds}
        if kinds <= around.movable:
            named = not hints and not _ELSEWHERE.search(reading.plain[: mention.at])
            if named or _is_asked_for(mention, reading, around.of_goal):
                return f"asks for another thing too, {_name(mention.kinds)}"
        if kinds <= around.doubled and _is_put_on(mention, reading.mentions[:number], reading):
            return f"puts something on the other {_name(mention.kinds)}"
    for state, able in around.states.items():
        if _asks_for_state(reading.plain, state, able, hints):
            return f"asks to {state} the {_name(able)} too"
    return None


def _is_put_on(mention: Mention, earlier: Iterable[Mention], reading: Reading) -> bool:
    """Return whether an ``earlier`` mentioned thing of one kind with ``mention`` is put on it."""
    for thing in earlier:
        between = reading.plain[thing.end : mention.at]
        if thing.kinds == mention.kinds and _ONTO.fullmatch(between):
            return True
    return False


def _is_asked_for(mention: Mention, reading: Reading, of_goal: frozenset[str]) -> bool:
    """Return whether the words around a thing move it, join it to a thing of the goal, or send it to a place."""
    before, after = reading.plain[: mention.at], reading.plain[mention.end :]
    moved = re.search(
        rf"\b(?:{'|'.join(read_words().moves)})(?: up| out)?(?: (?:the|a|an|its|that|both))?(?: \w+)? $", before
    )
    if moved and not _NOT.search(before[: moved.start()].rstrip()):
        return True
    if _GOES.match(after) and not _NOT.search(before.rstrip()):
        return True
    neighbours = [thing for thing in reading.mentions if of_goal & {*thing.kinds}]
    gaps = [reading.plain[thing.end : mention.at] for thing in neighbours if thing.end <= mention.at]
    gaps += [reading.plain[mention.end : thing.at] for thing in neighbours if mention.end <= thing.at]
    return not _STAYS.match(after) and any(_JOINED.fullmatch(gap.rstrip()) for gap in gaps)


def _asks_for_state(plain: str, state: str, kinds: tuple[str, ...], hints: bool) -> bool:
    """Return whether a text asks for a state of one of ``kinds``."""
    thing = rf"(?:door|{'|'.join(thing_words(kinds, hints))})s?"
    it = rf"(?:it|(?:the|its|that|this)(?: \w+){{0,2}} {thing}|that|which)"
    wording = read_words().states[state]
    entries = wording.asked if hints else wording.asked + wording.wished
    for entry in entries:
        request = entry.replace("IT", it).replace("THING", thing)
        for match in re.finditer(rf"\b(?:{request})\b", plain):
            if not _TOLD.search(plain[: match.start()]):
                return True
    return False


def _name(kinds: Iterable[str]) -> str:
    """Return the first kind in plain words."""
    return next(iter(kinds)).replace("_", " ")
