"""Check that a rewrite keeps its task's goal: moved things, their places and relations, and states such as open or lit.

The goal comes from the BDDL file, its words from ``language_words.yaml``. No grammar is parsed:

* Each thing and each place must have a word that nothing else in the scene shares.
* The words right before a place give the relation to it.
* If two things go to different places, the first thing goes to the first place.

A rewrite may leave out a part of the goal that LIBERO's own wording does not express by these words. The check finds a
missing goal, for named and for described things. ``language_extra.py`` finds a second goal. Neither finds the opposite
("do not"), nor descriptions that fit several things: writers check these.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, NamedTuple

import yaml
from pydantic import BeforeValidator

from pipeline.libero.task_goal import Aim, TaskGoal, read_goal
from pipeline.types import Frozen, Task

SIDES = ("front", "left", "right")
"""Relations that may be given without a word for the place, as in ``to its right``."""

UNTOLD = frozenset({"to", None})
"""Relations that leave the position open: ``bring it to the basket``, ``the basket should have it``."""

WAYS = frozenset({"on", "in", "off", "to", None})
"""Relations that name no place if a second relation follows: ``hold it over the basket and let it in``."""

DRAWERS = frozenset({"top", "middle", "bottom"})

NEAR_WORDS = 5
"""Most words between a relation and the place that it belongs to."""

_BACK = re.compile(
    r"\s*(?:$|[,.;:?!]|(?:and|it|its|that|this|there|these|those|them|which|each|one|what)\b"
    r"|the (?:former|latter|other)\b)"
)
"""Text after a relation to a place that was named before."""


Entries = Annotated[tuple[str, ...], BeforeValidator(lambda listed: re.split(r",\s+", listed))]
"""Regular expressions, in YAML with commas between them."""


class Thing(Frozen):
    """Names and descriptions of a kind of thing."""

    names: Entries
    hints: Entries


class State(Frozen):
    """Words that ask for a state, and for its opposite.

    Attributes:
        said: words for the state.
        opposite: words for its opposite.
        asked: requests for the state; ``IT`` stands for the thing or a pronoun.
        wished: wishes for its result; ``THING`` stands for the thing without an article.
        of: kinds that can be in the state.
    """

    said: Entries
    opposite: Entries
    asked: Entries
    wished: Entries
    of: Entries


class Words(Frozen):
    """Content of ``language_words.yaml``; every string is a regular expression."""

    things: dict[str, Thing]
    parts: dict[str, Entries]
    relations: dict[str, Entries]
    states: dict[str, State]
    both: Entries
    moves: Entries
    sides: Entries
    shelves: Entries
    top: Entries
    drawer: Entries
    common: Entries
    function: Entries


@cache
def read_words() -> Words:
    """Read the shipped words."""
    text = Path(__file__).with_name("language_words.yaml").read_text("ascii")
    return Words.model_validate(yaml.safe_load(text))


@cache
def thing_words(scene: tuple[str, ...], hints: bool) -> Mapping[str, tuple[str, ...]]:
    """Map each word to the kinds that it may mean in a scene; an unlisted kind has its own name.

    Args:
        hints: true if words that describe a thing count in addition to its names.
    """
    meant: dict[str, tuple[str, ...]] = {}
    for kind in scene:
        thing = read_words().things.get(kind)
        if thing is None:
            entries: tuple[str, ...] = (kind.replace("_", " "), kind.rpartition("_")[2])
        elif hints:
            entries = thing.names + thing.hints
        else:
            entries = thing.names
        for word in dict.fromkeys(entries):
            meant[word] = (*meant.get(word, ()), kind)
    return meant


@cache
def relation_words() -> Mapping[str, tuple[str, ...]]:
    """Map each word to the relation that it means, as a tuple with one entry."""
    meant: dict[str, tuple[str, ...]] = {}
    for relation, entries in read_words().relations.items():
        for word in entries:
            meant[word] = (relation,)
    return meant


def find_words(plain: str, meant: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[re.Match[str], tuple[str, ...]]]:
    """Find the words of ``meant`` in a text.

    Yields:
        The match of a word, and the meanings of the word.
    """
    for match in compile_pattern(tuple(meant)).finditer(plain):
        word = _longest_first(meant)[(match.lastindex or 0) - 1]
        yield match, meant[word]


def _longest_first(entries: Iterable[str]) -> list[str]:
    """Sort entries by their length, the longest first."""
    return sorted(entries, key=len, reverse=True)


@cache
def compile_pattern(entries: tuple[str, ...]) -> re.Pattern[str]:
    """Compile a pattern of any of the entries as whole words, the longest first.

    The number of the matched group, counted from 1, is the entry's place in this order.
    """
    groups = []
    for entry in _longest_first(entries):
        without_groups = re.sub(r"\((?!\?)", "(?:", entry)
        groups.append(f"({without_groups})")
    return re.compile(rf"\b(?:{'|'.join(groups)})(?:s|es)?\b")


class Mention(NamedTuple):
    """Word for a thing.

    Attributes:
        at, end: positions of its first character and after its last character.
        kinds: kinds in the scene that share the word.
        relation: relation of something to the thing, by the words right before.
    """

    at: int
    end: int
    kinds: tuple[str, ...]
    relation: str | None


class Reading:
    """Content of an instruction, by its words alone.

    Attributes:
        plain: the text in lower case, without hyphens and apostrophes.
        hints: true if words that describe things count in addition to their names.
        mentions: words for things of the scene, in order.
        back: relations to a place that was named before, and sides, each with its position in the text.
    """

    def __init__(self, text: str, scene: Sequence[str], hints: bool):
        """Read ``text`` in a ``scene`` that consists of these kinds of things."""
        self.plain, self.hints = _plain(text), hints
        relations: list[tuple[int, int, str]] = []
        for match, (meaning,) in find_words(self.plain, relation_words()):
            relations.append((match.start(), match.end(), meaning))
        self.back: list[tuple[int, str]] = []
        for start, end, meaning in relations:
            if meaning in SIDES or _BACK.match(self.plain, end):
                self.back.append((start, meaning))
        self.mentions: list[Mention] = []
        before = 0
        for match, kinds in find_words(self.plain, thing_words(tuple(scene), hints)):
            relation: str | None = None
            for start, end, meaning in relations:
                if start >= before and self._leads(end, match.start()):
                    relation = meaning
            if self.mentions and self.mentions[-1].relation == "between" and self._joins(before, match.start()):
                relation = "between"
            self.mentions.append(Mention(match.start(), match.end(), kinds, relation))
            before = match.end()

    def _leads(self, end: int, start: int) -> bool:
        """Return whether a relation that ends at ``end`` belongs to the thing that begins at ``start``."""
        between = self.plain[end:start]
        return end <= start and not re.search(r"[,.;:?!]", between) and len(between.split()) <= NEAR_WORDS

    def _joins(self, end: int, start: int) -> bool:
        """Return whether ``and`` joins the thing that ends at ``end`` and the thing that begins at ``start``."""
        return end <= start and re.fullmatch(r" and( \w+){0,3} ", self.plain[end:start]) is not None

    def has(self, patterns: Sequence[str]) -> bool:
        """Return whether the text has one of the ``patterns`` as whole words."""
        return compile_pattern(tuple(patterns)).search(self.plain) is not None

    def tells(self, kind: str, moved: frozenset[str]) -> bool:
        """Return whether a word means this kind alone in the scene, or exactly the two moved kinds together."""
        together = moved if kind in moved and self.has(read_words().both) else frozenset()
        return any(kind in mention.kinds and {*mention.kinds} <= together | {kind} for mention in self.mentions)

    def tells_part(self, part: str) -> bool:
        """Return whether the text names this drawer or side, or excludes both other drawers by naming them."""
        if self.has(read_words().parts[part]):
            return True
        if part not in DRAWERS or not self.hints:
            return False
        return all(self.has(read_words().parts[drawer]) for drawer in DRAWERS - {part})

    def tells_top(self, top: bool) -> bool:
        """Return whether the text has words for the top of a shelf exactly if ``top`` is true.

        LIBERO uses ``on`` for the boards of a shelf too.
        """
        return self.has(read_words().top) == top

    def keeps_outside(self) -> bool:
        """Return whether the text names no drawer, as a place on top demands; texts with ``hints`` always pass."""
        return self.hints or not self.has(read_words().drawer)

    def tells_state(self, state: str) -> bool:
        """Return whether the text has words for a state and none for its opposite."""
        return self.has(read_words().states[state].said) and not self.has(read_words().states[state].opposite)

    def relates(self, aim: Aim, accepted: frozenset[str], others: frozenset[str]) -> bool:
        """Return whether the aim's place has an accepted relation, or no relation that contradicts it.

        Args:
            accepted: relations that express the aim.
            others: relations that other parts of the goal explain.
        """
        given = [mention.relation for mention in self.mentions if aim.place in mention.kinds]
        back = {relation for _, relation in self.back}
        if aim.relation in SIDES or accepted & {*given}:
            return bool(accepted & {*given, *back})
        unexplained = [relation for relation in given if relation not in others]
        if accepted & back:
            return WAYS.issuperset(unexplained)
        return bool(unexplained) and UNTOLD.issuperset(unexplained)

    def starts(self, aim: Aim, accepted: frozenset[str], others: frozenset[str]) -> bool:
        """Return whether the text names the things that something starts next to or between.

        The relation must be stated literally if things are called by their names.
        """
        if self.hints:
            return self.relates(aim, accepted, others)
        given = {mention.relation for mention in self.mentions if aim.place in mention.kinds}
        return aim.relation in given | {relation for _, relation in self.back}

    def in_order(self, aims: Sequence[Aim]) -> bool:
        """Return whether the places have the order of the things that go there."""
        things, places = [], []
        for aim in aims:
            things.append(self._first(mention.at for mention in self.mentions if mention.kinds == (aim.thing,)))
            places.append(self._first(self._places(aim)))
        return _ranks(things) == _ranks(places)

    def _first(self, places: Iterable[int]) -> int:
        """Return the least of some positions in the text, or the end of the text if there are none."""
        return min(places, default=len(self.plain))

    def _places(self, aim: Aim) -> Iterator[int]:
        """List the positions in the text of the aim's place."""
        if aim.part:
            for match in compile_pattern(read_words().parts[aim.part]).finditer(self.plain):
                yield match.start()
            return
        for start, relation in self.back:
            if relation == aim.relation:
                yield start
        for mention in self.mentions:
            if aim.place in mention.kinds and mention.relation in {aim.relation, *UNTOLD}:
                yield mention.at


