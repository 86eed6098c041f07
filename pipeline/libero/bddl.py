"""What a BDDL file says of a task: its instruction, what is in its scene, where things start, and its goal."""

import re
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, cast, get_args

from bddl.parsing import scan_tokens

from pipeline.errors import PipelineError

Fact = tuple[str, ...]
"""A predicate and its arguments, such as ``("on", "plate_1", "main_table_plate_region")``."""

Arena = Literal["tabletop", "kitchen", "living_room", "study", "floor"]
"""LIBERO's rooms: table or floor, walls, lamps and where the agent view is."""

_ARENA = re.compile(rf"libero_({'|'.join(get_args(Arena))})(?:_tabletop)?_manipulation")
_PROBLEM = re.compile(r"\(define\s+\(problem\s+([^\s()]+)\)")
_LANGUAGE = re.compile(r"\(:language\s([^()]*)\)")


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

    @property
    def scene(self) -> Hashable:
        """Equal for tasks that begin in the same scene: the arena, and of what kind and where each thing is."""
        kinds = {**self.fixtures, **self.objects}
        where = {name: self.regions.get(place, place) for name, place in self.places.items()}
        return self.arena, frozenset((name, kinds[name], where[name]) for name in where)

    @property
    def carriers(self) -> dict[str, str]:
        """Object or fixture to what it moves with: itself where it starts in a region of the working surface, else
        what it stands on or in, such as wooden_cabinet_1 for a bowl that starts in wooden_cabinet_1_top_region."""
        carriers: dict[str, str] = {}
        for thing in self.places:
            carrier = thing
            while (place := self.places[carrier]) not in self.regions:
                carrier = next(host for host in self.places if f"{place}_".startswith(f"{host}_"))
            carriers[thing] = carrier
        return carriers

    @property
    def goal_regions(self) -> dict[str, str]:
        """Region of the working surface that the goal puts something in to the thing that names it: plate_1 for
        living_room_table_plate_right_region, which is to the right of the plate."""
        placed = {place: thing for thing, place in self.places.items()}
        named = {}
        for region in (fact[2] for fact in self.goal if len(fact) > 2 and fact[2] in self.regions):
            words = region.removesuffix("_region").rsplit("_", 1)[0]
            named[region] = next(thing for place, thing in placed.items() if place.startswith(words))
        return named

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
        named = [f"{name}_" for name in names]
        return tuple(thing for thing in self.things if any(name.startswith(f"{thing}_") for name in named))

    @property
    def receptacles(self) -> tuple[str, ...]:
        """The movable objects that the goal puts others on or in, none twice; basket_1 for basket_1_contain_region."""
        places = [fact[2] for fact in self.goal if fact[0] in ("on", "in")]
        return tuple(name for name in self.objects if any(f"{place}_".startswith(f"{name}_") for place in places))


@cache
def read(path: Path) -> Bddl:
    """Read a task's file, once a process.

    Raises:
        PipelineError: when it cannot be read or does not define a task.
    """
    try:
        return parse(path.read_text(), path)
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(f"cannot be read ({error})", where=path, expected="a BDDL file") from error


def parse(text: str, where: object) -> Bddl:
    """Read a BDDL file's text; ``where`` is what an error names.

    Raises:
        PipelineError: when it does not define a task.
    """
    expected = "a BDDL problem with :language, :objects, :init and :goal"
    try:
        _, (_, problem), *rest = scan_tokens(string=text)
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
