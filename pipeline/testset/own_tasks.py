"""Comparison of the user's own tasks with the benchmark's test tasks: a copy of a test task must not be trained on."""

import re
import zipfile
from collections.abc import Hashable, Iterable, Mapping
from functools import cache
from typing import NamedTuple

from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl
from pipeline.libero.tasks import SUITES, tasks
from pipeline.testset.benchmark import FOLDER, TestTask, fetch_testset, load
from pipeline.testset.definitions import Reader
from pipeline.types import Task


class _TestDefinitions(NamedTuple):
    """Content of LIBERO-Plus's BDDL files that LIBERO's files lack, each to the first test task that has it.

    Attributes:
        scenes: ``Bddl.scene`` of test tasks that add or move things.
        classes: names of the classes of scenes with other light, surfaces and walls.
        instructions: rewritten instructions, normalised by ``_plain``.
    """

    scenes: Mapping[Hashable, str]
    classes: Mapping[str, str]
    instructions: Mapping[str, str]


def reject_test_tasks(wanted: Iterable[Task]) -> None:
    """Compare scene, scene class and instruction of each own task with the test tasks.

    An own task in one of LIBERO's scenes is no test task: the tests of camera, robot start, noise and language begin in
    these scenes, and so do LIBERO's own demonstrations. Nothing is fetched if all tasks are LIBERO's.

    Raises:
        PipelineError: when a task equals a test task; it names the first such BDDL file.
    """
    own_tasks = [task for task in wanted if task.suite not in SUITES]
    for task in own_tasks:
        equal = _equal_test(task)
        if equal is not None:
            part, test_task = equal
            raise PipelineError(
                f"the task has the {part} of LIBERO-Plus's test task {test_task}",
                where=task.bddl_file,
                expected="a task that the benchmark does not test",
                remedy="change it, or leave it out of demos.tasks: a policy that is trained on it cannot be tested",
            )


def _equal_test(task: Task) -> tuple[str, str] | None:
    """Return the part that a task shares with a test task, and the test task's name; `None` if it shares no part."""
    test, definition = _definitions(), bddl.read(task.bddl_file)
    if definition.problem in test.classes:
        return "scene class", test.classes[definition.problem]
    if definition.scene in test.scenes:
        return "scene", test.scenes[definition.scene]
    instruction = _plain(definition.language)
    if instruction in test.instructions:
        return "instruction", test.instructions[instruction]
    return None


@cache
def _definitions() -> _TestDefinitions:
    """Collect the definitions that only test tasks have, from the benchmark's wheel."""
    libero_definitions: list[Bddl] = []
    for suite in SUITES:
        libero_definitions += [bddl.read(task.bddl_file) for task in tasks(suite)]
    scenes: dict[Hashable, str] = {}
    classes: dict[str, str] = {}
    instructions: dict[str, str] = {}
    with zipfile.ZipFile(fetch_testset(FOLDER)) as archive:
        reader = Reader(archive)
        for test_task in load(FOLDER).tasks:
            name = f"{test_task.suite}/{test_task.name}"
            if test_task.axis in ("layout", "pose"):
                scenes.setdefault(bddl.parse(_text(reader, test_task), name).scene, name)
            elif test_task.axis in ("light", "background"):
                classes.setdefault(bddl.heading(_text(reader, test_task), name)[0], name)
            elif test_task.axis == "language":
                instructions.setdefault(_plain(str(test_task.parameters["text"])), name)
    for definition in libero_definitions:
        scenes.pop(definition.scene, None)
        classes.pop(definition.problem, None)
        instructions.pop(_plain(definition.language), None)
    return _TestDefinitions(scenes, classes, instructions)


def _text(reader: Reader, test_task: TestTask) -> str:
    """Return the text of a test task's BDDL file."""
    return reader.packed(f"bddl_files/{test_task.suite}/{test_task.name}.bddl").decode()


def _plain(instruction: str) -> str:
    """Return the words of an instruction, without case and punctuation.

    LIBERO-Plus's instructions have no apostrophes: its "thats" is "that's" elsewhere.
    """
    return " ".join(re.findall(r"[a-z0-9]+", re.sub("['\u2019]", "", instruction.lower())))
