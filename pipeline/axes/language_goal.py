"""Whether a rewrite keeps the goal of its task: what is moved, where to, how it then stands, what is opened or lit.

The goal is that of the BDDL file, the words for it are those of ``language_words.yaml``. No grammar is parsed: each
thing and each place must be called by a word that nothing else in the scene shares, the relation is given by the words
right before a place, and where two things go to different places, the first goes to the first. What LIBERO's own
wording does not say by these words is not asked of a rewrite. So a goal that is left out is found, where things are
named and where they are described. A second goal is found by ``language_extra.py``. The opposite ("do not") is not
found, nor whether a description fits one thing only: writers check that.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, NamedTuple

import yaml
from pydantic import BeforeValidator

from pipeline.axes.base import Frozen
from pipeline.libero.task_goal import Aim, TaskGoal, read_goal
from pipeline.types import Task

SIDES = ("front", "left", "right")
"""Relations that may be given without a word for the place, as in ``to its right``."""

UNTOLD = frozenset({"to", None})
"""What leaves the relation open: ``bring it to the basket``, ``the basket should have it``."""

WAYS = frozenset({"on", "in", "off", "to", None})
"""Relations that name no place where they are followed by another: ``hold it over the basket and let it in``."""

DRAWERS = frozenset({"top", "middle", "bottom"})

NEAR_WORDS = 5
"""A relation belongs to a place that at most so many words come before."""

_BACK = re.compile(
    r"\s*(?:$|[,.;:?!]|(?:and|it|its|that|this|there|these|those|them|which|each|one|what)\b"
    r"|the (?:former|latter|other)\b)"
)
"""What follows a relation to a place that was named before."""


Entries = Annotated[tuple[str, ...], BeforeValidator(lambda listed: re.split(r",\s+", listed))]
"""Regular expressions, in YAML with commas between them."""


class Thing(Frozen):
    """What a kind of thing is called, and how else it can be described."""

    names: Entries
    hints: Entries


class State(Frozen):
    """How a state is asked for, and how its opposite is.

    Attributes:
        asked: how it is asked for with the thing, for which ``IT`` stands, or a pronoun.
        wished: how its result is wished for; ``THING`` stands for the thing without an article.
        of: kinds that can be in the state.
    """

    said: Entries
    opposite: Entries
    asked: Entries
    wished: Entries
    of: Entries


class Words(Frozen):
    """``language_words.yaml``; every string is a regular expression."""

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


@cache
def words() -> Words:
    """The words that are shipped."""
    return Words.model_validate(yaml.safe_load(Path(__file__).with_name("language_words.yaml").read_text("ascii")))


@cache
def thing_words(scene: tuple[str, ...], hints: bool) -> Mapping[str, tuple[str, ...]]:
    """Word to the kinds that it may mean in a scene; a kind that is not listed goes by its own name."""
    meant: dict[str, tuple[str, ...]] = {}
    for kind in scene:
        known = words().things.get(kind)
        names = known.names if known else (kind.replace("_", " "), kind.rpartition("_")[2])
        for word in dict.fromkeys(names + known.hints if known and hints else names):
            meant[word] = (*meant.get(word, ()), kind)
    return meant


@cache
def relation_words() -> Mapping[str, tuple[str, ...]]:
    return {word: (relation,) for relation, told in words().relations.items() for word in told}


def found(plain: str, meant: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[re.Match[str], tuple[str, ...]]]:
    """The listed words in a text, with what they mean."""
    for match in pattern(tuple(meant)).finditer(plain):
        yield match, meant[_longest_first(meant)[(match.lastindex or 0) - 1]]


def _longest_first(entries: Iterable[str]) -> list[str]:
    return sorted(entries, key=len, reverse=True)


@cache
def pattern(entries: tuple[str, ...]) -> re.Pattern[str]:
    """Any of the entries as whole words; the number of the group is the entry's place among the longest first."""
    groups = (re.sub(r"\((?!\?)", "(?:", entry) for entry in _longest_first(entries))
    return re.compile(rf"\b(?:{'|'.join(f'({group})' for group in groups)})(?:s|es)?\b")


class Mention(NamedTuple):
    """A word for a thing.

    Attributes:
        at, end: where it begins and ends.
        kinds: those in the scene that share the word.
        relation: how something stands to it, by the words right before.
    """

    at: int
    end: int
    kinds: tuple[str, ...]
    relation: str | None


