"""What lies in the user's own files is noticed when it changes."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from checkout import link_testset
from short_demonstrations import STOVE
from short_runs import run_in

from pipeline.run import inputs
from pipeline.run.run import Run
from pipeline.stages import STAGES, make_plan, perform, reason_to_run


def test_a_file_is_known_by_its_content_and_a_large_one_by_its_time(tmp_path: Path) -> None:
    small, large = tmp_path / "small", tmp_path / "large"
    small.write_text("one")
    with large.open("wb") as opened:
        opened.truncate(16_000_001)
    before = {file: inputs._state(file) for file in (small, large)}
    for file in before:
        os.utime(file, ns=(1, 1))
    assert [inputs._state(file) == state for file, state in before.items()] == [True, False]
    small.write_text("two")
    assert inputs._state(small) != before[small]


def test_a_file_that_changes_while_the_plan_is_made_leads_to_another_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    bank = tmp_path / "bank.yaml"
    texts = ["please switch on the stove at once for the soup"]
    bank.write_text(yaml.safe_dump({STOVE.suite: {STOVE.name: {"paraphrase": texts}}}))
    plan = {"axes": {"language": {"bank": str(bank)}}, "episodes": {"language": 1}}
    config = run_in(tmp_path / "run", demos={"tasks": [str(STOVE)]}, plan=plan).config

    def plan_and_edit(run: Run) -> None:
        make_plan(run)
        bank.write_text(bank.read_text() + "# edited\n")

    with monkeypatch.context() as patch:
        patch.setitem(STAGES, "plan", replace(STAGES["plan"], work=plan_and_edit))
        perform("plan", Run(config))
    assert reason_to_run("plan", Run(config)) is not None
    perform("plan", Run(config))
    assert reason_to_run("plan", Run(config)) is None
