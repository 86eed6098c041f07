"""LIBERO's task list, read without importing LIBERO."""

from __future__ import annotations

from pathlib import Path

import pytest
from libero.libero import get_libero_path
from libero.libero.benchmark import task_maps

from pipeline.libero.tasks import SUITES, tasks


@pytest.mark.parametrize("suite", SUITES)
def test_names_instructions_and_files_are_liberos(suite: str) -> None:
    folder = Path(get_libero_path("bddl_files")).resolve() / suite
    theirs = [(known.name, known.language, folder / known.bddl_file) for known in task_maps[suite].values()]
    assert [(task.name, task.instruction, task.bddl_file) for task in tasks(suite)] == theirs
