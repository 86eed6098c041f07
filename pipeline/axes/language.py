"""Language: the instruction reworded; the demonstration and its frames stay as they are.

The distance of two wordings is their normalised edit distance: the fewest characters to insert, delete or replace
to turn one into the other, by the length of the longer, both without case and punctuation.

The rewrites live in ``language_bank.yaml``, one list for each task and class. All are lower-case ASCII without a
final full stop, as LIBERO's own instructions are, each keeps one reading among the objects of its scene, and each
keeps the goal as far as ``language_goal.py`` can check.
"""

from __future__ import annotations

import bisect
from collections.abc import Collection
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from pipeline import seeding
from pipeline.axes.base import Axis, Level, Nearest, TextPerturbation
from pipeline.axes.language_lint import CLASSES, LENGTH, NAMED, REMEDY, Component, lint, normalise
from pipeline.errors import PipelineError
from pipeline.jit import compiled
from pipeline.libero.tasks import Same, find_task
from pipeline.strict_yaml import FastStrictLoader
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Place, Task

Bank = dict[str, dict[str, dict[Component, tuple[str, ...]]]]
"""Suite to task name to class to rewrites."""

BANK_FILE = Path(__file__).with_name("language_bank.yaml")
LEVELS = (0.5, 0.6, 0.67, 0.72)
"""Distances to the original wording at which the levels 2 to 5 begin."""


class LanguagePerturbation(TextPerturbation):
    """One rewrite of one task's instruction."""

    axis: Literal["language"] = "language"
    component: Component
    text: str

    clearance: ClassVar[float] = 0.2
    unit: ClassVar[str | None] = "share of characters to edit"
    measure: ClassVar[str] = "to the task's test instructions without case and punctuation"

    def apply(self, instruction: str) -> str:
        """The wording that takes the place of ``instruction``."""
        return self.text

    same: ClassVar[Same | None] = "task"

    def distances_on(self, test: TestSet, task: Task) -> list[float]:
        """To the task's test instructions; a clearance of about one word in five."""
        return _distances(self.text, test, task)

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """As the base class says; 0 where it is word for word a test instruction of any task."""
        found = super().nearest(test, task)
        return found._replace(distance=0.0) if normalise(self.text) in _all_test_wordings(test) else found


class LanguageAxis(Axis):
    """Draws rewrites from the bank: all those of the chosen levels, none more often than another.

    Attributes:
        classes: the classes drawn from.
        bank: a further bank, such as the command ``rewrite`` makes; its rewrites join those that are shipped.
    """

    draws: ClassVar = (LanguagePerturbation,)
    not_held_out: ClassVar[str] = "its rewrites are a list, and plans train on all of it"

    classes: tuple[Component, ...] = Field(default=CLASSES, min_length=1)
    bank: Place | None = None

    def beside(self, axes: Collection[str]) -> LanguageAxis:
        """Among objects that the layout axis adds: of the classes ``NAMED`` only.

        Names stay unambiguous there as far as the added objects are of categories that the scene does not have.

        Raises:
            ValueError: when none of ``classes`` is left.
        """
        if not (classes := self._classes(axes)):
            raise ValueError(f"language with added objects needs {' or '.join(NAMED)} among axes.language.classes")
        return self.model_copy(update={"classes": classes})

    def _classes(self, axes: Collection[str]) -> tuple[Component, ...]:
        return tuple(one for one in self.classes if one in NAMED) if "layout" in axes else self.classes

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """By the edit distance to the instruction of the LIBERO task, as rewrites."""
        return level_of(str(tested.parameters["text"]), find_task(tested.suite, tested.base).instruction)

    def entries(self, task: Task) -> tuple[str, ...]:
        """The task's rewrites.

        Raises:
            PipelineError: when the task has no rewrites, or one of them does not pass ``lint``.
        """
        return tuple(rewrite.text for rewrite in deal(task, self.classes, self.levels, self.bank))

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> LanguagePerturbation:
        """The rewrite at ``place`` of the task's list, which starts again at its end.

        Independent draws would repeat, so whoever samples deals out the places and ``rng`` is left alone.

        Raises:
            PipelineError: when the task has no rewrites, or one of them does not pass ``lint``.
        """
        rewrites = deal(task, self.classes, self.levels, self.bank)
        return rewrites[place % len(rewrites)]

    def wordings(self, task: Task, axes: Collection[str], test: TestSet) -> tuple[str, ...]:
        """All that it can draw for a task beside other axes, as far as it keeps clear of the benchmark's instructions.

        None where no bank has any.

        Raises:
            PipelineError: when one of them does not pass ``lint``.
        """
        rewrites = _dealt(task, self._classes(axes), self.levels, self.bank)
        return tuple(one.text for one in rewrites if one.nearest(test, task).distance >= one.clearance)


