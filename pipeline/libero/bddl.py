"""What a BDDL file says of a task: its instruction, what is in its scene, where things start, and its goal."""

import re
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast, get_args

from bddl.parsing import scan_tokens

from pipeline.errors import PipelineError

Fact = tuple[str, ...]
"""A predicate and its arguments, such as ``("on", "plate_1", "main_table_plate_region")``."""

Arena = Literal["tabletop", "kitchen", "living_room", "study", "floor"]
"""LIBERO's rooms: table or floor, walls, lamps and where the agent view is."""

_ARENA = re.compile(rf"libero_({'|'.join(get_args(Arena))})(?:_tabletop)?_manipulation")
_PROBLEM = re.compile(r"\(define\s+\(problem\s+([^\s()]+)\)")
_LANGUAGE = re.compile(r"\(:language\s([^()]*)\)")


REGION_WORDS = {"cookies": "box", "flat_stove": "stove", "glazed_rim_porcelain_ramekin": "ramekin"}
"""Categories that the names of LIBERO's regions call otherwise."""


class Beside(NamedTuple):
    """What the name of a region of the working surface says.

    Attributes:
        relation: ``next to``, ``between``, or the last word of the name, such as ``left``.
        things: the object or fixture that the region is beside, or the two that it is between.
    """

    relation: str
    things: tuple[str, ...]


