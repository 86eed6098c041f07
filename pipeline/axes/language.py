"""Language: the instruction reworded; the demonstration and its frames stay as they are.

The distance of two wordings is their normalised edit distance, both without case and punctuation: the fewest characters
to insert, delete or replace to turn the first into the second, divided by the length of the longer.

The rewrites are stored in ``language_bank.yaml``, one list for each task and class. All are lower-case ASCII without a
final full stop, as LIBERO's own instructions are. Each keeps one reading among the objects of its scene, and keeps the
goal as far as ``language_goal.py`` can check.
"""

from __future__ import annotations

import bisect
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain, zip_longest
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError, field_validator

from pipeline import seeding
from pipeline.axes.base import Axis, Level, Nearest, TextPerturbation
from pipeline.axes.language_copies import copies_test
from pipeline.axes.language_lint import CLASSES, LENGTH, NAMED, REMEDY, Component, lint, normalise
from pipeline.axes.report_data import BENCHMARK, CoveragePlots, Histogram, KeptPerturbation, ObservedEpisode, Strips
from pipeline.errors import PipelineError
from pipeline.grouping import grouped
from pipeline.jit import compiled
from pipeline.libero.tasks import Same, find_task
from pipeline.strict_yaml import FastStrictLoader
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Place, Task

Bank = dict[str, dict[str, dict[Component, tuple[str, ...]]]]
"""Suite to task name to class to rewrites."""

BANK_FILE = Path(__file__).with_name("language_bank.yaml")
LEVEL_STARTS = (0.5, 0.6, 0.67, 0.72)
"""Distances to the original wording at which the levels 2 to 5 begin."""


