"""LIBERO's task list, and tasks of one's own beside it."""

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
"""Control steps after settling before an episode has failed, as OpenVLA and LIBERO-Plus limit them."""

Same = Literal["task", "scene"]
"""What two changes may have in common: the LIBERO task, or the scene that their tasks begin in."""

_OF_FILES = ("scene", "suite", "libero", "bddl", "benchmark", "hdf", "demo")
_DEBRIS = re.compile(rf"[_\d/\\]|\b({'|'.join(_OF_FILES)})\b", re.IGNORECASE)
WITHOUT_DEBRIS = f"an instruction without digits, _, /, \\ and the words {', '.join(_OF_FILES)}, as of a file's name"

_TESTED = re.compile(
    r"(?P<base>.+?)(?:_language_\d+|_view(?:_\d+){5}_initstate_\d+|_noise_\d+|_table_\d+|_tb_\d+|_light_\d+|_add_\d+"
    r"|(?:_moved)?_level\d_sample\d)+"
)
"""Names of LIBERO-Plus's test tasks: that of a LIBERO task, and what is changed."""

OWN = Path("tasks")
"""Tasks of one's own: ``<suite>/<task>.bddl`` below this folder of the one that a run is started in, as workers are."""


def suites() -> tuple[str, ...]:
    """LIBERO's suites, then those of one's own.

    Raises:
        PipelineError: when one of one's own has a name that cannot be used.
    """
    own = sorted(folder.name for folder in OWN.glob("*") if any(folder.glob("*.bddl")))
    for name in own:
        # Datasets are called after the suite without libero_, some with val at the end, and OpenVLA-OFT takes
        # those with aloha in it for another robot's.
        if f"libero_{name}" in SUITES or not re.fullmatch(r"(?!libero_|val$|.*aloha)[a-z][a-z0-9_]*(?<!_val)", name):
            raise PipelineError(
                f"a suite cannot be called {name!r}",
                where=OWN / name,
                expected="lower-case letters, digits and _; none of LIBERO's suites, with or without libero_; no aloha "
                "in it, and neither val nor _val at its end",
                remedy="rename the folder, and that of its demonstrations",
            )
    return (*SUITES, *own)


def tasks(suite: str) -> tuple[Task, ...]:
    """A suite's tasks, in the order of LIBERO's list; those of one's own by name, with the instruction of their file.

    Raises:
        PipelineError: when there is no such suite, or one of one's own has an instruction that cannot be used.
    """
    if suite in SUITES:
        return _listed(suite)
    if suite not in suites():
        raise PipelineError(f"unknown suite {suite!r}", expected=" or ".join(suites()))
    files = sorted((OWN / suite).absolute().glob("*.bddl"))
    own = tuple(Task(suite, file.stem, bddl.read(file).language, file) for file in files)
    for task in own:
        _reject_unusable(task)
    return own


def _reject_unusable(task: Task) -> None:
    """Check the name and the instruction of a task of one's own.

    Raises:
        PipelineError: when the name is that of a test task, or the instruction is empty or has debris.
    """
    if base := base_of_test(task.name):
        raise PipelineError(
            f"is called as a test task of LIBERO-Plus, which perturbs {base}",
            where=task.bddl_file,
            expected="a task that the benchmark does not test",
            remedy="leave test tasks out of the suite: a policy that is trained on them cannot be tested",
        )
    if not task.instruction.strip():
        raise PipelineError(
            "the instruction is empty", where=task.bddl_file, expected="(:language <a sentence>)", remedy="write one"
        )
    if found := debris(task.instruction):
        raise PipelineError(
            f"the instruction {task.instruction!r} has {found!r}",
            where=task.bddl_file,
            expected=WITHOUT_DEBRIS,
            remedy="write numbers as words, and others in place of these, in (:language ...)",
        )


def debris(instruction: str) -> str | None:
    """What an instruction has only when it was made from a file's name; None where there is nothing."""
    found = _DEBRIS.search(instruction)
    return found and found[0]


def base_of_test(name: str) -> str | None:
    """The LIBERO task that a test task of LIBERO-Plus perturbs, by the test task's name; `None` for other names."""
    match = _TESTED.fullmatch(name)
    known = match is not None and any(match["base"] in _names()[suite] for suite in SUITES)
    return match["base"] if match and known else None


@cache
def _listed(suite: str) -> tuple[Task, ...]:
    folder = libero_folder() / "bddl_files" / suite
    # LIBERO words an instruction as the task's name without its scene.
    worded = {name: re.sub(r"^[A-Z_]*SCENE\d+_", "", name).replace("_", " ") for name in _names()[suite]}
    return tuple(Task(suite, name, text, folder / f"{name}.bddl") for name, text in worded.items())


@cache
def _names() -> Any:
    """Suite to LIBERO's list of names; only the file that holds it is run."""
    return run_path(str(libero_folder() / "benchmark" / "libero_suite_task_map.py"))["libero_task_map"]


def find_task(suite: str, name: str) -> Task:
    """The task of that name.

    Raises:
        PipelineError: when the suite has none, naming the closest.
    """
    by_name = {task.name: task for task in tasks(suite)}
    if name not in by_name:
        closest = difflib.get_close_matches(name, by_name, cutoff=0)
        raise PipelineError(f"{suite} has no task {name!r}", expected=" or ".join(closest))
    return by_name[name]


def exceeds_step_limit(suite: str, steps: int) -> bool | None:
    """Whether an evaluation ends before so many control steps are executed; None for suites of one's own."""
    return steps > STEP_LIMITS[suite] if suite in STEP_LIMITS else None


def shared(task: Task, same: Same) -> Hashable:
    """Equal for tasks that have the ``same`` in common."""
    return (task.suite, task.name) if same == "task" else bddl.read(task.bddl_file).scene


def select_tasks(patterns: Iterable[str]) -> list[Task]:
    """The tasks whose ``<suite>/<task>`` matches any of the shell-style patterns, in LIBERO's order.

    Raises:
        PipelineError: when a pattern matches nothing.
    """
    known = {str(task): task for suite in suites() for task in tasks(suite)}
    chosen: set[str] = set()
    for pattern in patterns:
        matched = fnmatch.filter(known, pattern)
        if not matched:
            closest = difflib.get_close_matches(pattern, known, cutoff=0)
            raise PipelineError(f"no task matches {pattern!r}", expected="a pattern such as " + " or ".join(closest))
        chosen.update(matched)
    return [task for name, task in known.items() if name in chosen]
