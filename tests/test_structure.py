"""Imports run one way: from rooms on upper floors to those below, and never round in a circle of modules."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from conftest import REPOSITORY

FLOORS = (
    "__main__",
    "stage_script",
    "commands",
    "stages",
    "publish",
    "report",
    "validation",
    "evaluation",
    "run",
    "clients",
    "rendering",
    "physics",
    "planning",
    "stores",
    "compute",
    "rewriting",
    "config",
    "compute_config",
    "export_config",
    "formats",
    "images",
    "axes",
    "scenes",
    "testset",
    "catalogue",
    "libero",
    "generated",
    "identity",
    "record",
    "episode_schema",
    "publish_config",
    "gl",
    "seeding",
    "jit",
    "tables",
    "grouping",
    "files",
    "strict_yaml",
    "rotations",
    "types",
    "exit_status",
    "origins",
    "machine_code",
    "errors",
)
"""Rooms of ``pipeline`` and modules at its root, top to bottom: what stands above may import what stands below."""


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
    assert rooms == set(FLOORS), "a new room needs a floor"
    upwards = [
        f"{module} imports {other}"
        for module, imported in graph.items()
        for other in imported
        if "pipeline" not in (module, other) and FLOORS.index(room(other)) < FLOORS.index(room(module))
    ]
    assert upwards == []
