"""What `validate` would reject at the end of a run is rejected where a task, a rewrite or a demonstration is read."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.axes import to_json
from pipeline.axes.language import list_rewrites
from pipeline.axes.language_lint import lint
from pipeline.compute.pool import loop
from pipeline.config import Config, DemosConfig
from pipeline.libero import hdf5
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import SUITES, find_task, tasks
from pipeline.types import Task
from pipeline.validation.checks import CHECKS
from pipeline.validation.demonstrations import check

BOWL = find_task("libero_goal", "put_the_bowl_on_the_plate")

REJECTED = {
    "put the 2nd bowl on the plate": "2",
    "put the bowl/cup on the plate": "/",
    "put the_bowl on the plate": "_",
    "set the scene and put the bowl on the plate": "scene",
    "in this demo put the bowl on the plate": "demo",
    "put the bowl on the plate for a benchmark": "benchmark",
}
"""Instruction to what of it is named."""

TAKEN = (
    "after the demolition next door put the bowl on the plate",
    "the scenery is nice so put the bowl on the plate",
    "dinner is for two so put the bowl on the plate",
)


def recorded(folder: Path, gripper: float = 1.0) -> None:
    """A demonstration of LIBERO's task, with another command of the gripper at one step."""
    demo = StarterSource().demonstration(BOWL)
    actions, states = demo.actions.copy(), np.tile(demo.init_state, (len(demo.actions), 1))
    actions[5, 6] = gripper
    hdf5.write(folder, BOWL, [hdf5.Recording(actions, states, states[:, :9], "<mujoco/>", {})])


@pytest.mark.parametrize(("instruction", "named"), REJECTED.items())
def test_a_task_of_ones_own(instruction: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    definition = tmp_path / "tasks" / "my_suite" / "bowl_away.bddl"
    definition.parent.mkdir(parents=True)
    text = BOWL.bddl_file.read_text()
    assert "(:language Put the bowl on the plate)" in text
    definition.write_text(text.replace("Put the bowl on the plate", instruction))
    recorded(tmp_path / "own" / "my_suite" / "bowl_away_demo.hdf5")
    said = {"root": "own", "tasks": ["my_suite/*"]}
    with pytest.raises(ValidationError) as caught:
        Config.model_validate({"name": "own", "demos": said, "plan": {"episodes": {"camera": 1}}})
    (fault,) = check(Path("own"), 0, loop).faults
    for told in (str(caught.value), fault):
        assert f"{definition}: the instruction {instruction!r} has {named!r}" in told
    assert "rename" not in fault


def worded(task: Task, text: str, bank: Path | None = None) -> list[str]:
    """What `validate` finds wrong with an instruction; of a bank, it is one of its rewrites."""
    rewrites = [one for one in list_rewrites(task, bank=bank) if one.text == text] if bank else []
    row = {"suite": task.suite, "task": task.name, "instruction": text, "perturbations": to_json(rewrites)}
    case: Any = SimpleNamespace(row=row, task=task, bank=bank, finding=lambda *told: told[1])
    found: Any = CHECKS["wording"].find(case)
    return list(found)


@pytest.mark.parametrize(("text", "named"), [*REJECTED.items(), *dict.fromkeys(TAKEN).items()])
def test_a_rewrite_of_ones_own(text: str, named: str | None, tmp_path: Path) -> None:
    if named:
        assert lint(text, BOWL, "distraction") == "file-name debris"
        assert worded(BOWL, text)[-1] == f"instruction {text!r} has {named!r}"
    else:
        bank = tmp_path / "bank.yaml"
        bank.write_text(json.dumps({BOWL.suite: {BOWL.name: {"distraction": [text]}}}))
        assert worded(BOWL, text, bank) == []


def test_a_gripper_between_open_and_closed(tmp_path: Path) -> None:
    file = tmp_path / BOWL.suite / f"{BOWL.name}_demo.hdf5"
    for gripper, told in (
        (-1.0, None),
        (1.0, None),
        (0.2, "the gripper has the command 0.2"),
        (0.0, "the gripper has the command 0"),
    ):
        recorded(file, gripper)
        faults = [
            str(problem.error)
            for problem in DemosConfig(root=tmp_path, tasks=(f"{BOWL.suite}/{BOWL.name}",)).index().problems
        ]
        assert faults == check(tmp_path, 0, loop).faults
        assert [fault.split("\n")[0] for fault in faults] == ([f"{file} data/demo_0: {told}"] if told else [])


def test_liberos_instructions_pass() -> None:
    assert not [fault for suite in SUITES for task in tasks(suite) for fault in worded(task, task.instruction)]
