"""Rewrites that copy a test instruction of their task: they share a phrase with it, or all its content words.

The distance of two wordings does not find these rewrites: a long sentence may contain most of a test instruction, and
other function words or another order change many characters.
"""

from functools import cache

from pipeline.axes.language_goal import read_words
from pipeline.axes.language_lint import normalise
from pipeline.testset.benchmark import TestSet
from pipeline.types import Task

PHRASE_WORDS = 6
"""Length in words of a phrase that a rewrite must not share with a test instruction."""

MIN_NEW_WORDS = 2
"""Least number of different new words of such a phrase.

New words are neither in LIBERO's instruction of the task nor among the words ``common`` of ``language_words.yaml``.
"""


def copies_test(text: str, test: TestSet, task: Task) -> bool:
    """Return whether ``text`` copies a test instruction of a task with LIBERO's instruction of ``task``.

    It does if both have the same content words, or share a phrase of ``PHRASE_WORDS`` consecutive words with at least
    ``MIN_NEW_WORDS`` new words.
    """
    if content_words(text) in _tested_contents(test, task):
        return True
    known = {*read_words().common, *normalise(task.instruction).split()}
    shared_phrases = phrases(text) & _tested_phrases(test, task)
    return any(len(set(phrase) - known) >= MIN_NEW_WORDS for phrase in shared_phrases)


def phrases(text: str) -> frozenset[tuple[str, ...]]:
    """Return all runs of ``PHRASE_WORDS`` consecutive words of a text."""
    listed = normalise(text).split()
    starts = range(len(listed) - PHRASE_WORDS + 1)
    return frozenset(tuple(listed[start : start + PHRASE_WORDS]) for start in starts)


def content_words(text: str) -> frozenset[str]:
    """Return the words of a text without the words ``function`` of ``language_words.yaml``."""
    return frozenset(normalise(text).split()) - {*read_words().function}


def _tested_texts(test: TestSet, task: Task) -> list[str]:
    return [str(tested.parameters["text"]) for tested in test.on(task, "language", "instruction")]


@cache
def _tested_phrases(test: TestSet, task: Task) -> frozenset[tuple[str, ...]]:
    return frozenset().union(*map(phrases, _tested_texts(test, task)))


@cache
def _tested_contents(test: TestSet, task: Task) -> frozenset[frozenset[str]]:
    return frozenset(map(content_words, _tested_texts(test, task)))
