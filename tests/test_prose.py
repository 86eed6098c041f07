"""Prose of pages, docstrings, messages and templates: short sentences, usual terms, a noun or a verb at the beginning.

No maintained linter from the package index checks Python sources by rules of one's own, so these few are here.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from checkout import REPOSITORY

PAGES = sorted([REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *(REPOSITORY / "docs").glob("*.md")])
SOURCES = sorted(
    file for room in ("pipeline", "stages", "examples", "benchmarks") for file in (REPOSITORY / room).rglob("*.py")
)
TEMPLATES = sorted((REPOSITORY / "pipeline").glob("[pr]*/templates/*.j2"))
EXCEPTIONS = [entry["text"] for entry in yaml.safe_load(Path(__file__).with_name("prose_exceptions.yaml").read_text())]

MOST_WORDS, MOST_NUMBERS = 30, 2
FIRST_WORDS = {"What", "Of", "How", "Whether", "So", "Have", "Or", "Where", "As", "By", "Those"}
TERMS = {
    r"dr(aw|aws|awn|awing|ew)": "sample, of a perturbation, or render",
    r"(a|the|first|its) looks?": "observation",
    r"refus\w*": "reject",
    r"told|said|says": "report or state",
    r"made|making": "generate, or a more exact verb",
    r"anew": "again",
    r"goes? on": "resume",
    r"beside": "next to, or in addition to",
    r"(keep|keeps|kept) clear of": "at least X away from",
    r"(hold|held) against": "compare with",
    r"(is|are|found|nothing) off": "error or difference",
    r"(?<!clean )twins?": "clean twin",
    r"whoever": "the noun",
    r"what": "the noun",
    r"those that": "the noun",
}
"""Words to avoid, as regular expressions, and the term to use."""

BLOCKS = re.compile(r"^```.*?^```|<!--.*?-->", re.MULTILINE | re.DOTALL)
PARAGRAPH_END = re.compile(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.|#+|\|) )")
NUMBER = re.compile(r"(?<![\w.])\d[\d,.]*")


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences outside code blocks and tables, with code spans and link targets left out."""
    for paragraph in PARAGRAPH_END.split(BLOCKS.sub("", text)):
        if not paragraph.lstrip().startswith(("|", ">>>")):
            plain = re.sub(r"`+([^`]*)`+", "X", re.sub(r"\]\([^)]*\)", "]", paragraph))
            yield from filter(None, re.split(r"(?<=[.!?:;])\s+", " ".join(plain.split()).lstrip("*-#0123456789. ")))


def faults(sentence: str, numbers: bool) -> Iterator[str]:
    """Yield the faults of a sentence; numbers are counted on pages alone, as docstrings have shapes and ranges."""
    words = [word for word in sentence.split() if re.search(r"\w", word)]
    if len(words) > MOST_WORDS:
        yield f"{len(words)} words"
    if numbers and len(NUMBER.findall(sentence)) > MOST_NUMBERS:
        yield f"{len(NUMBER.findall(sentence))} numbers"
    if words and words[0].strip('*_"“(') in FIRST_WORDS:
        yield f"begins with {words[0]}"
    for word, term in TERMS.items():
        if match := re.search(rf"\b({word})\b", sentence):
            yield f"{match.group()!r}, write {term}"


def wrong(text: str, numbers: bool = False) -> list[str]:
    """List the faults of a text."""
    found = []
    for sentence in sentences(text):
        if not any(re.sub(r"`[^`]*`", "X", exception) in sentence for exception in EXCEPTIONS):
            found += [f"{fault}: {sentence}" for fault in faults(sentence, numbers)]
    return found


def docstrings(file: Path) -> Iterator[str]:
    """Yield the docstrings of a file: of modules, classes, functions and constants."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


def messages(file: Path) -> Iterator[str]:
    """Yield the strings of a file with four words or more that are no docstrings, with X for inserted values."""
    tree = ast.parse(file.read_text())
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            skipped.add(node.value)
        elif isinstance(node, ast.JoinedStr):
            skipped.update(node.values)
    for node in ast.walk(tree):
        if node in skipped or not isinstance(node, ast.Constant | ast.JoinedStr):
            continue
        values = [getattr(part, "value", None) for part in getattr(node, "values", [node])]
        text = "".join(value if isinstance(value, str) else "X" for value in values)
        if len(text.split()) >= 4:
            yield text


def words_of(template: Path) -> str:
    """Return the text of a template, a paragraph for each of its elements."""
    shown = re.sub(r"{{.*?}}", "X", re.sub(r"{[%#].*?[%#]}", "\n\n", template.read_text(), flags=re.DOTALL))
    return re.sub(r"<(style|script).*?</\1>|<[^>]*>", "\n\n", shown, flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages(page: Path) -> None:
    assert wrong(page.read_text(), numbers=True) == []


def test_docstrings() -> None:
    assert [f"{file.name}: {fault}" for file in SOURCES for text in docstrings(file) for fault in wrong(text)] == []


def test_messages() -> None:
    assert [f"{file.name}: {fault}" for file in SOURCES for text in messages(file) for fault in wrong(text)] == []


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda template: template.name)
def test_templates(template: Path) -> None:
    assert wrong(words_of(template)) == []


@pytest.mark.parametrize(
    "sentence",
    ["What there is.", "It runs anew.", f"It has {'word ' * 30}end.", "Take 1, 2 or 3 of them.", "It goes on."],
)
def test_a_fault_is_noticed(sentence: str) -> None:
    assert len(wrong(sentence, numbers=True)) == 1
