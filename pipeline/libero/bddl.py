"""Tasks as BDDL files define them: instruction, things in the scene, places at the start, and goal."""

import re
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from bddl.parsing import scan_tokens

from pipeline.errors import PipelineError
from pipeline.libero.arenas import Arena

Fact = tuple[str, ...]
"""A predicate and its arguments, such as ``("on", "plate_1", "main_table_plate_region")``."""

_ARENA = re.compile(rf"libero_({'|'.join(get_args(Arena))})(?:_tabletop)?_manipulation")
_PROBLEM = re.compile(r"\(\s*define\s*\(\s*problem\s+([^\s()]+)\s*\)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII)
_LANGUAGE = re.compile(r"\(\s*:language\s([^()]*)\)")


ARGUMENTS = {"on": 2, "in": 2, "open": 1, "close": 1, "turnon": 1, "turnoff": 1}
"""Predicate of a goal to its number of arguments."""

REGION_WORDS = {"cookies": "box", "flat_stove": "stove", "glazed_rim_porcelain_ramekin": "ramekin"}
"""Category to the other word that the names of LIBERO's regions use for it."""


class Neighbours(NamedTuple):
    """Meaning of the name of a region of the working surface.

    Attributes:
        relation: ``next to``, ``between``, or the last word of the name, such as ``left``.
        things: the object or fixture that the region is next to, or the two things that the region is between.
    """

    relation: str
    things: tuple[str, ...]


@dataclass(frozen=True)
class Bddl:
    """A task as its file defines it; all names in lower case, as LIBERO reads them.

    Attributes:
        problem: name of the class that builds the scene.
        language: the instruction.
        regions: ``<target>_<region>`` to the centre (x, y) of its range in m, in the frame of the target. Regions that
            their target defines itself, such as a drawer, are left out.
        objects: movable object to category.
        fixtures: immovable thing, such as a table or a stove, to category.
        of_interest: the objects and fixtures that the task is about.
        start: facts that hold at the start.
        goal: facts that must all hold in the end.
    """

    problem: str
    language: str
    regions: Mapping[str, tuple[float, float]]
    objects: Mapping[str, str]
    fixtures: Mapping[str, str]
    of_interest: tuple[str, ...]
    start: tuple[Fact, ...]
    goal: tuple[Fact, ...]

    @property
    def arena(self) -> Arena:
        """Room of the scene."""
        return arena(self.problem)

    @cached_property
    def places(self) -> dict[str, str]:
        """Object or fixture to the region or thing that it starts on or in."""
        return {fact[1]: fact[2] for fact in self.start if fact[0] in ("on", "in")}

    @cached_property
    def scene(self) -> Hashable:
        """Arena and places of all things; tasks with equal values begin in the same scene."""
        return self.arena, frozenset(self.scene_names.values())

    @cached_property
    def scene_names(self) -> dict[str, str]:
        """Object or fixture to the name that it has in every task that begins in the same scene.

        Tasks number things of one category arbitrarily: the bowl on the stove is akita_black_bowl_1 in one task and
        akita_black_bowl_2 in another. Therefore the name consists of the category and the place. Things of one category
        at one place are numbered.
        """
        counts: Counter[str] = Counter()
        names = {}
        for thing in sorted(self.places):
            spot = f"{self.category(thing)} {self._spot(thing)}"
            counts[spot] += 1
            names[thing] = f"{spot} #{counts[spot]}"
        return names

    @property
    def asked(self) -> tuple[Hashable, frozenset[tuple[str, ...]]]:
        """The goal in its scene; equal for two tasks if one goal is to be reached in one scene."""
        facts = set()
        for predicate, *arguments in self.goal:
            facts.add((predicate, *map(self._scene_name, arguments)))
        return self.scene, frozenset(facts)

    def _scene_name(self, name: str) -> str:
        """Return the name of a thing or a region, with the owner's name in every task that begins in the scene."""
        owner = self.owner(name) or ""
        return self.scene_names.get(owner, owner) + name.removeprefix(owner)

    def category(self, name: str) -> str:
        """Return the category of an object or fixture; the name itself if the file declares no such thing."""
        return self.objects.get(name) or self.fixtures.get(name) or name

    @cached_property
    def carriers(self) -> dict[str, str]:
        """Object or fixture to the thing that it moves with.

        A thing that starts in a region of the working surface moves by itself. Any other thing moves with the thing
        that it stands on or in: a bowl in wooden_cabinet_1_top_region moves with wooden_cabinet_1.
        """
        return {thing: self._supports(thing)[-1] for thing in self.places}

    @cached_property
    def centres_m(self) -> dict[str, tuple[float, float]]:
        """Object or fixture to the centre (x, y) in m of the region that its carrier (see ``carriers``) starts in.

        Things whose carrier starts in no region with a range are left out.
        """
        places = {thing: self.places[carrier] for thing, carrier in self.carriers.items()}
        return {thing: self.regions[place] for thing, place in places.items() if place in self.regions}

    def owner(self, name: str) -> str | None:
        """Return the object or fixture that a part or region belongs to.

        For example, wooden_cabinet_1 owns wooden_cabinet_1_top_region. A thing owns itself. Return `None` if the name
        begins with no thing's name.
        """
        owners = [thing for thing in (*self.objects, *self.fixtures) if f"{name}_".startswith(f"{thing}_")]
        return max(owners, key=len, default=None)

    def neighbours(self, region: str) -> Neighbours | None:
        """Parse the name of a region of the working surface; return `None` if it names no thing.

        Without surface and relation, the rest of the name must be the thing's name, its category or its word in
        ``REGION_WORDS``. ``left_region`` names no thing, and neither does ``plate_left_region`` if there are two
        plates.
        """
        surface = self.owner(region)
        if surface is None or not self._on_surface(region):
            return None
        words = region.removeprefix(f"{surface}_").removesuffix("_region")
        if words.startswith("next_to_"):
            return self._neighbours("next to", words.removeprefix("next_to_"))
        if words.startswith("between_"):
            parts = words.removeprefix("between_").split("_")
            for length in range(1, len(parts)):
                first, second = "_".join(parts[:length]), "_".join(parts[length:])
                between = self._neighbours("between", first, second)
                if between is not None:
                    return between
            return None
        words, _, side = words.rpartition("_")
        return self._neighbours(side, words)

    @property
    def goal_regions(self) -> dict[str, str]:
        """Region of the working surface that the goal puts something in, to the thing that the region is named after.

        For example, living_room_table_plate_right_region, to the right of the plate, is named after plate_1.
        """
        things = {}
        for region in [fact[2] for fact in self.goal if len(fact) > 2]:
            neighbours = self.neighbours(region)
            if neighbours is not None and len(neighbours.things) == 1:
                things[region] = neighbours.things[0]
        return things

    @property
    def targets(self) -> tuple[str, ...]:
        """Movable objects that the goal puts somewhere, without duplicates."""
        placed = [fact[1] for fact in self.goal if fact[0] in ("on", "in")]
        return tuple(name for name in dict.fromkeys(placed) if name in self.objects)

    @property
    def things(self) -> tuple[str, ...]:
        """Fixtures and objects, without the table or the floor that they stand on."""
        kinds = {**self.fixtures, **self.objects}
        return tuple(name for name, kind in kinds.items() if not kind.endswith(("table", "floor")))

    @property
    def things_of_interest(self) -> tuple[str, ...]:
        """Subset of ``things`` that the task is about."""
        return self.things_named(self.of_interest)

    @property
    def things_of_goal(self) -> tuple[str, ...]:
        """Subset of ``things`` that the facts of the goal refer to."""
        names: list[str] = []
        for _, *arguments in self.goal:
            names += arguments
        return self.things_named(names)

    def things_named(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the subset of ``things`` that some names refer to.

        A region, such as a drawer of a cabinet or the burner of a stove, refers to the thing that it belongs to.
        """
        owners = {self.owner(name) for name in names}
        return tuple(thing for thing in self.things if thing in owners)

    @property
    def receptacles(self) -> tuple[str, ...]:
        """Movable objects that the goal puts other objects on or in, without duplicates.

        For example, a goal in basket_1_contain_region has the receptacle basket_1.
        """
        owners = {self.owner(fact[2]) for fact in self.goal if fact[0] in ("on", "in")}
        return tuple(name for name in self.objects if name in owners)

    def _on_surface(self, region: str) -> bool:
        """Return whether a region belongs to the working surface, not to a thing that stands on the surface."""
        return region in self.regions and self.owner(region) not in self.places

    def _supports(self, thing: str) -> list[str]:
        """List the thing, its support, the support's support and so on, without the working surface.

        The support of a thing is the thing that it stands on or in.
        """
        places = self.places
        supports = [thing]
        place = places.get(thing, "")
        while not self._on_surface(place):
            support = self.owner(place)
            if support is None or support not in places or support in supports:
                break
            supports.append(support)
            place = places[support]
        return supports

    def _spot(self, thing: str) -> str:
        """Describe the place of a thing by categories and parts, from its support down to the working surface.

        The description holds no names of things.
        """
        parts = []
        for support in self._supports(thing):
            place = self.places[support]
            owner = self.owner(place) or ""
            part = place.removeprefix(owner)
            if place in self.regions:
                x_m, y_m = self.regions[place]
                part = f" at {x_m:.4f}, {y_m:.4f}"
            parts.append(f"on {self.category(owner)}{part}")
        return " ".join(parts)

    def _neighbours(self, relation: str, *words: str) -> Neighbours | None:
        """Return the things that some words refer to; `None` unless each word refers to exactly one thing."""
        things = []
        for word in words:
            thing = self._called(word)
            if thing is None:
                return None
            things.append(thing)
        return Neighbours(relation, tuple(things))

    def _called(self, word: str) -> str | None:
        """Return the thing that a word of a region's name refers to; `None` if it refers to no or to several things.

        The word is a thing's name, the category of exactly one thing, or that category's word in ``REGION_WORDS``.
        """
        if word in self.places:
            return word
        renamed = [category for category, region_word in REGION_WORDS.items() if region_word == word]
        categories = {word, *renamed}
        things = [thing for thing in self.places if self.category(thing) in categories]
        return things[0] if len(things) == 1 else None


@cache
def read(path: Path) -> Bddl:
    """Read a task's file, once in each process.

    Raises:
        PipelineError: when the file cannot be read or does not define a task.
    """
    try:
        return parse(path.read_text(encoding="utf-8"), path)
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(f"the file cannot be read ({error})", where=path, expected="a BDDL file") from error


def parse(text: str, where: object) -> Bddl:
    """Parse a BDDL file's text; an error names the file by ``where``.

    Raises:
        PipelineError: when the text does not define a task.
    """
    expected = "a BDDL problem with :language, :objects, :init and :goal"
    if text.startswith("\ufeff"):
        raise PipelineError(
            "the file begins with a byte order mark (BOM), which LIBERO cannot read",
            where=where,
            expected=expected,
            remedy="save the file as UTF-8 without BOM",
        )
    try:
        tokens = scan_tokens(string=text)
        section = _section_with_empty(tokens)
        if section:
            raise PipelineError(
                f"the file has empty parentheses `()` in {section}",
                where=where,
                expected=expected,
                remedy="remove them; a section without content is written as `(:fixtures)`",
            )
        _reject_expressions(tokens, where)
        _, (_, problem), *rest = tokens
        sections: dict[str, Any] = {name: content for name, *content in rest}
        definition = Bddl(
            problem=problem,
            language=" ".join(sections[":language"]),
            regions=dict(_regions(sections.get(":regions", []))),
            objects=_declared(sections[":objects"]),
            fixtures=_declared(sections.get(":fixtures", [])),
            of_interest=tuple(sections.get(":obj_of_interest", [])),
            start=tuple(map(_fact, sections[":init"])),
            goal=_goal(sections[":goal"][0]),
        )
        _check(definition, where)
        return definition
    except PipelineError:
        raise
    except KeyError as error:
        raise PipelineError(f"the file has no {error.args[0]}", where=where, expected=expected) from error
    except Exception as error:  # the tokeniser raises nothing more specific
        raise PipelineError(f"the file is not a BDDL file ({error})", where=where, expected=expected) from error


def without_comments(text: str) -> str:
    """Return a BDDL file's text without comments, which LIBERO ignores."""
    return re.sub(r";.*", "", text)


def replace_sections(text: str, sections: Mapping[str, str]) -> str:
    """Return a BDDL file's text without comments and with other sections.

    Args:
        text: the text.
        sections: name of a section, such as ``:goal``, to its new content; a section that the text lacks is added.
    """
    text = without_comments(text)
    for name, content in sections.items():
        begin = re.search(rf"\(\s*{name}(?=[\s()])", text, re.IGNORECASE)
        start = text.rindex(")") if begin is None else begin.start()
        end = start if begin is None else _end(text, start)
        text = f"{text[:start]}({name} {content}){text[end:]}"
    return text


def _end(text: str, start: int) -> int:
    """Return the index after the expression that begins at ``start``."""
    depth = 0
    for place in range(start, len(text)):
        depth += {"(": 1, ")": -1}.get(text[place], 0)
        if depth == 0:
            return place + 1
    raise ValueError("the expression has no end")


def goal_text(facts: Iterable[Fact]) -> str:
    """Return the content of the section ``:goal`` that requires all of the facts."""
    joined = " ".join(f"({' '.join(fact)})" for fact in facts)
    return f"(And {joined})"


def heading(text: str, where: object) -> tuple[str, str]:
    """Return ``problem`` and ``language`` of a BDDL file's text without parsing it.

    Parsing is slow, and most of the 10,030 test tasks need only these two.

    Raises:
        PipelineError: when the text has no problem or no instruction.
    """
    text = without_comments(text).lower()
    problem, language = _PROBLEM.search(text), _LANGUAGE.search(text)
    if problem is None or language is None:
        raise PipelineError("the file is not a BDDL file", where=where, expected="a BDDL problem with :language")
    return problem[1], " ".join(language[1].split())


def arena(problem: str) -> Arena:
    """Return the arena in the name of a scene's class, such as libero_kitchen_tabletop_manipulation (lower case).

    LIBERO-Plus's names have further text after this.

    Raises:
        PipelineError: when the name has no arena.
    """
    match = _ARENA.match(problem)
    if match is None:
        raise PipelineError(
            f"the scene class {problem!r} names no known arena",
            where="(define (problem ...)) of a BDDL file",
            expected=f"libero_<arena>_[tabletop_]manipulation, <arena> being one of {', '.join(get_args(Arena))}",
            remedy="name one of LIBERO's scene classes, see docs/own-tasks.md",
        )
    return cast(Arena, match[1])


def _section_with_empty(tokens: list[Any]) -> str | None:
    """Return the name of the first section of a BDDL file that has an empty expression; `None` if no section has."""
    for section in tokens:
        if isinstance(section, list) and (section == [] or _has_empty(section)):
            return str(section[0]) if section and isinstance(section[0], str) else "the problem itself"
    return None


def _has_empty(expression: list[Any]) -> bool:
    """Return whether an expression contains an empty expression at any depth."""
    return any(isinstance(part, list) and (part == [] or _has_empty(part)) for part in expression)


def _reject_expressions(tokens: list[Any], where: object) -> None:
    """Raise a ``PipelineError`` if a yaw is not a number, because LIBERO evaluates it as Python code."""
    for part in tokens:
        if not isinstance(part, list):
            continue
        if part[0] == ":yaw_rotation":
            for value in chain.from_iterable(part[1]):
                if not _NUMBER.fullmatch(value):
                    raise PipelineError(
                        f":yaw_rotation has {value!r}, and LIBERO would run it as Python code",
                        where=where,
                        expected="two numbers in radians, such as (:yaw_rotation ((0.0 1.57)))",
                    )
        _reject_expressions(part, where)


def _regions(listed: list[Any]) -> list[tuple[str, tuple[float, float]]]:
    """Return name and centre of each region with a range.

    Args:
        listed: items ``[name, [":target", thing], [":ranges", [[x0, y0, x1, y1], ...]], ...]``; only the first range
            of a region counts.
    """
    centres = []
    for name, *fields in listed:
        sections = {field: content for field, *content in fields}
        if ":ranges" in sections:
            x0, y0, x1, y1 = map(float, sections[":ranges"][0][0])
            centres.append((f"{sections[':target'][0]}_{name}", ((x0 + x1) / 2, (y0 + y1) / 2)))
    return centres


def _declared(listed: list[str]) -> dict[str, str]:
    """Return name to category of declarations such as ``a_1 a_2 - kind b_1 - other``."""
    categories: dict[str, str] = {}
    while "-" in listed:
        end = listed.index("-")
        categories |= dict.fromkeys(listed[:end], listed[end + 1])
        listed = listed[end + 2 :]
    return categories


def _goal(expression: Any) -> tuple[Fact, ...]:
    """Return the facts of a goal: one fact, or a conjunction of facts."""
    facts = expression[1:] if expression[0] == "and" else [expression]
    return tuple(map(_fact, facts))


def _check(definition: Bddl, where: object) -> None:
    """Check goal and names of a definition.

    Raises:
        PipelineError: when the goal has no fact, a predicate that LIBERO cannot check, or a wrong number of arguments;
            or when a name belongs to no declared object or fixture.
    """
    if not definition.goal:
        raise PipelineError("the goal is empty", where=where, expected="at least one fact in :goal")
    for predicate, *arguments in definition.goal:
        if ARGUMENTS.get(predicate) != len(arguments):
            known = ", ".join(f"{name} ({number})" for name, number in ARGUMENTS.items())
            raise PipelineError(
                f"the goal has the fact ({predicate} {' '.join(arguments)})",
                where=where,
                expected=f"one of these predicates, with its number of arguments: {known}",
            )
    named: dict[str, set[str]] = {":obj_of_interest": {*definition.of_interest}, ":init": set(), ":goal": set()}
    for section, facts in ((":init", definition.start), (":goal", definition.goal)):
        for _, *arguments in facts:
            named[section].update(arguments)
    for section, names in named.items():
        for name in sorted(names):
            if definition.owner(name) is None:
                raise PipelineError(
                    f"{section} names {name!r}, which the file does not declare",
                    where=where,
                    expected=f"{', '.join(definition.things)}, the working surface, or a region of these",
                )


def _fact(expression: Any) -> Fact:
    """Convert a parsed expression to a fact."""
    if not all(isinstance(word, str) for word in expression):
        raise ValueError(f"{expression} is not a plain fact")
    return tuple(expression)
