"""docs/own-tasks.md is true: its files are valid, its arenas are LIBERO's, and a run needs the fields that it lists."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import pytest
from conftest import BOWL, REPOSITORY, link_testset, starter_demo

from pipeline.axes.language import deal
from pipeline.compute.pool import loop
from pipeline.config import Config, load
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.starts import recorded_start
from pipeline.libero.tasks import SUITES, select_tasks, tasks
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.planning import plan
from pipeline.testset.benchmark import TestSet
from pipeline.testset.own_tasks import reject_test_tasks
from pipeline.types import Task, Trajectory
from pipeline.validation.demonstrations import CheckedDemos, check

PAGE = (REPOSITORY / "docs" / "own-tasks.md").read_text()
FILE = re.compile(r"^```\w+\n([;#] (\S+)\n.*?)^```", re.MULTILINE | re.DOTALL)
"""A block of the page whose first line is a comment with the name of a file."""

CONFIG = Path("configs/table.yaml")
DEMO = "data/demo_0"


def rows_of(heading: str) -> list[list[str]]:
    """The cells of the table under a heading of the page."""
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return rows[2:]


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    """The configuration of the page, in a folder with the files of the page."""
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    for text, name in FILE.findall(PAGE):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return load(CONFIG)


def test_the_files_of_the_page_are_valid(config: Config) -> None:
    (task,) = select_tasks(config.demos.tasks)
    assert str(task) == "table/lay_the_bowl_on_the_plate"
    assert task.instruction == "lay the bowl on the plate"
    definition = bddl.read(task.bddl_file)
    assert (definition.arena, definition.targets) == ("tabletop", ("akita_black_bowl_1",))
    assert definition.centres_m["akita_black_bowl_1"] == pytest.approx((-0.09, 0.0))
    reject_test_tasks([task])
    assert config.plan.axes.language is not None
    assert len(deal(task, bank=config.plan.axes.language.bank)) == 2


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
    (command,) = re.findall(r"^python (-c .*)$", PAGE, re.MULTILINE)
    done = subprocess.run(
        [sys.executable, *shlex.split(command)], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert (Path(done.stdout.strip()) / "libero_goal" / f"{BOWL.name}.bddl").is_file()


def recorded(task: Task, config: Config) -> Trajectory:
    """The starter set's demonstration of the bowl, executed in the scene of the page."""
    demo = starter_demo(BOWL)
    with closing(Environment(BOWL)) as source, closing(Environment(task)) as environment:
        source.restore(recorded_start(demo, source.place_fixtures(0)))
        model_xml = environment.reset(0)
        for joint in environment.sim.model.joint_names:
            environment.sim.data.set_joint_qpos(joint, source.sim.data.get_joint_qpos(joint))
        demo = replace(demo, task=task, init_state=environment.state, model_xml=model_xml)
        return replay(environment, demo, "recorded", config.replay)


def write(path: Path, fields: Mapping[str, Any]) -> None:
    """Write an HDF5 file with some fields: attributes, such as ``data bddl_file_name``, and datasets."""
    with h5py.File(path, "w") as file:
        for name, value in fields.items():
            node, _, attribute = name.partition(" ")
            if attribute:
                file.require_group(node).attrs[attribute] = value
            else:
                file[node] = value


def required() -> Iterator[str]:
    """The fields of the page's table that a recording must have."""
    for field, _, _, is_required, _ in rows_of("Recordings"):
        if is_required == "yes":
            yield field.replace("`", "")


@pytest.mark.slow
def test_a_recording_with_the_required_fields_passes_the_check_and_is_planned(config: Config) -> None:
    assert config.demos.root is not None
    (task,) = select_tasks(config.demos.tasks)
    trajectory = recorded(task, config)
    assert trajectory.verdict.kept
    states = trajectory.states[:-1]
    content = {
        f"{DEMO}/actions": trajectory.actions,
        f"{DEMO}/states": states,
        f"{DEMO} model_file": trajectory.model_xml,
        "data bddl_file_name": str(task.bddl_file),
    }
    assert {*required()} == {*content}
    path = config.demos.root / task.suite / f"{task.name}_demo.hdf5"
    path.parent.mkdir(parents=True)
    write(path, content)
    assert check(config.demos.root, 1, loop, config.replay) == CheckedDemos(files=1, demonstrations=1, replayed=1)
    (entry,) = HDF5Source(config.demos.root).index([task]).entries
    rows = plan.make([entry], config.plan, config.replay, TestSet(()))
    assert {row.axis for row in rows} == {"clean", *config.plan.episodes}
    for field in content:
        write(path, {name: value for name, value in content.items() if name != field})
        assert HDF5Source(config.demos.root).index([task]).problems, field