@cache
def load_bank(file: Path = BANK_FILE) -> Bank:
    """``read_bank``, once a process; the one that is shipped by default."""
    return read_bank(file)


def read_bank(file: Path) -> Bank:
    """A bank as stored.

    Raises:
        PipelineError: when the file does not have the bank's form.
    """
    try:
        return TypeAdapter(Bank).validate_python(yaml.load(file.read_text(encoding="ascii"), FastStrictLoader) or {})
    except (OSError, yaml.YAMLError, UnicodeDecodeError, ValidationError) as error:
        raise PipelineError(
            f"not a bank of rewrites ({error})",
            where=file,
            expected=f"ASCII YAML: suite, task name, class ({', '.join(CLASSES)}), list of sentences",
            remedy="correct or restore the file, or make it again with the command rewrite",
        ) from error


def deal(
    task: Task,
    classes: tuple[Component, ...] = CLASSES,
    levels: tuple[Level, ...] = get_args(Level),
    bank: Path | None = None,
) -> tuple[LanguagePerturbation, ...]:
    """All rewrites of a task in the order they are drawn: shuffled by task, one class after the other in turn.

    Raises:
        PipelineError: when there are none, or one of them does not pass ``lint``.
    """
    if dealt := _dealt(task, classes, levels, bank):
        return dealt
    raise PipelineError(
        f"task {task} has no rewrites of class {' or '.join(classes)} at level {' or '.join(map(str, levels))}",
        where=bank or BANK_FILE,
        expected=f"a task of {', '.join(load_bank())}",
        remedy="add rewrites of the task to the bank, or take language out of the configured axes",
    )


@cache
def _dealt(
    task: Task, classes: tuple[Component, ...], levels: tuple[Level, ...], bank: Path | None
) -> tuple[LanguagePerturbation, ...]:
    banks = (load_bank(), load_bank(bank)) if bank else (load_bank(),)
    # Of wordings that only case or punctuation tells apart, the first counts, whatever the classes.
    first: dict[str, tuple[Component, str]] = {}
    for bank_of_task in (one.get(task.suite, {}).get(task.name, {}) for one in banks):
        for component, texts in bank_of_task.items():
            for text in texts:
                first.setdefault(normalise(text), (component, text))
    stored = {name: tuple(text for component, text in first.values() if component == name) for name in CLASSES}
    turn = seeding.rng("language", task.suite, task.name).permutation(list(dict.fromkeys(classes)))
    columns = [_shuffled(task, component, stored[component], levels) for component in turn.tolist()]
    dealt = tuple(card for row in zip_longest(*columns) for card in row if card is not None)
    for card in dealt:
        if fault := lint(card.text, task, card.component):
            raise PipelineError(
                f"{card.component} rewrite {card.text!r} of {task} is refused: {fault}",
                where=bank or BANK_FILE,
                expected=f"lower-case ASCII, {LENGTH}, no final punctuation, the task's goal",
                remedy=REMEDY,
            )
    return dealt


def _shuffled(
    task: Task, component: Component, texts: tuple[str, ...], levels: tuple[Level, ...]
) -> list[LanguagePerturbation]:
    order = seeding.rng("language", task.suite, task.name, component).permutation(len(texts))
    cards = (
        LanguagePerturbation(component=component, text=texts[i], level=level_of(texts[i], task.instruction))
        for i in order
    )
    return [card for card in cards if card.level in levels]


def level_of(text: str, original: str) -> Level:
    """The strength of a rewrite, by the ranges of ``LEVELS``."""
    level: Level = get_args(Level)[bisect.bisect_right(LEVELS, distance(text, original))]
    return level


def distance(text: str, other: str) -> float:
    """Normalised edit distance: 0 for wordings that differ in case and punctuation at most, 1 at most."""
    one, two = _characters(text), _characters(other)
    return int(_edits(one, two)) / max(len(one), len(two), 1)


@cache
def _characters(text: str) -> NDArray[np.uint8]:
    return np.frombuffer(normalise(text).encode(), np.uint8)


@compiled
def _edits(one: NDArray[np.uint8], two: NDArray[np.uint8]) -> int:
    """Levenshtein distance, row by row: ``row[j]`` is that of what was read of ``one`` to the first j of ``two``."""
    row = np.arange(len(two) + 1)
    for i in range(len(one)):
        diagonal, row[0] = row[0], i + 1
        for j in range(len(two)):
            replaced = diagonal + (one[i] != two[j])
            diagonal = row[j + 1]
            row[j + 1] = min(replaced, diagonal + 1, row[j] + 1)
    return int(row[-1])


@cache
def _distances(text: str, test: TestSet, task: Task) -> list[float]:
    return [distance(text, str(tested.parameters["text"])) for tested in test.on(task, "language")]


@cache
def _all_test_wordings(test: TestSet) -> frozenset[str]:
    return frozenset(normalise(str(tested.parameters["text"])) for tested in test.of("language"))
