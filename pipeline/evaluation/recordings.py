"""Demonstrations in which episodes start and which scripted policies repeat: the starter set's, or a user's files."""

from functools import cache
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.files import Edition, edition
from pipeline.libero.demonstrations import DemoEntry, HDF5Source, StarterSource
from pipeline.libero.hdf5 import demo_file
from pipeline.libero.tasks import SUITES
from pipeline.types import Demo, Task


def demonstration(task: Task, number: int, root: Path | None) -> Demo:
    """Load the demonstration of an episode.

    Args:
        task: the task.
        number: number of the episode; the demonstrations of a task repeat after the last one.
        root: folder of the recordings, ``<root>/<suite>/<task>_demo.hdf5``; `None` for the starter set, which has one
            demonstration of each of LIBERO's tasks.

    Raises:
        PipelineError: if the task has no usable demonstration.
    """
    if root is None:
        return StarterSource().demonstration(_libero(task))
    entries = _entries(task, root)
    return HDF5Source(root).load(entries[number % len(entries)].demo_id)


def content_of(task: Task, number: int, root: Path) -> str:
    """Return the SHA-256 of the demonstration in a user's file that ``demonstration`` loads.

    Raises:
        PipelineError: if the task has no usable demonstration.
    """
    entries = _entries(task, root)
    return entries[number % len(entries)].sha256


def count_of(task: Task, root: Path | None) -> int:
    """Return the number of usable demonstrations of a task.

    Raises:
        PipelineError: if the task has no usable demonstration.
    """
    if root is None:
        _libero(task)
        return 1
    return len(_entries(task, root))


def longest_steps(task: Task, root: Path) -> int:
    """Return the number of actions of the longest usable demonstration of a task.

    Raises:
        PipelineError: if the task has no usable demonstration.
    """
    return max(entry.steps for entry in _entries(task, root))


def _libero(task: Task) -> Task:
    """Return the task, which must be LIBERO's.

    Raises:
        PipelineError: if the task is a user's own.
    """
    if task.suite not in SUITES:
        raise PipelineError(
            f"the starter set has no demonstration of your task {task}",
            where="demos",
            expected=f"the folder that has {task.suite}/{task.name}_demo.hdf5",
            remedy="add --demos DIR; only a policy on `--source libero`, from resets, needs no demonstrations",
        )
    return task


def _entries(task: Task, root: Path) -> list[DemoEntry]:
    """List the usable demonstrations in the file of a task.

    Raises:
        PipelineError: if there is no such file, or no usable demonstration in it.
    """
    file = demo_file(root, task)
    try:
        return _entries_of(edition(file), task, root)
    except OSError as error:
        raise PipelineError(
            f"the recordings of {task} cannot be read ({error.strerror})",
            where=file,
            expected="<demos>/<suite>/<task>_demo.hdf5",
            remedy="correct --demos, or move the file to this place",
        ) from error


@cache
def _entries_of(version: Edition, task: Task, root: Path) -> list[DemoEntry]:
    """List the usable demonstrations of one edition of a file.

    Raises:
        PipelineError: if there is none; it is the first demonstration's error.
    """
    index = HDF5Source(root).index([task])
    if not index.entries:
        for problem in index.problems:
            # The folder may have files of no task, such as <task>_demo_old.hdf5.
            if problem.name == str(task) or problem.name.startswith(f"{task}/"):
                raise problem.error
        raise PipelineError(
            "the file has no demonstration",
            where=version.path,
            expected="at least one group data/demo_<number>",
            remedy="check the folder of --demos with `python -m pipeline demos check`",
        )
    return index.entries
