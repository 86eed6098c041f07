"""The own task of docs/own-tasks.md: its files, and a recording of it from a demonstration of LIBERO."""

import re
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
from checkout import REPOSITORY, link_testset
from short_demonstrations import BOWL, starter_demo

from pipeline.config import ReplayConfig
from pipeline.libero.starts import recorded_start
from pipeline.physics.environment import Environment
from pipeline.physics.replay import replay
from pipeline.types import Task, Trajectory

PAGE = (REPOSITORY / "docs" / "own-tasks.md").read_text()
FILE = re.compile(r"^```\w+\n([;#] (\S+)\n.*?)^```", re.MULTILINE | re.DOTALL)
"""A block of the page whose first line is a comment with the name of a file."""

DEMO = "data/demo_0"


def write_files(folder: Path) -> None:
    """Write the files of the page into a folder that has the test set."""
    link_testset(folder)
    for text, name in FILE.findall(PAGE):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def recorded(task: Task, replay_config: ReplayConfig) -> Trajectory:
    """The starter set's demonstration of the bowl, executed in the scene of the page."""
    demo = starter_demo(BOWL)
    with closing(Environment(BOWL)) as source, closing(Environment(task)) as environment:
        source.restore(recorded_start(demo, source.place_fixtures(0)))
        model_xml = environment.reset(0)
        for joint in environment.sim.model.joint_names:
            environment.sim.data.set_joint_qpos(joint, source.sim.data.get_joint_qpos(joint))
        demo = replace(demo, task=task, init_state=environment.state, model_xml=model_xml)
        return replay(environment, demo, "recorded", replay_config)


def content_of(task: Task, trajectory: Trajectory) -> dict[str, Any]:
    """The required fields of a file with one recording: datasets, and attributes such as ``data bddl_file_name``."""
    return {
        f"{DEMO}/actions": trajectory.actions,
        f"{DEMO}/states": trajectory.states[:-1],
        f"{DEMO} model_file": trajectory.model_xml,
        "data bddl_file_name": str(task.bddl_file),
    }


def write(path: Path, fields: Mapping[str, Any]) -> None:
    """Write an HDF5 file with some fields."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, value in fields.items():
            node, _, attribute = name.partition(" ")
            if attribute:
                file.require_group(node).attrs[attribute] = value
            else:
                file[node] = value