class Demand(NamedTuple):
    """Statement that a rewrite must make, and the fault of a rewrite without it."""

    fault: str
    met: Callable[[Reading], bool]


def changed_goal(text: str, task: Task, hints: bool) -> str | None:
    """Return the first part of the task's goal that ``text`` loses, or ``None`` if it keeps all checked parts.

    Args:
        hints: true if things may be described by common knowledge, and a drawer by exclusion; else by name only.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    reading = Reading(text, read_goal(task).scene, hints)
    for demand in demands(task):
        if not demand.met(reading):
            return demand.fault
    return None


@cache
def demands(task: Task) -> tuple[Demand, ...]:
    """List the goal's demands on a rewrite, as far as LIBERO's own wording meets them."""
    goal = read_goal(task)
    original = Reading(task.instruction, goal.scene, hints=False)
    return tuple(demand for demand in _of_goal(goal, original) if demand.met(original))


def lost_demands(task: Task, carried_task: Task) -> list[str]:
    """List the faults of the task's own instruction in another scene that it does not have in its own scene.

    Args:
        carried_task: the task carried to the other scene.
    """
    goal = read_goal(carried_task)
    reading = Reading(task.instruction, goal.scene, hints=False)
    faults = [demand.fault for demand in _of_goal(goal, reading) if not demand.met(reading)]
    own = read_goal(task)
    own_reading = Reading(task.instruction, own.scene, hints=False)
    own_faults = {demand.fault for demand in _of_goal(own, own_reading) if not demand.met(own_reading)}
    return [fault for fault in faults if fault not in own_faults]


def _of_goal(goal: TaskGoal, original: Reading) -> Iterator[Demand]:
    """List the demands of a goal on its rewrites, given LIBERO's ``original`` wording."""
    located = (*goal.aims, *goal.starts)
    kinds = []
    for aim in located:
        kinds += [kind for kind in (aim.thing, aim.place) if kind]
    kinds += [change.thing for change in goal.changes]
    moved = frozenset(aim.thing for aim in goal.aims)
    for kind in dict.fromkeys(kinds):
        yield Demand(f"has no word for the {_name(kind)} alone", partial(Reading.tells, kind=kind, moved=moved))
    parts = [aim.part for aim in located] + [change.part for change in goal.changes]
    parts += _sides(goal, original)
    for part in dict.fromkeys(part for part in parts if part):
        yield Demand(f"does not identify the part {part!r}", partial(Reading.tells_part, part=part))
    for kind in goal.pairs:
        yield Demand(f"does not name both {_name(kind)}s", partial(Reading.has, patterns=read_words().both))
    for aim in located:
        if aim.relation and aim.place:
            yield Demand(
                f"does not keep the relation {aim.relation!r} to the {_name(aim.place)}", _relation(aim, goal, original)
            )
            if aim.relation == "on" and not aim.part and aim.place in read_words().states["open"].of:
                yield Demand(f"names the inside of the {_name(aim.place)}", Reading.keeps_outside)
            if aim.place in read_words().shelves:
                top = original.has(read_words().top)
                yield Demand(_on_shelf(top), partial(Reading.tells_top, top=top))
    states = {change.state for change in goal.changes} | {*read_words().states} & {*original.plain.split()}
    for state in sorted(states):
        yield Demand(f"does not ask to {state}", partial(Reading.tells_state, state=state))
    destinations = {aim._replace(thing="") for aim in goal.aims}
    if len(moved) > 1 and len(destinations) > 1:
        yield Demand("lets the things change places", partial(Reading.in_order, aims=goal.aims))


