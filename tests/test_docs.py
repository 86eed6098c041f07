"""What the documentation points at is there: files, headings, and commands that the command line takes."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from checkout import REPOSITORY
from command_words import parse

from pipeline.config import load

PAGES = sorted([*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/*.md"), *REPOSITORY.glob("benchmarks/*.md")])
FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#]*)(?:#([^)]*))?\)")
COMMAND = re.compile(r"(?:\S*python -m pipeline|perturbed-libero) (.*)")


def anchors(page: Path) -> set[str]:
    """The names that a page's headings have on GitHub."""
    headings = re.findall(r"^#+ (.*)$", FENCED.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands() -> Iterator[tuple[str, list[str]]]:
    """Page and arguments of each command of this project in a block of shell."""
    for page in PAGES:
        for language, block in FENCED.findall(page.read_text()):
            if language == "sh":
                for line in block.replace("\\\n", " ").splitlines():
                    if found := COMMAND.match(line):
                        yield page.name, shlex.split(found[1], comments=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for target, anchor in LINK.findall(FENCED.sub("", page.read_text())):
        if target.startswith("http"):
            continue
        linked = (page.parent / target).resolve() if target else page
        if not linked.exists() or (anchor and anchor not in anchors(linked)):
            lost.append(f"{target}#{anchor}")
    assert lost == []


def test_files_that_the_pages_name_are_there() -> None:
    named = re.compile(r"`((?:benchmarks|configs|examples|pipeline|schemas|stages|tests)/[\w./-]+)[`\s]")
    lost = {
        f"{page.name}: {path}"
        for page in PAGES
        for path in named.findall(page.read_text())
        if not (REPOSITORY / path).exists()
    }
    assert lost == set()


def test_the_command_line_takes_the_commands_of_the_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    given = list(commands())
    assert len(given) >= 15
    for _, arguments in given:
        parse(arguments)


def test_the_numbers_of_episodes_in_the_readme_are_those_of_the_configurations() -> None:
    rows = re.findall(r"^\| `(\w+\.yaml)` \| ([\d,]+) \|", (REPOSITORY / "README.md").read_text(), re.MULTILINE)
    stated = {name: int(number.replace(",", "")) for name, number in rows}
    planned = {name: sum(load(REPOSITORY / "configs" / name).plan.episodes.values()) for name in stated}
    assert stated == planned
    assert len(stated) == 7
