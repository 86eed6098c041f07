"""docs/own-tasks.md is true: its files are valid, its arenas are LIBERO's, and a run needs the fields that it lists."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import own_task
import pytest
from checkout import REPOSITORY
from short_demonstrations import BOWL

from pipeline.axes.language import list_rewrites
from pipeline.compute.pool import loop
from pipeline.config import Config, load
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.tasks import SUITES, select_tasks, tasks
from pipeline.planning import plan
from pipeline.testset.benchmark import TestSet
from pipeline.testset.own_tasks import reject_test_tasks
from pipeline.validation.demonstrations import CheckedDemos, check

CONFIG = Path("configs/table.yaml")


def rows_of(heading: str) -> list[list[str]]:
    """The cells of the table under a heading of the page."""
    section = own_task.PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return rows[2:]


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    """The configuration of the page, in a folder with the files of the page."""
    monkeypatch.chdir(tmp_path)
    own_task.write_files(tmp_path)
    return load(CONFIG)


@pytest.mark.slow
def test_the_files_of_the_page_are_valid(config: Config) -> None:
    (task,) = select_tasks(config.demos.tasks)
    assert str(task) == "table/lay_the_bowl_on_the_plate"
    assert task.instruction == "lay the bowl on the plate"
    definition = bddl.read(task.bddl_file)
    assert (definition.arena, definition.targets) == ("tabletop", ("akita_black_bowl_1",))
    assert definition.centres_m["akita_black_bowl_1"] == pytest.approx((-0.09, 0.0))
    reject_test_tasks([task])
    assert config.plan.axes.language is not None
    assert len(list_rewrites(task, bank=config.plan.axes.language.bank)) == 2


def test_the_arenas_of_the_page_are_liberos() -> None:
    definitions = [bddl.read(task.bddl_file) for suite in SUITES for task in tasks(suite)]
    listed = [[cell.strip("`") for cell in row] for row in rows_of("The definition")]
    assert {arena for arena, _, _ in listed} == {*ARENAS}
    for arena, problem, surface in listed:
        name, category = surface.split(" - ")
        there = [definition for definition in definitions if definition.arena == arena]
        assert there
        for definition in there:
            assert definition.problem == problem.lower()
            assert definition.fixtures[name] == category


def test_the_command_of_the_page_prints_the_folder_of_liberos_files() -> None:
    (command,) = re.findall(r"^python (-c .*)$", own_task.PAGE, re.MULTILINE)
    done = subprocess.run(
        [sys.executable, *shlex.split(command)], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert (Path(done.stdout.strip()) / "libero_goal" / f"{BOWL.name}.bddl").is_file()


def required() -> Iterator[str]:
    """The fields of the page's table that a recording must have."""
    for field, _, _, is_required, _ in rows_of("Recordings"):
        if is_required == "yes":
            yield field.replace("`", "")


@pytest.mark.slow
def test_a_recording_with_the_required_fields_passes_the_check_and_is_planned(config: Config) -> None:
    assert config.demos.root is not None
    (task,) = select_tasks(config.demos.tasks)
    trajectory = own_task.recorded(task, config.replay)
    assert trajectory.verdict.kept
    content = own_task.content_of(task, trajectory)
    assert {*required()} == {*content}
    path = config.demos.root / task.suite / f"{task.name}_demo.hdf5"
    own_task.write(path, content)
    assert check(config.demos.root, 1, loop, config.replay) == CheckedDemos(files=1, demonstrations=1, replayed=1)
    (entry,) = HDF5Source(config.demos.root).index([task]).entries
    rows = plan.make([entry], config.plan, config.replay, TestSet(()))
    assert {row.axis for row in rows} == {"clean", *config.plan.episodes}
    for field in content:
        own_task.write(path, {name: value for name, value in content.items() if name != field})
        assert HDF5Source(config.demos.root).index([task]).problems, field
