"""Rewrites of a task's instruction by a language model, let into a bank through the gate that the language axis has.

The bank is a file of the form of ``axes/language_bank.yaml``. Nothing that a model says is trusted: answers are read
for lists, each sentence is linted as ``axes/language.py`` lints the bank, and what is missing is asked for again.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml
from jinja2 import StrictUndefined, Template
from pydantic import TypeAdapter

from pipeline.axes.language import Bank, load_bank, read_bank
from pipeline.axes.language_lint import CLASSES, LENGTH, REMEDY, Component, lint, normalise
from pipeline.errors import PipelineError
from pipeline.files import write
from pipeline.libero.bddl import Fact, read
from pipeline.libero.tasks import SUITES, tasks
from pipeline.rewriting.language_model import UnusableError
from pipeline.types import Task

IDLE_ANSWERS = 3
"""After so many answers in a row without one new rewrite, a class is given up."""

ASKED_AT_ONCE = 20
"""Longer lists get worse towards their end."""


def brief(bddl_file: Path) -> dict[str, Any]:
    """Read a task's scene and goal, as a model is told of them.

    Returns:
        ``task``, whose suite and name, its place in a bank, are the BDDL file's folder and stem, and whose instruction
        is LIBERO's where the task is one of LIBERO's; kinds of movable objects and fixtures, with their number where
        there are several (``things``); what is where at first (``start``), and has to be so at the end (``goal``).

    Raises:
        PipelineError: when the file cannot be read or does not define a task.
    """
    bddl = read(bddl_file)
    suite, name = bddl_file.resolve().parent.name, bddl_file.stem
    known = {task.name: task.instruction for task in tasks(suite)} if suite in SUITES else {}
    kinds = Counter([*bddl.objects.values(), *bddl.fixtures.values()])
    return {
        "task": Task(suite, name, known.get(name, bddl.language), bddl_file),
        "things": [_words(kind) if count == 1 else f"{count} x {_words(kind)}" for kind, count in kinds.items()],
        "start": list(map(_sentence, bddl.start)),
        "goal": list(map(_sentence, bddl.goal)),
    }


def _words(name: str) -> str:
    return name.replace("_", " ")


def _sentence(fact: Fact) -> str:
    """``on(plate 1, table)`` for ``(on plate_1 table)``."""
    return f"{fact[0]}({', '.join(map(_words, fact[1:]))})"


def prompt(told: Mapping[str, Any], component: Component, count: int, have: list[str], refused: Counter[str]) -> str:
    """The question for ``count`` more rewrites of one class."""
    text = Path(__file__).with_name("prompt.txt.j2").read_text()
    reasons = [reason for reason, _ in refused.most_common(5)]
    known = {**told, "component": component, "count": count, "have": have, "refused": reasons, "length": LENGTH}
    question: str = Template(text, undefined=StrictUndefined, trim_blocks=True).render(known)
    return question


def extend(bddl_file: Path, out: Path, per_class: int, ask: Callable[[str], str]) -> None:
    """Ask until the bank ``out`` has ``per_class`` rewrites of each class for the task.

    What ``out`` holds stays, and after each answer it holds what was accepted, so a run that was stopped goes on.

    Args:
        bddl_file: the task, ``<suite>/<task>.bddl``.
        ask: answers a prompt, such as a ``LanguageModel``.

    Raises:
        PipelineError: when a file cannot be read, the model cannot be reached, or too few rewrites were acceptable.
    """
    told, bank = brief(bddl_file), read_bank(out) if out.exists() else {}
    task: Task = told["task"]
    stored = {**dict.fromkeys(CLASSES, ()), **bank.get(task.suite, {}).get(task.name, {})}
    for component, text in ((component, text) for component, texts in stored.items() for text in texts):
        if fault := lint(text, task, component):  # which the language axis would refuse
            what = f"{component} rewrite {text!r} of {task} is refused: {fault}"
            raise PipelineError(what, where=out, remedy=REMEDY)
    shipped = load_bank().get(task.suite, {}).get(task.name, {})
    taken = {normalise(text) for texts in (*stored.values(), *shipped.values()) for text in texts}
    refused: Counter[str] = Counter()
    for component in CLASSES:
        idle = 0
        while (missing := per_class - len(stored[component])) > 0 and idle < IDLE_ANSWERS:
            have = [*shipped.get(component, ()), *stored[component]]
            question = prompt(told, component, min(missing, ASKED_AT_ONCE), have, refused)
            try:
                accepted, reasons = _sift(listed(ask(question)), task, component, taken, missing)
            except UnusableError as error:
                accepted, reasons = [], Counter([str(error)])
            idle = 0 if accepted else idle + 1
            refused += reasons
            if accepted:
                stored[component] += tuple(accepted)
                bank.setdefault(task.suite, {})[task.name] = stored
                _write(bank, out)
            print(f"{component}: {len(stored[component])} of {per_class}{_because(reasons)}")
    if any(len(stored[component]) < per_class for component in CLASSES):
        counts = ", ".join(f"{component} {len(stored[component])}" for component in CLASSES)
        raise PipelineError(
            f"too few acceptable rewrites of {task}: {counts}{_because(refused)}",
            where=out,
            expected=f"{per_class} of each class",
            remedy="run it again, it goes on from what was accepted; or ask another model",
        )


def _sift(
    offered: list[str], task: Task, component: Component, taken: set[str], wanted: int
) -> tuple[list[str], Counter[str]]:
    """The first ``wanted`` sentences that pass the gate, noted in ``taken``, and why others before them did not."""
    if not offered:
        raise UnusableError("an answer without a list")
    accepted: list[str] = []
    reasons: Counter[str] = Counter()
    for text in map(tidy, offered):
        if len(accepted) == wanted:
            break
        if fault := lint(text, task, component) or ("a repetition" if normalise(text) in taken else None):
            reasons[fault] += 1
        else:
            accepted.append(text)
            taken.add(normalise(text))
    return accepted, reasons


def _because(reasons: Counter[str]) -> str:
    counted = "; ".join(f"{count} x {reason}" for reason, count in reasons.most_common())
    return f" (refused: {counted})" if counted else ""


_THOUGHT = re.compile(r"<think>.*?</think>", re.DOTALL)
_MARKED = re.compile(r"""\s*(?:(?:\d+\s*[.):]|[-*•])\s+(.+)|\[?\s*["“](.+)["”],?\s*$)""")
"""A line that is numbered, bulleted or in quotation marks."""


def listed(answer: str) -> list[str]:
    """The sentences of an answer: its JSON list, or else its numbered, bulleted or quoted lines.

    Whatever stands around the list (preambles, code fences, a model's thoughts) is no part of it.
    """
    answer = _THOUGHT.sub("", answer)
    try:
        found = json.loads(answer[answer.find("[") : answer.rfind("]") + 1])
    except (ValueError, RecursionError):
        marked = (_MARKED.match(line) for line in answer.splitlines())
        return [match[1] or match[2] for match in marked if match]
    return [item if isinstance(item, str) else _only_text(item) for item in found]


def _only_text(item: object) -> str:
    """The sentence in an entry such as ``{"rewrite": "..."}``."""
    texts = [value for value in item.values() if isinstance(value, str)] if isinstance(item, dict) else []
    return texts[0] if len(texts) == 1 else ""


def tidy(text: str) -> str:
    """In lower case, without surplus white space, quotation marks around it and punctuation at its end."""
    plain = " ".join(text.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'").split())
    return plain.strip("\"'`, \N{LEFT DOUBLE QUOTATION MARK}\N{RIGHT DOUBLE QUOTATION MARK}").rstrip(".!? ")


def _write(bank: Bank, path: Path) -> None:
    """Replace the bank, but for the comments that it begins with."""
    lines = path.read_text(encoding="ascii").splitlines(keepends=True) if path.exists() else []
    head = "".join(takewhile(lambda line: line.startswith("#"), lines))
    plain = TypeAdapter(Bank).dump_python(bank, mode="json")
    write(path, head + yaml.safe_dump(plain, sort_keys=False, width=10_000))
