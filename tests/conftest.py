"""Fixtures that the tests share: demonstrations, whole runs, open scenes and memory."""

from __future__ import annotations

import ctypes
import gc
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from checkout import IN_SCRIPTS, in_a_clone, pipeline_command
from filelock import FileLock
from hypothesis import settings
from short_demonstrations import loaded_whole, replay_whole, write_short_demos
from short_runs import tiny_config

from pipeline.machine_code import MACHINE_CODE_VARIABLES
from pipeline.physics.environment import environment_of
from pipeline.types import Task, Trajectory

if TYPE_CHECKING:  # the tests that render choose what renders
    from pipeline.rendering.renderer import LastScene, Renderer

# Hypothesis stops an example after 200 ms by default, which a busy machine exceeds.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

LIBC = ctypes.CDLL("libc.so.6")
M_MMAP_THRESHOLD = -3
"""Number of an option in glibc's malloc.h."""

# glibc returns freed blocks of this size to the system; without a fixed size it soon keeps those of a whole scene.
LIBC.mallopt(M_MMAP_THRESHOLD, 2**20)


SLOW_FIXTURES = {
    "whole",
    "environment",
    "plate_environment",
    "crowded",
    "stage",
    "expanded",
    "at_resets",
    "everything",
    "golden",
    "installed",
}
"""Fixtures that mark a test as slow, also if it uses them through another fixture: see ``-m "not slow"``."""


def pytest_configure() -> None:
    """Stop without the fixed machine code: a program that a test calls would replace the tests' process."""
    if not MACHINE_CODE_VARIABLES.items() <= os.environ.items():
        raise pytest.UsageError("pytest-env has not set the machine code of pyproject.toml: run `bash setup.sh`")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests by their fixtures, and sort the modules."""
    for item in items:
        if SLOW_FIXTURES.intersection(fixtures_of(item)):
            item.add_marker(pytest.mark.slow)
    sort_modules(items)


def fixtures_of(item: pytest.Item) -> Sequence[str]:
    return item.fixturenames if isinstance(item, pytest.Function) else ()


def sort_modules(items: list[pytest.Item]) -> None:
    """Sort modules by their number of slow tests, to let several processes end at about the same time.

    A module that needs the run of ``finished`` comes first. While its process generates the run, the others must not
    wait for it. Therefore the slow modules that do not need the run come next.
    """
    slow_tests = Counter(item.path for item in items if item.get_closest_marker("slow"))
    need_run = {item.path for item in items if "finished" in fixtures_of(item)}
    # All processes must choose the same module, also among modules with equal numbers.
    first = max(need_run, key=lambda path: (slow_tests[path], path), default=None)

    def place(item: pytest.Item) -> tuple[bool, bool, bool, int]:
        slow = slow_tests[item.path]
        return item.path != first, slow == 0, item.path in need_run, -slow

    items.sort(key=place)


def pytest_collection_finish() -> None:
    """Exclude the half a million objects of the imports from garbage collection.

    robosuite collects garbage with every scene that it drops.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def opened() -> Iterator[LastScene]:
    """Yield the cache of the last open scene, with which the tests of a file render."""
    from pipeline.rendering.renderer import LastScene

    with closing(LastScene()) as opened:
        yield opened


@pytest.fixture(scope="module")
def shown(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    """Yield a renderer of the arena that a test is parametrised with; consecutive tests of an arena share it."""
    from arenas import renderer

    with closing(renderer(request.param)) as opened:
        yield opened


@pytest.fixture(scope="module", autouse=True)
def memory() -> Iterator[None]:
    """Release a module's memory after its tests: an environment or an open scene takes half a gigabyte."""
    yield
    environment_of.cache_clear()
    gc.collect()
    LIBC.malloc_trim(0)


Once = Callable[[str, Callable[[Path], None]], Path]
"""Function ``once(name, make)`` that returns a folder; the first process of a test run fills it with ``make``."""


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Once:
    of_process = tmp_path_factory.getbasetemp()
    shared_by_all = of_process if worker_id == "master" else of_process.parent

    def made_once(name: str, make: Callable[[Path], None]) -> Path:
        folder, complete = shared_by_all / name, shared_by_all / f"{name}.complete"
        with FileLock(shared_by_all / f"{name}.lock"):
            if not complete.exists():
                folder.mkdir()
                make(folder)
                complete.touch()
        return folder

    return made_once


@pytest.fixture(scope="session")
def whole(once: Once) -> dict[Task, Trajectory]:
    """Replay the three demonstrations from start to end."""
    folder = once("whole", replay_whole)
    return loaded_whole(folder)


@pytest.fixture(scope="session")
def short_demos(whole: dict[Task, Trajectory], once: Once) -> Path:
    """Write HDF5 demonstrations: a successful one of each task, and one of the milk that only waits."""
    return once("demos", partial(write_short_demos, whole))


@pytest.fixture(scope="session")
def finished(short_demos: Path, once: Once) -> Path:
    """Return the data folder of a finished ``dvc repro`` in a copy of the repository, on ``tiny_config``.

    Tests share the folder and do not change it.
    """
    return once("clone", partial(_run_in_clone, short_demos)) / "data" / "tiny"


MEASURE = """
import os, subprocess, sys
running = subprocess.Popen(sys.argv[2:])
_, status, usage = os.wait4(running.pid, 0)
open(sys.argv[1], "w").write(str(usage.ru_maxrss))
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""Program that writes the resident memory, in KB, of the largest process of a command.

Linux counts the peak of the process that starts a command as the command's own, so the tests do not start it.
"""


def _run_in_clone(short_demos: Path, clone: Path) -> None:
    in_a_clone(tiny_config(short_demos), clone)
    with (clone / "run.log").open("w") as log:
        command = [sys.executable, "-c", MEASURE, "largest_process_kb", *pipeline_command("run", "configs/tiny.yaml")]
        done = subprocess.run(command, cwd=clone, stdout=log, stderr=log, env=IN_SCRIPTS, check=False)
    assert done.returncode == 0, (clone / "run.log").read_text()
