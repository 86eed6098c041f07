"""What the workers of a cluster elsewhere must have in common with the run, checked before they do anything.

A worker may have been started in another folder, on another machine, with other packages or before the code was last
edited, and it may have served other runs. None of this may change a result or write where nobody looks.
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

from pipeline.errors import PipelineError
from pipeline.files import checksum, schema_file
from pipeline.identity import DISTRIBUTION, PACKAGES
from pipeline.machine_code import SETTINGS, in_shell, machine_code
from pipeline.seeding import digest

Item = TypeVar("Item")
Result = TypeVar("Result")

PACKAGE = "pipeline"
SOURCES = (".py", ".yaml", ".json", ".j2")


@dataclass(frozen=True)
class Workplace:
    """Where a run works, and with what.

    Attributes:
        folder: absolute path of the folder that the run was started in, from which its relative paths start.
        token: absolute path of a file that the run wrote for its workers to find.
        setup: what ``setup()`` is there.
    """

    folder: Path
    token: Path
    setup: Mapping[str, str]

    def enter(self) -> None:
        """Make sure that this process may work for the run, and forget what it knows of earlier ones.

        Raises:
            PipelineError: when the run's folder is not here, or other code or packages are.
        """
        global _entered
        if _entered == self:
            return
        from distributed import get_worker

        if faults := self.faults(get_worker()):
            raise _refusal(f"worker on {platform.node()}", faults)
        _forget()
        _entered = self

    def faults(self, dask_worker: Any) -> list[str]:
        """In a worker, which Dask fills in by the argument's name: why it cannot work for the run."""
        found = []
        if not (self.token.is_file() and self.folder.is_dir()):
            found.append(f"does not see {self.token.parent}, or another folder lies at that path there")
        here = setup()
        for name, version_of_run in self.setup.items():
            if here.get(name) != version_of_run:
                found.append(f"has {name} {here.get(name, 'not installed')}, the run has {version_of_run}")
        if (threads := dask_worker.state.nthreads) != 1:
            found.append(f"runs {threads} threads, and the simulator needs a process for itself")
        return found


_entered: Workplace | None = None
"""The run that this process worked for last."""


def in_place(fn: Callable[[Item], Result], workplace: Workplace, item: Item) -> Result:
    """Call a function in a worker as it would be where the run was started."""
    workplace.enter()
    with chdir(workplace.folder):
        return fn(item)


@cache
def setup() -> dict[str, str]:
    """What a result may depend on beside its input: versions of Python and the packages, code and machine code.

    A process keeps the code that it imported first, so this is found out once and not again.
    """
    # A worker of Dask has NumPy before it hears of this project, so it has what its environment asked for.
    versions = {"Python": platform.python_version(), "machine code": machine_code()}
    try:
        required = [Requirement(line).name for line in requires(DISTRIBUTION) or []]
        for name in (DISTRIBUTION, *required, *chain.from_iterable(PACKAGES.values())):
            versions[name] = version(name)
    except PackageNotFoundError as error:
        versions[str(error.name)] = "not installed"
    package = Path(__file__).resolve().parent.parent
    files = [file for file in package.rglob("*") if file.suffix in SOURCES]
    files += schema_file("episode.json").parent.glob("*.json")
    content = sorted((file.name, checksum(file)) for file in files)
    return versions | {f"code of {PACKAGE}": digest("code", content)[:16]}


@contextmanager
def workplace_of(client: Any, folder: Path) -> Iterator[Workplace]:
    """Check every worker that a Dask client has now; later ones are checked when they get their first work.

    The run writes into ``folder``.

    Raises:
        PipelineError: naming every worker that cannot work for this run, and why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Of a killed run, the next stage deletes it as it does all such files (``files.remove_leftovers``).
    token = folder.absolute() / f".cluster.{uuid4().hex}.tmp"
    workplace = Workplace(Path.cwd(), token, setup())
    token.touch()
    try:
        reports = client.run(workplace.faults, on_error="return")
        addresses: dict[str, list[str]] = {}
        for address, found in reports.items():
            if isinstance(found, BaseException):
                found = [f"cannot execute this run's code ({type(found).__name__}: {found})"]
            for fault in found:
                addresses.setdefault(fault, []).append(address)
        if addresses:
            refused = {address for of_fault in addresses.values() for address in of_fault}
            # Three addresses of each fault are enough to find the machines by.
            faults = [f"{', '.join(named[:3])} {fault}" for fault, named in addresses.items()]
            raise _refusal(f"{len(refused)} of {len(reports)} workers", faults)
        yield workplace
    finally:
        token.unlink(missing_ok=True)


def _refusal(where: str, faults: list[str]) -> PipelineError:
    return PipelineError(
        "; ".join(faults),
        where=where,
        expected="workers that share the run's folders, packages, code and machine code, with one thread each",
        remedy="mount the repository and its data at the same path everywhere, install the same requirements.lock, and "
        f"start the workers again with `export {in_shell(SETTINGS)}; dask worker ADDRESS --nthreads 1`",
    )


def _forget() -> None:
    """Empty every cache of this package: what lies at a path, such as a bank of rewrites, may be another file now."""
    if (open_scenes := sys.modules.get(f"{PACKAGE}.rendering.renderer")) is not None:
        open_scenes.scene_of_process().close()
    for name, module in list(sys.modules.items()):
        if name.startswith(f"{PACKAGE}.") and name != __name__:
            for value in list(vars(module).values()):
                # Of its type: what looks things up when they are asked for, such as OpenGL, is not to be asked.
                if hasattr(type(value), "cache_clear"):
                    value.cache_clear()