class Reading:
    """What an instruction says, by its words alone.

    Attributes:
        plain: the text in lower case, without hyphens and apostrophes.
        mentions: words for things of the scene, in order.
        back: relations to a place that was named before, and sides, with where they begin.
    """

    def __init__(self, text: str, scene: Sequence[str], hints: bool):
        self.plain, self.hints = _plain(text), hints
        relations = [
            (match.start(), match.end(), relation) for match, (relation,) in found(self.plain, relation_words())
        ]
        self.back = [
            (start, relation) for start, end, relation in relations if relation in SIDES or _BACK.match(self.plain, end)
        ]
        self.mentions: list[Mention] = []
        before = 0
        for match, kinds in found(self.plain, thing_words(tuple(scene), hints)):
            near = [
                relation for start, end, relation in relations if start >= before and self._leads(end, match.start())
            ]
            relation = near[-1] if near else None
            if self.mentions and self.mentions[-1].relation == "between" and self._joins(before, match.start()):
                relation = "between"
            self.mentions.append(Mention(match.start(), match.end(), kinds, relation))
            before = match.end()

    def _leads(self, end: int, start: int) -> bool:
        between = self.plain[end:start]
        return end <= start and not re.search(r"[,.;:?!]", between) and len(between.split()) <= NEAR_WORDS

    def _joins(self, end: int, start: int) -> bool:
        return end <= start and re.fullmatch(r" and( \w+){0,3} ", self.plain[end:start]) is not None

    def has(self, patterns: Sequence[str]) -> bool:
        return pattern(tuple(patterns)).search(self.plain) is not None

    def tells(self, kind: str, moved: frozenset[str]) -> bool:
        """Whether a word fits this kind and no other in the scene, or both that are moved and no other."""
        together = moved if kind in moved and self.has(words().both) else frozenset()
        return any(kind in mention.kinds and {*mention.kinds} <= together | {kind} for mention in self.mentions)

    def tells_part(self, part: str) -> bool:
        """Whether it says which drawer or side, if only by naming both of the other drawers."""
        others = DRAWERS - {part} if part in DRAWERS and self.hints else {part}
        return self.has(words().parts[part]) or all(self.has(words().parts[other]) for other in others)

    def tells_top(self, top: bool) -> bool:
        """Whether it says on top of a shelf, or does not, as ``top`` demands: LIBERO says ``on`` of its boards too."""
        return self.has(words().top) == top

    def keeps_outside(self) -> bool:
        """Whether it names no drawer, where things are called by their names and the top is meant."""
        return self.hints or not self.has(words().drawer)

    def tells_state(self, state: str) -> bool:
        return self.has(words().states[state].said) and not self.has(words().states[state].opposite)

    def relates(self, aim: Aim, accepted: frozenset[str], others: frozenset[str]) -> bool:
        """Whether the aim's place is named with an accepted relation, or at least with none but those of ``others``."""
        told = [mention.relation for mention in self.mentions if aim.place in mention.kinds]
        back = {relation for _, relation in self.back}
        if aim.relation in SIDES or accepted & {*told}:
            return bool(accepted & {*told, *back})
        unexplained = [relation for relation in told if relation not in others]
        if accepted & back:
            return WAYS.issuperset(unexplained)
        return bool(unexplained) and UNTOLD.issuperset(unexplained)

    def starts(self, aim: Aim, accepted: frozenset[str], others: frozenset[str]) -> bool:
        """Whether it says next to or between which things something starts: in so many words if things have names."""
        if self.hints:
            return self.relates(aim, accepted, others)
        told = {mention.relation for mention in self.mentions if aim.place in mention.kinds}
        return aim.relation in told | {relation for _, relation in self.back}

    def in_order(self, aims: Sequence[Aim]) -> bool:
        """Whether the places come in the order of the things that go there."""
        things = [self._first(one.at for one in self.mentions if one.kinds == (aim.thing,)) for aim in aims]
        return _ranks(things) == _ranks([self._first(self._places(aim)) for aim in aims])

    def _first(self, places: Iterable[int]) -> int:
        return min(places, default=len(self.plain))

    def _places(self, aim: Aim) -> Iterator[int]:
        if aim.part:
            yield from (match.start() for match in pattern(words().parts[aim.part]).finditer(self.plain))
            return
        yield from (start for start, relation in self.back if relation == aim.relation)
        yield from (
            one.at for one in self.mentions if aim.place in one.kinds and one.relation in {aim.relation, *UNTOLD}
        )


