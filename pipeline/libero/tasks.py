"""LIBERO's task list, and the user's own tasks in addition to it."""

import difflib
import fnmatch
import re
from collections.abc import Hashable, Iterable
from functools import cache
from pathlib import Path
from runpy import run_path
from typing import Any, Literal

from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.assets import libero_folder
from pipeline.types import Task

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")

STEP_LIMITS = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
"""Largest number of control steps after settling, as in OpenVLA and LIBERO-Plus; longer episodes have failed."""

Same = Literal["task", "instruction", "scene"]
"""Common part of two changes: the LIBERO task, its instruction, or the scene that their tasks begin in."""

_OF_FILES = ("scene", "suite", "libero", "bddl", "benchmark", "hdf", "demo")
_DEBRIS = re.compile(rf"[_\d/\\]|\b({'|'.join(_OF_FILES)})\b", re.IGNORECASE)
WITHOUT_DEBRIS = f"an instruction without digits, _, /, \\ and the words {', '.join(_OF_FILES)} of file names"

_TESTED = re.compile(
    r"(?P<base>.+?)(?:_language_\d+|_view(?:_\d+){5}_initstate_\d+|_noise_\d+|_table_\d+|_tb_\d+|_light_\d+|_add_\d+"
    r"|(?:_moved)?_level\d_sample\d)+"
)
"""Names of LIBERO-Plus's test tasks: the name of a LIBERO task, and codes of the changes."""

IN_SCENE = "__in__"
"""Text between the names of a task and of the scene that it is carried to, in names of files (``carried.py``)."""

OWN = Path("tasks")
"""Folder of the user's own tasks: ``<suite>/<task>.bddl`` below it.

It is relative to the folder that a run and its workers are started in.
"""


def suites() -> tuple[str, ...]:
    """List LIBERO's suites, then the user's own suites.

    Raises:
        PipelineError: when an own suite has a name that cannot be used.
    """
    own_suites = sorted(folder.name for folder in OWN.glob("*") if any(folder.glob("*.bddl")))
    for name in own_suites:
        # Datasets have the name of their suite without libero_, some with val at the end. OpenVLA-OFT assigns datasets
        # with aloha in their name to another robot.
        if f"libero_{name}" in SUITES or not re.fullmatch(r"(?!libero_|val$|.*aloha)[a-z][a-z0-9_]*(?<!_val)", name):
            raise PipelineError(
                f"a suite cannot have the name {name!r}",
                where=OWN / name,
                expected="lower-case letters, digits and _; none of LIBERO's suites, with or without libero_; no aloha "
                "in it, and neither val nor _val at its end",
                remedy="rename the folder, and the folder of its demonstrations",
            )
    return (*SUITES, *own_suites)


def tasks(suite: str) -> tuple[Task, ...]:
    """List a suite's tasks, in the order of LIBERO's list.

    Own tasks are sorted by name, and have the instruction of their file.

    Raises:
        PipelineError: when no such suite exists, or an own task has a name or an instruction that cannot be used.
    """
    if suite in SUITES:
        return _listed(suite)
    if suite not in suites():
        raise PipelineError(
            f"unknown suite {suite!r}",
            expected=" or ".join(suites()),
            remedy=f"if it is a suite of your own, run in the folder that has {OWN / suite}",
        )
    files = sorted((OWN / suite).absolute().glob("*.bddl"))
    own_tasks = tuple(Task(suite, file.stem, bddl.read(file).language, file) for file in files)
    for task in own_tasks:
        _reject_unusable(task)
    return own_tasks


def suites_with(name: str) -> list[str]:
    """List the suites that have a task of this name.

    Files of own tasks are not read, as a faulty one must not stop commands about other suites.

    Raises:
        PipelineError: as ``suites``.
    """
    names = {suite: {task.name for task in _listed(suite)} for suite in SUITES}
    for suite in suites():
        if suite not in SUITES:
            names[suite] = {file.stem for file in (OWN / suite).glob("*.bddl")}
    return [suite for suite, of_suite in names.items() if name in of_suite]


