"""Tasks of one's own compared with the benchmark's test tasks: a copy of a test task must not be trained on."""

import re
import zipfile
from collections.abc import Hashable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.tasks import SUITES, tasks
from pipeline.testset.benchmark import FOLDER, TestTask, fetch_testset, load
from pipeline.testset.definitions import Reader
from pipeline.types import Task


class _TestDefinitions(NamedTuple):
    """What only LIBERO-Plus's BDDL files have and LIBERO's have not, each to the test task that it is first found in.

    Attributes:
        scenes: by ``Bddl.scene``, of test tasks that add or move things.
        classes: names of the classes of scenes with other light, surfaces and walls.
        instructions: rewritten, as ``_plain``.
    """

    scenes: Mapping[Hashable, str]
    classes: Mapping[str, str]
    instructions: Mapping[str, str]


def reject_test_tasks(wanted: Iterable[Task], folder: Path = FOLDER) -> None:
    """Compare scene, scene class and instruction of each task of one's own with those of the test tasks.

    An own task in one of LIBERO's scenes is no test task: the tests of camera, robot start, noise and language begin
    there, as LIBERO's own demonstrations do. Nothing is fetched if no task is one's own.

    Raises:
        PipelineError: naming the first BDDL file that equals a test task.
    """
    for task in wanted:
        if task.suite not in SUITES and (equal := _equal_test(task, folder)):
            what, test_task = equal
            raise PipelineError(
                f"has the {what} of LIBERO-Plus's test task {test_task}",
                where=task.bddl_file,
                expected="a task that the benchmark does not test",
                remedy="change it, or leave it out of demos.tasks: a policy that is trained on it cannot be tested",
            )


def _equal_test(task: Task, folder: Path) -> tuple[str, str] | None:
    """What a task has in common with a test task, and the name of that; `None` if there is none."""
    test, own = _definitions(folder), bddl.read(task.bddl_file)
    if own.problem in test.classes:
        return "scene class", test.classes[own.problem]
    if own.scene in test.scenes:
        return "scene", test.scenes[own.scene]
    if (plain := _plain(own.language)) in test.instructions:
        return "instruction", test.instructions[plain]
    return None


@cache
def _definitions(folder: Path) -> _TestDefinitions:
    liberos = [bddl.read(task.bddl_file) for suite in SUITES for task in tasks(suite)]
    scenes: dict[Hashable, str] = {}
    classes: dict[str, str] = {}
    instructions: dict[str, str] = {}
    with zipfile.ZipFile(fetch_testset(folder)) as archive:
        reader = Reader(archive)
        for test_task in load(folder).tasks:
            name = f"{test_task.suite}/{test_task.name}"
            if test_task.axis in ("layout", "pose"):
                scenes.setdefault(bddl.parse(_text(reader, test_task), name).scene, name)
            elif test_task.axis in ("light", "background"):
                classes.setdefault(bddl.heading(_text(reader, test_task), name)[0], name)
            elif test_task.axis == "language":
                instructions.setdefault(_plain(str(test_task.parameters["text"])), name)
    for known in liberos:
        scenes.pop(known.scene, None)
        classes.pop(known.problem, None)
        instructions.pop(_plain(known.language), None)
    return _TestDefinitions(scenes, classes, instructions)


def _text(reader: Reader, test_task: TestTask) -> str:
    return reader.packed(f"bddl_files/{test_task.suite}/{test_task.name}.bddl").decode()


def _plain(instruction: str) -> str:
    """The words of an instruction, without case and punctuation."""
    return " ".join(re.findall(r"[a-z0-9]+", instruction.lower()))
