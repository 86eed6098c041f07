"""Check of a sentence as a replacement of an instruction: its form and, as far as it can be checked, its goal."""

import re
from typing import Literal, get_args

from pipeline.axes.language_extra import extra_request
from pipeline.axes.language_goal import changed_goal
from pipeline.libero.tasks import debris
from pipeline.types import Task

Component = Literal["distraction", "common_sense", "reasoning_chain", "paraphrase"]
CLASSES: tuple[Component, ...] = get_args(Component)
NAMED: tuple[Component, ...] = ("distraction", "paraphrase")
"""Classes that call all things and places of the goal by their names.

The other classes may describe them by common knowledge, or by exclusion (``the only dairy product``). Such a
description holds among the task's own objects only."""

MIN_WORDS = 3
MAX_WORDS_AND_MARKS, MAX_CHARACTERS = 38, 172
"""SmolVLA and pi0 keep the first 48 tokens of an instruction and cut the rest without a warning.

Two of the 48 are not free: pi0's tokenizer adds a token at the beginning, and both policies add a line break at the
end. Their tokenizers were not available, so three public ones were measured on the bank: GPT-2's, Mistral's and its
successor. No rewrite has more than 8 tokens beyond its words and marks in any of them, hence 46 - 8. The longest has 43
of the 46. The bound on characters is for sentences with more rare words than the bank's.
"""
LENGTH = (
    f"at least {MIN_WORDS} words, at most {MAX_WORDS_AND_MARKS} words and punctuation marks together, "
    f"and at most {MAX_CHARACTERS} characters"
)
REMEDY = "correct the sentence; or, if it is correct, add its words to axes/language_words.yaml"

_PREAMBLE = re.compile(
    r"^(sure|certainly|of course)\b\W*here\b"
    r"|\b(here (are|is)|below (are|is)|as an ai)\b"
    r"|\b(variation|variant|rewrite|rephrasing|paraphrase)s? (of|for)\b",
    re.IGNORECASE,
)
_MARK = re.compile(r"[^a-z ]")
_WELL_FORMED = re.compile(r"[a-z]+(?:[,.?!;:]? [a-z]+|['-][a-z]+)*")


def normalise(text: str) -> str:
    """Remove case, punctuation and repeated white space from ``text``; wordings are compared in this form."""
    return " ".join(re.sub(r"[^a-z0-9]+", " ", text.lower().replace("'", "")).split())


def too_long(instruction: str) -> str | None:
    """Return a warning if SmolVLA and pi0 may cut the instruction, else ``None``."""
    words_and_marks = len(instruction.split()) + len(_MARK.findall(instruction.lower()))
    if words_and_marks <= MAX_WORDS_AND_MARKS and len(instruction) <= MAX_CHARACTERS:
        return None
    return (
        f"the instruction has {words_and_marks} words and marks and {len(instruction)} characters: SmolVLA and pi0 "
        f"read 48 tokens and cut the rest, which may happen beyond {MAX_WORDS_AND_MARKS} words and marks, or "
        f"{MAX_CHARACTERS} characters"
    )


def lint(text: str, task: Task, component: Component) -> str | None:
    """Return why ``text`` cannot replace the task's instruction, or ``None`` if it can.

    Raises:
        PipelineError: when the task's BDDL file cannot be read.
    """
    words = len(text.split())
    words_and_marks = words + len(_MARK.findall(text))
    if words == 0:
        return "empty"
    if _PREAMBLE.search(text):
        return "preamble of a language model"
    if debris(text):
        return "file-name debris"
    if not _WELL_FORMED.fullmatch(text):
        return "characters, spacing or punctuation that a lower-case sentence without its final full stop does not have"
    if words < MIN_WORDS:
        return f"{words} words, wanted {LENGTH}"
    if words_and_marks > MAX_WORDS_AND_MARKS:
        return f"{words_and_marks} words and marks, wanted {LENGTH}"
    if len(text) > MAX_CHARACTERS:
        return f"{len(text)} characters, wanted {LENGTH}"
    if normalise(text) == normalise(task.instruction):
        return "equal to the original"
    hints = component not in NAMED
    return changed_goal(text, task, hints) or extra_request(text, task, hints)
