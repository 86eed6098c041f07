"""Checks that the workers of an external cluster share folders, packages and code with the run before they work.

A worker may have been started in another folder, on another machine, with other packages or before the last edit of the
code. It may also have served other runs. None of this may change a result or write files to a wrong folder.
"""

import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from packaging.requirements import Requirement

from pipeline.compute.workers import VARIABLES
from pipeline.errors import PipelineError
from pipeline.formats.registry import FORMATS
from pipeline.identity import DISTRIBUTION, PACKAGES, digest_library
from pipeline.machine_code import MACHINE_CODE_VARIABLES, in_shell, machine_code

Item = TypeVar("Item")
Result = TypeVar("Result")

PACKAGE = "pipeline"


@dataclass(frozen=True)
class Workplace:
    """Folders and setup of a run, which its workers must share.

    Attributes:
        folder: absolute path of the folder that the run was started in, from which its relative paths start.
        token: absolute path of a file that the run wrote for its workers to find.
        setup: result of ``setup()`` in the run's process.
    """

    folder: Path
    token: Path
    setup: Mapping[str, str]

    def enter(self) -> None:
        """Check that this process may work for the run, and forget the state of earlier runs.

        Raises:
            PipelineError: when the process does not see the run's folder, or has other code or packages.
        """
        global _entered
        if _entered == self:
            return
        from distributed import get_worker

        faults = self.faults(get_worker())
        if faults:
            raise _rejection(f"worker on {platform.node()}", faults)
        _forget()
        _entered = self

    def faults(self, dask_worker: Any) -> list[str]:
        """List the reasons why this worker cannot work for the run; Dask calls it in the worker.

        Args:
            dask_worker: filled in by Dask, by the argument's name.
        """
        reasons = []
        if not (self.token.is_file() and self.folder.is_dir()):
            reasons.append(f"does not see {self.token.parent}, or sees another folder at this path")
        here = setup()
        for name, version_of_run in self.setup.items():
            if here.get(name) != version_of_run:
                reasons.append(f"has {name} {here.get(name, 'not installed')}, but the run has {version_of_run}")
        threads = dask_worker.state.nthreads
        if threads != 1:
            reasons.append(f"runs {threads} threads, but the simulator needs a process with one thread")
        return reasons


_entered: Workplace | None = None
"""Workplace of the run that this process worked for last."""


def in_place(fn: Callable[[Item], Result], workplace: Workplace, item: Item) -> Result:
    """Call a function in a worker, in the folder that the run was started in."""
    workplace.enter()
    with chdir(workplace.folder):
        return fn(item)


@cache
def setup() -> dict[str, str]:
    """Return everything except the input that a result may depend on.

    These are the versions of Python and the packages, the code and the machine code. The result is cached, as a process
    keeps the code that it imported first.
    """
    # A Dask worker imports NumPy before this project, so its environment decides NumPy's machine code.
    versions = {"Python": platform.python_version(), "machine code": machine_code()}
    required = [Requirement(line).name for line in _requirements()]
    of_formats = [kind.packages for kind in FORMATS]
    for name in (DISTRIBUTION, *required, *chain.from_iterable([*PACKAGES.values(), *of_formats])):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions | {f"code of {PACKAGE}": digest_library()[:16]}


def _requirements() -> list[str]:
    """Return the requirements of this project; none if the project is not installed."""
    try:
        return requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return []


@contextmanager
def workplace_of(client: Any, folder: Path) -> Iterator[Workplace]:
    """Check every worker that a Dask client has now; later workers are checked when they get their first work.

    Args:
        folder: the run writes into it.

    Raises:
        PipelineError: naming every worker that cannot work for this run, and the reason.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # If the run is killed, the next stage deletes the token with all temporary files (``files.remove_leftovers``).
    token = folder.absolute() / f".cluster.{uuid4().hex}.tmp"
    workplace = Workplace(Path.cwd(), token, setup())
    token.touch()
    try:
        reports = client.run(workplace.faults, on_error="return")
        addresses: dict[str, list[str]] = {}
        for address, report in reports.items():
            faults_of_worker = report
            if isinstance(report, BaseException):
                faults_of_worker = [f"cannot execute this run's code ({type(report).__name__}: {report})"]
            for fault in faults_of_worker:
                addresses.setdefault(fault, []).append(address)
        if addresses:
            rejected: set[str] = set()
            faults = []
            for fault, addresses_of_fault in addresses.items():
                rejected.update(addresses_of_fault)
                # Three addresses of each fault are enough to find the machines.
                faults.append(f"{', '.join(addresses_of_fault[:3])} {fault}")
            raise _rejection(f"{len(rejected)} of {len(reports)} workers", faults)
        yield workplace
    finally:
        token.unlink(missing_ok=True)


def _rejection(where: str, faults: list[str]) -> PipelineError:
    return PipelineError(
        "; ".join(faults),
        where=where,
        expected="workers that share the run's folders, packages, code and machine code, with one thread each",
        remedy="mount the repository and its data at the same path everywhere, install the same requirements.lock, and "
        f"start the workers again with `export {in_shell(MACHINE_CODE_VARIABLES | VARIABLES)}; "
        "dask worker ADDRESS --nthreads 1`",
    )


def _forget() -> None:
    """Empty every cache of this package, as files at the same paths, such as a bank of rewrites, may have changed."""
    renderer = sys.modules.get(f"{PACKAGE}.rendering.renderer")
    if renderer is not None:
        renderer.scene_of_process().close()
    for name, module in list(sys.modules.items()):
        if name.startswith(f"{PACKAGE}.") and name != __name__:
            for value in list(vars(module).values()):
                # Ask the type: objects that look up attributes on access, such as OpenGL, must not be accessed.
                if hasattr(type(value), "cache_clear"):
                    value.cache_clear()