class LanguagePerturbation(TextPerturbation):
    """One rewrite of one task's instruction."""

    axis: Literal["language"] = "language"
    component: Component
    text: str

    clearance: ClassVar[float] = 0.2
    unit: ClassVar[str | None] = "share of characters to edit"
    measure: ClassVar[str] = "to the task's test instructions without case and punctuation; 0 for copies"

    def apply(self, instruction: str) -> str:
        """Return the wording that replaces ``instruction``."""
        return self.text

    same: ClassVar[Same | None] = "instruction"

    def distances_on(self, test: TestSet, task: Task) -> list[float]:
        """Return the distances to the test instructions of tasks with LIBERO's instruction of ``task``.

        Three tasks of LIBERO-90 share theirs with a tested task. The clearance is about one word in five.
        """
        return _distances(self.text, test, task)

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """Return the distance to the nearest test instruction.

        It is 0 if ``text`` is a test instruction of any task, or copies a test instruction of ``task``.
        """
        nearest = super().nearest(test, task)
        if normalise(self.text) in _all_test_wordings(test) or copies_test(self.text, test, task):
            return nearest._replace(distance=0.0)
        return nearest

    def is_clear(self, test: TestSet, task: Task) -> bool:
        """Return whether the rewrite keeps its clearance to the test instructions, so that plans use it."""
        return self.nearest(test, task).distance >= self.clearance

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Count the words of the instruction."""
        yield "words in the instruction", len(episode.instruction.split())


class LanguageAxis(Axis):
    """Rewrites from the bank: all rewrites of the chosen levels, each equally often.

    Attributes:
        levels: Levels of the rewrites to use, 1 (close to LIBERO's wording) to 5; all five by default. Repeated entries
            have no effect.
        components: Classes of the rewrites to use; all of them by default.
        bank: File of further rewrites, such as the command ``rewrite`` writes, which extends the shipped bank; none by
            default.
    """

    kinds: ClassVar = (LanguagePerturbation,)
    colour: ClassVar = "#e4572e"
    dimension: ClassVar = "language"
    audited: ClassVar = "instructions"
    not_held_out: ClassVar[str] = "its rewrites are a fixed list, and plans use the whole list"

    former_fields: ClassVar[Mapping[str, str]] = {"classes": "components"}

    components: tuple[Component, ...] = Field(default=CLASSES, min_length=1)
    bank: Place | None = None

    @field_validator("bank")
    @classmethod
    def _exists(cls, bank: Path | None) -> Path | None:
        if bank is not None and not bank.is_file():
            raise ValueError("there is no such file")
        return bank

    def restrict_for(self, axes: Collection[Axis]) -> LanguageAxis:
        """Return the axis, restricted to the classes ``NAMED`` if another axis puts other objects around the target.

        Names stay unambiguous then: no object of ``layout`` has a category of the scene, and ``goal`` carries a task
        only to scenes in which its instruction means one thing.

        Raises:
            ValueError: when none of ``components`` is left.
        """
        changing = [axis.name() for axis in axes if axis.changes_objects()]
        components = self._select_components(other_objects=bool(changing))
        if not components:
            raise ValueError(
                f"with {' and '.join(changing)}, axes.language.components must contain {' or '.join(NAMED)}"
            )
        return self.model_copy(update={"components": components})

    def _select_components(self, *, other_objects: bool) -> tuple[Component, ...]:
        if not other_objects:
            return self.components
        return tuple(component for component in self.components if component in NAMED)

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the level by the edit distance to the LIBERO task's instruction, as for rewrites."""
        return level_of(str(tested.parameters["text"]), find_task(tested.suite, tested.base).instruction)

    def levels_set_shares(self, task: Task) -> bool:
        """Return ``False``: the levels only select rewrites."""
        return False

    def entries(self, task: Task) -> tuple[str, ...]:
        """List the task's rewrites in the order of ``list_rewrites``.

        Raises:
            PipelineError: when the task has no rewrites, or one of them does not pass ``lint``.
        """
        return tuple(rewrite.text for rewrite in list_rewrites(task, self.components, self.levels, self.bank))

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> LanguagePerturbation:
        """Return the rewrite at ``entry_index`` of the task's list, which starts again at its end.

        The caller assigns the indices, because independent random choices would repeat. ``rng`` is not used.

        Raises:
            PipelineError: when the task has no rewrites, or one of them does not pass ``lint``.
        """
        rewrites = list_rewrites(task, self.components, self.levels, self.bank)
        return rewrites[entry_index % len(rewrites)]

    def list_clear_rewrites(self, task: Task, test: TestSet, *, other_objects: bool = False) -> tuple[str, ...]:
        """List the rewrites of a task that keep their clearance to test instructions.

        The result is empty if no bank has rewrites of the task.

        Args:
            other_objects: whether the episode shows other objects than the scene of ``task``; then only rewrites that
                name the target remain.

        Raises:
            PipelineError: when one of the rewrites does not pass ``lint``.
        """
        texts = []
        components = self._select_components(other_objects=other_objects)
        for rewrite in _find_rewrites(task, components, self.levels, self.bank):
            if rewrite.is_clear(test, task):
                texts.append(rewrite.text)
        return tuple(texts)

    @classmethod
    def observe_tests(cls, test: TestSet) -> Iterator[tuple[str, float]]:
        """Count the words of each test instruction."""
        for tested in test.on_axis("language"):
            yield "words in the instruction", len(str(tested.parameters["text"]).split())

    @classmethod
    def describe_coverage(cls, kept: Sequence[KeptPerturbation[LanguagePerturbation]], test: TestSet) -> CoveragePlots:
        """Describe plots of the distances to the original instructions."""
        tested = test.on_axis("language")
        tested_shares = []
        for task in tested:
            original = find_task(task.suite, task.base).instruction
            tested_shares.append(distance(str(task.parameters["text"]), original))
        shares = [distance(item.perturbation.text, item.task.instruction) for item in kept]
        rows = {}
        for name in CLASSES:
            of_class = [share for share, item in zip(shares, kept, strict=True) if item.perturbation.component == name]
            rows[name.replace("_", " ")] = {"language": np.array(of_class)}
        every = {BENCHMARK: np.array(tested_shares), "language": np.array(shares)}
        label = "share of edited characters"
        return CoveragePlots(
            f"{len(tested):,} test instructions of unknown class. The distance is the share of edited characters.",
            [
                Histogram("Distance to the original instruction", every, np.linspace(0, 1, 21), label),
                Strips("Distance by class", rows, label),
            ],
        )


@cache
def load_bank(file: Path = BANK_FILE) -> Bank:
    """Read a bank once per process, by default the shipped one."""
    return read_bank(file)


def read_bank(file: Path) -> Bank:
    """Read a bank from its file.

    Raises:
        PipelineError: when the file does not have the bank's form.
    """
    try:
        content = yaml.load(file.read_text(encoding="ascii"), FastStrictLoader) or {}
        return TypeAdapter(Bank).validate_python(content)
    except (OSError, yaml.YAMLError, UnicodeDecodeError, ValidationError) as error:
        # Of a file with other content, every entry is a fault.
        fault = _first_fault(error) if isinstance(error, ValidationError) else error
        raise PipelineError(
            f"the file is not a bank of rewrites ({fault})",
            where=file,
            expected=f"ASCII YAML: suite, task name, class ({', '.join(CLASSES)}), list of sentences",
            remedy="correct or restore the file, or generate it again with the command rewrite",
        ) from error


def _first_fault(error: ValidationError) -> str:
    """Describe the first fault of a bank with its place."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def load_further_bank(file: Path) -> Bank:
    """Read a user's bank once per process.

    Raises:
        PipelineError: when the file does not have the bank's form, or has rewrites of an unknown task: a plan would
            silently ignore them.
    """
    bank = load_bank(file)
    for suite, rewrites_of_task in bank.items():
        for name in rewrites_of_task:
            try:
                find_task(suite, name)
            except PipelineError as error:
                raise PipelineError(
                    f"the bank has rewrites of an unknown task ({error.what})",
                    where=file,
                    expected=error.expected,
                    remedy="correct the name of the suite or of the task",
                ) from error
    return bank


def list_rewrites(
    task: Task,
    classes: tuple[Component, ...] = CLASSES,
    levels: tuple[Level, ...] = get_args(Level),
    bank: Path | None = None,
) -> tuple[LanguagePerturbation, ...]:
    """List all rewrites of a task in the order in which plans use them: shuffled by task, with the classes in turn.

    Raises:
        PipelineError: when there are none, or one of them does not pass ``lint``.
    """
    rewrites = _find_rewrites(task, classes, levels, bank)
    if rewrites:
        return rewrites
    others = _find_rewrites(task, CLASSES, get_args(Level), bank)
    if others:
        levels_of = grouped((rewrite.component, rewrite.level) for rewrite in others)
        existing = [f"{name} at {', '.join(map(str, sorted({*found})))}" for name, found in levels_of.items()]
        raise PipelineError(
            f"task {task} has no rewrites of class {' or '.join(classes)} at level {' or '.join(map(str, levels))}",
            where="plan.axes.language",
            expected=f"classes and levels of its rewrites: {'; '.join(existing)}",
            remedy="add levels or components to plan.axes.language, or add such rewrites to a bank of your own",
        )
    raise PipelineError(
        f"task {task} has no rewrites",
        where=bank or BANK_FILE,
        expected=f"a task of {', '.join(load_bank())}",
        remedy="add rewrites of the task to the bank, or remove language from the configured axes",
    )


@cache
def _find_rewrites(
    task: Task, classes: tuple[Component, ...], levels: tuple[Level, ...], bank: Path | None
) -> tuple[LanguagePerturbation, ...]:
    """Return the result of ``list_rewrites``, or an empty tuple if there are none.

    Rewrites that lose their meaning in the scene that a task is carried to are left out.

    Raises:
        PipelineError: when one of the rewrites does not pass ``lint``.
    """
    stored = _stored(task, bank)
    turn = seeding.rng("language", task.suite, task.name).permutation(list(dict.fromkeys(classes)))
    columns = [_shuffled(task, component, tuple(stored[component]), levels) for component in turn.tolist()]
    keeping: list[LanguagePerturbation] = []
    for rewrite in chain.from_iterable(zip_longest(*columns)):
        if rewrite is None:
            continue
        fault = lint(rewrite.text, task, rewrite.component)
        if not fault:
            keeping.append(rewrite)
        elif task.goal_file is None:
            raise PipelineError(
                f"{rewrite.component} rewrite {rewrite.text!r} of {task} is rejected: {fault}",
                where=bank or BANK_FILE,
                expected=f"lower-case ASCII, {LENGTH}, no final punctuation, the task's goal",
                remedy=REMEDY,
            )
    return tuple(keeping)


def _stored(task: Task, bank: Path | None) -> dict[Component, list[str]]:
    """Collect a task's rewrites from the shipped bank and ``bank``, by class.

    Wordings that differ in case or punctuation alone count once, at their first place in any class.
    """
    banks = (load_bank(), load_bank(bank)) if bank else (load_bank(),)
    stored: dict[Component, list[str]] = {component: [] for component in CLASSES}
    listed: set[str] = set()
    for suites in banks:
        for component, texts in suites.get(task.suite, {}).get(task.name, {}).items():
            for text in texts:
                wording = normalise(text)
                if wording not in listed:
                    listed.add(wording)
                    stored[component].append(text)
    return stored


def _shuffled(
    task: Task, component: Component, texts: tuple[str, ...], levels: tuple[Level, ...]
) -> list[LanguagePerturbation]:
    """Shuffle one class of a task's rewrites, and keep those of ``levels``."""
    order = seeding.rng("language", task.suite, task.name, component).permutation(len(texts))
    rewrites = []
    for index in order:
        rewrite = rewrite_of(task, component, texts[index])
        if rewrite.level in levels:
            rewrites.append(rewrite)
    return rewrites


def rewrite_of(task: Task, component: Component, text: str) -> LanguagePerturbation:
    """Return the perturbation that rewords a task's instruction as ``text``."""
    return LanguagePerturbation(component=component, text=text, level=level_of(text, task.instruction))


def level_of(text: str, original: str) -> Level:
    """Return the strength of a rewrite, by the ranges of ``LEVEL_STARTS``."""
    level: Level = get_args(Level)[bisect.bisect_right(LEVEL_STARTS, distance(text, original))]
    return level


def distance(text: str, other: str) -> float:
    """Return the normalised edit distance of two wordings, from 0 to 1.

    It is 0 for wordings that differ in case and punctuation alone.
    """
    first, second = _characters(text), _characters(other)
    return int(_edits(first, second)) / max(len(first), len(second), 1)


@cache
def _characters(text: str) -> NDArray[np.uint8]:
    """Return the bytes (N,) of a normalised text."""
    return np.frombuffer(normalise(text).encode(), np.uint8)


@compiled
def _edits(one: NDArray[np.uint8], two: NDArray[np.uint8]) -> int:
    """Compute the Levenshtein distance, row by row.

    ``row[j]`` is the distance between the part of ``one`` that was read so far and the first j characters of ``two``.
    """
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
    tests = test.on(task, "language", "instruction")
    return [distance(text, str(tested.parameters["text"])) for tested in tests]


@cache
def _all_test_wordings(test: TestSet) -> frozenset[str]:
    """Return the normalised test instructions of all tasks."""
    return frozenset(normalise(str(tested.parameters["text"])) for tested in test.on_axis("language"))