def _reject_unusable(task: Task) -> None:
    """Check the name and the instruction of an own task.

    Raises:
        PipelineError: when the name belongs to a test task or has ``IN_SCENE``, or the instruction is empty or has
            ``debris``.
    """
    base = base_of_test(task.name)
    if base:
        raise PipelineError(
            f"the task has the name of a test task of LIBERO-Plus, which perturbs {base}",
            where=task.bddl_file,
            expected="a task that the benchmark does not test",
            remedy="leave test tasks out of the suite: a policy that is trained on them cannot be tested",
        )
    if IN_SCENE in task.name:
        raise PipelineError(
            f"the name has {IN_SCENE!r}, which separates the names of a task and of another scene in names of files",
            where=task.bddl_file,
            remedy="rename the file, and the file of its demonstrations",
        )
    if not task.instruction.strip():
        raise PipelineError(
            "the instruction is empty",
            where=task.bddl_file,
            expected="(:language <a sentence>)",
            remedy="write an instruction",
        )
    remnant = debris(task.instruction)
    if remnant:
        raise PipelineError(
            f"the instruction {task.instruction!r} has {remnant!r}",
            where=task.bddl_file,
            expected=WITHOUT_DEBRIS,
            remedy="write numbers as words, and replace the other listed texts, in (:language ...)",
        )


def debris(instruction: str) -> str | None:
    """Return the first text in an instruction that only file names have; `None` if the instruction has no such text.

    Such text shows that the instruction was derived from a file's name.
    """
    match = _DEBRIS.search(instruction)
    return match[0] if match else None


def base_of_test(name: str) -> str | None:
    """Return the LIBERO task that a test task of LIBERO-Plus perturbs, by its name; `None` for other names."""
    match = _TESTED.fullmatch(name)
    if match is None:
        return None
    base = match["base"]
    is_task = any(base in _names()[suite] for suite in SUITES)
    return base if is_task else None


@cache
def _listed(suite: str) -> tuple[Task, ...]:
    """List the tasks of one of LIBERO's suites."""
    folder = libero_folder() / "bddl_files" / suite
    listed = []
    for name in dict.fromkeys(_names()[suite]):
        # LIBERO's instruction is the task's name without its scene.
        instruction = re.sub(r"^[A-Z_]*SCENE\d+_", "", name).replace("_", " ")
        listed.append(Task(suite, name, instruction, folder / f"{name}.bddl"))
    return tuple(listed)


@cache
def _names() -> Any:
    """Read LIBERO's lists of names: suite to names. Only the file that holds the lists is run."""
    return run_path(str(libero_folder() / "benchmark" / "libero_suite_task_map.py"))["libero_task_map"]


def find_task(suite: str, name: str) -> Task:
    """Return the task of the given name.

    Raises:
        PipelineError: when the suite has no such task; it names the closest.
    """
    by_name = {task.name: task for task in tasks(suite)}
    if name not in by_name:
        closest = difflib.get_close_matches(name, by_name, cutoff=0)
        raise PipelineError(
            f"{suite} has no task {name!r}",
            expected=" or ".join(closest),
            remedy=f"list the tasks by `python -m pipeline tasks '{suite}/*'`",
        )
    return by_name[name]


def exceeds_step_limit(suite: str, steps: int) -> bool | None:
    """Return whether an episode has more control steps than an evaluation executes; `None` for own suites."""
    return steps > STEP_LIMITS[suite] if suite in STEP_LIMITS else None


def common_key(task: Task, same: Same) -> Hashable:
    """Return a key that is equal for tasks that have the part ``same`` in common."""
    match same:
        case "task":
            return task.suite, task.name
        case "instruction":
            return task.instruction
        case "scene":
            return bddl.read(task.bddl_file).scene


def select_tasks(patterns: Iterable[str]) -> list[Task]:
    """Return the tasks whose ``<suite>/<task>`` matches any of the shell-style patterns, in LIBERO's order.

    Raises:
        PipelineError: when a pattern matches no task.
    """
    patterns = tuple(patterns)
    # A faulty file of an own suite must not stop commands about other suites.
    of_suites = [pattern.partition("/")[0] if "/" in pattern else "*" for pattern in patterns]
    by_name: dict[str, Task] = {}
    for suite in suites():
        if suite in SUITES or any(fnmatch.fnmatch(suite, pattern) for pattern in of_suites):
            by_name |= {str(task): task for task in tasks(suite)}
    chosen: set[str] = set()
    for pattern in patterns:
        matched = fnmatch.filter(by_name, pattern)
        if not matched:
            closest = difflib.get_close_matches(pattern, by_name, cutoff=0)
            raise PipelineError(
                f"no task matches {pattern!r}",
                expected="a pattern such as " + " or ".join(closest),
                remedy="list all tasks by `python -m pipeline tasks`",
            )
        chosen.update(matched)
    return [task for name, task in by_name.items() if name in chosen]
