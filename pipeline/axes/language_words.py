"""The words by which a rewrite is seen to keep the goal of its task, and how they are found in a text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated

import yaml
from pydantic import BeforeValidator

from pipeline.axes.base import Frozen

WORDS_FILE = Path(__file__).with_name("language_words.yaml")

Entries = Annotated[tuple[str, ...], BeforeValidator(lambda listed: re.split(r",\s+", listed))]
"""Regular expressions, in YAML with commas between them."""


class Thing(Frozen):
    """What a kind of thing is called, and how else it can be described."""

    names: Entries
    hints: Entries


class State(Frozen):
    """How a state is asked for, and how its opposite is."""

    said: Entries
    opposite: Entries


class Words(Frozen):
    """``language_words.yaml``; every string is a regular expression."""

    things: dict[str, Thing]
    parts: dict[str, Entries]
    relations: dict[str, Entries]
    states: dict[str, State]
    both: Entries


@cache
def words() -> Words:
    """The words that are shipped."""
    return Words.model_validate(yaml.safe_load(WORDS_FILE.read_text(encoding="ascii")))


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