class Demand(NamedTuple):
    """Something that a rewrite has to say, and the fault where it does not."""

    fault: str
    met: Callable[[Reading], bool]


def changed_goal(text: str, task: Task, hints: bool) -> str | None:
    """What of the task's goal ``text`` does not keep; None when it keeps all that is checked.

    Args:
        hints: whether things may be described by what one knows of them, and a drawer by exclusion; else by name only.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    reading = Reading(text, read_goal(task.bddl_file).scene, hints)
    return next((demand.fault for demand in demands(task) if not demand.met(reading)), None)


@cache
def demands(task: Task) -> tuple[Demand, ...]:
    """What the goal demands of a rewrite, as far as LIBERO's own wording meets it."""
    goal = read_goal(task.bddl_file)
    original = Reading(task.instruction, goal.scene, hints=False)
    return tuple(demand for demand in _of_goal(goal, original) if demand.met(original))


def _of_goal(goal: TaskGoal, original: Reading) -> Iterator[Demand]:
    located = (*goal.aims, *goal.starts)
    kinds = [kind for aim in located for kind in (aim.thing, aim.place) if kind]
    moved = frozenset(aim.thing for aim in goal.aims)
    for kind in dict.fromkeys([*kinds, *(change.thing for change in goal.changes)]):
        yield Demand(f"has no word for the {_name(kind)} alone", partial(Reading.tells, kind=kind, moved=moved))
    parts = [aim.part for aim in located] + [change.part for change in goal.changes]
    parts += _sides(goal, original)
    for part in dict.fromkeys(part for part in parts if part):
        yield Demand(f"does not say which, {part}", partial(Reading.tells_part, part=part))
    for kind in goal.pairs:
        yield Demand(f"does not say both {_name(kind)}s", partial(Reading.has, patterns=words().both))
    for aim in located:
        if aim.relation and aim.place:
            yield Demand(
                f"does not keep the relation {aim.relation!r} to the {_name(aim.place)}", _relation(aim, goal, original)
            )
            if aim.relation == "on" and not aim.part and aim.place in words().states["open"].of:
                yield Demand(f"names the inside of the {_name(aim.place)}", Reading.keeps_outside)
            if aim.place in words().shelves:
                top = original.has(words().top)
                yield Demand(_on_shelf(top), partial(Reading.tells_top, top=top))
    states = {change.state for change in goal.changes} | {*words().states} & {*original.plain.split()}
    for state in sorted(states):
        yield Demand(f"does not say to {state}", partial(Reading.tells_state, state=state))
    if len({aim.thing for aim in goal.aims}) > 1 and len({aim._replace(thing="") for aim in goal.aims}) > 1:
        yield Demand("lets the things change places", partial(Reading.in_order, aims=goal.aims))


def _sides(goal: TaskGoal, original: Reading) -> list[str]:
    """List the sides in LIBERO's wording, where no name tells a moved thing from the others of its kind or name."""
    moved = frozenset(aim.thing for aim in goal.aims)
    named = all(original.tells(kind, moved) for kind in moved) and not goal.pairs
    return [] if named else [side for side in words().sides if side in original.plain.split()]


def _on_shelf(top: bool) -> str:
    return "does not say on top of the shelf" if top else "says on top of the shelf, which is another place"


def _relation(aim: Aim, goal: TaskGoal, original: Reading) -> Callable[[Reading], bool]:
    """The demand for an aim's relation, in LIBERO's wording too: what is on a bowl is in it; a start is left."""
    same_place = [one.relation for one in (*goal.aims, *goal.starts) if one.place == aim.place and one != aim]
    others = frozenset(relation for relation in same_place if relation)
    worded = {one.relation for one in original.mentions if one.relation and aim.place in one.kinds} - others
    also = {"off"} if aim in goal.starts else worded
    others |= {"off"} if any(one.place == aim.place for one in goal.starts) else frozenset()
    accepted = frozenset({str(aim.relation), *also})
    if aim in goal.starts and aim.relation in ("next to", "between"):
        return partial(Reading.starts, aim=aim, accepted=accepted, others=others)
    return partial(Reading.relates, aim=aim, accepted=accepted, others=others)


def _name(kind: str) -> str:
    return kind.replace("_", " ")


def _plain(text: str) -> str:
    return " ".join(re.sub(r"[-']", " ", text.lower()).split())


def _ranks(places: Sequence[int]) -> list[int]:
    return sorted(range(len(places)), key=places.__getitem__)