@dataclass(frozen=True)
class Bddl:
    """A task as its file defines it; all names in lower case, as LIBERO reads them.

    Attributes:
        problem: name of the class that builds the scene.
        language: the instruction.
        regions: ``<target>_<region>`` to the centre (x, y) of its range in m, in the frame of the target; a region
            that its target defines itself, such as a drawer, is not among them.
        objects: movable object to category.
        fixtures: thing that stays where it is, such as a table or a stove, to category.
        of_interest: the objects and fixtures that the task is about.
        start: what holds at first.
        goal: what must hold in the end, all of it.
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
        """Where the scene is."""
        return arena(self.problem)

    @property
    def places(self) -> dict[str, str]:
        """Object or fixture to the region or thing that it starts on or in."""
        return {fact[1]: fact[2] for fact in self.start if fact[0] in ("on", "in")}

    @cached_property
    def scene(self) -> Hashable:
        """Equal for tasks that begin in the same scene: the arena, and what stands where."""
        return self.arena, frozenset(self.scene_names.values())

    @cached_property
    def scene_names(self) -> dict[str, str]:
        """Object or fixture to the name that it has in every task that begins in the same scene.

        Tasks number things of one category as they like: the bowl on the stove is akita_black_bowl_1 in one task and
        akita_black_bowl_2 in another. So the name consists of the category and the place. Things of one category at
        one place are numbered.
        """
        spots = {thing: f"{self.category(thing)} {self._spot(thing)}" for thing in sorted(self.places)}
        before: Counter[str] = Counter()
        names = {}
        for thing, spot in spots.items():
            before[spot] += 1
            names[thing] = f"{spot} #{before[spot]}"
        return names

    def category(self, name: str) -> str:
        """Of an object or fixture; the name itself if the file declares no such thing."""
        return self.objects.get(name) or self.fixtures.get(name) or name

    @property
    def carriers(self) -> dict[str, str]:
        """Object or fixture to what it moves with: itself if it starts in a region of the working surface, else what it
        stands on or in, such as wooden_cabinet_1 for a bowl that starts in wooden_cabinet_1_top_region."""
        return {thing: self._supports(thing)[-1] for thing in self.places}

    @property
    def centres_m(self) -> dict[str, tuple[float, float]]:
        """Object or fixture to the centre (x, y) of the region that it, or else what carries it, starts in; without
        things that start in no region with a range."""
        places = {thing: self.places[carrier] for thing, carrier in self.carriers.items()}
        return {thing: self.regions[place] for thing, place in places.items() if place in self.regions}

    def owner(self, name: str) -> str | None:
        """The object or fixture that has a part or region: wooden_cabinet_1 for wooden_cabinet_1_top_region.

        A thing owns itself. `None` if the name begins with no thing's name.
        """
        owners = [thing for thing in (*self.objects, *self.fixtures) if f"{name}_".startswith(f"{thing}_")]
        return max(owners, key=len, default=None)

    def beside(self, region: str) -> Beside | None:
        """Parse the name of a region of the working surface; `None` if it names no thing.

        A region names a thing only if all that the name leaves, without surface and relation, is the thing's name, its
        category or its word in ``REGION_WORDS``. ``left_region`` names none, and neither does ``plate_left_region`` if
        there are two plates.
        """
        surface = self.owner(region)
        if surface is None or not self._on_surface(region):
            return None
        words = region.removeprefix(f"{surface}_").removesuffix("_region")
        if words.startswith("next_to_"):
            return self._beside("next to", words.removeprefix("next_to_"))
        if words.startswith("between_"):
            both = words.removeprefix("between_").split("_")
            splits = (("_".join(both[:at]), "_".join(both[at:])) for at in range(1, len(both)))
            pairs = (self._beside("between", *pair) for pair in splits)
            return next((pair for pair in pairs if pair is not None), None)
        words, _, side = words.rpartition("_")
        return self._beside(side, words)

    @property
    def goal_regions(self) -> dict[str, str]:
        """Region of the working surface that the goal puts something in to the thing that names it: plate_1 for
        living_room_table_plate_right_region, which is to the right of the plate."""
        regions = (fact[2] for fact in self.goal if len(fact) > 2)
        named = {region: self.beside(region) for region in regions}
        return {region: found.things[0] for region, found in named.items() if found and len(found.things) == 1}

    @property
    def targets(self) -> tuple[str, ...]:
        """The movable objects that the goal puts somewhere, none twice."""
        put = (fact[1] for fact in self.goal if fact[0] in ("on", "in"))
        return tuple(name for name in dict.fromkeys(put) if name in self.objects)

    @property
    def things(self) -> tuple[str, ...]:
        """The fixtures and objects, without the table or the floor that they stand on."""
        kinds = {**self.fixtures, **self.objects}
        return tuple(name for name, kind in kinds.items() if not kind.endswith(("table", "floor")))

    @property
    def things_of_interest(self) -> tuple[str, ...]:
        """The ``things`` that the task is about."""
        return self.things_named(self.of_interest)

    def things_named(self, names: Iterable[str]) -> tuple[str, ...]:
        """The ``things`` among some names. A region, such as a drawer of a cabinet or the burner of a stove, stands for
        the thing that it belongs to."""
        owners = {self.owner(name) for name in names}
        return tuple(thing for thing in self.things if thing in owners)

    @property
    def receptacles(self) -> tuple[str, ...]:
        """The movable objects that the goal puts others on or in, none twice; basket_1 for basket_1_contain_region."""
        owners = {self.owner(fact[2]) for fact in self.goal if fact[0] in ("on", "in")}
        return tuple(name for name in self.objects if name in owners)

    def _on_surface(self, region: str) -> bool:
        """Whether a region is one of the working surface, not of a thing that stands on it."""
        return region in self.regions and self.owner(region) not in self.places

    def _supports(self, thing: str) -> list[str]:
        """The thing, what it stands on or in, what that stands on or in, and so on, without the working surface."""
        supports = [thing]
        while not self._on_surface(place := self.places.get(supports[-1], "")):
            support = self.owner(place)
            if support is None or support not in self.places or support in supports:
                break
            supports.append(support)
        return supports

    def _spot(self, thing: str) -> str:
        """Where a thing starts, without names of things: in which part of what, down to the working surface."""
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

    def _beside(self, relation: str, *words: str) -> Beside | None:
        """The things that are called by some words, if each of these calls exactly one."""
        things = [self._called(word) for word in words]
        return None if None in things else Beside(relation, tuple(thing for thing in things if thing is not None))

    def _called(self, word: str) -> str | None:
        """The thing of this name; else the only one of this category, or of the category that regions call so."""
        if word in self.places:
            return word
        categories = {word, *(category for category, called in REGION_WORDS.items() if called == word)}
        things = [thing for thing in self.places if self.category(thing) in categories]
        return things[0] if len(things) == 1 else None


@cache
def read(path: Path) -> Bddl:
    """Read a task's file, once a process.

    Raises:
        PipelineError: when it cannot be read or does not define a task.
    """
    try:
        return parse(path.read_text(encoding="utf-8"), path)
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(f"cannot be read ({error})", where=path, expected="a BDDL file") from error


def parse(text: str, where: object) -> Bddl:
    """Read a BDDL file's text; ``where`` is what an error names.

    Raises:
        PipelineError: when it does not define a task.
    """
    expected = "a BDDL problem with :language, :objects, :init and :goal"
    if text.startswith("\ufeff"):
        raise PipelineError(
            "begins with a byte order mark (BOM), which LIBERO cannot read",
            where=where,
            expected=expected,
            remedy="save the file as UTF-8 without BOM",
        )
    try:
        tokens = scan_tokens(string=text)
        if section := _section_with_empty(tokens):
            raise PipelineError(
                f"has empty parentheses `()` in {section}",
                where=where,
                expected=expected,
                remedy="remove them; a section without content is written as `(:fixtures)`",
            )
        _, (_, problem), *rest = tokens
        sections: dict[str, Any] = {name: content for name, *content in rest}
        return Bddl(
            problem=problem,
            language=" ".join(sections[":language"]),
            regions=dict(_regions(sections.get(":regions", []))),
            objects=_declared(sections[":objects"]),
            fixtures=_declared(sections.get(":fixtures", [])),
            of_interest=tuple(sections.get(":obj_of_interest", [])),
            start=tuple(map(_fact, sections[":init"])),
            goal=tuple(map(_fact, goal[1:] if (goal := sections[":goal"][0])[0] == "and" else [goal])),
        )
    except PipelineError:
        raise
    except KeyError as error:
        raise PipelineError(f"has no {error.args[0]}", where=where, expected=expected) from error
    except Exception as error:  # the tokeniser raises nothing more specific
        raise PipelineError(f"not a BDDL file ({error})", where=where, expected=expected) from error


def heading(text: str, where: object) -> tuple[str, str]:
    """``problem`` and ``language`` of a BDDL file's text; of 10,030 test tasks, most need no more, and parsing is slow.

    Raises:
        PipelineError: when it has no problem or no instruction.
    """
    text = text.lower()
    problem, language = _PROBLEM.search(text), _LANGUAGE.search(text)
    if problem is None or language is None:
        raise PipelineError("not a BDDL file", where=where, expected="a BDDL problem with :language")
    return problem[1], " ".join(language[1].split())


def arena(problem: str) -> Arena:
    """The arena of a scene's class, by its name in lower case, such as libero_kitchen_tabletop_manipulation.

    LIBERO-Plus's names go on after that.

    Raises:
        PipelineError: when the name has none.
    """
    match = _ARENA.match(problem)
    if match is None:
        raise PipelineError(
            f"the scene class {problem!r} names no known arena",
            expected=f"libero_<arena>_[tabletop_]manipulation, <arena> being one of {', '.join(get_args(Arena))}",
        )
    return cast(Arena, match[1])


def _section_with_empty(tokens: list[Any]) -> str | None:
    """The first section of a BDDL file's expressions that has an empty one; `None` if none has."""
    for section in tokens:
        if isinstance(section, list) and (section == [] or _has_empty(section)):
            return str(section[0]) if section and isinstance(section[0], str) else "the problem itself"
    return None


def _has_empty(expression: list[Any]) -> bool:
    return any(isinstance(part, list) and (part == [] or _has_empty(part)) for part in expression)


def _regions(listed: list[Any]) -> list[tuple[str, tuple[float, float]]]:
    """Name and centre of each of a list of ``[name, [":target", thing], [":ranges", [[x0, y0, x1, y1], ...]], ...]``;
    of several ranges the first counts."""
    centres = []
    for name, *fields in listed:
        sections = {field: content for field, *content in fields}
        if ":ranges" in sections:
            x0, y0, x1, y1 = map(float, sections[":ranges"][0][0])
            centres.append((f"{sections[':target'][0]}_{name}", ((x0 + x1) / 2, (y0 + y1) / 2)))
    return centres


def _declared(listed: list[str]) -> dict[str, str]:
    """Name to category, of ``a_1 a_2 - kind b_1 - other``."""
    categories: dict[str, str] = {}
    while "-" in listed:
        end = listed.index("-")
        categories |= dict.fromkeys(listed[:end], listed[end + 1])
        listed = listed[end + 2 :]
    return categories


def _fact(expression: Any) -> Fact:
    if not all(isinstance(word, str) for word in expression):
        raise ValueError(f"{expression} is not a plain fact")
    return tuple(expression)
