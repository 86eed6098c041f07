"""Rewrites of a task's instruction by a language model, added to a bank if they pass the checks of the language axis.

The bank is a file of the form of ``axes/language_bank.yaml``. No answer of a model is trusted: this module reads lists
from the answers, lints each sentence as ``axes/language.py`` lints the bank, and asks again for missing rewrites.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml
from jinja2 import StrictUndefined, Template
from pydantic import TypeAdapter

from pipeline.axes.language import Bank, load_bank, read_bank, rewrite_of
from pipeline.axes.language_copies import copies_test
from pipeline.axes.language_lint import CLASSES, LENGTH, REMEDY, Component, lint, normalise
from pipeline.errors import PipelineError
from pipeline.files import write
from pipeline.libero.bddl import Fact, read
from pipeline.libero.tasks import SUITES, tasks
from pipeline.rewriting.language_model import UnusableError
from pipeline.testset import benchmark
from pipeline.types import Task

IDLE_ANSWERS = 3
"""Consecutive answers without a new rewrite after which a class is given up."""

ASKED_AT_ONCE = 20
"""Most rewrites in one request; longer lists get worse towards their end."""


def brief(bddl_file: Path) -> dict[str, Any]:
    """Read a task's scene and goal for the prompt.

    Returns:
        A dictionary with these entries:

        * ``task``: its suite and name, the keys in a bank, are the BDDL file's folder and stem. Its instruction is
          LIBERO's if the task is one of LIBERO's.
        * ``things``: kinds of movable objects and fixtures, with their number if there are several.
        * ``start``: relations at the start.
        * ``goal``: relations that must hold at the end.

    Raises:
        PipelineError: when the file cannot be read or does not define a task.
    """
    bddl = read(bddl_file)
    suite, name = bddl_file.absolute().parent.name, bddl_file.stem
    instructions = {task.name: task.instruction for task in tasks(suite)} if suite in SUITES else {}
    kinds = Counter([*bddl.objects.values(), *bddl.fixtures.values()])
    return {
        "task": Task(suite, name, instructions.get(name, bddl.language), bddl_file),
        "things": [_words(kind) if count == 1 else f"{count} x {_words(kind)}" for kind, count in kinds.items()],
        "start": list(map(_sentence, bddl.start)),
        "goal": list(map(_sentence, bddl.goal)),
    }


def _words(name: str) -> str:
    """Return a name in plain words."""
    return name.replace("_", " ")


def _sentence(fact: Fact) -> str:
    """Format a fact such as ``(on plate_1 table)`` as ``on(plate 1, table)``."""
    return f"{fact[0]}({', '.join(map(_words, fact[1:]))})"


def prompt(told: Mapping[str, Any], component: Component, count: int, have: list[str], rejected: Counter[str]) -> str:
    """Write the question for ``count`` more rewrites of one class.

    Args:
        told: result of ``brief``.
        have: rewrites that the model must not repeat.
        rejected: reasons for the rejection of earlier rewrites; the five most common ones enter the question.
    """
    template = Path(__file__).with_name("prompt.txt.j2").read_text()
    reasons = [reason for reason, _ in rejected.most_common(5)]
    fields = {**told, "component": component, "count": count, "have": have, "rejected": reasons, "length": LENGTH}
    question: str = Template(template, undefined=StrictUndefined, trim_blocks=True).render(fields)
    return question


def extend(bddl_file: Path, out: Path, per_class: int, ask: Callable[[str], str]) -> None:
    """Ask until the bank ``out`` has ``per_class`` rewrites of each class for the task.

    Rewrites in ``out`` stay. Each answer's accepted rewrites are stored at once, so that a stopped run can resume.

    Args:
        bddl_file: the task, ``<suite>/<task>.bddl``.
        ask: answers a prompt, such as a ``LanguageModel``.

    Raises:
        PipelineError: when a file cannot be read, the model cannot be reached, or too few rewrites are accepted.
    """
    task_brief = brief(bddl_file)
    bank = read_bank(out) if out.exists() else {}
    reject_lost_comments(out)
    task: Task = task_brief["task"]
    stored = _stored(bank, task)
    _check_stored(stored, task, out)
    shipped = load_bank().get(task.suite, {}).get(task.name, {})
    taken: set[str] = set()
    for texts in (*stored.values(), *shipped.values()):
        taken |= {normalise(text) for text in texts}
    rejected: Counter[str] = Counter()
    for component in CLASSES:
        idle = 0
        while len(stored[component]) < per_class and idle < IDLE_ANSWERS:
            missing = per_class - len(stored[component])
            have = [*shipped.get(component, ()), *stored[component]]
            question = prompt(task_brief, component, min(missing, ASKED_AT_ONCE), have, rejected)
            try:
                accepted, reasons = _sift(listed(ask(question)), task, component, taken, missing)
            except UnusableError as error:
                accepted, reasons = [], Counter([str(error)])
            idle = 0 if accepted else idle + 1
            rejected += reasons
            if accepted:
                stored[component] += tuple(accepted)
                _add(accepted, component, task, out)
            print(f"{component}: {len(stored[component])} of {per_class}{_because(reasons)}")
    if any(len(stored[component]) < per_class for component in CLASSES):
        counts = ", ".join(f"{component} {len(stored[component])}" for component in CLASSES)
        raise PipelineError(
            f"the model gave too few acceptable rewrites of {task}: {counts}{_because(rejected)}",
            where=out,
            expected=f"{per_class} of each class",
            remedy="run the command again, which resumes from the accepted rewrites; or ask another model",
        )


def _check_stored(stored: Mapping[Component, Sequence[str]], task: Task, out: Path) -> None:
    """Check the rewrites that ``out`` has already.

    Raises:
        PipelineError: when the language axis would reject one of them.
    """
    for component, texts in stored.items():
        for text in texts:
            fault = lint(text, task, component)
            if fault:
                what = f"{component} rewrite {text!r} of {task} is rejected: {fault}"
                raise PipelineError(what, where=out, remedy=REMEDY)


def _sift(
    offered: list[str], task: Task, component: Component, taken: set[str], wanted: int
) -> tuple[list[str], Counter[str]]:
    """Select the first ``wanted`` sentences that pass the checks, and add them to ``taken``.

    Returns:
        The selected sentences, and the counts of the reasons why earlier sentences were rejected.

    Raises:
        UnusableError: when ``offered`` is empty.
    """
    if not offered:
        raise UnusableError("an answer without a list")
    accepted: list[str] = []
    reasons: Counter[str] = Counter()
    for text in map(tidy, offered):
        if len(accepted) == wanted:
            break
        fault = lint(text, task, component)
        if not fault and normalise(text) in taken:
            fault = "a repetition"
        if not fault and copies_test(text, benchmark.load(), task):
            fault = "a copy of a test instruction of LIBERO-Plus"
        if not fault and not rewrite_of(task, component, text).is_clear(benchmark.load(), task):
            fault = "too close to a test instruction of LIBERO-Plus"
        if fault:
            reasons[fault] += 1
        else:
            accepted.append(text)
            taken.add(normalise(text))
    return accepted, reasons


def _because(reasons: Counter[str]) -> str:
    """Format the reasons of rejected rewrites, the most common first; empty if there are none."""
    counted = "; ".join(f"{count} x {reason}" for reason, count in reasons.most_common())
    return f" (rejected: {counted})" if counted else ""


_THOUGHT = re.compile(r"<think>.*?</think>", re.DOTALL)
_MARKED = re.compile(r"""\s*(?:(?:\d+\s*[.):]|[-*•])\s+(.+)|\[?\s*["“](.+)["”],?\s*$)""")
"""Line that is numbered, bulleted or in quotation marks."""


def listed(answer: str) -> list[str]:
    """Read the sentences of an answer: its JSON list, or else its numbered, bulleted or quoted lines.

    Text around the list (preambles, code fences, a model's thoughts) is ignored.
    """
    answer = _THOUGHT.sub("", answer)
    for bracket in re.finditer(r"\[", answer):
        try:
            items, _ = json.JSONDecoder().raw_decode(answer, bracket.start())
        except (ValueError, RecursionError):
            continue
        texts = [item if isinstance(item, str) else _only_text(item) for item in items]
        if any(texts):
            return texts
    marked = [_MARKED.match(line) for line in answer.splitlines()]
    return [match[1] or match[2] for match in marked if match]


def _only_text(item: object) -> str:
    """Return the sentence in an entry such as ``{"rewrite": "..."}``; empty if there is not exactly one."""
    if not isinstance(item, dict):
        return ""
    texts = [value for value in item.values() if isinstance(value, str)]
    return texts[0] if len(texts) == 1 else ""


def tidy(text: str) -> str:
    """Convert to lower case and remove surplus white space, outer quotation marks and final punctuation."""
    plain = " ".join(text.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'").split())
    return plain.strip("\"'`, \N{LEFT DOUBLE QUOTATION MARK}\N{RIGHT DOUBLE QUOTATION MARK}").rstrip(".!? ")


def _stored(bank: Bank, task: Task) -> dict[Component, tuple[str, ...]]:
    """Return each class to a task's rewrites in a bank."""
    return {**dict.fromkeys(CLASSES, ()), **bank.get(task.suite, {}).get(task.name, {})}


def _add(accepted: Sequence[str], component: Component, task: Task, path: Path) -> None:
    """Add rewrites to the bank in ``path``, which a person or another command may have changed meanwhile."""
    bank = read_bank(path) if path.exists() else {}
    stored = _stored(bank, task)
    stored[component] = (*stored[component], *accepted)
    bank.setdefault(task.suite, {})[task.name] = stored
    _write(bank, path)


def _write(bank: Bank, path: Path) -> None:
    """Replace the bank in ``path``, or in the file that it links to, except the comments at its beginning."""
    head, _ = _split(path)
    plain = TypeAdapter(Bank).dump_python(bank, mode="json")
    write(path.resolve(), head + yaml.safe_dump(plain, sort_keys=False, width=10_000))


def reject_lost_comments(path: Path) -> None:
    """Reject a bank with comments that ``rewrite`` would lose: all but those at its beginning.

    Raises:
        PipelineError: naming the file.
    """
    _, entries = _split(path)
    if any("#" in line for line in entries.splitlines()):
        raise PipelineError(
            "the bank has comments between its rewrites, which would be lost",
            where=path,
            expected="comments only at the beginning of the file",
            remedy="move the comments to the beginning of the file, or write the rewrites into a new file",
        )


def _split(path: Path) -> tuple[str, str]:
    """Return the comments and empty lines at the beginning of a bank, and the other lines."""
    lines = path.read_text(encoding="ascii").splitlines(keepends=True) if path.exists() else []
    head = [*takewhile(lambda line: line.startswith("#") or not line.strip(), lines)]
    return "".join(head), "".join(lines[len(head) :])
