"""Whether a rewrite asks for more than its task: another thing to move, another state, or two of a kind where one is.

As ``language_goal.py`` does, this reads words and parses no grammar. A thing that the goal does not name may be talked
about (``leave the wine``, ``the rack is reserved``), except by its name with an article in the classes of rewrites that
call all things by their names. Asking for it is what counts: after a verb that moves things, joined to a thing of the
goal, or followed by the place where it goes.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from pipeline.axes.language_goal import Mention, Reading, thing_words, words
from pipeline.libero.bddl import read
from pipeline.libero.task_goal import read_goal
from pipeline.types import Task

_JOINED = re.compile(r"(?:,? (?:and|as well as|plus|along with|together with)|,)(?: (?:then|also))?(?: (?:the|a|its))?")
"""Text between two things that are asked for together."""

_GOES = re.compile(r" (?:(?:too|also) )?(?:goes|go|belongs?|should|must|has to|needs? to|into|onto|to the)\b")
"""Text after a thing that says where it goes."""

_STAYS = re.compile(r" (?:is|are|was|were|stays?|remains?|can|will|would|do|does)\b")
"""Text after a thing that says that nothing is to happen to it."""

_NOT = re.compile(r"\b(?:not|t|never|without|neither|nor|instead of)(?: \w+)?$")
"""Text before a verb that takes the request back; ``t`` is the rest of ``don't``."""

_TOLD = re.compile(r"\b(?:i|we|they|may|might|would like to|want to|going to|about to|not|never|t) $")
"""Text before a verb that asks for nothing."""

_ONTO = re.compile(r"(?: \w+)? (?:on|onto|upon|on top of|in|into)(?: the)?(?: \w+)? ")
"""Text between a thing and another of its kind that it is put on."""

_ELSEWHERE = re.compile(r"\b(?:a|an|my|our|your|his|her|their|some|any) $")
"""Text before a word that means no thing of the scene, such as ``our barbecue``."""


@dataclass(frozen=True)
class Surroundings:
    """Parts of a task's scene that its goal does not ask for.

    Attributes:
        scene: kinds of everything in it.
        of_goal: kinds that the goal names.
        movable: kinds of objects that the goal does not name.
        doubled: kinds of which there are two or more, one of them is moved, and none is a place of the goal.
        states: states that the goal does not ask for, with the kinds that can be in them.
    """

    scene: tuple[str, ...]
    of_goal: frozenset[str]
    movable: frozenset[str]
    doubled: frozenset[str]
    states: dict[str, tuple[str, ...]]


@cache
def surroundings(task: Task) -> Surroundings:
    """Read what of a task's scene its goal does not ask for.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    goal, bddl = read_goal(task.bddl_file), read(task.bddl_file)
    located = (*goal.aims, *goal.starts)
    things = {aim.thing for aim in located} | {change.thing for change in goal.changes}
    places = {aim.place for aim in located if aim.place}
    objects = list(bddl.objects.values())
    asked = {change.state for change in goal.changes} | {*task.instruction.lower().split()}
    states = {
        state: tuple(kind for kind in known.of if kind in goal.scene)
        for state, known in words().states.items()
        if state not in asked
    }
    return Surroundings(
        scene=goal.scene,
        of_goal=frozenset(things | places),
        movable=frozenset(objects) - things - places,
        doubled=frozenset(kind for kind in things - places - {*goal.pairs} if objects.count(kind) > 1),
        states={state: kinds for state, kinds in states.items() if kinds},
    )


def extra_request(text: str, task: Task, hints: bool) -> str | None:
    """Name what ``text`` asks for beside the task's goal, or return ``None``.

    Args:
        hints: whether things may be described, as for ``changed_goal``; else other things may not be named at all.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    known = surroundings(task)
    reading = Reading(text, known.scene, hints=False)
    for number, mention in enumerate(reading.mentions):
        kinds = {*mention.kinds}
        if kinds <= known.movable and (
            _is_asked_for(mention, reading, known.of_goal)
            or (not hints and not _ELSEWHERE.search(reading.plain[: mention.at]))
        ):
            return f"asks for another thing too, {_name(mention.kinds)}"
        if kinds <= known.doubled and any(
            other.kinds == mention.kinds and _ONTO.fullmatch(reading.plain[other.end : mention.at])
            for other in reading.mentions[:number]
        ):
            return f"puts something on the other {_name(mention.kinds)}"
    for state, able in known.states.items():
        if _asks_for_state(reading.plain, state, able, hints):
            return f"asks to {state} the {_name(able)} too"
    return None


def _is_asked_for(mention: Mention, reading: Reading, of_goal: frozenset[str]) -> bool:
    """Whether a thing is moved, joined to a thing of the goal, or sent to a place, by the words around it."""
    before, after = reading.plain[: mention.at], reading.plain[mention.end :]
    moved = re.search(
        rf"\b(?:{'|'.join(words().moves)})(?: up| out)?(?: (?:the|a|an|its|that|both))?(?: \w+)? $", before
    )
    if moved and not _NOT.search(before[: moved.start()].rstrip()):
        return True
    if _GOES.match(after) and not _NOT.search(before.rstrip()):
        return True
    neighbours = [other for other in reading.mentions if of_goal & {*other.kinds}]
    gaps = [reading.plain[other.end : mention.at] for other in neighbours if other.end <= mention.at]
    gaps += [reading.plain[mention.end : other.at] for other in neighbours if mention.end <= other.at]
    return not _STAYS.match(after) and any(_JOINED.fullmatch(gap.rstrip()) for gap in gaps)


def _asks_for_state(plain: str, state: str, kinds: tuple[str, ...], hints: bool) -> bool:
    thing = rf"(?:door|{'|'.join(thing_words(kinds, hints))})s?"
    it = rf"(?:it|(?:the|its|that|this)(?: \w+){{0,2}} {thing}|that|which)"
    known = words().states[state]
    entries = known.asked if hints else known.asked + known.wished
    asked = (entry.replace("IT", it).replace("THING", thing) for entry in entries)
    requests = (match for entry in asked for match in re.finditer(rf"\b(?:{entry})\b", plain))
    return any(not _TOLD.search(plain[: match.start()]) for match in requests)


def _name(kinds: Iterable[str]) -> str:
    return next(iter(kinds)).replace("_", " ")
