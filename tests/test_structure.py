"""Imports run one way: from rooms on upper floors to those below, and never round in a circle of modules."""

import ast
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from checkout import REPOSITORY

from pipeline.axes import AXES

CONTRIBUTING = REPOSITORY / "CONTRIBUTING.md"
FLOOR = re.compile(r"^\w+( > \w+)+", re.MULTILINE)
"""Start of a line in the diagram of the rooms: names, from top to bottom."""


def floors() -> list[str]:
    """Read the rooms of ``pipeline`` and the modules at its root, from top to bottom."""
    names: list[str] = []
    for line in FLOOR.finditer(CONTRIBUTING.read_text()):
        names += line[0].split(" > ")
    return names


def modules() -> dict[str, Path]:
    """Dotted name to file; templates are programs of other environments."""
    files = [file for file in (REPOSITORY / "pipeline").rglob("*.py") if "templates" not in file.parts]
    names = [".".join(file.relative_to(REPOSITORY).with_suffix("").parts) for file in files]
    return {name.removesuffix(".__init__"): file for name, file in zip(names, files, strict=True)}


def imports(file: Path, known: dict[str, Path]) -> set[str]:
    """The project's modules that a file imports, wherever in it: also in functions and for type checking."""
    imported = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            imported |= {
                name if (name := f"{node.module}.{alias.name}") in known else node.module for alias in node.names
            }
        elif isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
    return imported & known.keys()


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    known = modules()
    return {name: imports(file, known) - {name} for name, file in known.items()}


def room(module: str) -> str:
    return (*module.split("."), "pipeline")[1]


def test_no_circle_of_modules(graph: dict[str, set[str]]) -> None:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"modules import each other in a circle: {' -> '.join(error.args[1])}")


def test_imports_run_downwards(graph: dict[str, set[str]]) -> None:
    rooms = {room(module) for module in graph} - {"pipeline"}
    order = floors()
    assert sorted(rooms) == sorted(order), f"the diagram in {CONTRIBUTING.name} has each room once"
    upwards = [
        f"{module} imports {other}"
        for module, imported in graph.items()
        for other in imported
        if "pipeline" not in (module, other) and order.index(room(other)) < order.index(room(module))
    ]
    assert upwards == []


AXIS_IS_SUBJECT = {
    # The benchmark's files and the paper's table, which name the dimensions of the test tasks.
    *("pipeline.testset.definitions", "pipeline.testset.own_tasks"),
    *("pipeline.evaluation.libero_plus", "pipeline.evaluation.analyses.other_programs", "pipeline.report.paper_table"),
    # Evaluation tasks that ask for another goal of a scene.
    *("pipeline.evaluation.goals", "pipeline.evaluation.selection"),
    # What two axes do to a scene, which sampling a plan must not load.
    *("pipeline.scenes.placement", "pipeline.scenes.moving"),
    # The axis whose exported episodes are no demonstrations.
    "pipeline.libero.demonstrations",
    # Other things with the name of an axis: columns and types of lerobot, keys of vla-eval, the instance of the arm.
    *("pipeline.formats.lerobot", "pipeline.formats.lerobot.columns", "pipeline.formats.lerobot.write_shared"),
    *("pipeline.formats.lerobot.language", "pipeline.validation.checks.labels"),
    *("pipeline.evaluation.harness", "pipeline.rendering.geometry"),
    *("pipeline.rewriting.rewrite", "pipeline.report.paper_rows"),
}
"""Modules outside of ``axes`` in which a string may be the name of an axis."""


def axis_names(file: Path) -> Iterator[str]:
    """Yield the strings of a file that are the name of an axis, alone or joined by +."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and {*node.value.split("+")} <= AXES.keys():
            yield node.value


def test_a_new_axis_is_named_in_its_own_room_alone() -> None:
    elsewhere = {name: file for name, file in modules().items() if room(name) != "axes"}
    assert {name for name, file in elsewhere.items() if [*axis_names(file)]} == AXIS_IS_SUBJECT
