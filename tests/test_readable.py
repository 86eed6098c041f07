"""Code is read by people: few comprehensions inside others, few walruses, and docstrings that begin with a verb.

Run as a script, it prints the figures of every folder and the places, for people who look for code to unfold.
"""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent
FOLDERS = ("pipeline", "stages", "examples", "benchmarks")
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
MOST_PER_1000_LINES = 1.0


def code_lines(file: Path) -> int:
    """Count the lines that are neither empty nor comments."""
    lines = (line.strip() for line in file.read_text().splitlines())
    return sum(bool(line) and not line.startswith("#") for line in lines)


def nested(tree: ast.AST) -> Iterator[int]:
    """Yield the line of every comprehension inside another one."""
    for outer in ast.walk(tree):
        if isinstance(outer, COMPREHENSIONS):
            for inner in ast.walk(outer):
                if inner is not outer and isinstance(inner, COMPREHENSIONS):
                    yield inner.lineno


def walruses(tree: ast.AST) -> Iterator[int]:
    """Yield the line of every assignment expression."""
    for node in ast.walk(tree):
        if isinstance(node, ast.NamedExpr):
            yield node.lineno


def comprehensions(tree: ast.AST) -> Iterator[int]:
    """Yield the line of every comprehension."""
    for node in ast.walk(tree):
        if isinstance(node, COMPREHENSIONS):
            yield node.lineno


KINDS = {"comprehensions": comprehensions, "nested comprehensions": nested, "walruses": walruses}


def places(kind: str) -> list[str]:
    """List file and line of every occurrence of a kind in the folders that users and contributors read."""
    found = []
    for folder in FOLDERS:
        for file in sorted((REPOSITORY / folder).rglob("*.py")):
            lines = sorted(set(KINDS[kind](ast.parse(file.read_text()))))
            found += [f"{file.relative_to(REPOSITORY)}:{line}" for line in lines]
    return found


def all_lines() -> int:
    return sum(code_lines(file) for folder in FOLDERS for file in (REPOSITORY / folder).rglob("*.py"))


@pytest.mark.parametrize("kind", ["nested comprehensions", "walruses"])
def test_dense_expressions_are_rare(kind: str) -> None:
    found = places(kind)
    per_1000 = 1000 * len(found) / all_lines()
    assert per_1000 <= MOST_PER_1000_LINES, f"{per_1000:.1f} {kind} per 1,000 lines:\n" + "\n".join(found)


def docstrings_without_a_verb() -> list[str]:
    """List the functions whose docstring does not begin with an imperative verb, as ruff finds them."""
    command = [sys.executable, "-m", "ruff", "check", "--select", "D401", "--output-format", "concise", *FOLDERS]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return [line for line in done.stdout.splitlines() if "D401" in line]


def main() -> None:
    lines = all_lines()
    figures: dict[str, float] = {"lines of code": lines}
    for kind in KINDS:
        found = places(kind)
        figures[f"{kind} per 1,000 lines"] = round(1000 * len(found) / lines, 2)
        if kind != "comprehensions":
            print(f"{kind}:", *found, sep="\n  ")
    offenders = docstrings_without_a_verb()
    print("docstrings without a verb:", *offenders, sep="\n  ")
    figures["docstrings without a verb"] = len(offenders)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