def _sides(goal: TaskGoal, original: Reading) -> list[str]:
    """List the sides in LIBERO's wording if a moved thing shares its kind or name with another thing."""
    moved = frozenset(aim.thing for aim in goal.aims)
    named = all(original.tells(kind, moved) for kind in moved) and not goal.pairs
    return [] if named else [side for side in read_words().sides if side in original.plain.split()]


def _on_shelf(top: bool) -> str:
    """Return the fault of a rewrite that does not keep a shelf's top, or its inside if ``top`` is false."""
    return "has no words for the top of the shelf" if top else "names the top of the shelf, which is another place"


def _relation(aim: Aim, goal: TaskGoal, original: Reading) -> Callable[[Reading], bool]:
    """Return the check of an aim's relation, which accepts the relation of LIBERO's wording too.

    For example, a goal puts a thing *on* a bowl and LIBERO's wording *in* it. A thing is taken *off* its start.
    """
    others: set[str] = set()
    for located in (*goal.aims, *goal.starts):
        if located.place == aim.place and located != aim and located.relation:
            others.add(located.relation)
    worded: set[str] = set()
    for mention in original.mentions:
        if mention.relation and aim.place in mention.kinds and mention.relation not in others:
            worded.add(mention.relation)
    also = {"off"} if aim in goal.starts else worded
    if any(start.place == aim.place for start in goal.starts):
        others.add("off")
    accepted = frozenset({str(aim.relation), *also})
    explained = frozenset(others)
    if aim in goal.starts and aim.relation in ("next to", "between"):
        return partial(Reading.starts, aim=aim, accepted=accepted, others=explained)
    return partial(Reading.relates, aim=aim, accepted=accepted, others=explained)


def _name(kind: str) -> str:
    """Return a kind in plain words."""
    return kind.replace("_", " ")


def _plain(text: str) -> str:
    """Return a text in lower case, without hyphens, apostrophes and repeated white space."""
    return " ".join(re.sub(r"[-']", " ", text.lower()).split())


def _ranks(places: Sequence[int]) -> list[int]:
    """Return the indices that sort ``places``."""
    return sorted(range(len(places)), key=places.__getitem__)
