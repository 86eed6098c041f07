"""Language: the instruction reworded; the demonstration and its frames stay as they are.

The rewrites live in ``language_bank.yaml``, one list for each task and class. All are lower-case ASCII without a
final full stop, as LIBERO's own instructions are, and each keeps one reading among the objects of its scene.
"""

from __future__ import annotations

import re
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import yaml
from pydantic import Field, TypeAdapter, ValidationError

from pipeline import seeding
from pipeline.axes.base import Frozen, TextPerturbation
from pipeline.errors import PipelineError
from pipeline.types import Task

Component = Literal["distraction", "common_sense", "reasoning_chain", "paraphrase"]
CLASSES: tuple[Component, ...] = get_args(Component)

Bank = dict[str, dict[str, dict[Component, tuple[str, ...]]]]
"""Suite to task name to class to rewrites."""

BANK_FILE = Path(__file__).with_name("language_bank.yaml")
MIN_WORDS, MAX_WORDS = 3, 60

_PREAMBLE = re.compile(
    r"^(sure|certainly|of course)\b\W*here\b"
    r"|\b(here (are|is)|below (are|is)|as an ai)\b"
    r"|\b(variation|variant|rewrite|rephrasing|paraphrase)s? (of|for)\b",
    re.IGNORECASE,
)
_DEBRIS = re.compile(r"[_\d/\\]|\b(scene|suite|libero|bddl|benchmark|hdf)\b", re.IGNORECASE)
_WELL_FORMED = re.compile(r"[a-z]+(?:[,.?!;:]? [a-z]+|['-][a-z]+)*")


class LanguagePerturbation(TextPerturbation):
    """One rewrite of one task's instruction."""

    axis: Literal["language"] = "language"
    component: Component
    text: str

    def apply(self, instruction: str) -> str:
        """The wording that takes the place of ``instruction``."""
        return self.text


class LanguageAxis(Frozen):
    """Draws rewrites from the bank.

    Attributes:
        classes: the classes drawn from.
    """

    classes: tuple[Component, ...] = Field(default=CLASSES, min_length=1)

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> LanguagePerturbation:
        """The rewrite at ``place`` of the task's deal, which starts again once the bank is exhausted.

        Independent draws would repeat, so neighbouring places are different wordings and ``rng`` is left alone.

        Raises:
            PipelineError: when the task has no rewrites, or one of them does not pass ``lint``.
        """
        rewrites = deal(task, self.classes)
        component, text = rewrites[place % len(rewrites)]
        return LanguagePerturbation(component=component, text=text)


@cache
def load_bank() -> Bank:
    """The bank as stored.

    Raises:
        PipelineError: when the file does not have the bank's form.
    """
    try:
        return TypeAdapter(Bank).validate_python(yaml.safe_load(BANK_FILE.read_text(encoding="ascii")))
    except (yaml.YAMLError, UnicodeDecodeError, ValidationError) as error:
        raise PipelineError(
            f"the bank of rewrites cannot be read ({error})",
            where=BANK_FILE,
            expected=f"ASCII YAML: suite, task name, class ({', '.join(CLASSES)}), list of sentences",
            remedy="restore the file from version control",
        ) from error


@cache
def deal(task: Task, classes: tuple[Component, ...]) -> tuple[tuple[Component, str], ...]:
    """All rewrites of a task in the order they are drawn: shuffled by task, one class after the other in turn."""
    stored = load_bank().get(task.suite, {}).get(task.name, {})
    turn = seeding.rng("language", task.suite, task.name).permutation(list(dict.fromkeys(classes)))
    columns = [_shuffled(task, component, stored.get(component, ())) for component in turn.tolist()]
    dealt = tuple(card for row in zip_longest(*columns) for card in row if card is not None)
    if not dealt:
        raise PipelineError(
            f"task {task.suite}/{task.name} has no rewrites of class {' or '.join(classes)}",
            where=BANK_FILE,
            expected=f"a task of {', '.join(load_bank())}",
            remedy="add rewrites of the task to the bank, or take language out of the configured axes",
        )
    for component, text in dealt:
        if fault := lint(text, task.instruction):
            raise PipelineError(
                f"{component} rewrite {text!r} of {task.suite}/{task.name} is refused: {fault}",
                where=BANK_FILE,
                expected=f"lower-case ASCII, {MIN_WORDS} to {MAX_WORDS} words, no final punctuation",
                remedy="correct or delete the sentence",
            )
    return dealt


def _shuffled(task: Task, component: Component, texts: tuple[str, ...]) -> list[tuple[Component, str]]:
    order = seeding.rng("language", task.suite, task.name, component).permutation(len(texts))
    return [(component, texts[i]) for i in order]


def normalise(text: str) -> str:
    """``text`` without case, punctuation and surplus white space: what two wordings are compared by."""
    return " ".join(re.sub(r"[^a-z0-9]+", " ", text.lower().replace("'", "")).split())


def lint(text: str, original: str) -> str | None:
    """The reason why ``text`` cannot stand in for the instruction ``original``; None when it can."""
    words = len(text.split())
    if words == 0:
        return "empty"
    if _PREAMBLE.search(text):
        return "preamble of a language model"
    if _DEBRIS.search(text):
        return "file-name debris"
    if not _WELL_FORMED.fullmatch(text):
        return "characters, spacing or punctuation other than of a lower-case sentence without its final full stop"
    if not MIN_WORDS <= words <= MAX_WORDS:
        return f"{words} words, wanted {MIN_WORDS} to {MAX_WORDS}"
    if normalise(text) == normalise(original):
        return "equal to the original"
    return None
